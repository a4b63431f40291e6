"""Joint test: move each joint slightly, slowly and with little torque, and back."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sextant.services.actuator.commissioning.limited_motion import TORQUE_SHARE, get, hold, limited_motion, put, ready, silent
from sextant.services.actuator.commissioning.operator_dialogue import Operator
from sextant.services.actuator.commissioning.torque_off import torque_off_if_interrupted
from sextant.services.actuator.commissioning.watched_motion import AGAIN, seen_problem, way_in_words
from sextant.services.actuator.servo_bus.attempts import retry
from sextant.services.actuator.servo_bus.bus_scan import BusResponse, scan_servo
from sextant.services.actuator.servo_bus.servo_health import health_problem
from sextant.services.actuator.servo_bus.several_buses import AnyBus
from sextant.shared.robot.profile import JOINTS, LEGS, RobotProfile
from sextant.shared.servo.servo_model import Block, Feedback, signed

STEP_DEG = 6.0
_WAY_NS, _PATIENCE_NS = 600_000_000, 2_000_000_000  # [ns] for a motion of a third of a second, and timeout
_OPEN_DEG = 3.0  # largest error from compliance and leg weight
_STRAINED = 0.9  # share of the torque limit


@dataclass(frozen=True, slots=True)
class Moved:
    """Result of one joint's test."""

    name: str  # leg and joint
    way: str  # commanded direction, as text
    asked_deg: float
    moved_deg: float
    back_deg: float  # remaining error after the return
    load: float  # maximum, as a share of the stall torque; NaN if the servo does not measure it
    voltage: float  # [V]
    temperature: float  # [deg C]
    problem: str  # problem, or an empty string

    def __str__(self) -> str:
        """Return a one-line report."""
        load = "" if math.isnan(self.load) else f"load {100 * self.load:3.0f} %  "
        measured = f"{load}{self.voltage:4.1f} V  {self.temperature:3.0f} deg C"
        line = f"{self.name:<19} {self.way:<14} {self.moved_deg:+5.1f} of {self.asked_deg:+5.1f} deg  {measured}"
        return f"{line}  -> {self.problem}" if self.problem else line


def run_joint_test(
    bus: AnyBus,
    profile: RobotProfile,
    operator: Operator,
    clock: Callable[[], int],
    *,
    legs: Sequence[str] = LEGS,
    hold_after: bool | None = False,
) -> list[Moved] | None:
    """Test the joints of legs one at a time, once the operator has agreed, who says of each which way it moved.

    Return None if nothing was moved.

    Args:
        bus: The robot's servos.
        profile: The robot.
        operator: Receives the result of each joint, and watches it.
        clock: Monotonic time [ns], the clock of the bus.
        legs: Legs to test.
        hold_after: Whether torque is on at the end, with the legs holding their positions; None asks.

    Raises:
        ServoNotRespondingError: A servo stopped answering; torque is off, as far as servos can be reached.
        BusDisconnectedError: The port is gone.
    """
    if not ready(bus, profile, operator):
        return None
    has_limit = profile.servo_model.has(profile.servo_model.table.torque_limit)
    torque = f"{100 * TORQUE_SHARE:.0f} % of its torque" if has_limit else "its full torque, which these servos cannot limit"
    if not operator.agree(
        f"Each joint of {legs_in_words(legs)} will move by {STEP_DEG:g} deg and back, one at a time, slowly, with "
        f"{torque}. Is the robot on a stand, its legs free?"
    ):
        operator.say("nothing was moved, torque is off")
        return None
    moved: list[Moved] = []
    with torque_off_if_interrupted(bus, operator):
        for leg in legs:
            moved += (_watched(bus, profile, operator, clock, LEGS.index(leg), joint) for joint in range(len(JOINTS)))
        _leave(bus, operator, hold_after)
    return moved


def legs_in_words(legs: Sequence[str]) -> str:
    """Return legs as "all legs" or "the left front leg"."""
    if set(legs) == set(LEGS):
        return "all legs"
    return f"the {', '.join(legs)} leg{'s' if len(legs) > 1 else ''}"


def _watched(bus: AnyBus, profile: RobotProfile, operator: Operator, clock: Callable[[], int], leg: int, joint: int) -> Moved:
    """Move one joint until the operator has seen it."""
    while True:
        found = move(bus, profile, clock, leg, joint)
        operator.say(str(found))
        seen = seen_problem(operator, profile, leg, joint, found.way)
        if seen != AGAIN:
            return replace(found, problem=found.problem or seen)


def move(bus: AnyBus, profile: RobotProfile, clock: Callable[[], int], leg: int, joint: int) -> Moved:
    """Move one joint without torque by the test step and back.

    Its torque is off again afterwards.
    """
    servo_id = int(profile.servo_ids[leg, joint])
    model = bus.model_of(servo_id)
    units = model.units
    step = round(np.radians(STEP_DEG) / units.tick_rad)  # [ticks]
    with limited_motion(bus, [servo_id]):
        start = model.position(get(bus, servo_id, model.table.present_position))
        sign, up = _way(profile, leg, joint, units.angle(start))
        hold(bus, [servo_id])
        there, load = _go(bus, servo_id, min(max(start + sign * up * step, 0), units.max_position), clock)
        back, load_back = _go(bus, servo_id, min(max(start, 0), units.max_position), clock)
    seen = scan_servo(bus, servo_id, listen=False)
    if seen is None or seen.response is not BusResponse.CLEAR:
        raise silent(bus, servo_id, "its state was being read after its motion")
    least_v = profile.battery.warn_voltage
    asked, moved, left = sign * np.degrees(np.array([up * sign * step, there - start, back - start]) * units.tick_rad)
    return Moved(
        name=profile.servo_names[servo_id],
        way=way_in_words(profile, leg, joint, up),
        asked_deg=float(asked),
        moved_deg=float(moved),
        back_deg=float(left),
        load=max(load, load_back),
        voltage=seen.voltage,
        temperature=seen.temperature,
        problem=_problem(float(asked), float(moved), float(left), max(load, load_back)) or health_problem(seen, least_v),
    )


def _go(bus: AnyBus, servo_id: int, goal: int, clock: Callable[[], int]) -> tuple[int, float]:
    """Move a servo to a goal; return its final position register and maximum load."""
    model = bus.model_of(servo_id)
    table, units = model.table, model.units
    block = Block((table.present_position, table.present_load, table.moving))
    put(bus, servo_id, table.goal_position, goal)
    measures = Feedback.LOAD in model.feedback
    began, load = clock(), 0.0 if measures else math.nan
    while True:
        state = retry(lambda: bus.read_bytes(servo_id, block.address, block.size))
        if state is None:
            raise silent(bus, servo_id, "it was moving")
        position, load_register, moving = block.unpack(state)
        position = model.position(position)
        if measures:
            load = max(load, abs(signed(load_register, units.load_sign, table.present_load.size)) * units.load)
        took = clock() - began
        if took > _PATIENCE_NS or (took > _WAY_NS and not moving):
            return position, load


def _problem(asked: float, moved: float, left: float, load: float) -> str:
    """Return what is wrong with a motion [deg], or an empty string."""
    if abs(asked - moved) > _OPEN_DEG:
        return "did not reach its goal: an obstacle blocks it, or the horn slips"
    if abs(left) > _OPEN_DEG:
        return "did not return: an obstacle blocks it, or the horn slips"
    if load > _STRAINED * TORQUE_SHARE:
        return "needs too much torque: check that the leg moves freely and its screws are not too tight"
    return ""


def _way(profile: RobotProfile, leg: int, joint: int, start: float) -> tuple[int, int]:
    """Return the servo's sign and the free direction of the joint, from its servo angle [rad].

    The direction is positive if the limit allows, else negative.
    """
    sign = int(profile.servo_signs[leg, joint])
    servo = np.tile(start, (len(LEGS), len(JOINTS)))
    q = profile.joint_angles(servo)[leg, joint]
    return sign, 1 if q + np.radians(STEP_DEG) <= profile.joint_limits[leg, joint, 1] else -1


def _leave(bus: AnyBus, operator: Operator, hold_after: bool | None) -> None:
    """Set the torque as the operator wants it, and report it."""
    if hold_after is None:
        hold_after = operator.agree("Turn torque on, with the legs at their present positions? With no, torque stays off.")
    if hold_after:
        hold(bus, bus.servo_ids)
    operator.say("torque is on: the legs hold their present positions" if hold_after else "torque is off")
