"""Quality against novelty: how accurate a method is by how far a pose lies from the nearest that training showed."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from benchmarks.analysis.scores import HELD_OUT_SPLITS
from benchmarks.analysis.statistics import intervals
from benchmarks.analysis.style import style_of

BINS, LEAST = 5, 3  # at most so many bins of motion, of so many frames or more
NARROW_DEG = 1.0  # Motion that stays within it is none: a curve would be a point.
COLUMNS = ("scene", "method", "novelty_deg", "psnr", "low", "high")


def curves(images: pd.DataFrame) -> pd.DataFrame:
    """Mean foreground PSNR with its 95 % interval (NaN for one value) by bins of novelty: `COLUMNS`.

    `images`: see `scores.images_of`. Held-out views of training poses stand at zero degrees; the frames of all
    held-out motion are sorted by their novelty into bins of equal number, each at its mean. Intervals are those of
    `statistics.intervals`. Scenes whose frames fill fewer than two bins, or lie within a degree, have no curve.
    """
    known = images[images["split"].isin(HELD_OUT_SPLITS) & images["novelty_deg"].notna()]
    rows = [row for scene, here in known.groupby("scene", sort=False) for row in _of_scene(str(scene), here)]
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype({"low": float, "high": float})


def _of_scene(scene: str, images: pd.DataFrame) -> Iterator[tuple[str, str, float, float, float | None, float | None]]:
    frames = images.drop_duplicates(["capture", "frame"])
    moved = frames.loc[frames["split"] != "novel_view", "novelty_deg"]
    count = min(BINS, len(moved) // LEAST)
    if count < 2 or moved.max() < NARROW_DEG:
        return
    edges = np.quantile(moved, np.linspace(0, 1, count + 1)[1:-1])
    of_image = pd.Series(1 + np.searchsorted(edges, images["novelty_deg"], side="right"), index=images.index)
    of_image[images["split"] == "novel_view"] = 0
    places = frames["novelty_deg"].groupby(of_image[frames.index]).mean()
    means = images.groupby(["method", of_image, "capture", "seed"], sort=False)["psnr"].mean()
    for place, degrees in places.items():
        here = means[means.index.get_level_values(1) == place]
        samples = {
            str(method): own.groupby("capture").agg(list).to_dict()
            for method, own in here.groupby("method", sort=False)
        }
        for method, interval in intervals(samples).items():
            yield scene, method, float(degrees), interval.mean, interval.low, interval.high


def sentences(table: pd.DataFrame) -> list[str]:
    """What each method loses from poses of training to the most novel ones, least loss first; a line per scene."""
    found = []
    for scene, here in table.groupby("scene", sort=False):
        ends = here.sort_values("novelty_deg").groupby("method", sort=False)
        losses = {str(method): own["psnr"].iloc[0] - own["psnr"].iloc[-1] for method, own in ends if len(own) > 1}
        told = ", ".join(f"{style_of(m).title} {loss:.1f} dB" for m, loss in sorted(losses.items(), key=lambda p: p[1]))
        first, last = here["novelty_deg"].min(), here["novelty_deg"].max()
        found.append(
            f"On {scene}, from poses {first:.0f} to poses {last:.0f} degrees from training's, PSNR falls by: {told}."
        )
    return found
