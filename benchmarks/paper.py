"""Our rows beside those of the ASH paper's tables, and how far the two orders agree.

Numbers: Pang et al., CVPR 2024, Tables 1 to 3, and the supplement's tables on design and on SMPL; LPIPS times 1000.
Captured data, 1285x940, GPU-weeks: levels cannot be compared with ours, orders can.
"""

from dataclasses import dataclass

import numpy as np

from benchmarks.conventions import kendall
from benchmarks.scores import Score, Scores

RESAMPLES = 2000


@dataclass(frozen=True, kw_only=True, slots=True)
class PaperRow:
    """A row of the paper: PSNR in dB and LPIPS x1000 on seen and on unseen motion; `method` is ours, None: not here."""

    title: str
    method: str | None
    view: tuple[float, float]
    pose: tuple[float, float]


@dataclass(frozen=True, kw_only=True, slots=True)
class PaperTable:
    """One of the paper's tables, for one of our scenes."""

    title: str
    scene: str
    rows: tuple[PaperRow, ...]


def _row(title: str, method: str | None, view: tuple[float, float], pose: tuple[float, float]) -> PaperRow:
    return PaperRow(title=title, method=method, view=view, pose=pose)


PAPER_TABLES = (
    PaperTable(
        title="Comparison, tight clothes (Tables 1 and 2)",
        scene="tight",
        rows=(
            _row("TAVA", None, (24.61, 62.26), (28.30, 37.47)),
            _row("NA", None, (30.33, 23.71), (28.78, 25.78)),
            _row("HDHumans", None, (30.98, 15.09), (28.17, 20.69)),
            _row("DDC", "ddc", (31.21, 22.56), (27.77, 30.16)),
            _row("ASH", "ash", (35.84, 11.92), (28.90, 22.83)),
        ),
    ),
    PaperTable(
        title="Comparison, loose clothes (Tables 1 and 2)",
        scene="loose",
        rows=(
            _row("TAVA", None, (27.31, 37.55), (26.31, 50.11)),
            _row("NA", None, (25.30, 50.01), (25.03, 44.20)),
            _row("HDHumans", None, (29.24, 15.79), (26.71, 22.75)),
            _row("DDC", "ddc", (28.10, 31.68), (26.43, 32.22)),
            _row("ASH", "ash", (35.47, 8.30), (27.12, 20.22)),
        ),
    ),
    PaperTable(
        title="Ablation of components (Table 3)",
        scene="loose",
        rows=(
            _row("w/o mot.", "wo_mot", (27.19, 33.16), (26.86, 32.35)),
            _row("w/o disp.", "wo_disp", (33.21, 17.34), (27.33, 25.32)),
            _row("w/ 128.res.", "res_128", (35.15, 11.26), (27.13, 22.00)),
            _row("w/ 512.res.", "res_512", (35.28, 8.60), (27.00, 21.13)),
            _row("ASH", "ash", (35.47, 8.30), (27.13, 20.22)),
        ),
    ),
    PaperTable(
        title="Ablation of design (supplement)",
        scene="loose",
        rows=(
            _row("w/ MLP", "mlp", (28.05, 34.93), (26.79, 35.00)),
            _row("w/ 12.cam", "cams_12", (33.50, 10.76), (26.96, 21.66)),
            _row("w/ 30.cam", "cams_30", (35.37, 8.52), (27.08, 20.76)),
            _row("w/ 60.cam", "cams_60", (35.49, 8.32), (27.14, 20.42)),
            _row("ASH", "ash", (35.47, 8.30), (27.13, 20.22)),
        ),
    ),
    PaperTable(
        title="Bare-body template (supplement)",
        scene="loose",
        rows=(
            _row("SMPL", "smpl", (34.93, 14.90), (28.75, 24.87)),
            _row("ASH", "ash", (35.47, 8.30), (27.13, 20.22)),
        ),
    ),
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Agreement:
    """Kendall's tau of two orders of the same methods, with the interval that our spread over seeds leaves it."""

    split: str
    tau: float
    low: float | None
    high: float | None
    methods: int

    @property
    def text(self) -> str:
        """For a reader."""
        interval = "" if self.low is None else f" [{self.low:+.2f}, {self.high:+.2f}]"
        return f"{self.tau:+.2f}{interval} over {self.methods} methods"


@dataclass(frozen=True, kw_only=True, slots=True)
class Beside:
    """A table of the paper with ours: per row the paper's four numbers as printed, then ours."""

    title: str
    scene: str
    rows: tuple[tuple[str, ...], ...]
    agreements: tuple[Agreement, ...]


HEAD = ("PSNR", "LPIPS", "PSNR", "LPIPS", "PSNR", "FLIP", "LPIPS", "PSNR", "FLIP", "LPIPS", "ms per frame")
GROUPS = (("paper, seen motion", 2), ("paper, unseen motion", 2), ("novel view", 3), ("novel pose", 3), ("cost", 1))


def beside_the_paper(scores: Scores) -> tuple[Beside, ...]:
    """The paper's tables for which at least two methods were run."""
    found = []
    for table in PAPER_TABLES:
        ours = [row for row in table.rows if row.method in scores.methods(table.scene)]
        if len(ours) < 2:
            continue
        rows = tuple(
            (row.title, *_paper_numbers(row), *_our_numbers(scores, table.scene, row.method)) for row in table.rows
        )
        agreements = [_agreement(scores, table.scene, ours, split) for split in ("novel_view", "novel_pose")]
        known = tuple(agreement for agreement in agreements if agreement is not None)
        found.append(Beside(title=table.title, scene=table.scene, rows=rows, agreements=known))
    return tuple(found)


def _paper_numbers(row: PaperRow) -> tuple[str, ...]:
    return tuple(f"{number:.2f}" for pair in (row.view, row.pose) for number in pair)


def _our_numbers(scores: Scores, scene: str, method: str | None) -> tuple[str, ...]:
    if method is None or method not in scores.methods(scene):
        return ("n/a",) * 7
    found = []
    for split in ("novel_view", "novel_pose"):
        found.append(_text(scores.fg(scene, method, split), 2))
        found.append(_text(scores.fg(scene, method, split, "flip"), 3))
        found.append(_text(scores.get(scene, method, split, "full", "lpips"), 1))
    return (*found, _text(scores.get(scene, method, "speed", "", "frame_ms"), 1))


def _text(score: Score | None, decimals: int) -> str:
    if score is None:
        return "n/a"
    spread = "" if score.half_width is None else f" ± {score.half_width:.{decimals}f}"
    return f"{score.mean:.{decimals}f}{spread}"


def _agreement(scores: Scores, scene: str, rows: list[PaperRow], split: str) -> Agreement | None:
    """Tau between the paper's PSNR and ours; the interval by drawing seeds anew (percentiles of the bootstrap)."""
    paper = [row.view[0] if split == "novel_view" else row.pose[0] for row in rows]
    seeds = [scores.values(scene, str(row.method), split, "foreground", "psnr") for row in rows]
    if not all(seeds):
        return None
    tau, low, high = kendall(paper, [float(np.mean(values)) for values in seeds]), None, None
    if all(len(values) > 1 for values in seeds):
        rng = np.random.default_rng(0)
        drawn = [kendall(paper, [float(rng.choice(v, len(v)).mean()) for v in seeds]) for _ in range(RESAMPLES)]
        low, high = (float(q) for q in np.quantile(drawn, [0.025, 0.975]))
    return Agreement(split=split, tau=tau, low=low, high=high, methods=len(rows))
