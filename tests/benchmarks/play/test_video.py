"""`video`, and the truth of what was never rendered."""

import subprocess
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from helpers.captures import SIZE
from helpers.scoring import psnr
from PIL import Image, ImageSequence

from ash.capture.dataset import Capture, Pose
from ash.capture.formats import load_capture
from ash.files import InputError
from benchmarks import cli
from benchmarks.cell import metrics
from benchmarks.play.avatars import open_avatars
from benchmarks.play.cameras import resized, spiral_camera
from benchmarks.play.motions import motion_clip
from benchmarks.play.truth import TruthRenderer
from benchmarks.play.video import CAPTION
from benchmarks.report.pictures import on_paper


def film(run: Path, out: Path, *more: str) -> int:
    return cli.main(["export", str(run), "--format", "mp4", "--out", str(out), *more])


def panel(frame: np.ndarray, number: int) -> np.ndarray:
    """One picture of a row, without its caption."""
    return frame[CAPTION : CAPTION + SIZE, number * SIZE : (number + 1) * SIZE, :3] / 255


@pytest.mark.parametrize("suffix", [".webp", ".mp4"])
def test_a_film_shows_the_truth_and_each_avatar_side_by_side(tube_run: Path, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"film{suffix}"
    assert film(tube_run, out, "--camera", "cam0", "--truth", "--height", str(SIZE), "--fps", "5") == cli.DONE
    if suffix == ".webp":
        with Image.open(out) as image:
            frames = [np.asarray(each.convert("RGB")) for each in ImageSequence.Iterator(image)]
            assert image.info["duration"] == 200 and image.info["loop"] == 0
    else:
        decode = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(out), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
        messages = subprocess.run(decode, capture_output=True, check=True)
        assert ", 5 fps," in messages.stderr.decode()
        frames = list(np.frombuffer(messages.stdout, np.uint8).reshape(-1, CAPTION + SIZE, 3 * SIZE, 3))
    assert len(frames) == 2 and frames[0].shape == (CAPTION + SIZE, 3 * SIZE, 3)
    with open_avatars(tube_run) as avatars:
        clip, camera = motion_clip(avatars.capture, "test"), avatars.capture.cameras["cam0"]
        for shown, frame in zip(frames, clip.frames, strict=True):
            truth = metrics.on_black(avatars.capture.image("cam0", frame))
            drawn = [avatars[title].on_black(Pose(clip.motion, frame), camera) for title in avatars.titles]
            for number, picture in enumerate([truth, *drawn]):
                request = on_paper(picture) / 255
                assert psnr(panel(shown, number), request, np.ones((SIZE, SIZE))) > 22, "as far as a codec goes"
            assert np.ptp(shown[:CAPTION, :SIZE]) > 100, "the name is burnt in"
            assert psnr(panel(shown, 1), panel(shown, 2), np.ones((SIZE, SIZE))) < 40, "methods differ"


def test_a_rig_gives_a_row_per_avatar_and_a_spiral_turns(tube_run: Path, tmp_path: Path) -> None:
    rig, spiral = tmp_path / "rig.webp", tmp_path / "spiral.webp"
    more = ["--methods", "ddc_plus+steps=60+warmup_steps=10", "--motion", "train", "--height", str(SIZE)]
    assert film(tube_run, rig, *more, "--camera", "rig", "--frames", "1") == cli.DONE
    with Image.open(rig) as image:
        assert image.size == (SIZE, CAPTION + SIZE), "the one held-out camera"
    assert film(tube_run, spiral, *more, "--frames", "0:3") == cli.DONE
    with open_avatars(tube_run) as avatars, Image.open(spiral) as image:
        assert image.n_frames == 3
        positions = [spiral_camera(avatars.capture, step, width=8, height=8).position for step in range(3)]
    assert np.linalg.norm(positions[1] - positions[0]) > 0.01 and np.linalg.norm(positions[2] - positions[0]) > 0.02


def test_what_cannot_be_filmed_is_refused(tube_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, more, words in (
        ("a.gif", [], "ends with .mp4 or .webp for the format mp4"),
        ("a.webp", ["--camera", "cam9"], "expected spiral, rig or one of cam0"),
        ("a.webp", ["--methods", "nerf"], "method: expected one of"),
        ("a.webp", ["--frames", "9"], "within 0:2"),
        ("a.webp", ["--truth", "--frames", "0"], "describes no scene of this version"),
    ):
        assert film(tube_run, tmp_path / name, *more) == cli.WRONG_INPUT, words
        assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def capture(small_capture: Path) -> Capture:
    return load_capture(small_capture)


@pytest.fixture(scope="module")
def truth(capture: Capture):
    """The process that traces light."""
    truth = TruthRenderer(capture.folder)
    yield truth
    truth.close()
    assert truth._process is None


def test_the_truth_rendered_here_is_the_captures_own_image_where_that_exists(
    capture: Capture, truth: TruthRenderer
) -> None:
    camera, frame = capture.splits["novel_pose"].views[0]
    drawn = truth.render(Pose(capture.motion, frame), capture.cameras[camera], captured=True)
    np.testing.assert_array_equal(drawn, metrics.on_black(capture.image(camera, frame)))


def test_the_truth_of_a_pose_that_was_never_rendered(capture: Capture, truth: TruthRenderer) -> None:
    camera, frame = capture.splits["novel_pose"].views[0]
    small, pose = resized(capture.cameras[camera], width=32, height=32), Pose(capture.motion, frame)
    own, again = (truth.render(pose, small, captured=captured) for captured in (True, False))
    raised = capture.motion.dofs.copy()
    arm = 3 + 3 * capture.skeleton.names.index("upper_arm_left")
    raised[:, arm : arm + 3] = 0, 0, np.pi / 3
    other = truth.render(Pose(replace(capture.motion, dofs=raised), frame), small, captured=False)
    assert own.shape == other.shape == (32, 32, 4) and (own[..., 3] > 128).mean() > 0.03
    silhouettes = [picture[..., 3] > 128 for picture in (own, again, other)]
    assert (silhouettes[0] ^ silhouettes[1]).sum() <= 0.05 * silhouettes[0].sum(), "posed anew, it is the same person"
    assert (silhouettes[0] ^ silhouettes[2]).sum() > 0.05 * silhouettes[0].sum(), "with an arm raised"


def test_a_renderer_that_cannot_says_why(tmp_path: Path, capture: Capture) -> None:
    truth = TruthRenderer(tmp_path)
    try:
        with pytest.raises(InputError, match=r"manifest\.json: cannot be read"):
            truth.render(Pose(capture.motion, 0), next(iter(capture.cameras.values())), captured=True)
    finally:
        truth.close()
