import json
import shutil
import zipfile

import numpy as np
import pytest
from helpers.figures import front_camera, ring_cameras, tube_mesh, tube_motion, tube_skeleton

from ash.capture.dataset import fewer_views, image_path
from ash.capture.formats import (
    load_capture,
    read_cameras,
    read_motion,
    read_skeleton,
    read_template,
    write_cameras,
    write_motion,
    write_skeleton,
    write_template,
)
from ash.capture.manifest import verify_capture
from ash.files import InputError, read_arrays, sha256_of, write_arrays, write_atomic, write_image, write_json


def write_all_but_images(folder, cameras):
    write_cameras(folder / "cameras.json", cameras)
    write_skeleton(folder / "skeleton.json", tube_skeleton())
    write_template(folder / "template.npz", tube_mesh())
    write_motion(folder / "motion.npz", tube_motion(2))


@pytest.fixture
def capture_folder(tmp_path):
    """A whole capture of one camera and two frames, without truth."""
    folder = tmp_path / "capture"
    write_all_but_images(folder, [front_camera(16, 12)])
    for frame in (0, 1):
        write_image(image_path(folder, "front", frame), np.full((12, 16, 4), 7 * frame, dtype=np.uint8))
    seal(folder)
    return folder


def seal(folder, **changes):
    files = {str(p.relative_to(folder)): sha256_of(p) for p in folder.rglob("*") if p.is_file()}
    files.pop("manifest.json", None)
    split = {"cameras": ["front"], "frames": [0, 1]}
    manifest = {"schema": 1, "scene": "tube", "seed": 0, "splits": {"train": split}, "files": files, "complete": True}
    write_json(folder / "manifest.json", manifest | changes)


def test_what_is_written_is_read_back(capture_folder):
    capture = load_capture(capture_folder)
    mesh, motion = tube_mesh(), tube_motion(2)
    for name in ("vertices", "faces", "uvs", "uv_faces", "skin_weights"):
        np.testing.assert_array_equal(getattr(capture.template, name), getattr(mesh, name))
    np.testing.assert_array_equal(capture.motion.dofs, motion.dofs)
    np.testing.assert_array_equal(capture.cameras["front"].viewmat, front_camera(16, 12).viewmat)
    assert capture.skeleton.names == ("root", "bend")
    assert (capture.image("front", 1) == 7).all()
    assert verify_capture(capture_folder) == []


def test_verify_finds_flipped_missing_and_foreign_files(capture_folder):
    damaged = image_path(capture_folder, "front", 0)
    content = bytearray(damaged.read_bytes())
    content[-20] ^= 1
    damaged.write_bytes(bytes(content))
    image_path(capture_folder, "front", 1).unlink()
    (capture_folder / "stray.txt").write_text("?")
    problems = "\n".join(verify_capture(capture_folder))
    assert "000000.png: altered" in problems
    assert "000001.png: missing" in problems
    assert "stray.txt: not in the manifest" in problems


def test_verify_does_not_leave_the_folder(capture_folder):
    manifest = json.loads((capture_folder / "manifest.json").read_text())
    manifest["files"]["../outside"] = "0" * 64
    write_json(capture_folder / "manifest.json", manifest)
    assert "../outside: outside the capture" in verify_capture(capture_folder)


def test_a_motion_file_that_unpacks_to_gigabytes_is_refused_before_memory_is_taken(capture_folder):
    with zipfile.ZipFile(capture_folder / "motion.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("sequence", "fps", "dofs"):
            with archive.open(f"{name}.npy", "w") as entry:
                np.lib.format.write_array_header_1_0(
                    entry, {"descr": "<f8", "fortran_order": False, "shape": (17 << 20,)}
                )
                for _ in range(17):
                    entry.write(bytes(8 << 20))
    with pytest.raises(InputError, match=r"motion\.npz: .* bytes unpacked, expected at most"):
        load_capture(capture_folder)


def test_another_schema_or_an_unfinished_capture_is_refused(capture_folder):
    seal(capture_folder, schema=99)
    with pytest.raises(InputError, match="expected capture schema 1, got 99"):
        load_capture(capture_folder)
    seal(capture_folder, complete=False)
    with pytest.raises(InputError, match="unfinished"):
        load_capture(capture_folder)


def test_missing_truncated_and_misshapen_images_are_named(capture_folder):
    capture = load_capture(capture_folder)
    path = image_path(capture_folder, "front", 0)
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(InputError, match=r"000000\.png: expected a PNG image"):
        capture.image("front", 0)
    write_image(path, np.zeros((3, 3, 4), dtype=np.uint8))
    with pytest.raises(InputError, match=r"expected a PNG image of shape \(12, 16, 4\), uint8, got RGBA \(3, 3\)"):
        capture.image("front", 0)
    path.unlink()
    with pytest.raises(InputError, match=r"000000\.png"):
        capture.image("front", 0)


@pytest.mark.parametrize(
    ("file", "place", "value", "message"),
    [
        *(("cameras", (0, "name"), name, "camera name") for name in ("../evil", "/etc", "", "a b", 3)),
        ("cameras", (0, "viewmat", 0, 0), -1.0, "not orthonormal"),
        ("joints", (1, "parent"), 1, "every parent before its children"),
    ],
)
def test_cameras_and_joints_that_cannot_be_are_refused(capture_folder, file, place, value, message):
    path = capture_folder / ("skeleton.json" if file == "joints" else "cameras.json")
    rows = json.loads(path.read_text())
    owner = rows[file]
    for key in place[:-1]:
        owner = owner[key]
    owner[place[-1]] = value
    write_json(path, rows)
    with pytest.raises(InputError, match=message):
        (read_skeleton if file == "joints" else read_cameras)(path)


def test_meshes_and_motions_that_do_not_fit_are_refused(capture_folder):
    with pytest.raises(InputError, match=r"skin_weights \[v, 5\]"):
        read_template(capture_folder / "template.npz", joints=5)
    with pytest.raises(InputError, match=r"dofs \[t, 18\]"):
        read_motion(capture_folder / "motion.npz", joints=5)


def test_nan_objects_and_lying_headers_are_refused(tmp_path):
    write_arrays(tmp_path / "nan.npz", x=np.array([1.0, np.nan]))
    with pytest.raises(InputError, match="x holds NaN"):
        read_arrays(tmp_path / "nan.npz", expected=("x",))
    np.savez(tmp_path / "objects.npz", x=np.array([{}], dtype=object))
    with pytest.raises(InputError, match=r"objects\.npz"):
        read_arrays(tmp_path / "objects.npz", expected=("x",))
    with zipfile.ZipFile(tmp_path / "huge.npz", "w") as archive:
        header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }"
        archive.writestr("x.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + b"\0" * 8)
    with pytest.raises(InputError, match="promises 8000000000000 bytes"):
        read_arrays(tmp_path / "huge.npz", expected=("x",))


def test_training_only_hides_held_out_views_and_test_motion(capture_folder):
    split = {"cameras": ["front"], "frames": [0]}
    seal(capture_folder, splits={"train": split, "novel_pose": {"cameras": ["front"], "frames": [1]}})
    training = load_capture(capture_folder).training_only()
    assert set(training.splits) == {"train"}
    assert len(training.motion.dofs) == 1


def test_a_failed_write_leaves_the_old_content_and_no_litter(tmp_path, monkeypatch):
    write_atomic(tmp_path / "x", b"old")
    monkeypatch.setattr("os.fsync", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space left"):
        write_atomic(tmp_path / "x", b"new")
    assert (tmp_path / "x").read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["x"]


def test_written_files_are_as_readable_as_any(tmp_path):
    write_atomic(tmp_path / "x", b"content")
    (tmp_path / "plain").write_bytes(b"content")
    assert (tmp_path / "x").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_windows_stop_at_the_start_of_their_sequence():
    motion = tube_motion(6)
    motion.sequence[3:] = 1
    np.testing.assert_array_equal(motion.window(2, 3), [2, 1, 0])
    np.testing.assert_array_equal(motion.window(0, 3), [0, 0, 0])
    np.testing.assert_array_equal(motion.window(4, 3), [4, 3, 3])


def test_a_capture_moves_with_its_folder(capture_folder, tmp_path):
    moved = shutil.copytree(capture_folder, tmp_path / "elsewhere")
    assert load_capture(moved).identity == load_capture(capture_folder).identity


def test_fewer_views_take_the_first_frames(capture_folder):
    seal(capture_folder, splits={name: {"cameras": ["front"], "frames": [0, 1]} for name in ("train", "novel_view")})
    capture = load_capture(capture_folder)
    fewer = fewer_views(capture, footage_s=1 / capture.motion.fps).splits
    assert fewer["train"] == capture.splits["train"].only(frames=[0])
    assert fewer["novel_view"] == capture.splits["novel_view"]
    assert len(fewer_views(capture, footage_s=0.001).splits["train"].frames) == 1
    assert fewer_views(capture, footage_s=1e6).splits == capture.splits


def test_fewer_cameras_are_evenly_spread_and_nested(tmp_path):
    cameras = ring_cameras(12, 16)
    write_all_but_images(tmp_path, cameras)
    seal(tmp_path, splits={"train": {"cameras": [c.name for c in cameras], "frames": [0]}})
    capture = load_capture(tmp_path)
    quarter = fewer_views(capture, cameras=0.25).splits["train"].cameras
    half = fewer_views(capture, cameras=0.5).splits["train"].cameras
    assert len(quarter) == 3 and len(half) == 6
    assert set(quarter) < set(half)
    numbers = sorted(int(name[3:]) for name in half)
    gaps = np.diff([*numbers, numbers[0] + 12])
    assert gaps.max() <= 3  # Six of twelve on a ring: never more than three steps apart.
    assert fewer_views(capture, cameras=1.0).splits["train"].cameras == capture.splits["train"].cameras
    assert len(fewer_views(capture, cameras=0.01).splits["train"].cameras) == 1
