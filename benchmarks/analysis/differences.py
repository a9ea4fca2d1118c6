"""Every method of a run against a reference, with verdicts, and how many captures those that are unclear would take."""

import math
from collections.abc import Sequence
from dataclasses import asdict

import pandas as pd

from benchmarks.analysis.results import RANKED_SPLITS, compare, foreground, methods_of
from benchmarks.analysis.statistics import Comparison, corrected
from benchmarks.analysis.style import reference_of

COLUMNS = ["scene", "split", "reference", "method", *Comparison.__dataclass_fields__, "verdict", "needed"]


def differences(rows: pd.DataFrame, *, splits: Sequence[str] = RANKED_SPLITS) -> pd.DataFrame:
    """Foreground PSNR of ASH (or ASH+) minus that of every other method that is no oracle, in dB: `COLUMNS`.

    `rows`: of unperturbed captures, of any scenes (`benchmarks.analysis.results.load`).

    A method is compared with the one of its pair (`benchmarks.analysis.style.reference_of`), ASH+ with ASH.
    `needed`: how many captures would give a verdict where there is none; NaN if there is one, or a single capture.

    p is corrected over the methods and splits of a scene: splits asked for apart cost the others no power.
    """
    table = []
    for scene, of_scene in rows.groupby("scene", sort=False):
        methods = methods_of(of_scene, oracles=False)
        compared = [
            ({"scene": scene, "split": split, "reference": reference, "method": method}, comparison)
            for split in splits
            for method in methods
            if (reference := reference_of(method, methods)) is not None
            and (comparison := compare(of_scene, reference, method, foreground(split))) is not None
        ]
        for (row, _), each in zip(compared, corrected([each for _, each in compared]), strict=True):
            needed = each.captures_needed() if each.verdict == "unclear" else math.nan
            table.append({**row, **asdict(each), "verdict": each.verdict, "needed": needed})
    return pd.DataFrame(table, columns=COLUMNS)
