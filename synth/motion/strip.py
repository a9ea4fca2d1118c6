"""A look at a motion file before anything is rendered: the retargeted skeleton in a row of frames."""

import io
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from PIL.PngImagePlugin import PngInfo

from ash.capture.dataset import Motion, Skeleton
from ash.files import InputError, write_atomic
from synth.motion.importing import Imported
from synth.posing import bone_frames
from synth.skeleton import JOINTS

COLUMNS = 12
MARK = ("Software", "ash-bench motions")  # stands in every strip's file, so that no other picture is replaced
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


def write_strip(path: Path, image: np.ndarray) -> None:
    """Write a strip as PNG; another strip is replaced, and nothing else.

    Raises:
        InputError: another file lies there.
    """
    if path.exists() and not _is_strip(path):
        raise InputError(f"{path}: there is another file, which is left alone; give another one by --out")
    text = PngInfo()
    text.add_text(*MARK)
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", pnginfo=text)
    write_atomic(path, buffer.getvalue())


def _is_strip(path: Path) -> bool:
    try:
        with Image.open(path, formats=["PNG"]) as image:
            return image.info.get(MARK[0]) == MARK[1]
    except (OSError, ValueError, SyntaxError):
        return False


def describe(imported: Imported) -> str:
    """One line of what was understood of a motion file."""
    motion, unmatched = imported.motion, imported.unmatched
    length = float(np.linalg.norm(np.diff(motion.dofs[:, :3], axis=0), axis=1).sum())
    rest = "" if imported.rest == "the file's" else f"rest pose {imported.rest}, "
    without = ", ".join(unmatched[:6]) + (f" and {len(unmatched) - 6} more" if len(unmatched) > 6 else "")
    return (
        f"{imported.path}: {imported.frames} frames at {imported.fps:.4g} per second, {len(motion.dofs)} taken at "
        f"{motion.fps:.4g} per second; {len(imported.joints)} of {len(JOINTS)} joints matched, of the file without a "
        f"partner: {without or 'none'}; {rest}"
        + (f"{imported.roots} roots, {imported.joints['pelvis']} taken, " if imported.roots > 1 else "")
        + f"path {length:.2f} m; {imported.up} is up, head above the hips in {imported.head_above_hips:.0%}"
    )


def _colour(joint: str) -> tuple[int, int, int]:
    return LEFT if joint.endswith("_left") else RIGHT if joint.endswith("_right") else MIDDLE
