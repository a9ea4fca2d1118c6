"""`ash-bench eval --motion`: drive trained avatars with a motion of another skeleton, and score them against its truth.

The paper drives its avatars with motions of AMASS and shows pictures: nobody filmed the person doing that. Here the
truth for any motion can be rendered.
"""

import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from ash.capture import novelty
from ash.capture.dataset import Capture, Motion
from ash.capture.formats import load_capture, read_template_truth
from ash.files import InputError, sha256_of, write_image, write_json
from benchmarks.cell import metrics
from benchmarks.cell.evaluation import spread
from benchmarks.cell.registry import ORACLES
from benchmarks.cell.run import trained_client
from benchmarks.cell.schema import Cell, Killed, MethodFailed, View, is_trained, result_of
from benchmarks.cell.worker import TEST_VIEWS
from benchmarks.report.pictures import on_paper
from benchmarks.suites.progress import Progress
from synth.capture import make_body, make_capture
from synth.motion.importing import read_motion_file
from synth.motion.strip import describe
from synth.truth.retargeting import recorded_scene, retargeted

STRIP_FRAMES = 6


@dataclass(frozen=True, kw_only=True, slots=True)
class Retargeted:
    """How one avatar came through: means over cameras and frames, and beside them its own test motion's."""

    title: str
    method: str
    seed: int
    psnr: float  # foreground, dB
    ssim: float  # foreground
    flip: float  # foreground
    iou: float
    template_mm: float | None  # None where the method shows no template
    own_psnr: float | None  # foreground, dB, on the test motion of its capture
    frame_psnr: tuple[float, ...]  # foreground, mean over cameras


def retarget(cells: list[Cell], motion: Path, out: Path, *, frames: int, workers: int) -> list[Retargeted]:
    """Render the truth of the motion into `out`, score every avatar on it, and draw a strip of pictures of each.

    Raises:
        InputError: nothing to drive, the motion cannot be read, or a capture is not a scene of this version.
    """
    driven = [cell for cell in cells if cell.config.source not in ORACLES and is_trained(cell)]
    if not driven:
        raise InputError("no trained avatar to drive (oracles know their surface for their capture's motion only)")
    rows = []
    for place in dict.fromkeys(cell.capture_folder for cell in driven):
        own = load_capture(place)
        truth = render_truth(own, motion, out / f"truth-{place.name}", frames=frames, workers=workers)
        far = novelty_deg(own, truth)
        here = [cell for cell in driven if cell.capture_folder == place]
        scored = [score(cell, own, truth, out) for cell in here]
        rows += scored
        content = {
            "scene": own.scene,
            "capture": own.identity,
            "motion": motion.name,
            "motion_sha256": sha256_of(motion),
            "frames": len(truth.splits["novel_pose"].frames),
            "fps": truth.motion.fps,
            "made_by_the_same_code": own.manifest.code == truth.manifest.code,
            "novelty_deg": far,
            "avatars": [asdict(row) for row in scored],
        }
        write_json(out / f"result-{place.name}.json", content)
    return rows


def render_truth(own: Capture, motion: Path, folder: Path, *, frames: int, workers: int) -> Capture:
    """The capture of the same person doing what the motion file says."""
    scene = recorded_scene(own.manifest, own.folder)
    body = make_body(scene)
    print(describe(read_motion_file(motion, body.skeleton, fps=scene.fps, most=frames)), file=sys.stderr)
    driven = retargeted(scene, body, motion, frames=frames)
    progress = Progress(f"images of {motion.name}", 0, expected_s=0.0, workers=workers)
    make_capture(driven, folder, workers=workers, progress=progress.advance)
    progress.close()
    truth = load_capture(folder)
    if own.manifest.code != truth.manifest.code:
        progress.say(f"{own.folder} was rendered by other code: its person may differ a little from the truth's")
    return truth


def score(cell: Cell, own: Capture, truth: Capture, out: Path) -> Retargeted:
    """Drive one avatar and compare it with the truth."""
    split = truth.splits["novel_pose"]
    images, vertices = drawn_in_isolation(cell, own, truth)
    scores = {view: metrics.score_view(image, metrics.on_black(truth.image(*view))) for view, image in images.items()}
    write_image(
        out / f"strip-{cell.capture_folder.name}-{cell.config.method}-{cell.config.seed}.png", strip(truth, images)
    )
    before = result_of(cell)

    def mean(region: str, metric: str) -> float:
        return float(np.mean([scored[region, metric] for scored in scores.values()]))

    return Retargeted(
        title=cell.config.title,
        method=cell.config.method,
        seed=cell.config.seed,
        psnr=mean("foreground", "psnr"),
        ssim=mean("foreground", "ssim"),
        flip=mean("foreground", "flip"),
        iou=mean("full", "iou"),
        template_mm=_template_mm(truth, vertices),
        own_psnr=None if before is None else before.value("novel_pose", "foreground", "psnr"),
        frame_psnr=tuple(
            float(np.mean([scores[camera, frame]["foreground", "psnr"] for camera in split.cameras]))
            for frame in split.frames
        ),
    )


def drawn_in_isolation(
    cell: Cell, own: Capture, truth: Capture
) -> tuple[dict[tuple[str, int], np.ndarray], dict[int, np.ndarray]]:
    """What the avatar draws of the motion (uint8 `[h, w, 4]` by camera and frame), and its template by frame.

    The method runs as in a cell: in a process of its own, which sees neither capture's truth.

    Raises:
        InputError: it does not load or draw any more.
    """
    split, vertices = truth.splits["novel_pose"], {}
    views = [View(split="novel_pose", camera=camera, frame=frame) for camera, frame in split.views]
    try:
        with trained_client(cell, own, secret=(truth.folder, truth.folder.parent)) as client:
            client.load_test_views(cell.folder.resolve() / TEST_VIEWS, truth)
            images = {(v.camera, v.frame): metrics.quantise(client.draw(v, truth.cameras[v.camera])) for v in views}
            if client.describe().geometry:
                vertices = {frame: client.geometry("vertices", frame) for frame in split.frames}
    except (MethodFailed, Killed) as error:
        raise InputError(f"{cell.folder}: {error or 'its process was killed'}") from error
    return images, vertices


def novelty_deg(own: Capture, truth: Capture) -> float:
    """How far the motion's poses lie from the nearest training pose, mean over them, degrees."""
    train, test = own.splits["train"].frames, truth.splits["novel_pose"].frames
    dofs = np.concatenate([own.motion.dofs[list(train)], truth.motion.dofs[list(test)]])
    both = Motion(dofs=dofs, sequence=np.zeros(len(dofs), dtype=np.int64), fps=truth.motion.fps)
    each = novelty.novelty_deg(both, train=range(len(train)), test=range(len(train), len(dofs)))
    return float(np.mean(each))


def strip(truth: Capture, images: dict[tuple[str, int], np.ndarray]) -> np.ndarray:
    """Truth above, the avatar below, in a few frames of the first held-out camera; uint8 `[h, w, 3]` on light grey."""
    split = truth.splits["novel_pose"]
    camera = split.cameras[0]
    frames = [split.frames[i] for i in spread(len(split.frames), STRIP_FRAMES)]
    pairs = [(metrics.on_black(truth.image(camera, frame)), images[camera, frame]) for frame in frames]
    seen = np.any([image[..., 3] > 0 for pair in pairs for image in pair], axis=0)
    window = metrics.occupied(seen, 0) or (slice(None), slice(None))
    rows = [[on_paper(pair[row][window]) for pair in pairs] for row in range(2)]
    return np.concatenate([np.concatenate(row, axis=1) for row in rows], axis=0)


def _template_mm(truth: Capture, vertices: dict[int, np.ndarray]) -> float | None:
    return metrics.template_error_mm(list(vertices.values()), read_template_truth(truth)[list(vertices)])
