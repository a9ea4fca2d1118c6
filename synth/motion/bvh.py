"""BVH files: a hierarchy of joints, then one row of channels per frame. Files from users are untrusted input.

Angles are degrees; which axis is up, what a joint is called and in which pose it rests is every exporter's own choice.
"""

import codecs
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from ash.files import InputError
from synth.posing import rotvec_to_rotmat

MAX_JOINTS = 512
MAX_FRAMES = 1_000_000
MAX_JOINT_FRAMES = 1_000_000  # rotations in memory at once
MAX_NUMBER = 1e7  # degrees or units of length
CHUNK, LONGEST_TOKEN = 1 << 16, 1000

# What common files call our joints, in lower case without separators; the first that a file has is taken.
NAMES = {
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
TORSO = ("pelvis", "spine", "chest", "neck", "head")
NEEDED = frozenset({"pelvis", "thigh_left", "thigh_right", "shin_left", "shin_right"})


@dataclass(kw_only=True, slots=True)
class Joint:
    """One joint, or the end of a chain, which has no name and no channels."""

    name: str
    parent: int
    offset: np.ndarray  # [3] from its parent at rest, the file's units and axes
    channels: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class Performance:
    """Some frames of a BVH file, in its own axes and units."""

    joints: dict[str, str]  # joint of ours -> what the file calls it
    rest: dict[str, np.ndarray]  # [3] rest position per joint of ours
    directions: dict[str, np.ndarray]  # [3] from a joint to its first child at rest
    rotations: dict[str, np.ndarray]  # [t, 3, 3] world rotation against the rest pose
    root: np.ndarray  # [t, 3]
    frames: int  # of the whole file
    fps: float


def read_bvh(
    path: Path, *, choose: Callable[[int, float], np.ndarray], given: dict[str, str] | None = None
) -> Performance:
    """Read the frames that `choose` takes, given their number and rate; `given` maps joints of ours to the file's.

    Raises:
        InputError: damaged, too large, or without the joints that a person needs.
    """
    try:
        with path.open("rb") as file:
            tokens = _tokens(file.read)
            joints = _hierarchy(tokens)
            named = _match(joints, given or {})
            missing = NEEDED - set(named)
            if missing:
                known = ", ".join(sorted(joint.name for joint in joints if joint.name)[:40])
                raise InputError(
                    f"found no joint for {', '.join(sorted(missing))} among {len(joints)} joints ({known}); "
                    "name them with --joint-map"
                )
            values, count, fps = _frames(tokens, joints, choose)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (IndexError, ValueError, StopIteration) as error:
        raise InputError(f"{path}: expected a BVH file ({str(error) or 'it ends too early'})") from error
    world, root = _rotations(joints, values, set(named.values()))
    rest = _rest_positions(joints)
    directions = {}
    for name, j in named.items():
        children = [child for child in joints if child.parent == j and np.linalg.norm(child.offset) > 0]
        if children:
            directions[name] = children[0].offset
    return Performance(
        joints={name: joints[j].name for name, j in named.items()},
        rest={name: rest[j] for name, j in named.items()},
        directions=directions,
        rotations={name: world[j] for name, j in named.items()},
        root=root,
        frames=count,
        fps=fps,
    )


def _tokens(read: Callable[[int], bytes]) -> Iterator[str]:
    """The words of a file, without ever holding all of it."""
    decode = codecs.getincrementaldecoder("utf-8-sig")("replace").decode
    rest = ""
    while chunk := read(CHUNK):
        text = rest + decode(chunk)
        words = text.split()
        rest = words.pop() if words and not text[-1].isspace() else ""
        if len(rest) > LONGEST_TOKEN:
            raise ValueError(f"a word of more than {LONGEST_TOKEN} characters")
        yield from words
    if rest:
        yield rest


def _hierarchy(tokens: Iterator[str]) -> list[Joint]:
    """Everything up to the word MOTION."""
    if next(tokens).upper() != "HIERARCHY":
        raise ValueError("it does not begin with HIERARCHY")
    joints: list[Joint] = []
    stack: list[int] = []
    current = -1
    while (word := next(tokens).upper()) != "MOTION":
        if word in ("ROOT", "JOINT", "END"):
            if len(joints) >= MAX_JOINTS:
                raise ValueError(f"more than {MAX_JOINTS} joints")
            name = next(tokens)
            joints.append(
                Joint(name="" if word == "END" else name, parent=stack[-1] if stack else -1, offset=np.zeros(3))
            )
            current = len(joints) - 1
        elif word == "{":
            if len(stack) > MAX_JOINTS:
                raise ValueError(f"braces deeper than {MAX_JOINTS}")
            stack.append(current)
        elif word == "}":
            stack.pop()
        elif word == "OFFSET":
            joints[current].offset = _numbers(list(islice(tokens, 3)), 3)
        elif word == "CHANNELS":
            joints[current].channels = _channels(tokens)
        else:
            raise ValueError(f"unexpected word {word[:20]!r}")
    if not joints:
        raise ValueError("it has no joints")
    return joints


def _channels(tokens: Iterator[str]) -> tuple[str, ...]:
    word = next(tokens)
    count = int(word) if word.isdigit() and len(word) < 3 else -1
    if not 0 <= count <= 6:
        raise ValueError(f"{word[:20]} channels")
    channels = tuple(token.lower() for token in islice(tokens, count))
    if len(channels) != count or any(c[1:] not in ("position", "rotation") or c[0] not in "xyz" for c in channels):
        raise ValueError(f"channels {channels}")
    return channels


def _frames(
    tokens: Iterator[str], joints: list[Joint], choose: Callable[[int, float], np.ndarray]
) -> tuple[np.ndarray, int, float]:
    """The chosen rows `[t, channels]`, how many rows there are, and their rate."""
    width = sum(len(joint.channels) for joint in joints)
    head = [word.lower() for word in islice(tokens, 5)]
    if len(head) < 5 or (head[0], *head[2:4]) != ("frames:", "frame", "time:"):
        raise ValueError("no Frames: and Frame Time:")
    count, step = int(head[1]), float(head[4])
    # Compared before anything is allocated: a header may promise 10^9 frames.
    if not 0 < count <= MAX_FRAMES or width == 0:
        raise ValueError(f"{count} frames of {width} channels promised, expected 1 to {MAX_FRAMES} frames")
    if not 1e-4 <= step <= 10:
        raise ValueError(f"a frame time of {step} s")
    chosen = choose(count, 1 / step)
    if len(chosen) * len(joints) > MAX_JOINT_FRAMES:
        raise ValueError(
            f"{len(chosen)} frames of {len(joints)} joints wanted, expected at most {MAX_JOINT_FRAMES // len(joints)} "
            "frames; take fewer with --start, --length or --stride"
        )
    wanted = {int(frame): row for row, frame in enumerate(chosen)}
    values = np.empty((len(chosen), width))
    for frame in range(count):
        row = list(islice(tokens, width))
        if len(row) < width:
            found = frame * width + len(row)
            raise ValueError(f"{count} frames of {width} channels promised, {found} numbers found")
        if frame in wanted:
            values[wanted[frame]] = _numbers(row, width)
    if next(tokens, None) is not None:
        raise ValueError(f"{count} frames of {width} channels promised, and more numbers found")
    return values, count, 1 / step


def _numbers(tokens: list[str], count: int) -> np.ndarray:
    values = np.array([float(token) for token in tokens])
    if len(values) != count or not np.isfinite(values).all() or np.abs(values).max(initial=0) > MAX_NUMBER:
        raise ValueError(f"expected {count} finite numbers below {MAX_NUMBER:g}")
    return values


def _match(joints: list[Joint], given: dict[str, str]) -> dict[str, int]:
    """Which joint of the file is which of ours: as the user says, else by its name."""
    plain = [
        joint.name.lower().replace("_", "").replace("-", "").replace(" ", "").rpartition(":")[2] for joint in joints
    ]
    exact = [joint.name for joint in joints]
    found: dict[str, int] = {}
    for name, theirs in given.items():
        if theirs not in exact or not theirs:
            known = ", ".join(name for name in exact[:40] if name)
            raise InputError(f"the joint map gives {name} as {theirs!r}, expected one of the file's joints: {known}")
        found[name] = exact.index(theirs)
    for name, candidates in _candidates().items():
        free = [c for c in candidates if c in plain and plain.index(c) not in found.values()]
        if name not in found and free:
            found[name] = plain.index(free[0])
    return found


def _candidates() -> dict[str, list[str]]:
    """Names to look for, per joint of ours, in order of preference."""
    result = {}
    for ours, theirs in NAMES.items():
        if ours in TORSO:
            result[ours] = list(theirs)
            continue
        for side, marks in (("left", ("left", "l")), ("right", ("right", "r"))):
            before = [f"{mark}{name}" for name in theirs for mark in marks]
            result[f"{ours}_{side}"] = before + [f"{name}{mark}" for name in theirs for mark in marks]
    return result


def _rest_positions(joints: list[Joint]) -> list[np.ndarray]:
    positions: list[np.ndarray] = []
    for joint in joints:
        positions.append(joint.offset if joint.parent < 0 else positions[joint.parent] + joint.offset)
    return positions


def _rotations(joints: list[Joint], values: np.ndarray, wanted: set[int]) -> tuple[dict[int, np.ndarray], np.ndarray]:
    """World rotations `[t, 3, 3]` of the wanted joints and of what they hang on, and the root's path `[t, 3]`."""
    needed = set(wanted)
    for j in sorted(wanted):
        while joints[j].parent >= 0:
            j = joints[j].parent
            needed.add(j)
    world: dict[int, np.ndarray] = {}
    root = np.zeros((len(values), 3))
    at = 0
    for j, joint in enumerate(joints):
        local = np.broadcast_to(np.eye(3), (len(values), 3, 3))
        for channel in joint.channels:
            axis = "xyz".index(channel[0])
            if channel.endswith("rotation"):
                if j in needed:
                    rotvecs = np.zeros((len(values), 3))
                    rotvecs[:, axis] = np.deg2rad(np.fmod(values[:, at], 360.0))
                    local = local @ rotvec_to_rotmat(rotvecs)
            elif joint.parent < 0:
                root[:, axis] = values[:, at]
            at += 1
        if j in needed:
            world[j] = local if joint.parent < 0 else world[joint.parent] @ local
    return world, root
