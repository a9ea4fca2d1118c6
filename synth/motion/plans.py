"""Plans of a motion: feet, pelvis, torso and arms over time, and the solver that turns a plan into joint angles.

A plan plants the ball of each foot, so that feet neither slide nor leave the floor by accident; legs follow by two-bone
inverse kinematics. The character faces +z, its left is +x.
"""

from dataclasses import dataclass, field

import numpy as np

from ash.capture.dataset import Skeleton
from synth.posing import rotation_between, rotmat_to_rotvec, rotvec_to_rotmat
from synth.skeleton import SIDES, SIGNS


@dataclass(frozen=True, kw_only=True, slots=True)
class FootStep:
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
    steps: tuple[list[FootStep], list[FootStep]] = field(default_factory=lambda: ([], []))
    stance: tuple[tuple[float, float, float], tuple[float, float, float]] | None = (
        None  # x, z, yaw of each foot at first
    )
    heel: np.ndarray | None = None  # [t, 2] lift of the heel as an angle, on top of what a step does
    lifted: np.ndarray | None = None  # [t, 2] height of each foot on top of what a step does
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
    if plan.lifted is not None:
        ball[..., 1] += plan.lifted
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
    rotvecs = continuous(np.stack([rotmat_to_rotvec(local[name]) for name in names], axis=1))
    return np.concatenate([shift, rotvecs.reshape(count, -1)], axis=1)


def continuous(rotvecs: np.ndarray) -> np.ndarray:
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
