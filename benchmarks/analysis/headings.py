"""Accuracy on headings that training did not see.

A method that is given motion in the world, as the paper's is, learns what it sees together with where the person faces.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import torch

from ash.capture.dataset import Motion
from ash.rotations import root_yaw
from benchmarks.analysis.results import MOTION_SPLITS
from benchmarks.analysis.style import listed, style_of

EDGES_DEG = (15.0, 60.0)  # between a heading of training, a new one, and one on the other side
BINS = ("up to 15 deg", "15 to 60 deg", "beyond 60 deg")


def heading_deg(motion: Motion, *, train: Sequence[int], test: Sequence[int]) -> np.ndarray:
    """Degrees, 0 to 180, from the heading of each test frame to the nearest heading of a training frame."""
    yaws = np.array([float(root_yaw(torch.from_numpy(dofs))) for dofs in motion.dofs[[*train, *test]]])
    apart = yaws[len(train) :, None] - yaws[None, : len(train)]
    nearest: np.ndarray = np.rad2deg(np.abs((apart + np.pi) % (2 * np.pi) - np.pi)).min(axis=1)
    return nearest


def by_heading(images: pd.DataFrame, degrees: Mapping[tuple[str, int], float]) -> pd.DataFrame:
    """Scene, method, bin, psnr, frames, captures: mean foreground PSNR of all images of new poses by heading.

    `degrees`: of a capture's frame, by `heading_deg`. Scenes without a frame in the last bin have no rows.
    """
    columns = ["scene", "method", "bin", "psnr", "frames", "captures"]
    if "psnr" not in images:  # All pictures were brought without alpha.
        return pd.DataFrame(columns=columns)
    posed = images[images["split"].isin(MOTION_SPLITS) & images["psnr"].notna()]
    turned_deg = [degrees.get(place, np.nan) for place in zip(posed["capture"], posed["frame"], strict=True)]
    posed = posed.assign(bin=np.searchsorted(EDGES_DEG, turned_deg))[~np.isnan(turned_deg)]
    rows = []
    for (scene, method, index), here in posed.groupby(["scene", "method", "bin"], sort=False):
        frames = here.drop_duplicates(["capture", "frame"])
        rows.append((scene, method, BINS[index], here["psnr"].mean(), len(frames), frames["capture"].nunique()))
    table = pd.DataFrame(rows, columns=columns)
    return table[table["scene"].isin(table.loc[table["bin"] == BINS[-1], "scene"])]


def changes(table: pd.DataFrame) -> list[str]:
    """A sentence per scene: what each method gains or loses from the first bin to the last, the best first."""
    sentences = []
    for scene, here in table.groupby("scene", sort=False):
        wide = here.pivot(index="method", columns="bin", values="psnr").reindex(columns=BINS)
        gains = (wide[BINS[-1]] - wide[BINS[0]]).dropna().sort_values(ascending=False)
        names = listed([f"{style_of(str(method)).title} {gain:+.1f} dB" for method, gain in gains.items()])
        last = here[here["bin"] == BINS[-1]].iloc[0]
        seen = f"frames: {last['frames']}, captures: {last['captures']}"
        sentences.append(f"On {scene}, from {BINS[0]} to {BINS[-1]} ({seen}), PSNR changes: {names}.")
    return sentences
