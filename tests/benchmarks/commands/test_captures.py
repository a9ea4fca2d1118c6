"""The door's capture commands, with files that users bring: good ones, broken ones and hostile ones."""

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
    """Two shards render it; what comes out moves as the files say and is seen by the cameras given."""
    motion = amass_file(tmp_path / "walk.npz", mocap_framerate=np.array(12.0))
    test = bvh_file(tmp_path / "turn.bvh")
    test.write_text(test.read_text().replace("0.04", "0.0833333"))
    out = tmp_path / "capture"
    command = ["synth", "mannequin", "--size", "ci", "--out", str(out), "--workers", "1"]
    command += ["--motion", str(motion), "--test-motion", str(test), "--rig", str(rig)]
    assert main([*command, "--shard", "2/2"]) == 0
    assert "shard is done" in capsys.readouterr().err
    assert main([*command, "--shard", "1/2"]) == 0
    told = capsys.readouterr().err
    assert "core-minutes" in told and "degrees from the nearest training pose" in told
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


def _bad_rigs(rig: Path) -> dict[str, str]:
    rows = json.loads(rig.read_text())["cameras"]

    def changed(**fields) -> str:
        return json.dumps({"cameras": [rows[0], {**rows[1], **fields}]})

    shifted = np.array(rows[1]["viewmat"])
    shifted[2, 3] = -5.0
    return {
        "camera name": changed(name="../../etc/passwd"),
        "expected a camera name": changed(name="/absolute"),
        "two cameras are called": changed(name=rows[0]["name"]),
        "not orthonormal": changed(viewmat=(2 * np.eye(4)).tolist()),
        "finite numbers": changed(K=[[float("nan")] * 3] * 3),
        "fx, fy > 0": changed(K=[[-50, 0, 32], [0, 50, 32], [0, 0, 1]]),
        "one size": changed(width=65),
        "16384": changed(width=10**9),
        "in front of it": changed(viewmat=shifted.tolist()),
        "folds": changed(distortion=[-9.0, 0, 0, 0]),
        "shape": changed(distortion=[0.1]),
        "held out": json.dumps({"cameras": rows[:1]}),
        "at least one camera": '{"cameras": []}',
        "list of cameras": '{"cameras": 7}',
        "not valid JSON": "[" * 200_000,
        "JSON": '{"cameras": [',
    }


@pytest.mark.parametrize("message", [
    "camera name", "expected a camera name", "two cameras are called", "not orthonormal", "finite numbers",
    "fx, fy > 0", "one size", "16384", "in front of it", "folds", "shape", "held out", "at least one camera",
    "list of cameras", "not valid JSON", "JSON",
])  # fmt: skip
def test_bad_rigs_end_in_one_clear_line(message: str, rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    path = tmp_path / "bad.json"
    path.write_text(_bad_rigs(rig)[message])
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


def test_export_and_undistort_have_doors(tmp_path: Path, capsys: pytest.CaptureFixture, small_capture: Path):
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


def test_modules_where_the_user_stands_replace_none_of_ours(tmp_path: Path) -> None:
    """Also in the processes that probe the renderer and that render."""
    (tmp_path / "random.py").write_text("raise RuntimeError('the wrong module')\n")
    command = [sys.executable, "-P", "-m", "benchmarks.cli", "synth", "mannequin", "--size", "ci", "--out", "capture"]
    command += ["--workers", "2", "--rig.cameras", "4", "--rig.width", "64", "--rig.height", "64"]
    command += ["--samples", "4", "--texture", "256"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "capture" / "manifest.json").is_file()
