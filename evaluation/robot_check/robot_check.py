"""Check of a robot profile without a robot: what it can do, which value limits it, and what to change."""

import json
import math
import textwrap
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sextant.evaluation.robot_check.foot_lag import lag_limits
from sextant.evaluation.robot_check.gait_cycle import GaitCycle, standing_torques, walk_cycle
from sextant.evaluation.robot_check.ground_limits import GroundLimit, Obstacle, find_ground_limits
from sextant.evaluation.robot_check.likely_mistakes import doubtful_numbers, misplaced_legs
from sextant.evaluation.robot_check.limit import MAX_SPEED_SHARE, MIN_MINUTES, Limit, in_cm
from sextant.evaluation.robot_check.remedies import ground_remedy, room_remedy, speed_remedy
from sextant.services.actuator.locomotion.feedforward import centre_of_mass, leg_shapes
from sextant.services.planner.locomotion.gait import GAITS
from sextant.services.planner.locomotion.step_planner import SHARES
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import body_inverse
from sextant.shared.robot.profile import JOINTS, RobotProfile
from sextant.shared.robot.reach import height_range, joint_room, least_support_margin, longest_stride
from sextant.shared.servo.protection import Protection

_PROTECTION = Protection()
_STIFFNESS_SHARE = 0.25  # [1] by which the stiffness may differ from stall torque over compliance slope
_MIN_OBSTACLE_M, _MIN_SLOPE_DEG = 0.02, 3.0  # obstacles that any walking robot must pass
_STAND = "stand"
_WIDTH = 120  # characters of a line


@dataclass(frozen=True, slots=True)
class Load:
    """Motor torques in a posture or a gait, as shares of the stall torque: coxa, femur, tibia."""

    gait: str  # "stand": on six legs
    body_height: float  # [m]
    speed: float  # [m/s]
    static: tuple[float, float, float]  # largest torque that holds the robot
    peak: tuple[float, float, float]  # largest torque that the planned motion needs; a servo gives at most 1
    rms: tuple[float, float, float]  # root mean square of the worst leg
    minutes: float  # [min] until the first servo reaches its temperature limit, infinite if none does
    temperature: float  # [deg C] that the hottest servo approaches


@dataclass(frozen=True, slots=True)
class RobotCheck:
    """Result of the check of a profile."""

    robot: str
    centre_of_mass: tuple[float, float, float]  # [m] {body} of the standing robot
    loads: tuple[Load, ...]
    limits: tuple[Limit, ...]

    @property
    def passes(self) -> bool:
        """Whether the robot meets all limits."""
        return all(limit.is_met for limit in self.limits)

    def to_json(self) -> str:
        """Return the result as JSON; an infinite time is null."""
        return json.dumps(_plain({**asdict(self), "passes": self.passes}), indent=1) + "\n"


def check_robot(profile: RobotProfile) -> RobotCheck:
    """Compute what a robot can do: reach, torque, heat, speed, stability, and the ground that it can walk over."""
    heights = sorted({*profile.stance.body_height_range, profile.stance.body_height})
    cycles = {(gait, height): walk_cycle(profile, gait, height) for gait in GAITS for height in heights}
    loads = [_standing(profile, height) for height in heights]
    loads += [_walking(profile, gait, height, cycle) for (gait, height), cycle in cycles.items()]
    tripod = cycles["tripod", profile.stance.body_height]
    centre = centre_of_mass(profile, leg_shapes(profile, body_inverse(profile, profile.rest_feet())))
    limits = (
        *_mistakes(profile),
        *_reach(profile),
        *_joints(profile, tripod),
        *_torque(profile, loads),
        *lag_limits(profile, cycles),
        _heat(profile, _walking(profile, "tripod", profile.stance.body_height, tripod)),
        _speed(profile, tripod),
        _support(profile, tripod, centre),
        *_ground(profile),
    )
    return RobotCheck(profile.name, centre, tuple(loads), limits)


# -------------------------------------------------------------------------------------------------------------- loads


def _standing(profile: RobotProfile, height: float) -> Load:
    feet = profile.rest_feet(height)
    torque = np.abs(standing_torques(profile, body_inverse(profile, feet), feet, np.ones(6)))
    return _load(profile, _STAND, height, 0.0, torque, torque, torque)


def _walking(profile: RobotProfile, gait: str, height: float, cycle: GaitCycle) -> Load:
    static, peak = (np.abs(torque).max(axis=0) for torque in (cycle.standing_torque, cycle.torque))
    return _load(profile, gait, height, cycle.speed, static, peak, cycle.rms_torque)


def _load(profile: RobotProfile, gait: str, height: float, speed: float, static: Array, peak: Array, rms: Array) -> Load:
    """Return a load from torques (6, 3) [N m]."""
    shares = rms / profile.servos.stall_torque
    hottest, minutes = float(shares.max()), math.inf
    for limit in np.unique(profile.servos.temperature_limit).tolist():
        share = float(shares.max(where=profile.servos.temperature_limit == limit, initial=0.0))
        minutes = min(minutes, _PROTECTION.time_to_reach(limit, share) / 60.0)
    of_static, of_peak, of_rms = (_three((torque / profile.servos.stall_torque).max(axis=0)) for torque in (static, peak, rms))
    return Load(gait, height, speed, of_static, of_peak, of_rms, minutes, _PROTECTION.final_temperature(hottest))


def _three(values: Array) -> tuple[float, float, float]:
    coxa, femur, tibia = values.tolist()
    return coxa, femur, tibia


# ------------------------------------------------------------------------------------------------------------- limits


def _mistakes(profile: RobotProfile) -> Iterator[Limit]:
    found = {
        "numbers": [f"{doubt.key} is {doubt.sentence}" for doubt in doubtful_numbers(profile)],
        "legs": misplaced_legs(profile),
    }
    likely = {
        "numbers": "all numbers are likely in their units",
        "legs": "each leg is on the side of its name and points outward",
    }
    for name, sentences in found.items():
        for sentence in sentences or [likely[name]]:
            yield Limit(name, float(len(sentences)), 0.0, "mistakes", not sentences, sentence)


def _reach(profile: RobotProfile) -> Iterator[Limit]:
    stance = profile.stance
    (low, high), (lowest, highest) = height_range(profile), stance.body_height_range
    words = (
        f"resting feet reach the ground from {in_cm(low)} to {in_cm(high)}, "
        f"body_height_range uses {in_cm(lowest)} to {in_cm(highest)}"
    )
    fits = low <= lowest + 1e-3 and highest <= high + 1e-3
    yield Limit("height", high - low, highest - lowest, "m", fits, f"{words}; stance.foot_radius_from_coxa moves both ends")
    for place, height, needed in (
        ("stride", stance.body_height, stance.stride),
        ("stride, low", lowest, min(SHARES) * stance.stride),
        ("stride, high", highest, min(SHARES) * stance.stride),
    ):
        found = longest_stride(profile, height)
        words = f"at a body height of {in_cm(height)} a stride of {in_cm(found.length)} is possible, {in_cm(needed)} needed"
        change = "change stance.foot_radius_from_coxa, stance.stride or the height"
        is_met = found.length >= needed - 1e-9
        yield Limit(place, found.length, needed, "m", is_met, f"{words}; limited by {found.limited_by}: {change}")


def _joints(profile: RobotProfile, cycle: GaitCycle) -> Iterator[Limit]:
    room = np.degrees(joint_room(profile, cycle.q, cycle.share))
    least = float(room.min())
    listed = ", ".join(f"{joint} {angle:.0f}" for joint, angle in zip(JOINTS, room.tolist(), strict=True))
    words = f"standing legs of the tripod gait keep {listed} deg from their limits; {room_remedy(profile, math.radians(least))}"
    yield Limit("joint room", least, 0.0, "deg", least >= 0.0, words)
    fastest = (np.abs(cycle.rate).max(axis=0) / profile.servos.no_load_speed).max(axis=0)
    worst = int(np.argmax(fastest))
    share = f"{fastest[worst]:.0%} of servo.no_load_speed"
    words = f"the {JOINTS[worst]} turns fastest, at {share}; a lower stance.foot_speed slows swings"
    is_met = bool(fastest[worst] <= MAX_SPEED_SHARE)
    yield Limit("joint speed", float(fastest[worst]), MAX_SPEED_SHARE, "of no-load speed", is_met, words)


def _torque(profile: RobotProfile, loads: list[Load]) -> Iterator[Limit]:
    for gait in (_STAND, *GAITS):
        of_gait = [load for load in loads if load.gait == gait]
        worst = max(of_gait, key=lambda load: max(load.static))
        share = max(worst.static)
        joint = JOINTS[worst.static.index(share)]
        most = _PROTECTION.mean_duty
        name = "standing" if gait == _STAND else f"the {gait} gait"
        words = (
            f"{name} takes {share:.0%} of the stall torque at a {joint}, at a body height of {in_cm(worst.body_height)}; "
            "feet nearer to the coxa (stance.foot_radius_from_coxa) or less body.mass lower it"
        )
        yield Limit(f"torque, {gait}", share, most, "of stall torque", share <= most, words)
    servo = max(profile.servos.each, key=lambda one: abs(one.stiffness / one.nominal_stiffness - 1.0))
    ratio, table = servo.stiffness / servo.nominal_stiffness, servo.servo_model.table
    if table.position_gain or table.compliance:
        expected = f"the setting of the {servo.model} gives {servo.nominal_stiffness:.3g} N m/rad"
    else:
        expected = f"no data sheet of {servo.model} servos states one to compare with"
    words = f"servo.stiffness is {servo.stiffness:g} N m/rad, {expected}; a wrong one makes the body sag"
    judged = not any(doubt.key.endswith("stall_torque") for doubt in doubtful_numbers(profile))
    if not judged:
        words = "servo.stiffness is not judged before the stall torque is right, on which it depends"
    yield Limit("stiffness", ratio, 1.0, "of the model's", not judged or abs(ratio - 1.0) <= _STIFFNESS_SHARE, words)


def _heat(profile: RobotProfile, load: Load) -> Limit:
    worst = load.rms.index(max(load.rms))
    limit, joint = float(profile.servos.temperature_limit[:, worst].min()), JOINTS[worst]
    torque = load.rms[worst] * float(profile.servos.stall_torque[:, worst].max())
    lasts = "for hours" if math.isinf(load.minutes) else f"for {load.minutes:.0f} min, then a servo reaches {limit:g} deg C"
    words = (
        f"walking in the tripod gait lasts {lasts}: the {joint} takes {torque:.2f} N m rms and heats to {load.temperature:.0f} "
        "deg C in the end; a lower stance.foot_speed, a longer stance.step_s or nearer feet cool it"
    )
    return Limit("heat", load.minutes, MIN_MINUTES, "min", load.minutes >= MIN_MINUTES, words)


def _speed(profile: RobotProfile, cycle: GaitCycle) -> Limit:
    stance = profile.stance
    if cycle.step_s > stance.step_s + 1e-9:
        limiting = f"stance.foot_speed, by which a step takes {cycle.step_s:.2f} s"
    elif cycle.travel < stance.max_speed * stance.step_s - 1e-9:
        limiting = "stance.stride over stance.step_s"
    else:
        limiting = "stance.max_speed"
    words = f"the tripod gait walks at {100 * cycle.speed:.1f} cm/s, limited by {limiting}; {speed_remedy(profile)}"
    return Limit("speed", cycle.speed, None, "m/s", cycle.speed > 0.0, words)


def _support(profile: RobotProfile, cycle: GaitCycle, centre: tuple[float, float, float]) -> Limit:
    margin, needed = least_support_margin(profile, cycle.feet, cycle.share), profile.stance.support_margin
    place = ", ".join(f"{axis} {round(100 * part, 1) + 0.0:.1f}" for axis, part in zip("xyz", centre, strict=True))
    words = (
        f"the centre of mass of the standing robot is at {place} cm in the body's frame; in the tripod gait it stays "
        f"{in_cm(margin)} inside the standing feet, stance.support_margin needs {in_cm(needed)}; a shorter stance.stride, a "
        "wider stance or body.centre_of_mass in the middle adds to it"
    )
    return Limit("support margin", margin, needed, "m", margin >= needed, words)


def _ground(profile: RobotProfile) -> Iterator[Limit]:
    found = find_ground_limits(profile)
    lengths: tuple[tuple[str, Obstacle, GroundLimit], ...] = (
        ("step up", "riser", found.riser),
        ("step down", "drop", found.drop),
        ("gap", "gap", found.gap),
    )
    for name, obstacle, limit in lengths:
        words = f"the step planner passes a {name} of {in_cm(limit.passed)}{_then(profile, obstacle, limit)}"
        yield Limit(name, limit.passed, _MIN_OBSTACLE_M, "m", limit.passed >= _MIN_OBSTACLE_M - 1e-9, words)
    slope = math.degrees(found.slope.passed)
    words = f"the step planner passes a slope of {slope:.0f} deg{_then(profile, 'slope', found.slope)}"
    yield Limit("slope", slope, _MIN_SLOPE_DEG, "deg", slope >= _MIN_SLOPE_DEG - 1e-9, words)


def _then(profile: RobotProfile, obstacle: Obstacle, limit: GroundLimit) -> str:
    """Return why the next larger obstacle is not passed, and what to change, as the end of a sentence."""
    if limit.refused is None:
        return ", the largest that was tried"
    refused = f"{math.degrees(limit.refused):.0f} deg" if obstacle == "slope" else in_cm(limit.refused)
    return f"; at {refused}: {limit.reason}; {ground_remedy(profile, obstacle, limit.refused)}"


def _plain(value: Any) -> Any:
    """Return a value as JSON takes it: infinite numbers become None."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# --------------------------------------------------------------------------------------------------------------- text


def describe(check: RobotCheck) -> str:
    """Return a check as text: a table of the loads, then one sentence per limit."""
    lines = [
        f"{check.robot}: {'passes' if check.passes else 'fails'}",
        "",
        "shares of the stall torque [%], coxa / femur / tibia; peak: what exact paths need, a servo gives at most 100",
        "gait      height     speed       static          peak           rms     lasts",
    ]
    for load in check.loads:
        static, peak, rms = (
            " /".join(f"{100 * part:3.0f}" for part in shares) for shares in (load.static, load.peak, load.rms)
        )
        lasts = "hours" if math.isinf(load.minutes) else f"{load.minutes:.0f} min"
        how = f"{load.gait:7} {in_cm(load.body_height):>8} {100 * load.speed:5.1f} cm/s"
        lines.append(f"{how} {static:>14}{peak:>14}{rms:>14} {lasts:>9}")
    lines.append("")
    width = max(len(limit.name) for limit in check.limits)
    for limit in check.limits:
        start = f"{'ok  ' if limit.is_met else 'FAIL'}  {limit.name:{width}}  "
        lines += textwrap.wrap(limit.sentence, _WIDTH, initial_indent=start, subsequent_indent=" " * len(start))
    return "\n".join(lines)
