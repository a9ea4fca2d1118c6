"""A capture drawn by NumPy in a second, and methods that need no training: what the harness's tests run on.

The person is three textured boxes (trunk and two arms) that swing; every image is a z-buffered cloud of surface points.
"""

import os
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import safetensors.numpy

from ash.capture.dataset import (
    Camera,
    Capture,
    Motion,
    Pose,
    Skeleton,
    TemplateMesh,
    image_path,
    pixels_path,
    surface_path,
)
from ash.capture.formats import write_cameras, write_motion, write_skeleton, write_template
from ash.capture.manifest import Manifest, Split, hash_files
from ash.files import write_arrays, write_image
from ash.protocol import StageClock
from benchmarks.cell.sandbox import METHOD_PATH

SIZE = 64
TRAIN_FRAMES, TEST_FRAMES = 4, 3
FPS = 25.0
SAMPLES = 26  # Surface points along each edge of a box's face.

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
BOXES = (  # centre, half size, joint
    (np.array([0.0, 1.1, 0.0]), np.array([0.22, 0.45, 0.14]), 0),
    (np.array([0.42, 1.2, 0.0]), np.array([0.2, 0.09, 0.09]), 1),
    (np.array([-0.42, 1.2, 0.0]), np.array([0.2, 0.09, 0.09]), 2),
)


def skeleton() -> Skeleton:
    """A trunk and two arms."""
    heads = np.array([[0.0, 0.9, 0.0], [0.24, 1.2, 0.0], [-0.24, 1.2, 0.0]])
    return Skeleton(names=("trunk", "left", "right"), parents=np.array([-1, 0, 0]), heads=heads)


def template() -> TemplateMesh:
    """Three boxes, each face with its own patch of the atlas."""
    vertices, faces, uvs, uv_faces, weights = [], [], [], [], []
    for box, (centre, half, joint) in enumerate(BOXES):
        for side, quad in enumerate(QUADS):
            first, patch = len(vertices), box * len(QUADS) + side
            low = np.array([patch % 5, patch // 5]) / 5 + 0.02
            vertices += [centre + half * CORNERS[corner] for corner in quad]
            uvs += [low + 0.16 * np.array(step) for step in ((0, 0), (1, 0), (1, 1), (0, 1))]
            for triangle in ([0, 1, 2], [0, 2, 3]):
                faces.append([first + i for i in triangle])
            weights += [np.eye(3)[joint]] * 4
    uv_faces = faces
    return TemplateMesh(
        vertices=np.array(vertices),
        faces=np.array(faces),
        uvs=np.array(uvs),
        uv_faces=np.array(uv_faces),
        skin_weights=np.array(weights),
    )


def motion() -> Motion:
    """The arms swing; the test sequence swings further and turns the trunk."""
    frames = TRAIN_FRAMES + TEST_FRAMES
    phase = 2 * np.pi * np.arange(frames) / TRAIN_FRAMES
    dofs = np.zeros((frames, 12))
    dofs[:, 3 + 3 + 2], dofs[:, 3 + 6 + 2] = 0.4 * np.sin(phase), -0.4 * np.sin(phase)
    dofs[TRAIN_FRAMES:] *= 1.5
    dofs[TRAIN_FRAMES:, 4] = 0.3
    return Motion(dofs=dofs, sequence=np.repeat([0, 1], [TRAIN_FRAMES, TEST_FRAMES]), fps=FPS)


def posed(dofs: np.ndarray) -> np.ndarray:
    """Template vertices `[v, 3]` under one frame's degrees of freedom."""
    bones, mesh = skeleton(), template()
    poses: list[np.ndarray] = []
    for joint, parent in enumerate(bones.parents):
        local = np.eye(4)
        local[:3, :3] = _rotation(dofs[3 + 3 * joint : 6 + 3 * joint])
        local[:3, 3] = bones.heads[joint] + dofs[:3] if parent < 0 else bones.heads[joint] - bones.heads[parent]
        poses.append(local if parent < 0 else poses[parent] @ local)
    for joint, pose in enumerate(poses):
        pose[:3, 3] -= pose[:3, :3] @ bones.heads[joint]
    blended = np.einsum("vj,jab->vab", mesh.skin_weights, np.array(poses))
    return np.einsum("vab,vb->va", blended[:, :3, :3], mesh.vertices) + blended[:, :3, 3]


def cameras() -> list[Camera]:
    """Five cameras on a ring, looking at the chest."""
    from synth.camera.rig import look_at  # Not above: no process of a method sees synth.

    focal = 1.25 * SIZE
    K = np.array([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1.0]])
    found = []
    for index, angle in enumerate(np.linspace(0, 2 * np.pi, 5, endpoint=False)):
        viewmat = look_at(np.array([2.2 * np.sin(angle), 1.3, 2.2 * np.cos(angle)]), np.array([0, 1.1, 0]))
        found.append(Camera(name=f"cam{index}", width=SIZE, height=SIZE, K=K, viewmat=viewmat))
    return found


def draw(vertices: np.ndarray, camera: Camera, *, detail: float = 1.0) -> np.ndarray:
    """Float RGBA `[h, w, 4]`, premultiplied: stripes of contrast `detail` on the boxes."""
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES
    u, v = (grid.ravel() for grid in np.meshgrid(steps, steps))
    corners = vertices.reshape(-1, 4, 3)
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], -1)
    points = np.einsum("pc,qcd->qpd", weights, corners).reshape(-1, 3)
    stripes = 0.5 + 0.5 * detail * np.sign(np.sin(18 * u) * np.sin(11 * v))
    hues = np.stack([0.5 + 0.4 * np.sin(np.arange(len(corners)) + shift) for shift in (0, 2, 4)], -1)
    colours = (0.25 + 0.75 * stripes[None, :, None]) * hues[:, None]
    pixels, depth = camera.project(points)
    x, y = np.floor(pixels).astype(int).T
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    order = np.flatnonzero(inside)[np.argsort(-depth[inside], kind="stable")]
    image = np.zeros((camera.height, camera.width, 4))
    image[y[order], x[order], :3] = colours.reshape(-1, 3)[order]
    image[y[order], x[order], 3] = 1
    return image


def write_capture(folder: Path) -> Path:
    """A finished capture of the box person."""
    rig, mesh, course = cameras(), template(), motion()
    truth = np.stack([posed(dofs) for dofs in course.dofs])
    train, test = range(TRAIN_FRAMES), range(TRAIN_FRAMES, TRAIN_FRAMES + TEST_FRAMES)
    write_cameras(folder / "cameras.json", rig)
    write_skeleton(folder / "skeleton.json", skeleton())
    write_template(folder / "template.npz", mesh)
    write_motion(folder / "motion.npz", course)
    write_arrays(folder / "truth" / "template.npz", vertices=truth)
    surface = {"rest": mesh.vertices, "faces": mesh.faces, "uvs": mesh.uvs, "uv_faces": mesh.uv_faces}
    write_arrays(folder / "truth" / "surface.npz", **surface, part=np.zeros(len(mesh.faces), np.int64))
    views = [(camera, frame) for camera in rig for frame in train]
    views += [(camera, frame) for camera in rig[3:] for frame in test]
    for camera, frame in views:
        image = draw(truth[frame], camera)
        write_image(image_path(folder, camera.name, frame), np.rint(image * 255).astype(np.uint8))
        # What was drawn are points, so no pixel knows a triangle.
        nothing = {"triangle": np.full((SIZE, SIZE), -1), "barycentric": np.zeros((SIZE, SIZE, 2))}
        noise = np.full((SIZE, SIZE), 1e-4, dtype=np.float32)
        write_arrays(pixels_path(folder, camera.name, frame), noise=noise, **nothing)
    for frame in range(len(truth)):
        write_arrays(surface_path(folder, frame), vertices=truth[frame])
    shown, held_out = (tuple(camera.name for camera in some) for some in (rig[:3], rig[3:]))
    splits = {
        "train": Split(cameras=shown, frames=tuple(train)),
        "novel_view": Split(cameras=held_out, frames=tuple(train)),
        "novel_pose": Split(cameras=held_out, frames=tuple(test)),
    }
    Manifest(scene="boxes", seed=0, splits=splits, files=hash_files(folder)).write(folder)
    return folder


class FakeAvatar:
    """Draws the boxes; `detail` is how much of the stripes it has learned, `shift_m` how far its template is off."""

    def __init__(
        self, capture: Capture, *, detail: float = 0.9, shift_m: float = 0.0, seed: int = 0, preset: str = ""
    ) -> None:
        rng = np.random.default_rng(seed)
        self.weights = np.array([detail + 0.02 * rng.standard_normal(), shift_m])

    def fit(self, capture: Capture, *, folder: Path) -> None:
        assert set(capture.splits) == {"train"}, "a method that is no oracle was shown held-out views"
        rows = [
            f'{{"step": {i}, "seconds": {0.1 * i}, "loss": {1 / (i + 1)}, "train_psnr": {10 + i}}}\n' for i in range(5)
        ]
        (folder / "log.jsonl").write_text("".join(rows))

    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
        with clock.stage("stg1"):
            vertices = self.template_vertices(pose)
        with clock.stage("stg4"):
            return draw(vertices, camera, detail=self.weights[0]).astype(np.float32)

    def template_vertices(self, pose: Pose) -> np.ndarray:
        return posed(pose.dofs) + np.array([self.weights[1], 0, 0])

    def gaussian_means(self, pose: Pose) -> np.ndarray:
        return self.template_vertices(pose)

    def parameter_count(self) -> int:
        return 2

    def gaussian_count(self) -> int:
        return 72

    def save(self, path: Path) -> None:
        safetensors.numpy.save_file({"weights": self.weights}, path)

    def load(self, path: Path) -> None:
        self.weights = safetensors.numpy.load_file(path)["weights"]


class Broken(FakeAvatar):
    """Fails in the way that `failure` says."""

    def __init__(self, capture: Capture, *, failure: str, **settings) -> None:
        super().__init__(capture, detail=0.5, **settings)
        self.failure = failure

    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
        image = super().render(pose, camera, clock=clock)
        match self.failure:
            case "nan":
                image[0, 0, 0] = np.nan
            case "raise":
                raise RuntimeError("the method's own mistake")
            case "die":
                os.abort()
            case "sleep":
                time.sleep(3600)
            case "grow":
                self.hoard = np.ones((1 << 30) // 8)  # 1 GiB, touched
                time.sleep(3600)
        return image


good, bad = FakeAvatar, partial(FakeAvatar, detail=0.2, shift_m=0.02)
nan, raising, dying, sleeping, growing = (
    partial(Broken, failure=failure) for failure in ("nan", "raise", "die", "sleep", "grow")
)


@dataclass(frozen=True, kw_only=True)
class Stripes:
    """What a fake method with a configuration offers."""

    detail: float = 0.9  # how much of the stripes is learned, 0..1
    shift_m: float = 0.0  # how far the template is off

    def __post_init__(self) -> None:
        if not 0 <= self.detail <= 1:
            raise ValueError(f"detail: expected 0 to 1, got {self.detail}")


def tuned(capture: Capture, *, seed: int, preset: str, config: Stripes | None = None) -> FakeAvatar:
    """Has a configuration, as docs/plugin.md tells."""
    wanted = config or stripes_of(preset)
    return FakeAvatar(capture, detail=wanted.detail, shift_m=wanted.shift_m, seed=seed)


def stripes_of(preset: str) -> Stripes:
    """Half of the stripes at the smallest budget."""
    if preset not in ("ci", "cpu"):
        raise ValueError(f"preset: expected one of ci, cpu, got {preset!r}")
    return Stripes(detail=0.5 if preset == "ci" else 0.9)


tuned.config = stripes_of


@dataclass(frozen=True, kw_only=True)
class Placed:
    """What a fake method offers that can choose its device."""

    device: str = "cpu"


class TellsGpus(FakeAvatar):
    """Prints which GPUs it sees."""

    def fit(self, capture: Capture, *, folder: Path) -> None:
        super().fit(capture, folder=folder)
        print("sees", os.environ.get("CUDA_VISIBLE_DEVICES"), flush=True)


def placed(capture: Capture, *, seed: int, preset: str, config: Placed | None = None) -> FakeAvatar:
    return TellsGpus(capture, seed=seed)


placed.config = lambda preset: Placed()

METHODS = ("good", "tuned", "placed", "bad", "nan", "raising", "dying", "sleeping", "growing")


def write_suite(folder: Path, capture: Path, *methods: str, name: str = "boxes", preset: str = "ci") -> Path:
    """A suite's file: methods on a capture that is there."""
    lines = [
        'about = "fake methods on boxes"',
        f"scenes = [{{ capture = {str(capture)!r} }}]",
        f"methods = {list(methods or ('fake_good', 'fake_bad'))}",
        f"preset = {preset!r}",
        "cell_minutes = 0.1",
    ]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def use(folder: Path, monkeypatch) -> None:
    """Install the fake methods."""
    install(folder, monkeypatch, "fakes", {f"fake_{name}": name for name in METHODS})


def install(folder: Path, monkeypatch, module: str, factories: dict[str, str]) -> None:
    """Register factories of a helper as methods, as an installed distribution does: here and in processes of cells."""
    info = folder / f"ash_bench_{module}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: ash-bench-{module}\nVersion: 1.0\n")
    lines = [f"{name} = helpers.{module}:{factory}\n" for name, factory in factories.items()]
    (info / "entry_points.txt").write_text("[ash_bench.methods]\n" + "".join(lines))
    paths = [str(folder), str(Path(__file__).parents[1]), *filter(None, [os.environ.get(METHOD_PATH)])]
    monkeypatch.setenv(METHOD_PATH, os.pathsep.join(paths))
    monkeypatch.syspath_prepend(str(folder))


def _rotation(vector: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
