"""A trained avatar driven by another skeleton's motion, against the truth that is rendered for it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.scenes import small_scene
from PIL import Image

from ash.capture.formats import load_capture, read_template_truth
from ash.files import InputError
from benchmarks import cli
from benchmarks.commands import arguments
from synth.capture import make_body, make_capture
from synth.motion.importing import import_motion
from synth.scene import Outfit
from synth.truth.retargeting import recorded_scene, retargeted


@pytest.fixture(scope="module")
def motion(tmp_path_factory) -> Path:
    """An AMASS file of SMPL's skeleton at 24 frames per second: arms come down, the left knee bends, a step forward."""
    path = tmp_path_factory.mktemp("motion") / "steps.npz"
    poses = np.zeros((8, 156))
    poses[:, 0] = np.pi / 2
    poses[:, 16 * 3 + 2], poses[:, 17 * 3 + 2] = np.linspace(-0.2, -1.2, 8), np.linspace(0.2, 1.2, 8)
    poses[:, 4 * 3] = np.linspace(0, 0.8, 8)
    np.savez(path, poses=poses, trans=np.linspace([0, 0, 0.9], [0, -0.3, 0.9], 8), mocap_framerate=np.array(24.0))
    return path


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    """Skinned only: the template with the true skinning is exact, so an avatar can be wrong in its colours alone."""
    scene = small_scene(outfit=Outfit(skirt=True))
    return make_capture(scene, tmp_path_factory.mktemp("capture") / "small")


@pytest.fixture(scope="module")
def run(capture: Path, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    short = ["--training.steps", "60", "--training.background", "random", "--row", "static"]
    other = shutil.copytree(capture, capture.parent / "other")  # Of the same scene, as another person's is.
    one_more = ["--seed", "1"]
    for method, place, more in (("static", capture, short), ("nearest", capture, []), ("nearest", other, one_more)):
        command = ["train", method, str(place), "--preset", "ci", "--out", str(folder)]
        assert cli.main([*command, *more]) == arguments.DONE
    return folder


def test_avatars_are_driven_by_the_motion_and_scored_against_its_truth(
    run: Path, motion: Path, capture: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = run / "out"
    command = ["eval", str(run), "--motion", str(motion), "--frames", "3", "--out", str(out), "--workers", "1"]
    assert cli.main(command) == arguments.DONE
    content = json.loads((out / "result-small.json").read_text())
    rows = sorted(content["avatars"], key=lambda row: row["method"], reverse=True)
    printed = capsys.readouterr()
    assert "steps.npz" in printed.out and "joints matched" in printed.err
    assert content["frames"] == 3 and content["made_by_the_same_code"] and 1 < content["novelty_deg"] < 90
    assert [row["method"] for row in rows] == ["static", "nearest"] and rows[0]["template_mm"] < 0.01
    assert rows[0]["iou"] > 0.8 and rows[0]["iou"] > rows[1]["iou"] + 0.05, "the avatar is where the motion says"
    assert rows[0]["psnr"] > rows[1]["psnr"] + 1, "driven is better than looked up"
    assert len(rows[0]["frame_psnr"]) == 3 and rows[0]["own_psnr"] > 5
    (beside,) = json.loads((out / "result-other.json").read_text())["avatars"]
    assert (beside["method"], beside["seed"]) == ("nearest", 1), "each capture has files of its own"
    truth = load_capture(out / "truth-small")
    wanted = import_motion(motion, truth.skeleton, fps=12.0)
    frames = list(truth.splits["novel_pose"].frames)
    np.testing.assert_allclose(truth.motion.dofs[frames][:, 3:], wanted.dofs[:3, 3:], atol=1e-9)
    np.testing.assert_array_equal(truth.template.vertices, load_capture(capture).template.vertices)
    assert np.ptp(read_template_truth(truth)[frames], axis=0).max() > 0.1
    with Image.open(out / "strip-small-static-0.png") as strip:
        assert strip.width % 3 == 0 and strip.height % 2 == 0 and np.asarray(strip).std() > 20


def test_the_scene_of_a_capture_comes_back_from_its_manifest(capture: Path, motion: Path) -> None:
    manifest = load_capture(capture).manifest
    scene = recorded_scene(manifest, capture)
    assert scene == small_scene(outfit=Outfit(skirt=True))
    driven = retargeted(scene, make_body(scene), motion, frames=3)
    assert driven.identity != scene.identity
    stored = json.loads(json.dumps(driven.parameters))
    assert recorded_scene(replace(manifest, parameters=stored, identity=driven.identity), capture) == driven
    with pytest.raises(InputError, match="another scene"):
        recorded_scene(replace(manifest, seed=1, parameters=manifest.parameters | {"seed": 1}), capture)
    with pytest.raises(InputError, match="no scene of this version"):
        recorded_scene(replace(manifest, parameters={}), capture)
    with pytest.raises(InputError, match="fps: expected float, got '12'"):
        recorded_scene(replace(manifest, parameters=manifest.parameters | {"fps": "12"}), capture)


def test_nothing_to_drive_and_a_bad_motion_are_refused(run: Path, tmp_path: Path, capsys) -> None:
    (cell, *_) = (run / "cells").iterdir()
    (tmp_path / "bad.bvh").write_text("HIERARCHY nothing")
    assert cli.main(["eval", str(cell), "--motion", str(tmp_path / "bad.bvh")]) == arguments.WRONG_INPUT
    untrained = tmp_path / "cell"
    untrained.mkdir()
    (untrained / "config.json").write_bytes((cell / "config.json").read_bytes())
    assert cli.main(["eval", str(untrained), "--motion", str(tmp_path / "bad.bvh")]) == arguments.WRONG_INPUT
    assert "no trained avatar" in capsys.readouterr().err
