import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from helpers.motion_files import amass_file, bvh_file

from ash.files import InputError, write_arrays
from synth.motion.importing import import_motion, read_joint_map, read_motion_file
from synth.motion.strip import LEFT, RIGHT, describe, draw_strip
from synth.person.mannequin import heads
from synth.posing import bone_frames
from synth.scene import Take
from synth.skeleton import make_skeleton

SKELETON = make_skeleton(heads())


def _directions(dofs: np.ndarray) -> dict[str, np.ndarray]:
    """World direction of each bone, `[t, 3]`, named by the joint at its start."""
    frames = bone_frames(SKELETON, dofs)[:, :, :3, 3]
    result = {}
    for j, parent in enumerate(SKELETON.parents):
        if parent >= 0:
            bone = frames[:, j] - frames[:, parent]
            result[SKELETON.names[j]] = bone / np.linalg.norm(bone, axis=1, keepdims=True)
    return result


def test_amass_poses_become_our_directions(tmp_path: Path):
    motion = import_motion(amass_file(tmp_path / "walk.npz"), SKELETON)
    bones = _directions(motion.dofs)
    assert motion.fps == 60 and len(motion.dofs) == 5
    np.testing.assert_allclose(bones["forearm_left"][0], [1, 0, 0], atol=1e-9)  # T-pose, though ours rests in an A
    np.testing.assert_allclose(bones["hand_right"][0], [-1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(bones["shin_left"][0], [0, -1, 0], atol=1e-9)
    np.testing.assert_allclose(bones["foot_left"][2], [0, -np.cos(1), -np.sin(1)], atol=1e-9)  # the shin swings back
    np.testing.assert_allclose(bones["forearm_left"][3], [np.cos(1.2), -np.sin(1.2), 0], atol=1e-9)
    np.testing.assert_allclose(bones["foot_right"][4], [0, -1, 0], atol=1e-9)
    path = bone_frames(SKELETON, motion.dofs)[:, 0, :3, 3]
    assert path[-1, 2] - path[0, 2] > 0.9 and abs(path[-1, 0] - path[0, 0]) < 1e-9  # -y there is forward (+z) here
    toes = [SKELETON.names.index(f"toe_{side}") for side in ("left", "right")]
    lowest = (bone_frames(SKELETON, motion.dofs)[:, toes, 1, 3] - SKELETON.heads[toes, 1]).min()
    assert abs(lowest) < 1e-9


def test_bvh_turns_and_bends_what_it_says(tmp_path: Path):
    motion = import_motion(bvh_file(tmp_path / "turn.bvh"), SKELETON)
    assert motion.fps == pytest.approx(25)
    bones = _directions(motion.dofs)
    np.testing.assert_allclose(bones["shin_left"][0], [0, -1, 0], atol=1e-9)
    # The pelvis faces +x after a quarter turn about y, so a knee bent by 60 degrees points the shin to -x.
    np.testing.assert_allclose(bones["foot_left"][1], [-np.sin(np.pi / 3), -0.5, 0], atol=1e-9)
    np.testing.assert_allclose(bones["foot_right"][1], [0, -1, 0], atol=1e-9)
    hip, ankle = (SKELETON.heads[SKELETON.names.index(name)] for name in ("thigh_left", "foot_left"))
    leg = np.linalg.norm(ankle - hip)
    np.testing.assert_allclose(motion.dofs[1, 2] - motion.dofs[0, 2], 40 * leg / 80, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "BVH"),
        ("HIERARCHY ROOT", "BVH"),
        ("HIERARCHY ROOT Hips { OFFSET 0 0", "BVH"),
        ("HIERARCHY } } MOTION", "BVH"),
        ("HIERARCHY ROOT Hips { OFFSET 0 0 nan CHANNELS 0 } MOTION", "finite"),
        ("HIERARCHY ROOT Hips { CHANNELS 1000000000 } MOTION", "channels"),
        ("HIERARCHY ROOT A { OFFSET 0 0 0 CHANNELS 1 Xrotation } MOTION Frames: 1 Frame Time: 0.1 0", "no joint"),
        ("\x00\x01\x02 binary", "HIERARCHY"),
    ],
)  # fmt: skip
def test_broken_bvh_is_refused(tmp_path: Path, text: str, message: str):
    path = tmp_path / "broken.bvh"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        import_motion(path, SKELETON)


def test_bvh_that_promises_too_much_is_refused(tmp_path: Path):
    path = bvh_file(tmp_path / "short.bvh", frames="0 0 0\n")
    with pytest.raises(InputError, match="3 numbers found"):
        import_motion(path, SKELETON)
    path.write_text(path.read_text().replace("Frames: 2", "Frames: 1000000000"))
    with pytest.raises(InputError, match="1000000000 frames"):
        import_motion(path, SKELETON)
    path.write_text("HIERARCHY " + "JOINT a { " * 600)
    with pytest.raises(InputError, match="more than 512 joints"):
        import_motion(path, SKELETON)


def test_hostile_npz_is_refused(tmp_path: Path):
    poses = np.zeros((5, 156))
    bad = {
        "finite": {"poses": np.full((5, 156), np.nan)},
        "shape": {"poses": poses[:, :60]},
        "trans": {"trans": np.zeros((4, 3))},
        "mocap_framerate": {"mocap_framerate": np.array(-1.0)},
        "allow_pickle|Object arrays|npz": {"trans": np.array([{"a": 1}] * 5, dtype=object)},
    }
    for message, changes in bad.items():
        with pytest.raises(InputError, match=message):
            import_motion(amass_file(tmp_path / "bad.npz", **changes), SKELETON)
    whole = amass_file(tmp_path / "cut.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="npz"):
        import_motion(tmp_path / "cut.npz", SKELETON)
    with pytest.raises(InputError, match="cannot be read"):
        import_motion(tmp_path / "absent.bvh", SKELETON)
    with pytest.raises(InputError, match=r"\.bvh or an AMASS"):
        import_motion(tmp_path / "dance.fbx", SKELETON)


def _tipped(text: str, order: tuple[int, int, int], signs: tuple[int, int, int]) -> str:
    """The same BVH in a world with other axes: what was axis k there is now axis `order[k]`, times its sign."""
    names, lines, motion = "xyz", [], False
    channels: list[str] = []
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["OFFSET"]:
            moved = [0.0] * 3
            for k in range(3):
                moved[order[k]] = signs[k] * float(words[1 + k])
            line = "OFFSET " + " ".join(str(value) for value in moved)
        elif words[:1] == ["CHANNELS"]:
            line = f"CHANNELS {words[1]} " + " ".join(
                names[order[names.index(w[0].lower())]] + w[1:] for w in words[2:]
            )
            channels += words[2:]
        elif motion:
            # The change of axes is a rotation, so angles about the moved axes keep their values.
            axes = [names.index(channel[0].lower()) for channel in channels]
            line = " ".join(str(signs[axis] * float(word)) for axis, word in zip(axes, words, strict=True))
        motion = motion or words[:2] == ["Frame", "Time:"]
        lines.append(line)
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("up", "order", "signs"),
    [("z", (0, 2, 1), (1, 1, -1)), ("x", (1, 0, 2), (1, 1, -1)), ("-y", (0, 1, 2), (1, -1, -1)),
     ("z", (1, 2, 0), (1, 1, 1))],
)  # fmt: skip
def test_the_up_axis_is_found(tmp_path: Path, up: str, order: tuple[int, int, int], signs: tuple[int, int, int]):
    plain = bvh_file(tmp_path / "plain.bvh")
    (tmp_path / "tipped.bvh").write_text(_tipped(plain.read_text(), order, signs))
    found = read_motion_file(tmp_path / "tipped.bvh", SKELETON)
    assert found.up == up and found.head_above_hips == 1.0
    wanted, got = (_directions(m.dofs) for m in (import_motion(plain, SKELETON), found.motion))
    turned = {name: got[name] @ _yaw_between(got, wanted).T for name in got}
    for name in wanted:
        np.testing.assert_allclose(turned[name], wanted[name], atol=1e-9)


def _yaw_between(got: dict[str, np.ndarray], wanted: dict[str, np.ndarray]) -> np.ndarray:
    """Which way is north is free; the line between the hips tells."""
    a, b = got["thigh_left"][0], wanted["thigh_left"][0]
    angle = np.arctan2(b[0], b[2]) - np.arctan2(a[0], a[2])
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def test_an_amass_world_with_y_up_is_found(tmp_path: Path):
    poses = np.zeros((5, 156))  # SMPL's own rest pose
    root = np.linspace([0, 0.9, 0], [0, 0.9, 1.0], 5)
    found = read_motion_file(amass_file(tmp_path / "y.npz", poses=poses, trans=root), SKELETON)
    assert found.up == "y" and found.head_above_hips == 1.0
    assert read_motion_file(amass_file(tmp_path / "z.npz"), SKELETON).up == "z"


def test_a_person_on_their_head_is_refused(tmp_path: Path):
    path = bvh_file(tmp_path / "turn.bvh")
    with pytest.raises(InputError, match=r"head is above the hips in 0% of the frames.*--up"):
        import_motion(path, SKELETON, take=Take(up="-y"))
    poses = np.zeros((5, 156))
    poses[:, 0] = -np.pi / 2  # upside down in a world with z up, hanging below its origin
    with pytest.raises(InputError, match=r"head is above|not clear which axis"):
        import_motion(amass_file(tmp_path / "down.npz", poses=poses), SKELETON, take=Take(up="z"))


def test_a_rest_pose_that_lies_is_refused(tmp_path: Path):
    path = bvh_file(tmp_path / "bones.bvh")
    path.write_text(
        path.read_text().replace("OFFSET 0 10 0", "OFFSET 10 0 0").replace("OFFSET 0 -40 0", "OFFSET 40 0 0")
    )
    with pytest.raises(InputError, match=r"rest pose .* does not stand upright"):
        import_motion(path, SKELETON)


def test_a_take_is_a_part_of_the_file(tmp_path: Path):
    path = amass_file(tmp_path / "walk.npz")
    whole = import_motion(path, SKELETON)
    for take, frames in (
        (Take(start=1 / 60), [1, 2, 3, 4]),
        (Take(start=1 / 60, length=2 / 60), [1, 2]),
        (Take(stride=2), [0, 2, 4]),
    ):
        part = import_motion(path, SKELETON, take=take)
        np.testing.assert_allclose(part.dofs[:, 3:], whole.dofs[frames][:, 3:], atol=1e-12)
    assert len(import_motion(path, SKELETON, most=2).dofs) == 2
    with pytest.raises(InputError, match=r"lasts 0\.08 s"):
        import_motion(path, SKELETON, take=Take(start=3.0))
    for wrong in ({"up": "w"}, {"start": -1.0}, {"length": 0.0}, {"stride": 0}, {"start": float("nan")}):
        with pytest.raises(InputError):
            Take(**wrong)


def test_a_joint_map_names_what_no_rule_knows(tmp_path: Path):
    path = bvh_file(tmp_path / "odd.bvh")
    plain = import_motion(path, SKELETON)
    path.write_text(path.read_text().replace("Hips", "Bone001").replace("LeftUpLeg", "Bone002"))
    with pytest.raises(InputError, match=r"no joint for pelvis, thigh_left .*Bone001.*--joint-map"):
        import_motion(path, SKELETON)
    names = tmp_path / "names.json"
    names.write_text('{"pelvis": "Bone001", "thigh_left": "Bone002"}')
    np.testing.assert_allclose(import_motion(path, SKELETON, take=Take(joints=read_joint_map(names))).dofs, plain.dofs)
    for text, message in (
        ('{"hip": "Bone001"}', "unknown joint 'hip'"), ("[]", "expected an object"), ('{"pelvis": 3}', "an object"),
    ):  # fmt: skip
        names.write_text(text)
        with pytest.raises(InputError, match=message):
            read_joint_map(names)
    with pytest.raises(InputError, match="gives pelvis as 'Nobody'"):
        import_motion(path, SKELETON, take=Take(joints=(("pelvis", "Nobody"),)))
    with pytest.raises(InputError, match="no joint map"):
        import_motion(amass_file(tmp_path / "w.npz"), SKELETON, take=Take(joints=(("pelvis", "a"),)))


def test_small_files_take_little_memory(tmp_path: Path):
    """Half a megabyte of zeros promises a million frames: they are counted, cut or refused before they are rotated."""
    many = np.zeros((200_000, 66))
    path = tmp_path / "bomb.npz"
    write_arrays(path, poses=many, trans=np.zeros((200_000, 3)), mocap_framerate=np.array(60.0))
    with pytest.raises(InputError, match="take fewer"):
        import_motion(path, SKELETON, take=Take(up="y"))
    tracemalloc.start()
    assert len(import_motion(path, SKELETON, fps=12.0, most=50, take=Take(up="y")).dofs) == 50
    assert tracemalloc.get_traced_memory()[1] < 2.2 * many.nbytes
    tracemalloc.stop()
    path = bvh_file(tmp_path / "long.bvh", frames="0 " * (27 * 120_000))
    path.write_text(path.read_text().replace("Frames: 2", "Frames: 120000"))
    with pytest.raises(InputError, match="take fewer"):
        import_motion(path, SKELETON)
    tracemalloc.start()
    assert len(import_motion(path, SKELETON, fps=12.0, most=50).dofs) == 50
    assert tracemalloc.get_traced_memory()[1] < 8e6
    tracemalloc.stop()


def test_a_strip_shows_the_skeleton(tmp_path: Path):
    found = read_motion_file(bvh_file(tmp_path / "turn.bvh"), SKELETON)
    image = draw_strip(SKELETON, found.motion)
    assert image.dtype == np.uint8 and image.shape[2] == 3
    front = image[: len(image) // 2]
    blue, orange = ((front == colour).all(axis=-1) for colour in (LEFT, RIGHT))
    first = slice(0, front.shape[1] // len(found.motion.dofs))
    assert np.nonzero(blue[:, first])[1].mean() > np.nonzero(orange[:, first])[1].mean(), "its left is at +x"
    assert "y is up" in describe(found) and "2 frames" in describe(found)
