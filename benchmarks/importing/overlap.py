"""Whether footage, cameras, motion and template belong together: the posed template against the masks, per camera."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ash.capture.dataset import Camera, Capture
from ash.mesh.rasterizing import rasterize_mesh
from benchmarks.cell.evaluation import spread
from benchmarks.cell.metrics import foreground, silhouette_iou
from synth.export.formats import posed_template

FRAMES = 8  # of each camera, evenly taken


@dataclass(frozen=True, kw_only=True, slots=True)
class Overlap:
    """How well the skinned template covers the masks of a camera; wrinkles and swinging cloth take from it."""

    camera: str
    iou: float  # intersection over union, mean over frames
    worst: float  # the least
    worst_frame: int
    offset_px: tuple[float, float]  # how far right and down of the template the mask's middle lies, mean over frames


def silhouette(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """Pixels `[h, w]` (bool) whose centre a mesh covers; `vertices` `[v, 3]` in metres.

    A lens that distorts bends no edge between two vertices.
    """
    if camera.is_pinhole:
        seen = (vertices @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T
    else:
        pixels, depth = camera.project(vertices)
        seen = np.concatenate([pixels, np.ones_like(pixels[:, :1])], axis=1) * depth[:, None]
    drawn = rasterize_mesh(
        torch.from_numpy(seen), torch.from_numpy(faces), width=camera.width, height=camera.height, near=0.01
    )
    covered: np.ndarray = drawn.triangle.numpy() >= 0
    return covered


def template_overlaps(capture: Capture) -> list[Overlap]:
    """The overlap of every camera that has images, over at most `FRAMES` of its frames, in the order of cameras."""
    frames: dict[str, set[int]] = {}
    for split in capture.splits.values():
        for camera, frame in split.views:
            frames.setdefault(camera, set()).add(frame)
    chosen = {}
    for name in (name for name in capture.cameras if name in frames):
        taken = sorted(frames[name])
        chosen[name] = [taken[i] for i in spread(len(taken), FRAMES)]
    posed = {frame: posed_template(capture, frame) for frame in set().union(*chosen.values())}
    return [_overlap(capture, name, {frame: posed[frame] for frame in chosen[name]}) for name in chosen]


def _overlap(capture: Capture, name: str, posed: dict[int, np.ndarray]) -> Overlap:
    ious, offsets = {}, []
    for frame, vertices in posed.items():
        drawn = silhouette(vertices, capture.template.faces, capture.cameras[name])
        mask = foreground(capture.image(name, frame))
        ious[frame] = silhouette_iou(drawn, mask)
        if drawn.any() and mask.any():
            offsets.append(np.argwhere(mask).mean(axis=0) - np.argwhere(drawn).mean(axis=0))
    down, right = np.mean(offsets, axis=0) if offsets else (float("nan"), float("nan"))
    worst_frame = min(ious, key=lambda frame: ious[frame])
    return Overlap(
        camera=name,
        iou=float(np.mean(list(ious.values()))),
        worst=ious[worst_frame],
        worst_frame=worst_frame,
        offset_px=(float(right), float(down)),
    )


def overlap_table(overlaps: Sequence[Overlap]) -> str:
    """The overlaps as lines of text, and their mean."""
    lines = [f"{'camera':<16} {'IoU':>6} {'worst (frame)':>16} {'mask right, down of template, px':>34}"]
    for row in overlaps:
        worst, offset = f"{row.worst:.3f} ({row.worst_frame})", "{:+.1f}, {:+.1f}".format(*row.offset_px)
        lines.append(f"{row.camera:<16} {row.iou:6.3f} {worst:>16} {offset:>34}")
    return "\n".join([*lines, f"{'mean':<16} {np.mean([row.iou for row in overlaps]):6.3f}"])
