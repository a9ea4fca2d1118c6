"""Commands that make captures, with files that users bring: good ones, broken ones and hostile ones."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.motion_files import amass_file, bvh_file

from ash.capture.formats import load_capture, read_cameras, write_cameras
from benchmarks.cli import main
from synth.camera.rig import rig_from_file
from synth.motion.clips import FLOOR


@pytest.fixture
def rig(tmp_path: Path, small_capture: Path) -> Path:
    """A file of three cameras."""
    cameras = list(read_cameras(small_capture / "cameras.json").values())[:3]
    write_cameras(tmp_path / "rig.json", cameras)
    return tmp_path / "rig.json"


def test_a_users_motion_seen_by_a_users_cameras(rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    """Two shards render it; what comes out moves as the files say and is seen by the cameras given.

    Modules where the user stands replace none of ours, also in the processes that probe the renderer and that render.
    """
    motion = amass_file(tmp_path / "walk.npz", mocap_framerate=np.array(12.0))
    test = bvh_file(tmp_path / "turn.bvh")
    test.write_text(test.read_text().replace("0.04", "0.0833333"))
    out = tmp_path / "capture"
    command = ["synth", "mannequin", "--size", "ci", "--out", str(out), "--workers", "1"]
    command += ["--motion", str(motion), "--test-motion", str(test), "--rig", str(rig)]
    command += ["--samples", "4", "--texture", "256"]
    (tmp_path / "random.py").write_text("raise RuntimeError('the wrong module')\n")
    apart = [sys.executable, "-P", "-m", "benchmarks.cli", *command, "--shard", "2/2"]
    done = subprocess.run(apart, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "shard is done" in done.stderr, done.stderr
    assert "core-minutes" in done.stderr and "degrees from the nearest training pose" in done.stderr
    assert main([*command, "--shard", "1/2"]) == 0
    assert "shard is done" not in capsys.readouterr().err
    capture = load_capture(out)
    assert [len(capture.splits[name].frames) for name in ("train", "novel_pose")] == [5, 2]
    assert list(capture.cameras) == list(read_cameras(rig))
    knee = 3 + 3 * capture.skeleton.names.index("shin_left")
    bend = np.linalg.norm(capture.motion.dofs[:, knee : knee + 3], axis=1)
    assert bend[:2].max() < 0.3 and bend[3] > 0.8
    root = capture.motion.dofs[:5, [0, 2]] + capture.skeleton.heads[0, [0, 2]]
    np.testing.assert_allclose(root.min(axis=0) + root.max(axis=0), 0, atol=1e-9)
    assert all(capture.image(*view)[..., 3].any() for view in capture.splits["train"].views)
    # The same files elsewhere are the same scene; other contents are not.
    moved = tmp_path / "elsewhere.npz"
    moved.write_bytes(motion.read_bytes())
    command[command.index(str(motion))] = str(moved)
    assert main(command) == 0
    assert "1/2" not in capsys.readouterr().err


def test_a_rig_may_be_the_bare_list_of_its_cameras(rig: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare.json"
    bare.write_text(json.dumps(json.loads(rig.read_text())["cameras"]))
    assert rig_from_file(bare) == rig_from_file(rig)


CAMERA = {
    "name": "a",
    "width": 64,
    "height": 64,
    "K": [[50, 0, 32], [0, 50, 32], [0, 0, 1]],
    "viewmat": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]],
}
BAD_RIGS = {  # what is told: how the second of two cameras differs from CAMERA, or the whole file
    "camera name": {"name": "../../etc/passwd"},
    "expected a camera name": {"name": "/absolute"},
    "two cameras are called": {},
    "not orthonormal": {"name": "b", "viewmat": (2 * np.eye(4)).tolist()},
    "finite numbers": {"name": "b", "K": [[float("nan")] * 3] * 3},
    "fx, fy > 0": {"name": "b", "K": [[-50, 0, 32], [0, 50, 32], [0, 0, 1]]},
    "one size": {"name": "b", "width": 65},
    "16384": {"name": "b", "width": 10**9},
    "folds": {"name": "b", "distortion": [-9.0, 0, 0, 0]},
    "shape": {"name": "b", "distortion": [0.1]},
    "held out": json.dumps({"cameras": [CAMERA]}),
    "at least one camera": '{"cameras": []}',
    "list of cameras": '{"cameras": 7}',
    "not valid JSON": "[" * 200_000,
    "JSON": '{"cameras": [',
}


@pytest.mark.parametrize("message", BAD_RIGS)
def test_bad_rigs_end_in_one_clear_line(message: str, tmp_path: Path, capsys: pytest.CaptureFixture):
    path, bad = tmp_path / "bad.json", BAD_RIGS[message]
    path.write_text(bad if isinstance(bad, str) else json.dumps({"cameras": [CAMERA, CAMERA | bad]}))
    _require_refusal(["--rig", str(path)], message, tmp_path, capsys)


def _bad_motion(kind: str, folder: Path) -> Path:
    far = np.linspace([0, 0, 0.9], [0, 2.5 * FLOOR, 0.9], 5)
    if kind == "finite":
        path = bvh_file(folder / "finite.bvh")
        path.write_text(path.read_text().replace("0 0 40", "0 nan 40"))
        return path
    arrays = {
        "far": {"trans": far, "mocap_framerate": np.array(12.0)},
        "slow": {"mocap_framerate": np.array(3.0)},
        "short": {"poses": np.zeros((1, 156)), "trans": far[:1]},
    }
    return amass_file(folder / f"{kind}.npz", **arrays[kind])


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("finite", "finite"), ("far", "expected at most 1.2 m"), ("slow", "frames per second"),
        ("short", "expected at least 2"),
    ],
)  # fmt: skip
def test_bad_motions_end_in_one_clear_line(
    kind: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """What else reading refuses is in tests/synth/motion/test_importing.py and tests/fuzz/test_readers.py."""
    _require_refusal(["--motion", str(_bad_motion(kind, tmp_path))], message, tmp_path, capsys)


def _require_refusal(arguments: list[str], message: str, folder: Path, capsys: pytest.CaptureFixture) -> None:
    out = folder / "out"
    assert main(["synth", "mannequin", "--size", "ci", "--out", str(out), "--workers", "1", *arguments]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("ash-bench: ")]
    assert len(lines) == 1 and message in lines[0]
    assert not list(out.rglob("frames/*/*.png"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--shard", "3/2"], "expected a shard"), (["--executor", "pbs"], "executor")],
)
def test_bad_options_are_refused(arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture):
    _require_refusal(arguments, message, tmp_path, capsys)


def test_a_capture_is_exported_and_undistorted(tmp_path: Path, capsys: pytest.CaptureFixture, small_capture: Path):
    small = str(small_capture)
    assert main(["export", small, "--format", "colmap", "--out", str(tmp_path / "colmap")]) == 0
    assert (tmp_path / "colmap/sparse/0/points3D.txt").is_file()
    assert main(["export", small, "--format", "fbx", "--out", str(tmp_path / "fbx")]) == 2
    assert main(["export", small, "--format", "colmap", "--out", str(tmp_path / "colmap")]) == 2
    assert main(["export", small, "--format", "undistorted", "--out", str(tmp_path / "straight")]) == 0
    assert main(["verify", str(tmp_path / "straight")]) == 0
    files = load_capture(tmp_path / "straight").manifest.files
    assert files == load_capture(small_capture).manifest.files  # Pinholes stay as they are, byte for byte.
    assert "empty folder" in capsys.readouterr().err
