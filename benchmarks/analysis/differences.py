"""Every method of a run against a reference, with verdicts, and how small a difference more captures would show."""

import math
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
import pandas as pd

from benchmarks.analysis.results import RANKED_SPLITS, RunTables, compare, foreground
from benchmarks.analysis.statistics import Comparison, corrected, detectable
from benchmarks.analysis.style import REFERENCES, reference_of

COLUMNS = ["scene", "split", "reference", "method", *Comparison.__dataclass_fields__, "verdict", "needed"]
CAPTURES = (1, 2, 4, 8, 16)  # for which reports print the detectable difference


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
            if method != REFERENCES[0]
            and (reference := reference_of(method, methods)) is not None
            and (comparison := compare(tables.of(scene), reference, method, foreground(split))) is not None
        ]
        for (row, _), each in zip(compared, corrected([each for _, each in compared]), strict=True):
            needed = each.captures_needed() if each.verdict == "unclear" else math.nan
            rows.append({**row, **asdict(each), "verdict": each.verdict, "needed": needed})
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
