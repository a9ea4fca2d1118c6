"""One comparison of the gate and its verdict."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Verdict = Literal["unchanged", "not worse", "worse", "better than explained", "not judged"]
Layer = Literal["rows", "protocol", "rendering", "training", "quality", "cost"]
LAYERS: tuple[Layer, ...] = ("rows", "protocol", "rendering", "training", "quality", "cost")
OUTCOMES: tuple[Verdict, ...] = ("worse", "better than explained", "not worse", "unchanged")  # the first that occurs
FAILING = ("worse", "better than explained")

GATED = (  # (split, region, metric): few, so that Holm's correction leaves power
    ("train_view", "foreground", "psnr"),  # varies least between seeds
    ("novel_view", "foreground", "psnr"),
    ("novel_pose", "foreground", "psnr"),
    ("near_pose", "foreground", "psnr"),
    ("far_pose", "foreground", "psnr"),
    ("novel_view", "foreground", "flip"),
    ("novel_view", "full", "lpips"),  # where the backbone's weights are
    ("novel_pose", "full", "lpips"),
    ("novel_view", "full", "iou"),
    ("novel_pose", "", "template_mm"),
)


@dataclass(frozen=True, slots=True)
class Check:
    """A comparison and its outcome."""

    row: str  # scene, person and method; empty: the run as a whole
    layer: Layer
    verdict: Verdict
    detail: str
    name: str = ""  # the quality, stage or count; empty where the whole of a row is meant

    @property
    def title(self) -> str:
        """What was compared."""
        return ": ".join(part for part in (self.row, self.layer, self.name) if part)


def outcome(checks: Sequence[Check]) -> Verdict:
    """The verdict on a change: the worst of its checks."""
    verdicts = {check.verdict for check in checks}
    return next((verdict for verdict in OUTCOMES if verdict in verdicts), "not judged")


def of_exact_change(change: float, margin: float, *, higher_is_better: bool) -> Verdict:
    """The verdict on a change that is known exactly: a loss counts from a fifth of the margin on, a gain from it on."""
    gain = change if higher_is_better else -change
    if abs(change) <= margin / 5:
        return "unchanged"
    return "worse" if gain < 0 else "better than explained" if gain > margin else "not worse"
