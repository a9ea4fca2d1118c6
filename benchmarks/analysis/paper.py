"""What the ASH paper's rows were trained on, and our renders scored by the conventions of others.

The paper's tables are `[[table]]` in `benchmarks/suites/paper.toml` and `cameras.toml`.
"""

import pandas as pd

from benchmarks.analysis.results import Quantity, RunTables

SEEN = {  # by the paper's rows that were trained on a part of its views, under our names
    "cams_12": "12 of 120 cameras",
    "cams_30": "30 of 120 cameras",
    "cams_60": "60 of 120 cameras",
    "wo_mot_truncated": "40 s of footage",
}

CONVENTIONS = {  # region, and who scores so
    "foreground": "ours: foreground",
    "release_crop": "ASH release: masked crop on white",
    "white_frame": "AnimatableGaussians: frame on white",
    "full": "nerfbaselines: whole frame",
}


def conventions(tables: RunTables, scene: str, split: str, metric: str) -> pd.DataFrame | None:
    """The same renders scored by the conventions of others: methods by `CONVENTIONS`.

    Oracles are left out; None where fewer than two methods were scored so.
    """
    names = tables.methods(scene, oracles=False)
    by_region = {region: tables.values(scene, Quantity(split, region, metric), names) for region in CONVENTIONS}
    values = pd.DataFrame(by_region, index=list(names))
    return None if len(names) < 2 or values.isna().any(axis=None) else values
