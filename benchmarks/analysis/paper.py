"""Our rows beside those of the ASH paper's tables, and our renders scored by the conventions of others.

Numbers: Pang et al., CVPR 2024, Tables 1 to 3, and the supplement's tables on design and on SMPL; LPIPS times 1000.
Captured data, 1285x940, GPU-weeks: levels cannot be compared with ours, orders can.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

import pandas as pd

from benchmarks.analysis.results import Quantity, RunTables

SEEN = {  # by the paper's rows that were trained on a part of its views, under our names
    "cams_12": "12 of 120 cameras",
    "cams_30": "30 of 120 cameras",
    "cams_60": "60 of 120 cameras",
    "wo_mot_truncated": "40 s of footage",
}
STAND_IN = {"wo_mot_truncated": "wo_mot"}  # Where the first was not run, the second is compared, and that is said.


@dataclass(frozen=True, slots=True)
class PaperRow:
    """A row of the paper: PSNR in dB and LPIPS x1000 on seen and on unseen motion; `method` is ours, None: not here.

    `note`: how the method that stands in differs from the paper's.
    """

    title: str
    method: str | None
    view: tuple[float, float]
    pose: tuple[float, float]
    note: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class PaperTable:
    """One of the paper's tables, for one of our scenes."""

    title: str
    scene: str
    rows: tuple[PaperRow, ...]


PAPER_TABLES = (
    PaperTable(
        title="Comparison, tight clothes (Tables 1 and 2)",
        scene="tight",
        rows=(
            PaperRow("TAVA", None, (24.61, 62.26), (28.30, 37.47)),
            PaperRow("NA", None, (30.33, 23.71), (28.78, 25.78)),
            PaperRow("HDHumans", None, (30.98, 15.09), (28.17, 20.69)),
            PaperRow("DDC", "ddc", (31.21, 22.56), (27.77, 30.16)),
            PaperRow("ASH", "ash", (35.84, 11.92), (28.90, 22.83)),
        ),
    ),
    PaperTable(
        title="Comparison, loose clothes (Tables 1 and 2)",
        scene="loose",
        rows=(
            PaperRow("TAVA", None, (27.31, 37.55), (26.31, 50.11)),
            PaperRow("NA", None, (25.30, 50.01), (25.03, 44.20)),
            PaperRow("HDHumans", None, (29.24, 15.79), (26.71, 22.75)),
            PaperRow("DDC", "ddc", (28.10, 31.68), (26.43, 32.22)),
            PaperRow("ASH", "ash", (35.47, 8.30), (27.12, 20.22)),
        ),
    ),
    PaperTable(
        title="Ablation of components (Table 3)",
        scene="loose",
        rows=(
            PaperRow("w/o mot.", "wo_mot_truncated", (27.19, 33.16), (26.86, 32.35)),
            PaperRow("w/o disp.", "wo_disp", (33.21, 17.34), (27.33, 25.32)),
            PaperRow("w/ 128.res.", "res_128", (35.15, 11.26), (27.13, 22.00)),
            PaperRow("w/ 512.res.", "res_512", (35.28, 8.60), (27.00, 21.13)),
            PaperRow("ASH", "ash", (35.47, 8.30), (27.13, 20.22)),
        ),
    ),
    PaperTable(
        title="Ablation of design (supplement)",
        scene="loose",
        rows=(
            PaperRow("w/ MLP", "mlp", (28.05, 34.93), (26.79, 35.00)),
            PaperRow("ASH", "ash", (35.47, 8.30), (27.13, 20.22)),
        ),
    ),
    PaperTable(
        title="Ablation of cameras (supplement)",
        scene="loose_12_cameras",
        rows=(
            PaperRow("w/ 12.cam", "cams_12", (33.50, 10.76), (26.96, 21.66)),
            PaperRow("w/ 30.cam", "cams_30", (35.37, 8.52), (27.08, 20.76)),
            PaperRow("w/ 60.cam", "cams_60", (35.49, 8.32), (27.14, 20.42)),
            PaperRow("ASH", "ash", (35.47, 8.30), (27.13, 20.22)),
        ),
    ),
    PaperTable(
        title="Bare-body template (supplement)",
        scene="loose",
        rows=(
            PaperRow("SMPL", "smpl", (34.93, 14.90), (28.75, 24.87)),
            PaperRow("ASH", "ash", (35.47, 8.30), (27.13, 20.22)),
        ),
    ),
)


def tables_beside(tables: RunTables) -> tuple[PaperTable, ...]:
    """The paper's tables of which at least two methods were run."""
    beside = []
    for table in PAPER_TABLES:
        run = tables.methods(table.scene)
        rows = tuple(_as_run(row, run) for row in table.rows)
        if sum(row.method in run for row in rows) > 1:
            beside.append(replace(table, rows=rows))
    return tuple(beside)


def _as_run(row: PaperRow, run: Collection[str]) -> PaperRow:
    """The row with our method that was run in its place, if another one was."""
    if row.method is None or row.method in run or STAND_IN.get(row.method) not in run:
        return row
    note = f"{row.title}: ours saw all frames, the paper's {SEEN[row.method]}."
    return replace(row, method=STAND_IN[row.method], note=note)


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
