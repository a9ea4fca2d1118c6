"""A capture whose training frames are seen by turns, with near and far motion: rendered, perturbed, exported."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.executing import InThisProcess
from helpers.scenes import small_scene

from ash.capture.dataset import Capture, scan_path, surface_path
from ash.capture.formats import load_capture, read_scan, read_template_truth
from ash.capture.manifest import verify_capture
from ash.files import InputError, read_arrays, read_json
from synth.capture import drape, is_finished, make_capture
from synth.export.formats import export
from synth.perturbation.perturb import Perturbation, perturb
from synth.scene import Clip, Rig, Scene
from synth.truth.retargeting import recorded_scene


def rotating_scene() -> Scene:
    """Four training cameras, of which two see each frame."""
    return replace(
        small_scene(),
        rig=Rig(cameras=5, held_out=1, cameras_per_frame=2, width=64, height=64),
        near=(Clip(generator="walk", frames=4, history=1, stride=2),),
        far=(Clip(generator="arms_up", frames=4, history=2, stride=4),),
    )


@pytest.fixture(scope="module")
def capture(shared) -> Capture:
    return load_capture(
        shared("rotating", lambda folder: make_capture(rotating_scene(), folder, executor=InThisProcess()))
    )


def images_of(folder: Path) -> set[tuple[str, int]]:
    return {(path.parent.name, int(path.stem)) for path in (folder / "frames").rglob("*.png")}


def test_only_what_a_split_names_is_rendered(capture):
    assert verify_capture(capture.folder) == [] and is_finished(rotating_scene(), capture.folder)
    assert images_of(capture.folder) == {view for split in capture.splits.values() for view in split.views}
    counts = {name: split.count for name, split in capture.splits.items()}
    assert counts == {"train": 6, "novel_view": 1, "near_pose": 2, "novel_pose": 2, "far_pose": 1}
    assert capture.splits["far_pose"].frames == (5 + 4 + 2,)
    assert len(capture.motion.dofs) == 3 + 2 + 4 + 4
    assert recorded_scene(capture.manifest, capture.folder) == rotating_scene()


def test_a_lost_image_of_a_part_is_noticed(capture, tmp_path):
    perturbed = perturb(capture.folder, tmp_path / "same", Perturbation())
    camera, frame = capture.splits["train"].views[-1]
    (perturbed / f"frames/{camera}/{frame:06d}.png").unlink()
    assert verify_capture(perturbed) == [f"frames/{camera}/{frame:06d}.png: missing"]


def test_scans_know_only_what_the_part_saw(capture):
    whole = len(read_scan(capture, 0)[0])
    assert 0 < whole < 0.8 * len(capture.template.vertices)
    assert not scan_path(capture.folder, capture.splits["near_pose"].frames[0]).exists()


def test_missing_cameras_take_their_pairs_along(capture, tmp_path):
    fewer = load_capture(perturb(capture.folder, tmp_path / "fewer", Perturbation(cameras=2)))
    train = fewer.splits["train"]
    assert set(train.views) == {view for view in capture.splits["train"].views if view[0] in train.cameras}
    assert images_of(fewer.folder) == {view for split in fewer.splits.values() for view in split.views}
    assert verify_capture(fewer.folder) == []


def test_exports_write_the_cameras_of_the_frame_or_refuse(capture, tmp_path):
    export(capture, tmp_path / "nerf", form="nerfstudio")
    for frame in capture.splits["train"].frames:
        rows = read_json(tmp_path / f"nerf/frame_{frame:06d}/transforms.json")["frames"]
        assert [row["file_path"] for row in rows] == [f"images/{n}.png" for n in capture.splits["train"].seeing(frame)]
    export(capture, tmp_path / "colmap", form="colmap", frame=1)
    assert sorted(path.stem for path in (tmp_path / "colmap/images").iterdir()) == sorted(
        capture.splits["train"].seeing(1)
    )
    assert "seen by 2 of its 4 cameras" in (tmp_path / "colmap/ABOUT.txt").read_text()
    with pytest.raises(InputError, match=r"--rig\.cameras-per-frame 0"):
        export(capture, tmp_path / "ash", form="ash")


def test_a_clip_draped_alone_is_as_it_is_side_by_side_with_others(capture, tmp_path):
    clip = np.flatnonzero(capture.motion.sequence == 1)
    alone = drape(rotating_scene(), tmp_path, capture.motion, clip)
    for frame in clip.tolist():
        assert surface_path(tmp_path, frame).read_bytes() == surface_path(capture.folder, frame).read_bytes()
    np.testing.assert_array_equal(alone.template, read_template_truth(capture)[clip])
    told = read_arrays(capture.folder / "truth" / "clothes.npz", expected=("stretch",))
    np.testing.assert_array_equal(alone.stretch, told["stretch"][clip])
