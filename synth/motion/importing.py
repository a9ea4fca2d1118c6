"""Motion from files: BVH and AMASS-style `.npz`, retargeted to our skeleton. Files from users are untrusted input.

Both give world rotations of their joints against a rest pose of their own. Retargeting keeps, for every joint of ours,
the world direction that its bone takes in the file, so bone lengths and rest poses may differ; the root's path is
scaled by the ratio of leg lengths. Which axes are up, in the rest pose and in the world, is found or given.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ash.capture.dataset import Motion, Skeleton
from ash.files import InputError, array_names, read_arrays, read_json
from synth.motion import bvh
from synth.motion.plans import continuous
from synth.posing import bone_frames, nearest_rotation, rotation_between, rotmat_to_rotvec, rotvec_to_rotmat
from synth.scene import Take
from synth.skeleton import JOINTS, SIDES

WHOLE = Take()
MAX_FRAMES = 1_000_000
MAX_BYTES = 128 << 20
LARGEST_MAP = 1 << 16  # bytes of a joint map
CLEAR = 0.6  # how much of the mean direction from feet to head lies along an axis that is up
STANDING = 0.5  # cosine to the vertical of a bone of torso or legs in a rest pose that stands
HEIGHTS = (0.02, 2.5)  # of a root over the floor, in lengths of the leg: lying, and jumping

# SMPL's first 22 joints, as in AMASS: name of ours (or none), parent, and the rest position of the mean body in metres.
SMPL_JOINTS = (
    ("pelvis", -1), ("thigh_left", 0), ("thigh_right", 0), ("", 0), ("shin_left", 1), ("shin_right", 2), ("spine", 3),
    ("foot_left", 4), ("foot_right", 5), ("chest", 6), ("toe_left", 7), ("toe_right", 8), ("neck", 9),
    ("clavicle_left", 9), ("clavicle_right", 9), ("head", 12), ("upper_arm_left", 13), ("upper_arm_right", 14),
    ("forearm_left", 16), ("forearm_right", 17), ("hand_left", 18), ("hand_right", 19),
)  # fmt: skip
SMPL_LEG = 0.8  # metres from hip to ankle
SMPL_DIRECTIONS = {
    **{f"{name}_{side}": (sign, 0.0, 0.0) for name in ("clavicle", "upper_arm", "forearm")
       for side, sign in (("left", 1.0), ("right", -1.0))},
    **{f"{name}_{side}": (0.0, -1.0, 0.0) for name in ("thigh", "shin") for side in ("left", "right")},
    **{f"foot_{side}": (0.0, -0.4, 1.0) for side in ("left", "right")},
}  # fmt: skip

UPRIGHT = ("pelvis", "shin_left", "shin_right", "thigh_left", "thigh_right")  # joints that tell what is up

CHILD = {
    "thigh": "shin",
    "shin": "foot",
    "foot": "toe",
    "clavicle": "upper_arm",
    "upper_arm": "forearm",
    "forearm": "hand",
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Source:
    """Motion of another skeleton: world rotations against its rest pose, for the joints that are ours too."""

    rotations: dict[str, np.ndarray]  # [t, 3, 3] per joint of ours
    directions: dict[str, np.ndarray]  # [3] direction of the joint's bone at rest
    rest: np.ndarray  # [3, 3] rows: which directions at rest are left, up and forward
    usual_up: np.ndarray  # [3] what is up in the world of such files, if their motion does not say otherwise
    root: np.ndarray  # [t, 3] position of the pelvis, in the file's units
    leg: float  # length from hip to ankle, in the file's units
    fps: float
    joints: dict[str, str]  # joints of ours that follow the file, each with the file's name for it
    unmatched: tuple[str, ...] = ()  # joints of the file without a partner
    roots: int = 1  # of the file
    rest_pose: str = "the file's"


@dataclass(frozen=True, kw_only=True, slots=True)
class Imported:
    """A motion file as it was understood."""

    path: Path
    motion: Motion
    up: str  # the axis that is up in the file
    unmatched: tuple[str, ...]  # joints of the file without a partner
    roots: int  # of the file
    rest: str  # where the rest pose comes from
    joints: dict[str, str]  # joints of ours that follow the file, each with the file's name for it
    frames: int  # of the whole file
    fps: float  # of the file
    head_above_hips: float  # share of the frames


def import_motion(
    path: Path, skeleton: Skeleton, *, fps: float | None = None, most: int | None = None, take: Take = WHOLE
) -> Motion:
    """Read a `.bvh` or an AMASS `.npz` file and retarget it; with `fps`, frames nearest to that rate are taken.

    Raises:
        InputError: another kind of file, damaged, too large, without the joints that a person needs, or upside down.
    """
    imported = read_motion_file(path, skeleton, fps=fps, most=most, take=take)
    require_upright(imported)
    return imported.motion


def read_motion_file(
    path: Path, skeleton: Skeleton, *, fps: float | None = None, most: int | None = None, take: Take = WHOLE
) -> Imported:
    """As `import_motion`, whichever way up the person comes out.

    Raises:
        InputError: another kind of file, damaged, too large, or without the joints that a person needs.
    """
    _require_motion_file(path)
    whole: list[tuple[int, float]] = []

    def choose(frames: int, rate: float) -> np.ndarray:
        whole.append((frames, rate))
        return _chosen(path, frames, rate, fps=fps, most=most, take=take)

    if path.suffix.lower() == ".bvh":
        source = _from_bvh(path, choose, take)
    elif take.joints or take.rest_frame is not None:
        raise InputError(f"{path}: its joints and rest pose are SMPL's, expected no joint map and no rest frame")
    else:
        source = read_amass(path, choose, fps=take.fps)
    up = take.up if take.up != "auto" else up_axis(path, source)
    motion = retarget(skeleton, stood_up(source, up))
    (frames, rate) = whole[0]
    motion = replace(motion, fps=rate if fps is None or fps >= rate else fps)
    names = list(skeleton.names)
    heads = bone_frames(skeleton, motion.dofs)[:, [names.index("head"), names.index("pelvis")], 1, 3]
    share = float(np.mean(heads[:, 0] > heads[:, 1]))
    return Imported(
        path=path,
        motion=motion,
        up=up,
        joints=source.joints,
        unmatched=source.unmatched,
        roots=source.roots,
        rest=source.rest_pose,
        frames=frames,
        fps=rate,
        head_above_hips=share,
    )


def require_upright(imported: Imported) -> None:
    """A person is on their feet for most of a motion.

    Raises:
        InputError: the head is below the hips in half of the frames or more.
    """
    if imported.head_above_hips <= 0.5:
        raise InputError(
            f"{imported.path}: the head is above the hips in {imported.head_above_hips:.0%} of the "
            f"frames, expected most; {imported.up} was taken for up: give another --up, or other "
            "frames with --start and --length"
        )


def read_joint_map(path: Path) -> tuple[tuple[str, str], ...]:
    """Read a JSON object that maps joints of ours to the names that a motion file gives them.

    Raises:
        InputError: no such object, or a joint that we do not have.
    """
    if path.is_file() and path.stat().st_size > LARGEST_MAP:
        raise InputError(f"{path}: {path.stat().st_size} bytes, expected at most {LARGEST_MAP}")
    content = read_json(path)
    if not isinstance(content, dict) or not all(isinstance(name, str) and name for name in content.values()):
        raise InputError(f'{path}: expected an object such as {{"pelvis": "Hips", "thigh_left": "LeftUpLeg"}}')
    known = [name for name, _ in JOINTS]
    if unknown := sorted(set(content) - set(known)):
        raise InputError(f"{path}: unknown joint {unknown[0]!r}, expected some of {', '.join(known)}")
    return tuple(sorted(content.items()))


def _require_motion_file(path: Path) -> None:
    if path.suffix.lower() not in (".bvh", ".npz"):
        raise InputError(f"{path}: expected a .bvh or an AMASS .npz file")
    try:
        size = path.stat().st_size
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if not path.is_file():
        raise InputError(f"{path}: expected a regular file")
    if size > MAX_BYTES:
        raise InputError(f"{path}: {size} bytes, expected at most {MAX_BYTES}")


def _chosen(path: Path, frames: int, rate: float, *, fps: float | None, most: int | None, take: Take) -> np.ndarray:
    """Which frames of a file are taken: those nearest to the wanted rate, within the wanted seconds."""
    step = (1.0 if fps is None else max(1.0, rate / fps)) * take.stride
    first = take.start * rate
    end = frames if take.length is None else min(frames, first + take.length * rate)
    if most is not None:
        end = min(end, first + (most + 1) * step)  # One more: rounding may join two.
    chosen = np.unique(np.round(np.arange(first, end, step)).astype(int))
    chosen = chosen[chosen < frames][:most]
    if not len(chosen):
        raise InputError(f"{path}: it lasts {frames / rate:.2f} s, expected frames from {take.start:g} s on")
    return chosen


def _from_bvh(path: Path, choose: Callable[[int, float], np.ndarray], take: Take) -> Source:
    read = bvh.read_bvh(path, choose=choose, given=dict(take.joints), rest_frame=take.rest_frame, fps=take.fps)
    names = [name for name in ("shin_left", "foot_left") if name in read.rest]
    joints = [read.rest[name] for name in ("thigh_left", *names)]
    leg = float(sum(np.linalg.norm(lower - upper) for upper, lower in pairwise(joints)))
    if not leg > 0:
        raise InputError(f"{path}: the legs have no length")
    rest, fallen = _rest_axes(read.rest)
    source = Source(
        rotations=read.rotations,
        directions={name: bone for name, bone in read.directions.items() if name.rpartition("_")[0] in CHILD},
        rest=rest,
        usual_up=rest[1],
        root=read.path,
        leg=leg,
        fps=read.fps,
        joints=read.joints,
        unmatched=read.unmatched,
        roots=read.roots,
        rest_pose="the file's" if take.rest_frame is None else f"frame {take.rest_frame}",
    )
    if not fallen:
        return source
    if take.rest_frame is not None:
        raise InputError(
            f"{path}: {fallen} does not stand upright in frame {take.rest_frame}; give another --rest-frame"
        )
    return _without_rest_pose(path, source, read.rest, fallen)


def _rest_axes(rest: dict[str, np.ndarray]) -> tuple[np.ndarray, str]:
    """Which axes of the file are left, up and forward in its rest pose, `[3, 3]` rows, and a bone that does not stand.

    The bone is of the torso or a leg, and empty where all stand; where all bones rest along x, most do not.
    """
    torso = [name for name in bvh.TORSO if name in rest]
    legs = [[f"{name}_{side}" for name in ("foot", "shin", "thigh") if f"{name}_{side}" in rest] for side in SIDES]
    bones = {low: rest[high] - rest[low] for chain in (torso, *legs) for low, high in pairwise(chain)}
    bones = {name: _unit(bone) for name, bone in bones.items() if bone.any()}
    across = rest["thigh_left"] - rest["thigh_right"]
    up = _axis_along(np.sum(list(bones.values()), axis=0))
    left = _axis_along(across * (1 - np.abs(up)))
    fallen = [name for name, bone in bones.items() if bone @ up < STANDING]
    if not across.any():
        fallen.append("the hips")
    return np.stack([left, up, np.cross(left, up)]), fallen[0] if fallen else ""


def _without_rest_pose(path: Path, source: Source, rest: dict[str, np.ndarray], fallen: str) -> Source:
    """The motion against a T-pose where the file's rest pose is none, from the directions of the bones.

    Every joint's rotation is completed by a constant one, which turns the bone of the T-pose onto the file's. What the
    direction leaves open, the twist about the bone, is chosen so that over the motion the joint twists least against
    its parent. The pelvis is known from its hips and spine; the spine of a T-pose is straight.

    Raises:
        InputError: the motion does not stand either: legs and torso point the same way.
    """
    torso = [name for name in ("spine", "chest", "neck", "head") if name in rest]
    across = _unit(rest["thigh_left"] - rest["thigh_right"])
    up = rest[torso[0]] - rest["pelvis"] if torso else np.zeros(3)
    up = _unit(up - across * (up @ across))
    legs = [source.rotations[f"thigh_{side}"] @ source.directions[f"thigh_{side}"] for side in SIDES]
    upright = np.einsum("ta,ta->t", source.rotations["pelvis"] @ up, np.sum(legs, axis=0))
    if not across.any() or not up.any() or np.median(upright) >= 0:
        raise InputError(
            f"{path}: in its rest pose {fallen} does not stand upright, nor does its motion; give a frame in which "
            "the person stands by --rest-frame, or export the motion with a T-pose for rest pose"
        )
    directions = {name: np.array(bone) for name, bone in SMPL_DIRECTIONS.items()}
    bones = {name: (directions[name], bone) for name, bone in source.directions.items() if name in directions}
    for low, high in pairwise(name for name in ("spine", "chest", "neck") if name in rest):
        if (rest[high] - rest[low]).any():
            bones[low] = (np.array([0.0, 1.0, 0.0]), rest[high] - rest[low])
    rotations = {"pelvis": source.rotations["pelvis"] @ np.stack([across, up, np.cross(across, up)], axis=1)}
    for name, parent in JOINTS:
        if name not in source.rotations or name == "pelvis":
            continue
        above = parent
        while above not in rotations:
            above = dict(JOINTS)[above]
        given, swung = source.rotations[name], rotations[above]
        if name in bones:
            ours, theirs = bones[name]
            swung = rotation_between(swung @ ours, given @ theirs) @ swung
        mean = np.mean(np.swapaxes(given, 1, 2) @ swung, axis=0)
        rotations[name] = given @ nearest_rotation(mean)
    return replace(
        source,
        rotations=rotations,
        directions={name: directions[name] for name in source.directions if name in directions},
        rest=np.eye(3),
        usual_up=_axis_along(np.mean([rotations[name][:, :, 1] for name in UPRIGHT], axis=(0, 1))),
        rest_pose="by bone directions",
    )


def _axis_along(direction: np.ndarray) -> np.ndarray:
    """The signed axis that a direction is nearest to."""
    best = int(np.argmax(np.abs(direction)))
    return np.eye(3)[best] * (1.0 if direction[best] >= 0 else -1.0)


def _unit(direction: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(direction)
    return direction / length if length > 0 else direction


def up_axis(path: Path, source: Source) -> str:
    """The axis that is up in a file's world: that of the rest pose, unless posture and path speak for another.

    Raises:
        InputError: neither posture nor path tells.
    """
    upright = [source.rotations[name] @ source.rest[1] for name in UPRIGHT]
    posture = np.mean(upright, axis=(0, 1))
    usual, seen = source.usual_up, _axis_along(posture)
    if (usual == seen).all():
        return _axis_name(usual)
    clear = posture @ seen >= CLEAR
    if clear and not (_stays_over_the_floor(source, usual) and not _stays_over_the_floor(source, seen)):
        return _axis_name(seen)
    if _stays_over_the_floor(source, usual):
        return _axis_name(usual)
    raise InputError(
        f"{path}: it is not clear which axis is up (from feet to head the body points along "
        f"{np.round(posture, 2).tolist()}); give --up"
    )


def _stays_over_the_floor(source: Source, up: np.ndarray) -> bool:
    height = source.root @ up / source.leg
    return bool(HEIGHTS[0] <= height.min() and height.max() <= HEIGHTS[1])


def _axis_name(axis: np.ndarray) -> str:
    index = int(np.argmax(np.abs(axis)))
    return ("-" if axis[index] < 0 else "") + "xyz"[index]


def stood_up(source: Source, up: str) -> Source:
    """The same motion in our axes: `up` becomes y, and the rest pose faces z with its left at x."""
    axis = np.eye(3)["xyz".index(up[-1])] * (-1.0 if up.startswith("-") else 1.0)
    opposite = up == "-y"
    turn = np.diag([1.0, -1.0, -1.0]) if opposite else rotation_between(axis, np.array([0.0, 1.0, 0.0]))
    turn = np.round(turn)  # Axes go to axes.
    return replace(
        source,
        rotations={name: turn @ rotations @ source.rest.T for name, rotations in source.rotations.items()},
        directions={name: source.rest @ direction for name, direction in source.directions.items()},
        root=source.root @ turn.T,
    )


def retarget(skeleton: Skeleton, source: Source) -> Motion:
    """Give our joints the directions of the source's bones; the lowest foot stands on the floor."""
    count = len(source.root)
    heads = {name: skeleton.heads[j] for j, name in enumerate(skeleton.names)}
    world: list[np.ndarray] = []
    local = np.empty((count, len(skeleton.names), 3, 3))
    for j, (name, parent) in enumerate(zip(skeleton.names, skeleton.parents, strict=True)):
        above = world[parent] if parent >= 0 else np.broadcast_to(np.eye(3), (count, 3, 3))
        if name in source.rotations:
            world.append(source.rotations[name] @ _to_their_rest(name, heads, source))
        else:
            world.append(above.copy())
        local[:, j] = np.swapaxes(above, 1, 2) @ world[j]
    leg = np.linalg.norm(heads["foot_left"] - heads["thigh_left"])
    shift = (source.root - source.root[0]) * (leg / source.leg)
    rotvecs = continuous(rotmat_to_rotvec(local))
    dofs = np.concatenate([shift, rotvecs.reshape(count, -1)], axis=1)
    dofs[:, 1] -= _lowest_foot(skeleton, dofs)
    return Motion(dofs=dofs, sequence=np.zeros(count, dtype=np.int64), fps=source.fps)


def _to_their_rest(name: str, heads: dict[str, np.ndarray], source: Source) -> np.ndarray:
    """The rotation from our rest pose to the source's, for one bone."""
    word, _, side = name.rpartition("_") if name.endswith(("_left", "_right")) else (name, "", "")
    child = f"{CHILD[word]}_{side}" if word in CHILD else ""
    if word in ("hand", "toe"):  # The last bones have no direction of their own; they follow their parent's.
        parent = {"hand": "forearm", "toe": "foot"}[word]
        return _to_their_rest(f"{parent}_{side}", heads, source)
    if not child or name not in source.directions:
        return np.eye(3)
    return rotation_between(heads[child] - heads[name], source.directions[name])


def _lowest_foot(skeleton: Skeleton, dofs: np.ndarray) -> float:
    """How high the lowest ball of a foot gets above where it rests, over the whole motion, metres."""
    toes = [skeleton.names.index(f"toe_{side}") for side in ("left", "right")]
    height = bone_frames(skeleton, dofs)[:, toes, 1, 3] - skeleton.heads[toes, 1]
    return float(height.min())


RATES = ("mocap_framerate", "mocap_frame_rate", "framerate", "frame_rate", "fps")
PATHS = ("trans", "transl")
POSES = (("poses",), ("root_orient", "pose_body"), ("global_orient", "body_pose"))


def read_amass(path: Path, choose: Callable[[int, float], np.ndarray], *, fps: float | None = None) -> Source:
    """Read SMPL's, SMPL-H's or SMPL-X's joints as axis-angle, the path and the rate; mostly z is up.

    The poses are `poses` `[t, >= 66]` or its parts (`root_orient` and `pose_body`), the path is `trans` or `transl`
    `[t, 3]`, the rate `mocap_framerate`, `mocap_frame_rate` or `fps`, unless `fps` gives it.
    """
    names = array_names(path, most=MAX_BYTES)
    layout = next((layout for layout in POSES if set(layout) <= set(names)), POSES[0])
    where = next((name for name in PATHS if name in names), PATHS[0])
    rates = [name for name in RATES if name in names][:1]
    arrays = read_arrays(path, expected=(*layout, where, *(rates if fps is None else ())), most=MAX_BYTES)
    parts, trans = [arrays[name] for name in layout], arrays[where]
    if any(part.dtype.kind != "f" or part.ndim not in (2, 3) or len(part) != len(parts[0]) for part in parts):
        raise InputError(f"{path}: expected {' and '.join(layout)} of shape [t, 66 or more]")
    poses = np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
    if poses.shape[1] < 66 or not 0 < len(poses) <= MAX_FRAMES:
        raise InputError(f"{path}: expected poses of shape [1 to {MAX_FRAMES}, 66 or more], got {poses.shape}")
    if trans.shape != (len(poses), 3) or trans.dtype.kind != "f":
        raise InputError(f"{path}: expected {where} of shape {(len(poses), 3)}, got {trans.dtype} {trans.shape}")
    rate = fps if fps is not None else _rate(path, rates[0], arrays[rates[0]]) if rates else None
    if rate is None:
        raise InputError(f"{path}: no frame rate (expected {', '.join(RATES)}); give it by --motion-fps")
    chosen = choose(len(poses), rate)
    if len(chosen) * len(SMPL_JOINTS) > bvh.MAX_JOINT_FRAMES:
        most = bvh.MAX_JOINT_FRAMES // len(SMPL_JOINTS)
        raise InputError(f"{path}: {len(chosen)} frames, expected at most {most}; take fewer with --length or --stride")
    angles, root = poses[chosen, :66].astype(np.float64), trans[chosen].astype(np.float64)
    if max(np.abs(angles).max(), np.abs(root).max()) > bvh.MAX_NUMBER:
        raise InputError(f"{path}: expected {', '.join(layout)} and {where} below {bvh.MAX_NUMBER:g}")
    local = rotvec_to_rotmat(angles.reshape(len(chosen), 22, 3))
    world: list[np.ndarray] = []
    rotations = {}
    for j, (name, parent) in enumerate(SMPL_JOINTS):
        world.append(local[:, j] if parent < 0 else world[parent] @ local[:, j])
        if name:
            rotations[name] = world[j]
    return Source(
        rotations=rotations,
        directions={name: np.array(value) for name, value in SMPL_DIRECTIONS.items()},
        rest=np.eye(3),  # SMPL's own rest pose has y up, whatever the world around it does.
        usual_up=np.array([0.0, 0.0, 1.0]),
        root=root,
        leg=SMPL_LEG,
        fps=rate,
        joints={name: name for name, _ in SMPL_JOINTS if name},
    )


def _rate(path: Path, name: str, value: np.ndarray) -> float:
    """A rate as a number, a list of one, or text."""
    try:
        rate = float(value.reshape(-1)[0]) if value.size == 1 and value.dtype.kind in "fiuSU" else math.nan
    except ValueError:
        rate = math.nan
    if not 0 < rate <= 10_000:
        raise InputError(
            f"{path}: expected a {name} of 0 to 10000, got {value.dtype} {value.shape}; give it by --motion-fps"
        )
    return rate
