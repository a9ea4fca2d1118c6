"""Every method of a run against a reference, with verdicts, and how many captures those that are unclear would take."""

import math
from collections.abc import Sequence
from dataclasses import asdict

import pandas as pd

from benchmarks.analysis.results import RANKED_SPLITS, RunTables, compare, foreground
from benchmarks.analysis.statistics import Comparison, corrected
from benchmarks.analysis.style import reference_of

COLUMNS = ["scene", "split", "reference", "method", *Comparison.__dataclass_fields__, "verdict", "needed"]


def differences(
    tables: RunTables, *, splits: Sequence[str] = RANKED_SPLITS, scenes: Sequence[str] = ()
) -> pd.DataFrame:
    """Foreground PSNR of ASH (or ASH+) minus that of every other method that is no oracle, in dB: `COLUMNS`.

    A method is compared with the one of its pair (`benchmarks.analysis.style.reference_of`), ASH+ with ASH.
    `needed`: how many captures would give a verdict where there is none; NaN if there is one, or a single capture.

    p is corrected over the methods and splits of a scene: splits asked for apart cost the others no power.
    """
    rows = []
    for scene in scenes or tables.scenes:
        methods = tables.methods(scene, oracles=False)
        compared = [
            ({"scene": scene, "split": split, "reference": reference, "method": method}, comparison)
            for split in splits
            for method in methods
            if (reference := reference_of(method, methods)) is not None
            and (comparison := compare(tables.of(scene), reference, method, foreground(split))) is not None
        ]
        for (row, _), each in zip(compared, corrected([each for _, each in compared]), strict=True):
            needed = each.captures_needed() if each.verdict == "unclear" else math.nan
            rows.append({**row, **asdict(each), "verdict": each.verdict, "needed": needed})
    return pd.DataFrame(rows, columns=COLUMNS)
