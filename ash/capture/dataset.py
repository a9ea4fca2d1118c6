"""The capture on disk: the one contract between the generator of ground truth and everything else.

A capture is a folder:

    manifest.json        schema, scene, its parameters, seed, versions, SHA-256 of every file, complete or not; splits:
                         cameras, frames, and parts (the cameras that saw each frame) where not all of them did
    cameras.json         width, height; per camera: name, K, viewmat (world -> camera, OpenCV axes); for a lens with
                         distortion its k1 k2 p1 p2, and then images and truth are those of the distorted picture
    skeleton.json        joints: name, parent, rest position of its head
    template.npz         the template mesh that methods are given: rest vertices, faces, UVs, skin weights
    body.npz             the same of the body without clothes, as a fitted body model would give it; may be absent
    motion.npz           degrees of freedom per frame, and the sequence each frame belongs to
    frames/CAM/FRAME.png RGBA, uint8 sRGB, straight alpha; of the pairs that a split names
    scans/FRAME.npz      vertices [n, 3] and faces [f, 3] of what a scanner made of a training frame: noise and holes;
                         may be absent
    truth/               what no real capture knows; only oracles and the evaluation may read it
        template.npz     vertices [t, v, 3]: where the template's vertices really are, per frame
        surface.npz      faces, uvs, uv_faces, part (label per face) of the rendered surface
        surface/FRAME.npz  vertices [s, 3] of the rendered surface, metres
        pixels/CAM/FRAME.npz  triangle [h, w] (-1: none), barycentric [h, w, 2] (weights of corners
                         1 and 2; corner 0 has the rest), noise [h, w] (variance of sRGB in 0..1)

Units are metres, radians and seconds; right-handed, y up; cameras follow OpenCV (x right, y down, z forward) with pixel
centres at +0.5. NumPy only: this module knows formats, no method and no renderer.
"""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ash.capture.lens import distort, undistort
from ash.capture.manifest import NAME, Manifest, Split
from ash.files import InputError, read_image, sha256_of


@dataclass(frozen=True, kw_only=True, slots=True)
class Camera:
    """A calibrated camera. `K` is in pixels; `viewmat` maps world to camera (OpenCV axes, metres).

    Methods only ever see pinhole cameras: a capture whose lenses distort is undistorted first
    (`synth.export.undistorted`), and `Capture.training_only` refuses the others.
    """

    name: str
    width: int
    height: int
    K: np.ndarray  # [3, 3] float64
    viewmat: np.ndarray  # [4, 4] float64
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(4))  # [4] k1 k2 p1 p2; zeros: a pinhole

    @property
    def position(self) -> np.ndarray:
        """Optical centre in the world, `[3]` metres."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    @property
    def is_pinhole(self) -> bool:
        """Whether the lens leaves straight lines straight."""
        return not self.distortion.any()

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points `[..., 3]` to pixels `[..., 2]` and depth along the optical axis `[...]` in metres."""
        in_camera = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        if self.is_pinhole:
            in_image = in_camera @ self.K.T
            return in_image[..., :2] / in_image[..., 2:], in_camera[..., 2]
        seen = distort(in_camera[..., :2] / in_camera[..., 2:], self.distortion)
        return seen @ self.K[:2, :2].T + self.K[:2, 2], in_camera[..., 2]

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """World directions `[..., 3]`, of depth 1 and not of length 1, that pixels `[..., 2]` look along."""
        seen = (pixels - self.K[:2, 2]) @ np.linalg.inv(self.K[:2, :2]).T
        ideal = seen if self.is_pinhole else undistort(seen, self.distortion)
        return np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1) @ self.viewmat[:3, :3]


@dataclass(frozen=True, kw_only=True, slots=True)
class Skeleton:
    """Joints in topological order (a parent precedes its children; the root has parent -1).

    Every joint's rest frame has the world's axes. With rotation vectors r (radians, parent's frame) and root
    translation t,
        G_root = T(head_root + t) R(r_root),    G_j = G_parent T(head_j - head_parent) R(r_j),
    and the skinning transform of joint j, rest to posed, is G_j T(-head_j).
    """

    names: tuple[str, ...]
    parents: np.ndarray  # [j] int
    heads: np.ndarray  # [j, 3] float64, metres


@dataclass(frozen=True, kw_only=True, slots=True)
class TemplateMesh:
    """The clothed rest mesh that methods are given, as a person-specific scan would be."""

    vertices: np.ndarray  # [v, 3] float64, metres, rest pose
    faces: np.ndarray  # [f, 3] int64 into vertices
    uvs: np.ndarray  # [u, 2] float64 in [0, 1], u to the right, v up
    uv_faces: np.ndarray  # [f, 3] int64 into uvs
    skin_weights: np.ndarray  # [v, j] float64, rows sum to 1


@dataclass(frozen=True, kw_only=True, slots=True)
class Motion:
    """Degrees of freedom per frame: root translation (metres), then one rotation vector per joint (radians).

    A window of motion never reaches across the start of a sequence: earlier frames repeat its first.
    """

    dofs: np.ndarray  # [t, 3 + 3 j] float64
    sequence: np.ndarray  # [t] int64, the sequence each frame belongs to
    fps: float

    def window(self, frame: int, length: int) -> np.ndarray:
        """Indices of the `length` frames that end with `frame`, newest first, clamped to the start of its sequence."""
        first = int(np.flatnonzero(self.sequence == self.sequence[frame])[0])
        return np.maximum(frame - np.arange(length), first)


@dataclass(frozen=True, slots=True)
class Pose:
    """One frame of a motion, with the history that led to it: what an avatar is asked to take on."""

    motion: Motion
    frame: int

    @property
    def dofs(self) -> np.ndarray:
        """Root translation (metres), then one rotation vector per joint (radians): `[3 + 3 j]`."""
        return self.motion.dofs[self.frame]

    def window(self, length: int) -> np.ndarray:
        """Indices of the `length` frames that end with this one; see `Motion.window`."""
        return self.motion.window(self.frame, length)

    def at(self, frame: int) -> "Pose":
        """Another frame of the same motion."""
        return Pose(self.motion, frame)


@dataclass(frozen=True, kw_only=True, slots=True)
class Capture:
    """A loaded capture. Small parts are in memory; images and truth are read when asked for."""

    folder: Path
    scene: str
    manifest: Manifest
    splits: dict[str, Split]
    cameras: dict[str, Camera]
    skeleton: Skeleton
    template: TemplateMesh
    motion: Motion
    store: Path | None = None  # where what is derived from the capture may be kept for other methods; None: nowhere

    @property
    def identity(self) -> str:
        """SHA-256 over the manifest: two captures with equal identity hold equal bytes."""
        return sha256_of(self.folder / NAME)

    def background(self, camera: str) -> np.ndarray | None:
        """The camera's picture of the empty studio, sRGB uint8 `[h, w, 3]`; None where the capture has none."""
        path, by = background_path(self.folder, camera), self.cameras[camera]
        return read_image(path, shape=(by.height, by.width, 3)) if path.is_file() else None

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGBA of a view, uint8 `[h, w, 4]`, sRGB, straight alpha."""
        view = self.cameras[camera]
        return read_image(image_path(self.folder, camera, frame), shape=(view.height, view.width, 4))

    def training_only(self) -> "Capture":
        """What a method may learn from: training cameras, frames and motion; no held-out view and no test motion.

        Raises:
            InputError: a lens distorts, and methods know pinhole cameras only.
        """
        bent = [name for name, camera in self.cameras.items() if not camera.is_pinhole]
        if bent:
            raise InputError(
                f"{self.folder}: the lens of {bent[0]} distorts; first: ash-bench export --format undistorted"
            )
        train = self.splits["train"]
        count = max(train.frames) + 1  # Training sequences come first, so indices stay as they are.
        motion = replace(self.motion, dofs=self.motion.dofs[:count], sequence=self.motion.sequence[:count])
        cameras = {name: self.cameras[name] for name in train.cameras}
        return replace(self, splits={"train": train}, cameras=cameras, motion=motion)


def require_pose(pose: Pose, skeleton: Skeleton) -> None:
    """Refuse a frame that a motion lacks, a pose of another skeleton, and a pose with NaN or infinity.

    Raises:
        InputError: says what was expected and what came.
    """
    motion, frame = pose.motion, pose.frame
    width = 3 + 3 * len(skeleton.names)
    if motion.dofs.ndim != 2 or motion.dofs.shape[1] != width:
        raise InputError(f"motion: expected degrees of freedom of shape [t, {width}], got {motion.dofs.shape}")
    if not 0 <= frame < len(motion.dofs):
        raise InputError(f"frame: expected 0 to {len(motion.dofs) - 1}, got {frame}")
    if not np.isfinite(motion.dofs[frame]).all():
        raise InputError(f"frame {frame}: expected a pose of finite numbers, got NaN or infinity")


def fewer_views(capture: Capture, *, cameras: float = 1.0, footage_s: float = math.inf) -> Capture:
    """The capture with a share (0..1] of its training cameras and the first seconds of its training motion.

    At least one camera and one frame stay; other splits keep theirs. Cameras are chosen by `spread_cameras`. Where only
    some of the cameras recorded each frame, frames that none of the chosen cameras recorded are left out.
    """
    train = capture.splits["train"]
    names = spread_cameras(capture, max(1, round(cameras * len(train.cameras))))
    first = train.frames[: max(1, round(min(footage_s * capture.motion.fps, len(train.frames))))]
    return replace(capture, splits=capture.splits | {"train": train.only(cameras=names, frames=first)})


def spread_cameras(capture: Capture, count: int) -> tuple[str, ...]:
    """`count` training cameras spread evenly, in the split's order.

    Farthest-point sampling of their positions, so that a smaller choice is part of a larger.

    Raises:
        InputError: the capture has fewer training cameras.
    """
    names = capture.splits["train"].cameras
    if not 1 <= count <= len(names):
        raise InputError(f"{capture.folder}: expected 1 to {len(names)} training cameras, got {count}")
    positions = np.stack([capture.cameras[name].position for name in names])
    return tuple(names[index] for index in sorted(farthest_points(positions, count)))


def farthest_points(positions: np.ndarray, count: int) -> list[int]:
    """Indices of `count` of the positions `[n, 3]`: the first, then each time the farthest from those chosen."""
    chosen = [0]
    for _ in range(count - 1):
        distance = np.linalg.norm(positions[:, None] - positions[chosen], axis=-1).min(1)
        chosen.append(int(distance.argmax()))
    return chosen


def image_path(folder: Path, camera: str, frame: int) -> Path:
    """Where the image of a view lies."""
    return folder / "frames" / camera / f"{frame:06d}.png"


def background_path(folder: Path, camera: str) -> Path:
    """Where the picture of the empty studio lies that a camera took."""
    return folder / "plates" / f"{camera}.png"


def pixels_path(folder: Path, camera: str, frame: int) -> Path:
    """Where the per-pixel truth of a view lies."""
    return folder / "truth" / "pixels" / camera / f"{frame:06d}.npz"


def surface_path(folder: Path, frame: int) -> Path:
    """Where the rendered surface's vertices of a frame lie."""
    return folder / "truth" / "surface" / f"{frame:06d}.npz"


def scan_path(folder: Path, frame: int) -> Path:
    """Where the scan of a training frame lies, in captures that have scans."""
    return folder / "scans" / f"{frame:06d}.npz"
