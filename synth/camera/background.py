"""Backgrounds: the empty studio as every camera sees it, which is what shows where a mask is too large.

A round hall with a boarded floor and a wall of panels. It casts no light on the person and takes none, so that masks
that are right give the same images with and without it.
"""

from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, zoom

WALL_M, HEIGHT_M = 2.5, 9.0  # Behind the cameras; up to where no camera looks.
FLOOR_M = -0.02  # Under the soles.
SIZE = 512  # of the textures, pixels
SKY = 1.6


def make_hall(mi: Any, radius: float, seed: int) -> Any:
    """A scene of the empty studio for cameras `radius` metres from its middle."""
    rng = np.random.default_rng([seed, 11])
    outer = radius + WALL_M
    flat = mi.ScalarTransform4f().translate([0, FLOOR_M, 0]).rotate([1, 0, 0], -90).scale(outer)
    return mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": SKY}},
            "floor": {"type": "rectangle", "to_world": flat, "bsdf": _painted(mi, boards(rng), 4, 4)},
            "wall": {
                "type": "cylinder",
                "p0": [0, FLOOR_M, 0],
                "p1": [0, HEIGHT_M, 0],
                "radius": outer,
                "bsdf": _painted(mi, panels(rng), 5, 2),
            },
        }
    )


def boards(rng: np.random.Generator) -> np.ndarray:
    """A boarded floor, sRGB uint8 `[s, s, 3]`."""
    planks = np.repeat(rng.uniform(0.75, 1.1, 16), SIZE // 16)[:, None]
    grain = gaussian_filter(rng.standard_normal((SIZE, SIZE)), (0.8, 14), mode="wrap")
    shade = planks * (1 + 0.6 * grain) * np.where(np.arange(SIZE) % (SIZE // 16) < 2, 0.55, 1.0)[:, None]
    return _as_bytes(shade[..., None] * np.array([0.55, 0.42, 0.31]))


def panels(rng: np.random.Generator) -> np.ndarray:
    """A wall of coloured panels with stains, sRGB uint8 `[s, s, 3]`."""
    coarse = rng.uniform(0.3, 0.75, (8, 8, 1)) * rng.uniform(0.8, 1.2, (8, 8, 3))
    stains = gaussian_filter(rng.standard_normal((SIZE, SIZE)), 12, mode="wrap")
    joints = np.minimum(*np.meshgrid(*2 * [np.where(np.arange(SIZE) % (SIZE // 8) < 2, 0.6, 1.0)]))
    return _as_bytes(zoom(coarse, (SIZE // 8, SIZE // 8, 1), order=0) * ((1 + 2 * stains) * joints)[..., None])


def _as_bytes(colour: np.ndarray) -> np.ndarray:
    return np.round(255 * np.clip(colour, 0, 1)).astype(np.uint8)


def _painted(mi: Any, image: np.ndarray, across: int, up: int) -> dict[str, Any]:
    """A material that repeats an image so many times in either direction."""
    bitmap = mi.Bitmap(np.ascontiguousarray(image), pixel_format=mi.Bitmap.PixelFormat.RGB)
    tiles = mi.ScalarTransform4f().scale([across, up, 1])
    colour = {"type": "bitmap", "bitmap": bitmap, "to_uv": tiles, "raw": False}
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": colour}}
