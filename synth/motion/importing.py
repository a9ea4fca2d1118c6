"""Motion from files: BVH and AMASS-style `.npz`, retargeted to our skeleton. Files from users are untrusted input.

Both give world rotations of their joints against a rest pose of their own. Retargeting keeps, for every joint of ours,
the world direction that its bone takes in the file, so bone lengths and rest poses may differ; the root's path is
scaled by the ratio of leg lengths. Which axes are up, in the rest pose and in the world, is found or given.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ash.capture.dataset import Motion, Skeleton
from ash.files import InputError, read_arrays, read_json
from synth.motion import bvh
from synth.motion.plans import continuous
from synth.posing import bone_frames, rotation_between, rotmat_to_rotvec, rotvec_to_rotmat
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
    root: np.ndarray  # [t, 3] position of the root, in the file's units
    leg: float  # length from hip to ankle, in the file's units
    fps: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Imported:
    """A motion file as it was understood."""

    path: Path
    motion: Motion
    up: str  # the axis that is up in the file
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
    found = read_motion_file(path, skeleton, fps=fps, most=most, take=take)
    require_upright(found)
    return found.motion


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
        source, joints = _from_bvh(path, choose, take)
    elif take.joints:
        raise InputError(f"{path}: its joints are SMPL's, expected no joint map")
    else:
        source, joints = read_amass(path, choose), {name: name for name, _ in SMPL_JOINTS if name}
    up = take.up if take.up != "auto" else up_axis(path, source)
    motion = retarget(skeleton, stood_up(source, up))
    (frames, rate) = whole[0]
    motion = replace(motion, fps=rate if fps is None or fps >= rate else fps)
    names = list(skeleton.names)
    heads = bone_frames(skeleton, motion.dofs)[:, [names.index("head"), names.index("pelvis")], 1, 3]
    share = float(np.mean(heads[:, 0] > heads[:, 1]))
    return Imported(path=path, motion=motion, up=up, joints=joints, frames=frames, fps=rate, head_above_hips=share)


def require_upright(found: Imported) -> None:
    """A person is on their feet for most of a motion.

    Raises:
        InputError: the head is below the hips in half of the frames or more.
    """
    if found.head_above_hips <= 0.5:
        raise InputError(
            f"{found.path}: the head is above the hips in {found.head_above_hips:.0%} of the frames, expected most; "
            f"{found.up} was taken for up: give another --up, or other frames with --start and --length"
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


def _from_bvh(path: Path, choose: Callable[[int, float], np.ndarray], take: Take) -> tuple[Source, dict[str, str]]:
    found = bvh.read_bvh(path, choose=choose, given=dict(take.joints))
    names = [name for name in ("shin_left", "foot_left") if name in found.rest]
    joints = [found.rest[name] for name in ("thigh_left", *names)]
    leg = float(sum(np.linalg.norm(lower - upper) for upper, lower in pairwise(joints)))
    if not leg > 0:
        raise InputError(f"{path}: the legs have no length")
    rest = _rest_axes(path, found.rest)
    source = Source(
        rotations=found.rotations,
        directions={name: found.directions[name] for name in found.directions if name.rpartition("_")[0] in CHILD},
        rest=rest,
        usual_up=rest[1],
        root=found.root,
        leg=leg,
        fps=found.fps,
    )
    return source, found.joints


def _rest_axes(path: Path, rest: dict[str, np.ndarray]) -> np.ndarray:
    """Which axes of the file are left, up and forward in its rest pose, `[3, 3]` rows; a person stands upright there.

    Raises:
        InputError: the torso or the legs do not stand in the rest pose, as where all bones rest along x.
    """
    torso = [name for name in bvh.TORSO if name in rest]
    legs = [[f"{name}_{side}" for name in ("foot", "shin", "thigh") if f"{name}_{side}" in rest] for side in SIDES]
    bones = {low: rest[high] - rest[low] for chain in (torso, *legs) for low, high in pairwise(chain)}
    bones = {name: _unit(bone) for name, bone in bones.items() if bone.any()}
    across = rest["thigh_left"] - rest["thigh_right"]
    up = _axis_along(np.sum(list(bones.values()), axis=0))
    left = _axis_along(across * (1 - np.abs(up)))
    fallen = [name for name, bone in bones.items() if bone @ up < STANDING]
    if fallen or not across.any():
        raise InputError(
            f"{path}: in its rest pose {fallen[0] if fallen else 'the hips'} does not stand upright; "
            "export the motion with a T-pose for rest pose"
        )
    return np.stack([left, up, np.cross(left, up)])


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
    upright = [source.rotations[name] @ source.rest[1] for name in sorted(bvh.NEEDED)]
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


def read_amass(path: Path, choose: Callable[[int, float], np.ndarray]) -> Source:
    """Read `poses` `[t, >= 66]` (axis-angle of SMPL's joints), `trans` `[t, 3]`, `mocap_framerate`; mostly z is up."""
    arrays = read_arrays(path, expected=("poses", "trans", "mocap_framerate"), most=MAX_BYTES)
    poses, trans, rate = arrays["poses"], arrays["trans"], arrays["mocap_framerate"]
    if poses.dtype.kind != "f" or poses.ndim != 2 or poses.shape[1] < 66 or not 0 < len(poses) <= MAX_FRAMES:
        raise InputError(f"{path}: expected poses of shape [1 to {MAX_FRAMES}, 66 or more], got {poses.shape}")
    if trans.shape != (len(poses), 3) or trans.dtype.kind != "f":
        raise InputError(f"{path}: expected trans of shape {(len(poses), 3)}, got {trans.dtype} {trans.shape}")
    if rate.shape != () or rate.dtype.kind not in "fiu" or not 0 < float(rate) <= 10_000:
        raise InputError(f"{path}: expected a mocap_framerate of 0 to 10000, got {rate.dtype} {rate.shape}")
    chosen = choose(len(poses), float(rate))
    if len(chosen) * len(SMPL_JOINTS) > bvh.MAX_JOINT_FRAMES:
        most = bvh.MAX_JOINT_FRAMES // len(SMPL_JOINTS)
        raise InputError(f"{path}: {len(chosen)} frames, expected at most {most}; take fewer with --length or --stride")
    angles, root = poses[chosen, :66].astype(np.float64), trans[chosen].astype(np.float64)
    if max(np.abs(angles).max(), np.abs(root).max()) > bvh.MAX_NUMBER:
        raise InputError(f"{path}: expected poses and trans below {bvh.MAX_NUMBER:g}")
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
        fps=float(rate),
    )
