"""Motion from files: BVH and AMASS-style `.npz`, retargeted to our skeleton. Files from users are untrusted input.

Both give world rotations of their joints against a rest pose of their own. Retargeting keeps, for every joint of ours,
the world direction that its bone takes in the file, so bone lengths and rest poses may differ; the root's path is
scaled by the ratio of leg lengths.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ash.dataset import Motion, Skeleton
from ash.files import InputError, read_arrays
from synth.plans import continuous
from synth.posing import rotation_between, rotmat_to_rotvec, rotvec_to_rotmat

MAX_FRAMES = 1_000_000
MAX_BYTES = 512 << 20
MAX_JOINTS = 512

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

# What common BVH files call our joints, in lower case without separators; the first that a file has is taken.
BVH_NAMES = {
    "pelvis": ("hips", "pelvis", "root"),
    "spine": ("spine", "lowerback", "spine1", "abdomen"),
    "chest": ("spine2", "spine3", "chest", "spine1"),
    "neck": ("neck", "neck1"),
    "head": ("head",),
    "clavicle": ("shoulder", "collar", "clavicle"),
    "upper_arm": ("arm", "upperarm", "uparm"),
    "forearm": ("forearm", "lowerarm", "lowarm"),
    "hand": ("hand", "wrist"),
    "thigh": ("upleg", "upperleg", "thigh", "hip"),
    "shin": ("leg", "lowerleg", "lowleg", "shin", "knee", "calf"),
    "foot": ("foot", "ankle"),
    "toe": ("toebase", "toe"),
}
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
    directions: dict[str, np.ndarray]  # [3] direction of the joint's bone at rest, world
    root: np.ndarray  # [t, 3] position of the root, in the file's units
    leg: float  # length from hip to ankle, in the file's units
    fps: float


def import_motion(path: Path, skeleton: Skeleton, *, fps: float | None = None) -> Motion:
    """Read a `.bvh` or an AMASS `.npz` file and retarget it; with `fps`, frames nearest to that rate are taken.

    Raises:
        InputError: another kind of file, damaged, too large, or without the joints that a person needs.
    """
    kind = path.suffix.lower()
    if kind not in (".bvh", ".npz"):
        raise InputError(f"{path}: expected a .bvh or an AMASS .npz file")
    try:
        size = path.stat().st_size
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if size > MAX_BYTES:
        raise InputError(f"{path}: {size} bytes, expected at most {MAX_BYTES}")
    source = read_bvh(path) if kind == ".bvh" else read_amass(path)
    motion = retarget(skeleton, source)
    if fps is None or fps >= source.fps:
        return motion
    chosen = np.unique(np.round(np.arange(0, len(motion.dofs), source.fps / fps)).astype(int))
    chosen = chosen[chosen < len(motion.dofs)]
    return Motion(dofs=motion.dofs[chosen], sequence=motion.sequence[chosen], fps=fps)


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
    from synth.posing import bone_frames

    toes = [skeleton.names.index(f"toe_{side}") for side in ("left", "right")]
    height = bone_frames(skeleton, dofs)[:, toes, 1, 3] - skeleton.heads[toes, 1]
    return float(height.min())


def read_amass(path: Path) -> Source:
    """Read `poses` `[t, >= 66]` (axis-angle of SMPL's joints), `trans` `[t, 3]`, `mocap_framerate`; z is up there."""
    arrays = read_arrays(path, expected=("poses", "trans", "mocap_framerate"))
    poses, trans, rate = arrays["poses"], arrays["trans"], arrays["mocap_framerate"]
    if poses.dtype.kind != "f" or poses.ndim != 2 or poses.shape[1] < 66 or not 0 < len(poses) <= MAX_FRAMES:
        raise InputError(f"{path}: expected poses of shape [1 to {MAX_FRAMES}, 66 or more], got {poses.shape}")
    if trans.shape != (len(poses), 3) or trans.dtype.kind != "f" or rate.shape != () or not 0 < float(rate) <= 10_000:
        raise InputError(
            f"{path}: expected trans of shape {(len(poses), 3)} and a mocap_framerate, got {trans.shape}, {rate}"
        )
    upright = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up to y up
    local = rotvec_to_rotmat(poses[:, :66].astype(np.float64).reshape(len(poses), 22, 3))
    world: list[np.ndarray] = []
    rotations = {}
    for j, (name, parent) in enumerate(SMPL_JOINTS):
        world.append(local[:, j] if parent < 0 else world[parent] @ local[:, j])
        if name:
            # SMPL's own rest pose has y up, so only the world around it has to be turned.
            rotations[name] = upright @ world[j]
    directions = {name: np.array(value) for name, value in SMPL_DIRECTIONS.items()}
    root = trans.astype(np.float64) @ upright.T
    return Source(rotations=rotations, directions=directions, root=root, leg=SMPL_LEG, fps=float(rate))


@dataclass(kw_only=True, slots=True)
class _BvhJoint:
    name: str
    parent: int
    offset: np.ndarray
    channels: tuple[str, ...] = ()


def read_bvh(path: Path) -> Source:
    """Read a BVH file: the hierarchy, then one line of channels per frame. Angles are degrees there, y is up."""
    try:
        tokens = path.read_text(encoding="utf-8", errors="replace").split()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    try:
        joints, at = _hierarchy(tokens)
        values, fps = _frames(tokens, at, sum(len(joint.channels) for joint in joints))
    except (IndexError, ValueError) as error:
        raise InputError(f"{path}: expected a BVH file ({error or 'it ends too early'})") from error
    named = _match(joints)
    missing = {"pelvis", "thigh_left", "thigh_right", "shin_left", "shin_right"} - set(named)
    if missing:
        raise InputError(f"{path}: found no joint for {', '.join(sorted(missing))} among {len(joints)} joints")
    world, root = _bvh_rotations(joints, values)
    directions = {}
    for name, j in named.items():
        children = [child for child in joints if child.parent == j and np.linalg.norm(child.offset) > 0]
        word = name.rpartition("_")[0]
        if word in CHILD and children:
            directions[name] = children[0].offset
    leg = sum(float(np.linalg.norm(joints[named[name]].offset)) for name in ("shin_left", "foot_left") if name in named)
    if not leg > 0:
        raise InputError(f"{path}: the legs have no length")
    return Source(
        rotations={name: world[j] for name, j in named.items()}, directions=directions, root=root, leg=leg, fps=fps
    )


def _hierarchy(tokens: list[str]) -> tuple[list[_BvhJoint], int]:
    if tokens[0].upper() != "HIERARCHY":
        raise ValueError("it does not begin with HIERARCHY")
    joints: list[_BvhJoint] = []
    stack: list[int] = []
    at, current = 1, -1
    while tokens[at].upper() != "MOTION":
        word = tokens[at].upper()
        if word in ("ROOT", "JOINT", "END"):
            if len(joints) >= MAX_JOINTS:
                raise ValueError(f"more than {MAX_JOINTS} joints")
            end = word == "END"
            joints.append(
                _BvhJoint(name="" if end else tokens[at + 1], parent=stack[-1] if stack else -1, offset=np.zeros(3))
            )
            current = len(joints) - 1
            at += 2
        elif word == "{":
            stack.append(current)
            at += 1
        elif word == "}":
            stack.pop()
            at += 1
        elif word == "OFFSET":
            joints[current].offset = _numbers(tokens[at + 1 : at + 4], 3)
            at += 4
        elif word == "CHANNELS":
            count = int(tokens[at + 1])
            if not 0 <= count <= 6:
                raise ValueError(f"{count} channels")
            joints[current].channels = tuple(token.lower() for token in tokens[at + 2 : at + 2 + count])
            if any(c[1:] not in ("position", "rotation") or c[0] not in "xyz" for c in joints[current].channels):
                raise ValueError(f"channels {joints[current].channels}")
            at += 2 + count
        else:
            raise ValueError(f"unexpected word {tokens[at][:20]!r}")
    if not joints:
        raise ValueError("it has no joints")
    return joints, at + 1


def _frames(tokens: list[str], at: int, width: int) -> tuple[np.ndarray, float]:
    if tokens[at].lower() != "frames:" or tokens[at + 2].lower() != "frame" or tokens[at + 3].lower() != "time:":
        raise ValueError("no Frames: and Frame Time:")
    count, step = int(tokens[at + 1]), float(tokens[at + 4])
    rest = tokens[at + 5 :]
    # Compared before anything is allocated: a header may promise 10^9 frames.
    if not 0 < count <= MAX_FRAMES or width == 0 or len(rest) != count * width:
        raise ValueError(f"{count} frames of {width} channels promised, {len(rest)} numbers found")
    if not 1e-4 <= step <= 10:
        raise ValueError(f"a frame time of {step} s")
    return _numbers(rest, len(rest)).reshape(count, width), 1 / step


def _numbers(tokens: list[str], count: int) -> np.ndarray:
    values = np.array([float(token) for token in tokens])
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"expected {count} finite numbers")
    return values


def _match(joints: list[_BvhJoint]) -> dict[str, int]:
    """Which BVH joint is which of ours."""
    plain = [
        joint.name.lower().replace("_", "").replace("-", "").replace(" ", "").rpartition(":")[2] for joint in joints
    ]
    sides = {"left": ("left", "l"), "right": ("right", "r")}
    found: dict[str, int] = {}
    for ours, theirs in BVH_NAMES.items():
        if ours in ("pelvis", "spine", "chest", "neck", "head"):
            wanted = {ours: list(theirs)}
        else:
            wanted = {
                f"{ours}_{side}": [f"{mark}{name}" for name in theirs for mark in marks]
                + [f"{name}{mark}" for name in theirs for mark in marks]
                for side, marks in sides.items()
            }
        for name, candidates in wanted.items():
            place = next(
                (plain.index(c) for c in candidates if c in plain and plain.index(c) not in found.values()), None
            )
            if place is not None:
                found[name] = place
    return found


def _bvh_rotations(joints: list[_BvhJoint], values: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    world: list[np.ndarray] = []
    root = np.zeros((len(values), 3))
    at = 0
    for joint in joints:
        local = np.broadcast_to(np.eye(3), (len(values), 3, 3))
        for channel in joint.channels:
            axis = "xyz".index(channel[0])
            if channel.endswith("rotation"):
                rotvecs = np.zeros((len(values), 3))
                rotvecs[:, axis] = np.deg2rad(values[:, at])
                local = local @ rotvec_to_rotmat(rotvecs)
            elif joint.parent < 0:
                root[:, axis] = values[:, at]
            at += 1
        world.append(local if joint.parent < 0 else world[joint.parent] @ local)
    return world, root
