"""Every method of a run against a reference, with verdicts, and how small a difference more captures would show."""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
import pandas as pd

from benchmarks.analysis.results import RANKED_SPLITS, RunTables, compare, foreground
from benchmarks.analysis.statistics import Comparison, corrected, detectable

COLUMNS = ["scene", "split", "method", *Comparison.__dataclass_fields__, "verdict"]
CAPTURES = (1, 2, 4, 8, 16)  # for which reports print the detectable difference


def differences(
    tables: RunTables, *, reference: str = "ash", splits: Sequence[str] = RANKED_SPLITS, scenes: Sequence[str] = ()
) -> pd.DataFrame:
    """Foreground PSNR of the reference minus that of every other method that is no oracle, in dB: `COLUMNS`.

    p is corrected over the methods and splits of a scene: splits asked for apart cost the others no power.
    """
    rows = []
    for scene in scenes or tables.scenes:
        compared = [
            (split, method, comparison)
            for split in splits
            for method in tables.methods(scene, oracles=False)
            if method != reference
            and (comparison := compare(tables.of(scene), reference, method, foreground(split))) is not None
        ]
        for (split, method, _), each in zip(compared, corrected([each for *_, each in compared]), strict=True):
            rows.append({"scene": scene, "split": split, "method": method, **asdict(each), "verdict": each.verdict})
    return pd.DataFrame(rows, columns=COLUMNS)


def detectable_effects(table: pd.DataFrame) -> pd.DataFrame:
    """By split and number of captures: the smallest true difference, dB, that so many captures show with 80 % power.

    `median` over the methods of `differences`, and `worst`. A single capture tells nothing about others.
    """
    rows = []
    for split, group in table[table["captures"] > 0].groupby("split", sort=False):
        spread = group["spread"]
        rows += [
            (split, count, detectable(float(np.median(spread)), count), detectable(float(spread.max()), count))
            for count in CAPTURES
        ]
    return pd.DataFrame(rows, columns=["split", "captures", "median", "worst"])
