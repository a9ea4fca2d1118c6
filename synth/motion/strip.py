"""A look at a motion file before anything is rendered: the retargeted skeleton in a row of frames."""

import numpy as np
from PIL import Image, ImageDraw

from ash.capture.dataset import Motion, Skeleton
from synth.motion.importing import Imported
from synth.posing import bone_frames

COLUMNS = 12
WIDTH, HEIGHT, MARGIN = 130, 260, 24  # pixels of one frame
PAPER, FLOOR, MIDDLE, LEFT, RIGHT = (250, 250, 248), (200, 200, 196), (70, 70, 70), (31, 119, 180), (214, 96, 20)


def draw_strip(skeleton: Skeleton, motion: Motion) -> np.ndarray:
    """At most 12 frames of a motion, seen from the front and, below, from the person's left; uint8 `[h, w, 3]`.

    The left side is blue, the right one orange; the line is the floor. Every frame is centred on the pelvis.
    """
    chosen = np.unique(np.round(np.linspace(0, len(motion.dofs) - 1, COLUMNS)).astype(int))
    places = bone_frames(skeleton, motion.dofs[chosen])[:, :, :3, 3]
    tall = max(2.0, float(np.abs(places[..., 1]).max()) + 0.3)
    scale = (HEIGHT - 2 * MARGIN) / tall  # pixels per metre
    image = Image.new("RGB", (WIDTH * len(chosen), 2 * HEIGHT), PAPER)
    draw = ImageDraw.Draw(image)
    for column, (frame, points) in enumerate(zip(chosen, places, strict=True)):
        centred = points - points[0] * [1, 0, 1]
        for row, across in enumerate((centred[:, 0], -centred[:, 2])):
            low = HEIGHT * (row + 1) - MARGIN
            x, y = WIDTH * (column + 0.5) + scale * across, low - scale * centred[:, 1]
            draw.line((WIDTH * column, low, WIDTH * (column + 1), low), fill=FLOOR)
            for j, parent in enumerate(skeleton.parents):
                if parent >= 0:
                    draw.line((x[parent], y[parent], x[j], y[j]), fill=_colour(skeleton.names[j]), width=3)
            head = skeleton.names.index("head")
            draw.ellipse((x[head] - 5, y[head] - 9, x[head] + 5, y[head] + 3), outline=MIDDLE, width=2)
        draw.text((WIDTH * column + 6, 4), f"{frame / motion.fps:.2f} s", fill=MIDDLE)
    return np.asarray(image)


def describe(found: Imported) -> str:
    """One line of what was understood of a motion file."""
    count = len(found.motion.dofs)
    return (
        f"{found.path}: {found.frames} frames at {found.fps:.4g} per second, {found.up} is up; {count} taken at "
        f"{found.motion.fps:.4g} per second, {len(found.joints)} joints matched, head above the hips in "
        f"{found.head_above_hips:.0%}"
    )


def _colour(joint: str) -> tuple[int, int, int]:
    return LEFT if joint.endswith("_left") else RIGHT if joint.endswith("_right") else MIDDLE
