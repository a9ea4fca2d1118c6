"""Generators of motions: functions of time and a random stream that return a plan, timed as people move."""

from collections.abc import Callable

import numpy as np

from synth.motion.plans import FootStep, Plan, bump, smooth, standing
from synth.skeleton import SIGNS


def in_a_manner(plan: Plan, rng: np.random.Generator) -> Plan:
    """The plan as it happens to be done this time: how low, how upright, where the arms are held and how they drift.

    What the feet do stays. Without it, two takes of a kind would differ by less than a degree per joint.
    """
    x = np.linspace(0, 1, len(plan.times))

    def held(most: float, drift: float) -> np.ndarray:
        return rng.uniform(-most, most) + drift * np.sin(2 * np.pi * (rng.uniform(0.4, 1.0) * x + rng.uniform()))

    for axis in range(3):
        plan.bend[:, axis] += held(0.14, 0.08)
        plan.look[:, axis] += held(0.16, 0.1)
    for arm in range(2):
        plan.flexion[:, arm] += held(0.22, 0.1)
        # Over the head, sideways is across: there the arms are left where they are.
        plan.abduction[:, arm] += (0.22 + held(0.14, 0.08)) * np.cos(np.clip(plan.flexion[:, arm], 0, np.pi / 2))
        plan.elbow[:, arm] += 0.35 + held(0.25, 0.1)
    plan.shift[:, 1] -= rng.uniform(0.0, 0.05)
    return plan


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
            steps.append(FootStep(start=begin, end=times[0] + touch, position=(place[0], place[1]), yaw=heading))
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


def stand(times: np.ndarray, rng: np.random.Generator) -> Plan:
    """Stand still with the arms a little away from the body."""
    plan = standing(times)
    plan.abduction += 0.4
    plan.shift[:, 1] = -0.01
    plan.yaw += rng.uniform(-0.2, 0.2)
    _plant(plan, yaw=float(plan.yaw[0]), width=0.13)
    return plan


def run(times: np.ndarray, rng: np.random.Generator) -> Plan:
    """Run on the spot: knees high, arms bent and swinging, both feet off the floor between steps."""
    plan = standing(times)
    t = times - times[0]
    beat = 2 * np.pi * t / rng.uniform(0.62, 0.72)
    plan.yaw += rng.uniform(-0.3, 0.3)
    plan.shift[:, 1] = -0.06 + 0.03 * np.cos(2 * beat)
    plan.bend[:, 0] = 0.15
    plan.bend[:, 1] = -0.3 * np.sin(beat)
    plan.tilt[:, 1] = 0.15 * np.sin(beat)
    plan.flexion = 0.15 + 0.75 * np.stack([np.sin(beat), -np.sin(beat)], axis=1)
    plan.elbow = np.full((len(times), 2), 1.5)
    _plant(plan, yaw=float(plan.yaw[0]), width=0.09, splay=0.03)
    raised = 0.5 - 0.5 * np.stack([np.sin(beat), -np.sin(beat)], axis=1)
    plan.lifted = 0.24 * raised**2
    plan.heel = 0.7 * raised
    return plan


def jump(times: np.ndarray, rng: np.random.Generator) -> Plan:
    """Crouch, jump straight up under gravity, land and recover, the arms helping."""
    plan = standing(times)
    duration = times[-1] - times[0]
    x = (times - times[0]) / duration
    height = rng.uniform(0.16, 0.22)
    flight = 2 * np.sqrt(2 * height / 9.81) / duration  # as a share of the clip
    start = 0.5 - flight / 2
    inside = np.clip((x - start) / flight, 0, 1)
    plan.air = height * 4 * inside * (1 - inside)
    crouch = bump(x, start - 0.42, start + 0.05) + 0.8 * bump(x, start + flight - 0.05, start + flight + 0.42)
    plan.shift[:, 1] = -0.015 - 0.2 * crouch
    plan.bend[:, 0] = 0.35 * crouch
    plan.tilt[:, 0] = 0.2 * crouch
    plan.flexion += (-0.5 * bump(x, start - 0.42, start + 0.05) + 1.9 * bump(x, start - 0.12, start + flight + 0.2))[
        :, None
    ]
    plan.elbow += 0.4 * crouch[:, None]
    plan.yaw += rng.uniform(-0.3, 0.3)
    _plant(plan, yaw=float(plan.yaw[0]), width=0.12)
    plan.heel = (0.5 * np.sqrt(4 * inside * (1 - inside)))[:, None] * np.ones(2)
    return plan


def spin(times: np.ndarray, rng: np.random.Generator) -> Plan:
    """Turn once around on the spot, the arms out."""
    plan = standing(times)
    x = (times - times[0]) / (times[-1] - times[0])
    sign = rng.choice([-1.0, 1.0])
    plan.yaw = rng.uniform(-0.3, 0.3) + sign * 2 * np.pi * smooth((x + 0.05) / 1.1)
    plan.abduction += 0.8 * bump(x, -0.1, 1.1)[:, None]
    plan.elbow += 0.2
    plan.bend[:, 1] = 0.25 * sign * bump(x, -0.3, 0.6)
    plan.shift[:, 1] = -0.03
    _plant(plan, yaw=float(plan.yaw[0]), width=0.1)
    _follow(plan, x, width=0.1, count=6)
    return plan


def arms_up(times: np.ndarray, rng: np.random.Generator) -> Plan:
    """Stretch both arms up and apart, on tiptoe, and sway. A pose that no other motion is like."""
    plan = standing(times)
    x = (times - times[0]) / (times[-1] - times[0])
    up, sway = smooth((x + 0.3) / 0.55), np.sin(2 * np.pi * x + rng.uniform(0, 2 * np.pi))
    plan.abduction += rng.uniform(1.9, 2.1) * up[:, None]
    plan.bend[:, 0] = -0.12 * up
    plan.bend[:, 2] = 0.2 * up * sway
    plan.look[:, 0] = -0.35 * up
    plan.shift[:, 1] = -0.01 + 0.03 * up
    plan.yaw += rng.uniform(-0.3, 0.3)
    _plant(plan, yaw=float(plan.yaw[0]), width=0.12)
    plan.heel = 0.35 * up[:, None] * np.ones(2)
    return plan


def deep_squat(times: np.ndarray, rng: np.random.Generator) -> Plan:
    """Sink onto the balls of the feet and stay down, the arms between the knees, looking around."""
    plan = standing(times)
    x = (times - times[0]) / (times[-1] - times[0])
    deep, around = smooth((x + 0.3) / 0.85), np.sin(2 * np.pi * x + rng.uniform(0, 2 * np.pi))
    plan.shift[:, 1] = -0.01 - rng.uniform(0.32, 0.36) * deep
    back = -0.1 * deep
    plan.bend[:, 0] = 0.45 * deep
    plan.bend[:, 1] = 0.3 * deep * around
    plan.tilt[:, 0] = 0.15 * deep
    plan.look[:, 0] = -0.3 * deep
    plan.look[:, 1] = 0.4 * deep * around
    plan.flexion += 0.7 * deep[:, None]
    plan.elbow += 0.8 * deep[:, None]
    plan.yaw += rng.uniform(-0.4, 0.4)
    plan.shift[:, [0, 2]] = back[:, None] * np.stack([np.sin(plan.yaw), np.cos(plan.yaw)], axis=1)
    _plant(plan, yaw=float(plan.yaw[0]), width=0.12, splay=0.12)
    plan.heel = 0.5 * deep[:, None] * np.ones(2)
    return plan


def twist(times: np.ndarray, rng: np.random.Generator) -> Plan:
    """Turn the torso from side to side over planted feet, the arms carried along."""
    plan = standing(times)
    beat = 2 * np.pi * (times - times[0]) / rng.uniform(1.5, 1.8) + rng.uniform(0, 2 * np.pi)
    most = rng.uniform(0.55, 0.7)
    plan.yaw += rng.uniform(-0.3, 0.3)
    plan.bend[:, 1] = most * np.sin(beat)
    plan.tilt[:, 1] = 0.15 * np.sin(beat)
    plan.look[:, 1] = 0.3 * np.sin(beat)
    plan.shift[:, 1] = -0.03 + 0.01 * np.cos(2 * beat)
    plan.abduction += rng.uniform(0.5, 0.9)
    plan.flexion = 0.35 * np.stack([-np.sin(beat - 0.5), np.sin(beat - 0.5)], axis=1)
    plan.elbow += 0.3 + 0.3 * np.abs(np.sin(beat))[:, None]
    _plant(plan, yaw=float(plan.yaw[0]), width=0.16, splay=0.15)
    return plan


def wave(times: np.ndarray, rng: np.random.Generator) -> Plan:
    """Wave with one arm held high, the other hand on the hip, the weight going from foot to foot."""
    plan = standing(times)
    t = times - times[0]
    beat, sway = 2 * np.pi * t / rng.uniform(0.8, 1.0), 2 * np.pi * t / rng.uniform(2.0, 2.6) + rng.uniform(0, 6)
    high = int(rng.integers(2))
    low, sign = 1 - high, SIGNS[high]
    plan.yaw += rng.uniform(-0.4, 0.4)
    plan.abduction[:, high] += rng.uniform(1.4, 1.6) + 0.1 * np.sin(beat)
    plan.elbow[:, high] += 0.9 + 0.5 * np.sin(beat)
    plan.abduction[:, low] += 0.55
    plan.flexion[:, low] -= 0.3
    plan.elbow[:, low] += 1.3
    plan.bend[:, 2] = 0.1 * sign + 0.12 * np.sin(sway)
    plan.look[:, 2] = -0.12 * np.sin(sway)
    plan.tilt[:, 2] = 0.08 * np.sin(sway)
    plan.shift[:, 0] = 0.05 * np.sin(sway)
    plan.shift[:, 1] = -0.03
    _plant(plan, yaw=float(plan.yaw[0]), width=0.13)
    return plan


def bow(times: np.ndarray, rng: np.random.Generator) -> Plan:
    """Bow and straighten again and again, the arms sweeping back."""
    plan = standing(times)
    low = 0.5 - 0.5 * np.cos(2 * np.pi * (times - times[0]) / rng.uniform(1.9, 2.3) + rng.uniform(0, 2 * np.pi))
    plan.yaw += rng.uniform(-0.5, 0.5)
    plan.bend[:, 0] = rng.uniform(0.6, 0.75) * low
    plan.tilt[:, 0] = 0.35 * low
    plan.look[:, 0] = -0.2 * low
    plan.abduction += (0.3 + 0.5 * low)[:, None]
    plan.flexion += (0.2 - 0.5 * low)[:, None]
    plan.elbow += 0.3
    back = -0.07 * low
    plan.shift[:, [0, 2]] = back[:, None] * np.stack([np.sin(plan.yaw), np.cos(plan.yaw)], axis=1)
    plan.shift[:, 1] = -0.02 - 0.03 * low
    _plant(plan, yaw=float(plan.yaw[0]), width=0.12)
    return plan


def clap(times: np.ndarray, rng: np.random.Generator) -> Plan:
    """Open the arms wide and bring them together in front, the knees giving with every beat."""
    plan = standing(times)
    beat = 2 * np.pi * (times - times[0]) / rng.uniform(1.1, 1.3) + rng.uniform(0, 2 * np.pi)
    apart = 0.5 + 0.5 * np.cos(beat)
    plan.yaw += rng.uniform(-0.4, 0.4)
    plan.flexion += (rng.uniform(1.2, 1.4) - 0.5 * apart)[:, None]
    plan.abduction += (0.1 + 1.1 * apart)[:, None]
    plan.elbow += (0.7 - 0.4 * apart)[:, None]
    plan.bend[:, 0] = 0.18 * (1 - apart)
    plan.bend[:, 1] = 0.15 * np.sin(beat / 2)
    plan.look[:, 0] = -0.1 * (1 - apart)
    plan.shift[:, 1] = -0.05 + 0.03 * np.cos(2 * beat)
    _plant(plan, yaw=float(plan.yaw[0]), width=0.15, splay=0.12)
    return plan


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
            FootStep(start=at[0], end=at[1], position=(place[0], place[1]), yaw=yaw + SIGNS[foot] * 0.08, lift=0.05)
        )


GENERATORS: dict[str, Callable[[np.ndarray, np.random.Generator], Plan]] = {
    "walk": walk,
    "reach": reach,
    "turn": turn,
    "squat": squat,
    "dance": dance,
    "stand": stand,
    "run": run,
    "jump": jump,
    "spin": spin,
    "arms_up": arms_up,
    "deep_squat": deep_squat,
    "twist": twist,
    "wave": wave,
    "bow": bow,
    "clap": clap,
}
