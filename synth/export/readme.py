"""The README.md of exported plain files: every convention on one page, for a reader of JSON, NumPy arrays and PNG."""

from ash.capture.dataset import Capture

CONVENTIONS = """
## Conventions

- Units: metres, radians, seconds, pixels. The world is right-handed, y up.
- Cameras: OpenCV axes (x right, y down, z forward); pixel centres lie at +0.5, so that the first pixel covers 0 to 1.
- Images: PNG, 8 bits per channel, sRGB values as displayed. Row 0 is the top.
- Arrays: `numpy.load(FILE)[NAME]`, no pickled objects. f: frames, j: joints, v: vertices.

`cameras.json`: `{"cameras": [...]}`, for each camera `name`, `width`, `height`, `K` (3x3, pixels), `viewmat` (4x4,
world to camera, metres) and, where the lens distorts, `distortion` (k1, k2, p1, p2 of OpenCV; the images are the
distorted ones). A point p of the world lies in the camera at `q = viewmat[:3, :3] @ p + viewmat[:3, 3]`, and is seen
without distortion at the pixel `(K @ q)[:2] / q[2]`, column first.

`skeleton.json`: `{"joints": [...]}`, parents first, for each joint `name`, `parent` (-1: the root) and `head` (its
position at rest). At rest every joint has the axes of the world.

`template.npz`: the mesh at rest, in the clothes of the person: `vertices` [v, 3], `faces` [n, 3] into vertices, `uvs`
[u, 2] in 0 to 1 (u right, v up), `uv_faces` [n, 3] into uvs, `skin_weights` [v, j] with rows that sum to 1.

`poses.npz`: for each of f frames
- `frame` [f]: its number, as in file names; `fps`: frames per second;
- `sequence` [f]: the take that it belongs to; motion is continuous within a take only;
- `dofs` [f, 3 + 3 j]: translation of the root, then a rotation vector per joint (axis times angle, frame of the
  parent);
- `joints` [f, j, 4, 4]: each joint's frame, joint to world; `skinning` [f, j, 4, 4]: rest pose to posed, of points
  near it.

`posed_template/FRAME.npz`: `vertices` [v, 3] (float32) of the template moved by the skeleton alone (dual quaternion
skinning): the mesh without wrinkles or swinging cloth, for methods with no skeleton. It is no truth of the frame.
"""

PLAIN = """# {title}: the training part

Every image that a method may learn from, with its camera and pose; no test image, no test pose.

`views.json`: `{{"views": [...]}}`, for each image `camera`, `frame` and `image`, its file here. The images are RGBA
with straight alpha: the colour of a pixel is not multiplied by its alpha. The alpha channel is the mask of the
person. On black, with values in 0 to 1: `rgb * alpha`.

`scans/FRAME.npz`, where the capture has scans: `vertices` [n, 3] and `faces` [m, 3] of what a scanner made of a
training frame, with noise and holes, unrelated to the template.
"""

TEST_VIEWS = """# {title}: the views to render

Cameras and poses of every scored image, and none of the images. The poses are there to be rendered, also those of
earlier frames of the same take; nothing may be learned from them.

`views.json`: `"views"` lists `split`, `camera`, `frame` and `image` of each picture; `"splits"` lists the file names of
each split. Render each view and save it as the PNG file `image`, below a folder of yours (this one will do):

- size: `width` x `height` of the camera; 8 bits per channel, sRGB values as displayed;
- RGBA with straight alpha, or premultiplied if `info.json` beside `images/` says `{{"alpha": "premultiplied"}}`;
- or RGB on black: without alpha, only scores of the whole frame are computed;
- nothing else below `images/`.

`info.json` may say more, each key optional; it is shown as reported by its authors: `training_s` (seconds), `frame_ms`
(milliseconds per frame), `device`, `parameters` (a whole number), `commit`.

Then: `ash-bench score FOLDER CAPTURE --name NAME`.
"""


def readme(text: str, capture: Capture) -> bytes:
    """A page that begins with `text`, `PLAIN` or `TEST_VIEWS`, and goes on with what both share."""
    return (text.format(title=capture.scene) + CONVENTIONS).encode()
