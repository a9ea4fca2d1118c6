"""Results as one tidy table: a row per number, the same table for reports, gate and readers."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from ash.files import write_atomic
from benchmarks.cells import CellResult
from benchmarks.metrics import METRICS

COLUMNS = ("scene", "method", "seed", "split", "region", "metric", "value", "unit", "direction", "protocol")


def tidy(results: Sequence[CellResult]) -> pd.DataFrame:
    """One row per number of every cell, in the columns of `results.csv`."""
    rows = [
        (
            result.config.place,
            result.config.method,
            result.config.seed,
            row.split,
            row.region,
            row.metric,
            row.value,
            METRICS[row.metric].unit,
            METRICS[row.metric].direction,
            result.config.protocol,
        )
        for result in results
        for row in result.summary
    ]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def write_csv(path: Path, table: pd.DataFrame) -> None:
    """Write `results.csv`: numbers in full, so that nothing is lost on the way to another tool."""
    write_atomic(path, table.to_csv(index=False, lineterminator="\n").encode())
