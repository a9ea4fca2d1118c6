"""BVH files: a hierarchy of joints, then one row of channels per frame. Files from users are untrusted input.

Angles are degrees; which axis is up, what a joint is called and in which pose it rests is every exporter's own choice.
"""

import codecs
import re
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

# What common files call the joints, in lower case without separators; the first that is free is taken. The order of the
# rows counts: where a file has a collar bone, "shoulder" is the upper arm (SMPL), else the collar bone (Mixamo).
NAMES = {
    "pelvis": ("hips", "pelvis", "hip", "root"),
    "spine": ("spine", "lowerback", "spine1", "spine01", "abdomen", "waist", "chest"),
    "chest": (
        "chest4", "chest3", "upperchest", "spine3", "spine03", "spine2", "spine02", "chest2", "chest", "spine1",
        "spine01", "thorax",
    ),
    "neck": ("neck", "neck1", "neck01"),
    "head": ("head",),
    "upper_arm": ("arm", "upperarm", "uparm", "shldr", "shldrbend", "shoulder"),
    "clavicle": ("collar", "clavicle", "shoulder"),
    "forearm": ("forearm", "lowerarm", "lowarm", "elbow", "forearmbend"),
    "hand": ("wrist", "hand"),
    "thigh": ("upleg", "upperleg", "thigh", "thighbend", "hip"),
    "shin": ("leg", "lowerleg", "lowleg", "shin", "knee", "calf"),
    "foot": ("ankle", "foot"),
    "toe": ("toebase", "toe", "ball", "foot"),
}  # fmt: skip
PREFIX = re.compile(r"^(mixamorig\d*|bip0*1|ccbase|jbipc?|valvebiped|[mf]avg|character\d*|skeleton\d*)")
TORSO = ("pelvis", "spine", "chest", "neck", "head")
NEEDED = frozenset(
    {"pelvis"} | {f"{name}_{side}" for name in ("thigh", "shin", "upper_arm", "forearm") for side in ("left", "right")}
)


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
    path: np.ndarray  # [t, 3] position of the pelvis
    unmatched: tuple[str, ...]  # joints of the file without a partner
    roots: int  # how many roots the file has
    frames: int  # of the whole file
    fps: float


def read_bvh(
    path: Path,
    *,
    choose: Callable[[int, float], np.ndarray],
    given: dict[str, str] | None = None,
    rest_frame: int | None = None,
    fps: float | None = None,
) -> Performance:
    """Read the frames that `choose` takes, given their number and rate; `given` maps joints of ours to the file's.

    With `rest_frame`, that frame of the file is the rest pose; with `fps`, that is the rate, whatever the file says.

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
            values, count, rate = _frames(tokens, joints, choose, rest_frame=rest_frame, fps=fps)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (IndexError, ValueError, StopIteration) as error:
        raise InputError(f"{path}: expected a BVH file ({str(error) or 'it ends too early'})") from error
    world = _rotations(joints, values, set(named.values()))
    offsets = {j: joint.offset for j, joint in enumerate(joints)}
    pelvis_path = _path(joints, values, world, named["pelvis"])
    if rest_frame is not None:  # The last row: what every joint does there is its rest.
        reference = {j: rotations[-1] for j, rotations in world.items()}
        world = {j: rotations[:-1] @ reference[j].T for j, rotations in world.items()}
        pelvis_path = pelvis_path[:-1]
        for j, joint in enumerate(joints):
            if joint.parent in reference:
                offsets[j] = reference[joint.parent] @ joint.offset
    rest: list[np.ndarray] = []
    for j, joint in enumerate(joints):
        rest.append(offsets[j] if joint.parent < 0 else rest[joint.parent] + offsets[j])
    directions = {}
    for name, j in named.items():
        children = [k for k, child in enumerate(joints) if child.parent == j and np.linalg.norm(child.offset) > 0]
        if children:
            directions[name] = offsets[_main_child(children, named, joints)]
    return Performance(
        joints={name: joints[j].name for name, j in named.items()},
        rest={name: rest[j] for name, j in named.items()},
        directions=directions,
        rotations={name: world[j] for name, j in named.items()},
        path=pelvis_path,
        unmatched=tuple(joint.name for j, joint in enumerate(joints) if joint.name and j not in named.values()),
        roots=sum(joint.parent < 0 for joint in joints),
        frames=count,
        fps=rate,
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
    tokens: Iterator[str],
    joints: list[Joint],
    choose: Callable[[int, float], np.ndarray],
    *,
    rest_frame: int | None,
    fps: float | None,
) -> tuple[np.ndarray, int, float]:
    """The chosen rows `[t, channels]`, then that of the rest frame; how many rows there are, and their rate."""
    width = sum(len(joint.channels) for joint in joints)
    head = [word.lower() for word in islice(tokens, 5)]
    if len(head) < 5 or (head[0], *head[2:4]) != ("frames:", "frame", "time:"):
        raise ValueError("no Frames: and Frame Time:")
    count, step = int(head[1]), float(head[4])
    # Compared before anything is allocated: a header may promise 10^9 frames.
    if not 0 < count <= MAX_FRAMES or width == 0:
        raise ValueError(f"{count} frames of {width} channels promised, expected 1 to {MAX_FRAMES} frames")
    if fps is None and not 1e-4 <= step <= 10:
        raise ValueError(f"a frame time of {step} s; give the rate by --motion-fps")
    rate = 1 / step if fps is None else fps
    chosen = choose(count, rate)
    if rest_frame is not None and not 0 <= rest_frame < count:
        raise InputError(f"rest frame {rest_frame}, expected 0 to {count - 1}")
    if len(chosen) * len(joints) > MAX_JOINT_FRAMES:
        raise ValueError(
            f"{len(chosen)} frames of {len(joints)} joints wanted, expected at most {MAX_JOINT_FRAMES // len(joints)} "
            "frames; take fewer with --start, --length or --stride"
        )
    wanted = {int(frame): row for row, frame in enumerate(chosen)}
    values = np.empty((len(chosen) + (rest_frame is not None), width))
    for frame in range(count):
        row = list(islice(tokens, width))
        if len(row) < width:
            read = frame * width + len(row)
            raise ValueError(f"{count} frames of {width} channels promised, {read} numbers found")
        if frame in wanted:
            values[wanted[frame]] = _numbers(row, width)
        if frame == rest_frame:
            values[-1] = _numbers(row, width)
    if next(tokens, None) is not None:
        raise ValueError(f"{count} frames of {width} channels promised, and more numbers found")
    return values, count, rate


def _numbers(tokens: list[str], count: int) -> np.ndarray:
    values = np.array([float(token) for token in tokens])
    if len(values) != count or not np.isfinite(values).all() or np.abs(values).max(initial=0) > MAX_NUMBER:
        raise ValueError(f"expected {count} finite numbers below {MAX_NUMBER:g}")
    return values


def _match(joints: list[Joint], given: dict[str, str]) -> dict[str, int]:
    """Which joint of the file is which of ours: as the user says, else by its name.

    Of several roots the one counts below which most joints match; the others are props or other people.
    """
    names = [joint.name for joint in joints]
    for name, theirs in given.items():
        if theirs not in names or not theirs:
            first = ", ".join(name for name in names[:40] if name)
            raise InputError(f"the joint map gives {name} as {theirs!r}, expected one of the file's joints: {first}")
    trees: dict[int, list[int]] = {}
    root_of: list[int] = []
    for j, joint in enumerate(joints):
        root_of.append(j if joint.parent < 0 else root_of[joint.parent])
        trees.setdefault(root_of[j], []).append(j)
    matches = [_match_names(names, members, given) for members in trees.values()]
    whole = [match for match in matches if not NEEDED - set(match)]
    return max(whole, key=len) if whole else _match_names(names, list(range(len(joints))), given)


def _match_names(names: list[str], members: list[int], given: dict[str, str]) -> dict[str, int]:
    """The same among the joints with these indices."""
    matched = {name: j for name, theirs in given.items() for j in reversed(members) if names[j] == theirs}
    free: dict[str, int] = {}
    for j in members:
        if names[j] and j not in matched.values():
            plain = re.sub(r"[^a-z0-9]", "", names[j].rpartition(":")[2].lower())
            free.setdefault(PREFIX.sub("", plain) or plain, j)
    for name, candidates in _candidates().items():
        if name not in matched and (present := [c for c in candidates if c in free]):
            matched[name] = free.pop(present[0])
    return matched


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


def _main_child(children: list[int], named: dict[str, int], joints: list[Joint]) -> int:
    """Of a joint's children that which leads to the next matched joint; else the first."""
    above: set[int] = set()
    for j in named.values():
        while j >= 0:
            above.add(j)
            j = joints[j].parent
    return next((child for child in children if child in above), children[0])


def _rotations(joints: list[Joint], values: np.ndarray, wanted: set[int]) -> dict[int, np.ndarray]:
    """World rotations `[t, 3, 3]` of the wanted joints and of what they hang on."""
    needed = set(wanted)
    for j in sorted(wanted):
        while joints[j].parent >= 0:
            j = joints[j].parent
            needed.add(j)
    world: dict[int, np.ndarray] = {}
    at = 0
    for j, joint in enumerate(joints):
        local = np.broadcast_to(np.eye(3), (len(values), 3, 3))
        for channel in joint.channels:
            if channel.endswith("rotation") and j in needed:
                rotvecs = np.zeros((len(values), 3))
                rotvecs[:, "xyz".index(channel[0])] = np.deg2rad(np.fmod(values[:, at], 360.0))
                local = local @ rotvec_to_rotmat(rotvecs)
            at += 1
        if j in needed:
            world[j] = local if joint.parent < 0 else world[joint.parent] @ local
    return world


def _path(joints: list[Joint], values: np.ndarray, world: dict[int, np.ndarray], pelvis: int) -> np.ndarray:
    """World position `[t, 3]` of the pelvis: channels of position count wherever they lie from the root down to it.

    Position channels of a joint below the root take the place of its offset, unless they never change.
    """
    starts = np.cumsum([0, *(len(joint.channels) for joint in joints)])
    chain = [pelvis]
    while joints[chain[0]].parent >= 0:
        chain.insert(0, joints[chain[0]].parent)
    path = np.zeros((len(values), 3))
    for j in chain:
        joint = joints[j]
        columns = {c[0]: int(starts[j]) + k for k, c in enumerate(joint.channels) if c.endswith("position")}
        step = np.zeros((len(values), 3)) + (0 if joint.parent < 0 else joint.offset)
        if joint.parent < 0 or any(np.ptp(values[:, column]) > 0 for column in columns.values()):
            for axis, column in columns.items():
                step[:, "xyz".index(axis)] = values[:, column]
        path = step if joint.parent < 0 else path + np.einsum("tab,tb->ta", world[joint.parent], step)
    return path
