"""Motions: seeded generators that plan feet, pelvis, torso and arms, and a solver that turns plans into joints.

A plan plants the ball of each foot, so that feet neither slide nor leave the floor by accident; legs follow by two-bone
inverse kinematics. The character faces +z, its left is +x.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ash.dataset import Motion, Skeleton
from ash.files import InputError
from synth.posing import rotation_between, rotmat_to_rotvec, rotvec_to_rotmat

SIDES = ("left", "right")
SIGNS = (1.0, -1.0)
JOINTS: tuple[tuple[str, str], ...] = (
    ("pelvis", ""),
    ("spine", "pelvis"),
    ("chest", "spine"),
    ("neck", "chest"),
    ("head", "neck"),
    *(
        (f"{name}_{side}", f"{parent}_{side}" if parent not in ("chest", "pelvis") else parent)
        for side in SIDES
        for name, parent in (
            ("clavicle", "chest"),
            ("upper_arm", "clavicle"),
            ("forearm", "upper_arm"),
            ("hand", "forearm"),
            ("thigh", "pelvis"),
            ("shin", "thigh"),
            ("foot", "shin"),
            ("toe", "foot"),
        )
    ),
)


def make_skeleton(heads: dict[str, np.ndarray]) -> Skeleton:
    """A skeleton of our 21 joints from the rest position of each head (metres)."""
    names = tuple(name for name, _ in JOINTS)
    parents = np.array([names.index(parent) if parent else -1 for _, parent in JOINTS])
    return Skeleton(names=names, parents=parents, heads=np.array([heads[name] for name in names], dtype=np.float64))


@dataclass(frozen=True, kw_only=True, slots=True)
class Step:
    """One foot swings from where it stands to `position` (x, z on the floor, metres) and `yaw` (radians)."""

    start: float  # seconds
    end: float
    position: tuple[float, float]
    yaw: float = 0.0
    lift: float = 0.07


@dataclass(kw_only=True, slots=True)
class Plan:
    """What a generator decides, per time `[t]`; radians and metres; zero is standing upright with hanging arms."""

    times: np.ndarray
    shift: np.ndarray  # [t, 3] of the pelvis
    yaw: np.ndarray  # [t] of the pelvis, world
    tilt: np.ndarray  # [t, 3] rotation vector of the pelvis after yaw
    bend: np.ndarray  # [t, 3] rotation vector of the torso, shared by spine and chest
    look: np.ndarray  # [t, 3] rotation vector of the head, shared by neck and head
    flexion: np.ndarray  # [t, 2] upper arm forward
    abduction: np.ndarray  # [t, 2] upper arm sideways
    elbow: np.ndarray  # [t, 2]
    steps: tuple[list[Step], list[Step]] = field(default_factory=lambda: ([], []))
    stance: tuple[tuple[float, float, float], tuple[float, float, float]] | None = (
        None  # x, z, yaw of each foot at first
    )
    heel: np.ndarray | None = None  # [t, 2] lift of the heel as an angle, on top of what a step does
    air: np.ndarray | None = None  # [t] height of both feet above the floor (a jump)


def standing(times: np.ndarray) -> Plan:
    """A plan of standing still."""
    n = len(times)
    zeros = np.zeros
    return Plan(
        times=times, shift=zeros((n, 3)), yaw=zeros(n), tilt=zeros((n, 3)), bend=zeros((n, 3)), look=zeros((n, 3)),
        flexion=zeros((n, 2)), abduction=np.full((n, 2), 0.12), elbow=np.full((n, 2), 0.25),
    )  # fmt: skip


def smooth(x: np.ndarray | float) -> np.ndarray:
    """Minimum-jerk ease from 0 to 1 for x in 0..1, clamped outside."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def bump(times: np.ndarray, start: float, end: float) -> np.ndarray:
    """Ease from 0 to 1 and back between `start` and `end`, 1 in the middle."""
    x = np.clip((times - start) / (end - start), 0.0, 1.0)
    return np.sin(np.pi * smooth(x)) ** 2


def walk(times: np.ndarray, rng: np.random.Generator) -> Plan:
    """Walk along a straight line through the middle of the floor."""
    plan = standing(times)
    duration = times[-1] - times[0]
    speed, period = rng.uniform(0.5, 0.6), rng.uniform(1.0, 1.12)
    heading = rng.uniform(-0.5, 0.5)
    forward, side = np.array([np.sin(heading), np.cos(heading)]), np.array([np.cos(heading), -np.sin(heading)])
    along = speed * (times - times[0] - duration / 2)
    phase = rng.uniform(0, 1)
    plan.yaw += heading
    plan.shift[:, [0, 2]] = along[:, None] * forward
    angle = 2 * np.pi * ((times - times[0]) / period + phase)
    plan.shift[:, 1] = -0.035 + 0.012 * np.cos(2 * angle)
    plan.tilt[:, 1] = 0.12 * np.sin(angle)
    plan.tilt[:, 2] = 0.04 * np.cos(angle)
    plan.bend[:, 0] = 0.06
    plan.bend[:, 1] = -0.22 * np.sin(angle)
    plan.look[:, 1] = 0.1 * np.sin(angle)
    stance = 0.6
    starts = []
    for foot, sign in enumerate(SIGNS):
        swing = 0.45 * sign * np.sin(angle)
        plan.flexion[:, foot] = swing
        plan.elbow[:, foot] = 0.35 + 0.3 * np.maximum(swing, -0.2)
        offset = 0.5 * foot + phase
        first = int(np.floor(offset)) - 1
        contacts = [(k - offset) * period for k in range(first, first + int(duration / period) + 4)]
        steps = []
        for touch in contacts:
            place = speed * (touch + stance * period / 2 - duration / 2) * forward + sign * 0.085 * side
            begin = times[0] + touch - (1 - stance) * period
            steps.append(Step(start=begin, end=times[0] + touch, position=(place[0], place[1]), yaw=heading))
        starts.append((steps[0].position[0], steps[0].position[1], heading))
        plan.steps[foot].extend(steps[1:])
    plan.stance = (starts[0], starts[1])
    return plan


def reach(times: np.ndarray, rng: np.random.Generator) -> Plan:
    """Reach up and across with one arm, then forward with the other."""
    plan = standing(times)
    x = (times - times[0]) / (times[-1] - times[0])
    high, low = int(rng.integers(2)), 0
    low = 1 - high
    up, out = bump(x, -0.25, 0.85), bump(x, 0.3, 1.25)
    plan.flexion[:, high] += rng.uniform(1.9, 2.2) * up
    plan.abduction[:, high] += 0.35 * up
    plan.elbow[:, high] += 0.5 * out
    plan.flexion[:, low] += rng.uniform(1.1, 1.4) * out
    plan.abduction[:, low] += 0.5 * out
    plan.elbow[:, low] += 0.5 * bump(x, 0.0, 1.0)
    sign = SIGNS[high]
    plan.bend[:, 1] = sign * (-0.45 * up + 0.45 * out)
    plan.bend[:, 2] = sign * 0.12 * up
    plan.bend[:, 0] = 0.15 * out
    plan.look[:, 0] = -0.25 * up + 0.1 * out
    plan.look[:, 1] = sign * (0.2 * up - 0.3 * out)
    plan.shift[:, 0] = sign * 0.05 * (up - out)
    plan.shift[:, 1] = -0.015
    plan.tilt[:, 2] = sign * 0.04 * up
    plan.yaw += rng.uniform(-0.3, 0.3)
    _plant(plan, yaw=float(plan.yaw[0]), width=rng.uniform(0.11, 0.16))
    return plan


def turn(times: np.ndarray, rng: np.random.Generator) -> Plan:
    """Turn on the spot by about a right angle with small steps, the arms swinging out."""
    plan = standing(times)
    x = (times - times[0]) / (times[-1] - times[0])
    sign = rng.choice([-1.0, 1.0])
    total = sign * rng.uniform(1.5, 1.9)
    begin = rng.uniform(-1.0, 0.3)
    plan.yaw = begin + total * smooth((x + 0.08) / 1.1)
    plan.bend[:, 1] = 0.3 * sign * (bump(x, -0.3, 0.7) - 0.5 * bump(x, 0.5, 1.4))
    plan.look[:, 1] = 0.4 * sign * bump(x, -0.3, 0.7)
    plan.shift[:, 1] = -0.03 + 0.01 * np.cos(6 * np.pi * x)
    plan.shift[:, 0] = 0.02 * np.sin(4 * np.pi * x)
    for arm in range(2):
        plan.abduction[:, arm] += 0.45 * bump(x, 0.0, 1.0)
        plan.elbow[:, arm] += 0.4 * bump(x, 0.1, 0.9)
        plan.flexion[:, arm] = SIGNS[arm] * sign * 0.3 * np.sin(np.pi * x)
    _plant(plan, yaw=float(plan.yaw[0]), width=0.1)
    _follow(plan, x, width=0.1, count=2)
    return plan


def squat(times: np.ndarray, rng: np.random.Generator) -> Plan:
    """Squat half-way and rise, arms forward for balance."""
    plan = standing(times)
    x = (times - times[0]) / (times[-1] - times[0])
    deep = bump(x, -0.05, 1.05)
    plan.shift[:, 1] = -0.01 - rng.uniform(0.24, 0.3) * deep
    plan.shift[:, 2] = -0.1 * deep
    plan.bend[:, 0] = 0.5 * deep
    plan.tilt[:, 0] = 0.3 * deep
    plan.look[:, 0] = -0.4 * deep
    plan.flexion += rng.uniform(1.2, 1.6) * deep[:, None]
    plan.elbow += 0.2 * deep[:, None]
    plan.yaw += rng.uniform(-0.6, 0.6)
    plan.shift[:, [0, 2]] = plan.shift[:, 2:] * np.stack([np.sin(plan.yaw), np.cos(plan.yaw)], axis=1)
    _plant(plan, yaw=float(plan.yaw[0]), width=0.17, splay=0.25)
    return plan


def dance(times: np.ndarray, rng: np.random.Generator) -> Plan:
    """Step from side to side, hips swaying, the arms rising in turn. The motion kept for tests."""
    plan = standing(times)
    t = times - times[0]
    beat = 2 * np.pi * t / rng.uniform(0.95, 1.1)
    plan.yaw += rng.uniform(-0.2, 0.2) + 0.3 * np.sin(beat / 2)
    plan.shift[:, 0] = 0.11 * np.sin(beat)
    plan.shift[:, 1] = -0.07 + 0.02 * np.cos(2 * beat)
    plan.tilt[:, 2] = 0.12 * np.sin(beat)
    plan.tilt[:, 1] = 0.2 * np.sin(beat / 2)
    plan.bend[:, 2] = -0.2 * np.sin(beat)
    plan.bend[:, 1] = -0.35 * np.sin(beat / 2 + 0.5)
    plan.look[:, 2] = -0.1 * np.sin(beat)
    plan.look[:, 1] = 0.25 * np.sin(beat / 2)
    for arm, sign in enumerate(SIGNS):
        raised = 0.5 + 0.5 * sign * np.sin(beat / 2 + 0.4)
        plan.abduction[:, arm] += 1.3 * raised
        plan.flexion[:, arm] = 0.3 + 0.5 * (1 - raised)
        plan.elbow[:, arm] = 0.5 + 0.7 * (1 - raised)
    _plant(plan, yaw=0.0, width=0.17, splay=0.2)
    plan.heel = np.stack([0.35 * np.maximum(0, -np.sin(beat)) ** 2, 0.35 * np.maximum(0, np.sin(beat)) ** 2], axis=1)
    return plan


GENERATORS: dict[str, Callable[[np.ndarray, np.random.Generator], Plan]] = {
    "walk": walk,
    "reach": reach,
    "turn": turn,
    "squat": squat,
    "dance": dance,
}


def _plant(plan: Plan, *, yaw: float, width: float, splay: float = 0.08) -> None:
    side = np.array([np.cos(yaw), -np.sin(yaw)]) * width
    plan.stance = ((side[0], side[1], yaw + splay), (-side[0], -side[1], yaw - splay))


def _follow(plan: Plan, x: np.ndarray, *, width: float, count: int) -> None:
    """Let the feet follow the pelvis' yaw in `count` small steps each."""
    duration = plan.times[-1] - plan.times[0]
    for k in range(2 * count):
        foot = k % 2 if plan.yaw[-1] > plan.yaw[0] else 1 - k % 2
        start, end = k / (2 * count) - 0.05, (k + 1) / (2 * count) - 0.05
        yaw = float(np.interp(min(end + 0.5 / count, 1.0), x, plan.yaw))
        place = SIGNS[foot] * width * np.array([np.cos(yaw), -np.sin(yaw)])
        at = plan.times[0] + duration * np.array([start, end])
        plan.steps[foot].append(
            Step(start=at[0], end=at[1], position=(place[0], place[1]), yaw=yaw + SIGNS[foot] * 0.08, lift=0.05)
        )


def feet_tracks(plan: Plan) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ball of each foot `[t, 2, 3]` (height above its rest), yaw `[t, 2]` and heel angle `[t, 2]`."""
    times = plan.times
    if plan.stance is None:
        raise ValueError("a plan must say where its feet stand at first")
    ball, yaw, heel = np.zeros((len(times), 2, 3)), np.zeros((len(times), 2)), np.zeros((len(times), 2))
    for foot in range(2):
        x, z, heading = plan.stance[foot]
        ball[:, foot, 0], ball[:, foot, 2], yaw[:, foot] = x, z, heading
        for step in plan.steps[foot]:
            progress = (times - step.start) / (step.end - step.start)
            ease = smooth(progress)
            for axis, goal in ((0, step.position[0]), (2, step.position[1])):
                ball[:, foot, axis] += ease * (goal - ball[:, foot, axis])
            yaw[:, foot] += ease * (step.yaw - yaw[:, foot])
            swing = np.clip(progress, 0, 1)
            ball[:, foot, 1] += step.lift * np.sin(np.pi * smooth(swing)) ** 2
            # The heel leaves the floor shortly before the ball does.
            heel[:, foot] += 0.55 * bump(progress, -0.6, 0.85)
    if plan.heel is not None:
        heel = heel + plan.heel
    if plan.air is not None:
        ball[:, :, 1] += plan.air[:, None]
    return ball, yaw, heel


def solve(skeleton: Skeleton, plan: Plan) -> np.ndarray:
    """Degrees of freedom `[t, 3 + 3 j]` that follow a plan: the torso directly, legs by inverse kinematics."""
    names, heads = skeleton.names, skeleton.heads
    head = {name: heads[j] for j, name in enumerate(names)}
    count = len(plan.times)
    local = {name: np.broadcast_to(np.eye(3), (count, 3, 3)).copy() for name in names}
    up = np.zeros((count, 3))
    up[:, 1] = plan.yaw
    pelvis = rotvec_to_rotmat(up) @ rotvec_to_rotmat(plan.tilt)
    local["pelvis"] = pelvis
    local["spine"] = local["chest"] = rotvec_to_rotmat(plan.bend / 2)
    local["neck"] = local["head"] = rotvec_to_rotmat(plan.look / 2)
    for arm, side in enumerate(SIDES):
        _solve_arm(local, head, plan, arm, side)
    balls, yaws, heels = feet_tracks(plan)
    legs = [_Leg(head, side) for side in SIDES]
    ankles = [leg.ankle(balls[:, k], yaws[:, k], heels[:, k]) for k, leg in enumerate(legs)]
    shift = plan.shift.copy()
    if plan.air is not None:
        shift[:, 1] += plan.air
    shift[:, 1] = _reachable_height(head, pelvis, shift, legs, ankles)
    root = head["pelvis"] + shift
    for k, leg in enumerate(legs):
        leg.solve(local, pelvis, root, ankles[k], yaws[:, k], heels[:, k])
    rotvecs = _continuous(np.stack([rotmat_to_rotvec(local[name]) for name in names], axis=1))
    return np.concatenate([shift, rotvecs.reshape(count, -1)], axis=1)


def _continuous(rotvecs: np.ndarray) -> np.ndarray:
    """Choose among the rotation vectors `[t, j, 3]` of equal rotations those that do not jump by a turn in time."""
    result = rotvecs.copy()
    for t in range(1, len(result)):
        angle = np.linalg.norm(result[t], axis=-1, keepdims=True)
        axis = result[t] / np.where(angle < 1e-9, 1.0, angle)
        turns = np.round((np.sum(result[t - 1] * axis, axis=-1, keepdims=True) - angle) / (2 * np.pi))
        result[t] += 2 * np.pi * turns * axis
    return result


def _solve_arm(local: dict[str, np.ndarray], head: dict[str, np.ndarray], plan: Plan, arm: int, side: str) -> None:
    sign = SIGNS[arm]
    hang = rotation_between(head[f"forearm_{side}"] - head[f"upper_arm_{side}"], np.array([0.05 * sign, -1.0, 0.0]))
    straight = hang @ (head[f"hand_{side}"] - head[f"forearm_{side}"])
    zero = np.zeros(len(plan.times))
    flex = rotvec_to_rotmat(np.stack([-plan.flexion[:, arm], zero, zero], axis=1))
    # Past the shoulder the collar bone takes a third of the movement, as it does in people.
    lift = 0.3 * np.maximum(plan.abduction[:, arm] + 0.6 * np.maximum(plan.flexion[:, arm], 0) - 0.6, 0)
    local[f"clavicle_{side}"] = rotvec_to_rotmat(np.stack([zero, zero, sign * lift], axis=1))
    abduct = rotvec_to_rotmat(np.stack([zero, zero, sign * np.maximum(plan.abduction[:, arm] - lift, 0.0)], axis=1))
    local[f"upper_arm_{side}"] = abduct @ flex @ hang
    bend = rotvec_to_rotmat(np.stack([-plan.elbow[:, arm], zero, zero], axis=1))
    align = rotation_between(straight, np.array([0.05 * sign, -1.0, 0.0]))  # The rest pose may bend the elbow a little.
    local[f"forearm_{side}"] = hang.T @ bend @ align @ hang


class _Leg:
    """Two-bone inverse kinematics of one leg; angles from the rest pose."""

    def __init__(self, head: dict[str, np.ndarray], side: str) -> None:
        self.side = side
        self.hip = head[f"thigh_{side}"] - head["pelvis"]
        self.thigh = head[f"shin_{side}"] - head[f"thigh_{side}"]
        self.shin = head[f"foot_{side}"] - head[f"shin_{side}"]
        self.foot = head[f"foot_{side}"] - head[f"toe_{side}"]  # From the ball to the ankle.
        self.ball_height = head[f"toe_{side}"][1]

    def rotation(self, yaw: np.ndarray, heel: np.ndarray) -> np.ndarray:
        zero = np.zeros_like(yaw)
        turned = rotvec_to_rotmat(np.stack([zero, yaw, zero], axis=1))
        return turned @ rotvec_to_rotmat(np.stack([heel, zero, zero], axis=1))

    def ankle(self, ball: np.ndarray, yaw: np.ndarray, heel: np.ndarray) -> np.ndarray:
        return ball + np.array([0, self.ball_height, 0]) + self.rotation(yaw, heel) @ self.foot

    @property
    def reach(self) -> float:
        return float(0.997 * (np.linalg.norm(self.thigh) + np.linalg.norm(self.shin)))

    def solve(
        self,
        local: dict[str, np.ndarray],
        pelvis: np.ndarray,
        root: np.ndarray,
        ankle: np.ndarray,
        yaw: np.ndarray,
        heel: np.ndarray,
    ) -> None:
        span = ankle - (root + pelvis @ self.hip)
        distance = np.linalg.norm(span, axis=1, keepdims=True)
        a, b = np.linalg.norm(self.thigh), np.linalg.norm(self.shin)
        cosine = (a**2 + distance**2 - b**2) / (2 * a * distance)
        cosine = np.clip(cosine, -1, 1)
        along = span / distance
        zero = np.zeros_like(yaw)
        facing = pelvis[:, :, 2] + np.stack([np.sin(yaw), zero, np.cos(yaw)], axis=1)
        hinge = _unit(np.cross(facing, along))  # Bending about it moves the knee forward.
        knee_out = np.cross(along, hinge)
        thigh = a * (cosine * along + np.sqrt(1 - cosine**2) * knee_out)
        upper = _frame(thigh, hinge) @ _frame(self.thigh, np.array([1.0, 0, 0])).T
        lower = _frame(span - thigh, hinge) @ _frame(self.shin, np.array([1.0, 0, 0])).T
        foot = self.rotation(yaw, heel)
        local[f"thigh_{self.side}"] = np.swapaxes(pelvis, -1, -2) @ upper
        local[f"shin_{self.side}"] = np.swapaxes(upper, -1, -2) @ lower
        local[f"foot_{self.side}"] = np.swapaxes(lower, -1, -2) @ foot
        flat = self.rotation(yaw, np.zeros_like(heel))
        local[f"toe_{self.side}"] = np.swapaxes(foot, -1, -2) @ flat


def _reachable_height(
    head: dict[str, np.ndarray], pelvis: np.ndarray, shift: np.ndarray, legs: list[_Leg], ankles: list[np.ndarray]
) -> np.ndarray:
    """Height of the pelvis' shift, lowered where a leg would be too short; a soft minimum keeps it smooth."""
    heights = [shift[:, 1]]
    for leg, ankle in zip(legs, ankles, strict=True):
        hip = head["pelvis"] + shift + pelvis @ leg.hip
        flat = np.sum((ankle - hip)[:, [0, 2]] ** 2, axis=1)
        highest = ankle[:, 1] + np.sqrt(np.maximum(leg.reach**2 - flat, 1e-4))
        heights.append(shift[:, 1] + highest - hip[:, 1])
    sharpness = 150.0  # per metre: the soft minimum is at most ln(3) / 150 = 7 mm below the true one
    return -np.log(sum(np.exp(-sharpness * h) for h in heights)) / sharpness


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _frame(direction: np.ndarray, hinge: np.ndarray) -> np.ndarray:
    """Rotation `[..., 3, 3]` whose columns are the direction, the hinge made orthogonal to it, and their product."""
    first = _unit(direction)
    hinge = np.broadcast_to(hinge, first.shape)
    second = _unit(hinge - np.sum(hinge * first, axis=-1, keepdims=True) * first)
    return np.stack([first, second, np.cross(first, second)], axis=-1)


@dataclass(frozen=True, kw_only=True, slots=True)
class Clip:
    """A generator and how many frames of it to take."""

    generator: str
    frames: int

    def __post_init__(self) -> None:
        if self.generator not in GENERATORS:
            raise InputError(f"unknown motion {self.generator!r}, expected one of {', '.join(GENERATORS)}")
        if not 2 <= self.frames <= 100_000:
            raise InputError(f"a clip of {self.frames} frames, expected 2 to 100000")


def make_motion(skeleton: Skeleton, clips: tuple[Clip, ...], *, fps: float, seed: int) -> Motion:
    """Generate the clips in order, each a sequence of its own, each from its own random stream."""
    dofs, sequence = [], []
    for index, clip in enumerate(clips):
        rng = np.random.default_rng([seed, index])
        dofs.append(solve(skeleton, GENERATORS[clip.generator](np.arange(clip.frames) / fps, rng)))
        sequence.append(np.full(clip.frames, index))
    return Motion(dofs=np.concatenate(dofs), sequence=np.concatenate(sequence), fps=fps)
