"""Servos of a robot with several models or several buses: which joints have which servo, and which bus each of them is on."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from sextant.shared.files import config
from sextant.shared.geometry import Array
from sextant.shared.robot.joint_names import JOINT_NAMES, SELECTS, selected
from sextant.shared.robot.servo import Servo, known_model
from sextant.shared.servo.servo_model import Feedback, ServoModel

_N = len(JOINT_NAMES)
_LARGEST_RAD = 3.2  # limits in degrees are not all below


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoGroup(Servo):
    """Servos of some joints. The table has all keys of `[servo]`, which holds for the other joints, and its own."""

    joints: tuple[str, ...]  # sides, legs, joints or both, as "left", "left front", "tibia" or "left front tibia"

    checks = (*Servo.checks, *config.each("joints", lambda words: bool(selected(words)), SELECTS))

    def __post_init__(self) -> None:
        config.verify(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class BusJoints:
    """Joints whose servos are on one bus, with a separate port."""

    name: str  # in the setting actuator.port, as in "left=/dev/ttyUSB0, right=/dev/ttyUSB1"
    joints: tuple[str, ...]  # sides, legs, joints or both, as "left", "left front", "tibia" or "left front tibia"

    checks = (
        *config.each("name", lambda name: name.isascii() and name.isidentifier(), "a name of letters and digits, as left,"),
        *config.each("joints", lambda words: bool(selected(words)), SELECTS),
    )

    def __post_init__(self) -> None:
        config.verify(self)


class BusRows(NamedTuple):
    """One bus of a robot."""

    name: str  # empty for the only one
    rows: tuple[int, ...]  # its joints, 0 to 17


class JointServos:
    """The servo of each joint. Arrays are (6, 3)."""

    def __init__(self, servo: Servo, groups: Sequence[ServoGroup], buses: Sequence[BusJoints]) -> None:
        """Find the servo of each joint: that of its group, or else the default."""
        of_joint: list[Servo] = [servo] * _N
        for group in groups:
            for index in _all_selected(group.joints):
                of_joint[index] = group
        self.each = tuple(of_joint)  # (18,)
        self.models = tuple(one.servo_model for one in of_joint)  # (18,)
        self.buses = tuple(BusRows(bus.name, _all_selected(bus.joints)) for bus in buses) or (BusRows("", tuple(range(_N))),)

    @cached_property
    def stall_torque(self) -> Array:
        """Torques [N m] at standstill."""
        return self._array("stall_torque")

    @cached_property
    def no_load_speed(self) -> Array:
        """Speeds [rad/s] without torque."""
        return self._array("no_load_speed")

    @cached_property
    def stiffness(self) -> Array:
        """Torques per position error [N m/rad]."""
        return self._array("stiffness")

    @cached_property
    def damping(self) -> Array:
        """Joint damping [N m s/rad]."""
        return self._array("damping")

    @cached_property
    def lag_s(self) -> Array:
        """Times [s] by which turning servos are behind their goals."""
        return self.damping / self.stiffness

    @cached_property
    def friction(self) -> Array:
        """Dry friction [N m]."""
        return self._array("friction")

    @cached_property
    def armature(self) -> Array:
        """Reflected rotor inertia [kg m^2]."""
        return self._array("armature")

    @cached_property
    def inertia_s(self) -> float:
        """Longest time constant [s] of rotor inertia and servo stiffness; a joint with a long one overshoots."""
        return float(np.sqrt(self.armature / self.stiffness).max())

    @cached_property
    def temperature_limit(self) -> Array:
        """Temperatures [deg C] at which servos shut themselves down."""
        return self._array("temperature_limit")

    @cached_property
    def tick_rad(self) -> Array:
        """Angles [rad] per tick of position registers."""
        return np.array([model.units.tick_rad for model in self.models]).reshape(-1, 3)

    @cached_property
    def centre(self) -> Array:
        """Position registers [ticks] at servo angle 0."""
        return np.array([float(model.units.centre) for model in self.models]).reshape(-1, 3)

    @cached_property
    def range_rad(self) -> Array:
        """Largest servo angles [rad] in both directions from the centre."""
        return np.array([model.units.range_rad for model in self.models]).reshape(-1, 3)

    def _array(self, name: str) -> Array:
        return np.array(list(map(attrgetter(name), self.each))).reshape(-1, 3)


def _all_selected(words: Sequence[str]) -> tuple[int, ...]:
    """Return the joints (0 to 17) that any of these words select, in their order."""
    return tuple(sorted({index for one in words if isinstance(one, str) for index in selected(one)}))


def models_of(servo: object, groups: Sequence[object]) -> list[ServoModel | None]:
    """Return the model of each joint (18,), None if unknown; the tables may have errors."""
    found = [_model_of(servo)] * _N
    for group in groups:
        for index in _all_selected(getattr(group, "joints", ())):
            found[index] = _model_of(group)
    return found


def _model_of(servo: object) -> ServoModel | None:
    return known_model(*(getattr(servo, name, None) for name in ("model", "numbers", "pulses")))


def given_twice(groups: tuple[object, ...], key: str) -> Iterator[config.Misfit]:
    """Yield joints that are in more than one group of the table `key`."""
    owners: dict[int, int] = {}
    for k, group in enumerate(groups):
        for index in _all_selected(getattr(group, "joints", ())):
            if index in owners:
                found = f"the {JOINT_NAMES[index]}, which {key}[{owners[index]}] has, too"
                yield config.Misfit(f"{key}[{k}].joints", "each joint in one group", found)
                break
            owners[index] = k


def unlike(servo: Servo, groups: tuple[ServoGroup, ...]) -> Iterator[config.Misfit]:
    """Yield groups whose servos do not measure the same as the others: forces on feet are estimated in one way for all legs."""
    first = _model_of(servo)
    for k, group in enumerate(groups):
        model = _model_of(group)
        if first is None or model is None:
            continue
        if Feedback.POSITION not in first.feedback & model.feedback:
            expected = "one model for all joints, as for all robots with hobby servos,"
            yield config.Misfit(f"servo_groups[{k}].model", expected, f"{model.name} besides {first.name}")
        elif model.feedback != first.feedback:
            expected = f"a servo that measures the same as {first.name}, which {_measures(first)},"
            yield config.Misfit(f"servo_groups[{k}].model", expected, f"{model.name}, which {_measures(model)}")


def _measures(model: ServoModel) -> str:
    return "measures its load" if Feedback.LOAD in model.feedback else "measures no load"


def _missing(buses: tuple[BusJoints, ...]) -> str:
    """Return a joint that is on no bus, or an empty string."""
    on = {index for bus in buses for index in _all_selected(getattr(bus, "joints", ()))}
    return next((name for index, name in enumerate(JOINT_NAMES) if index not in on), "")


def wrong_buses(servo: Servo, groups: tuple[ServoGroup, ...], buses: tuple[BusJoints, ...]) -> Iterator[config.Misfit]:
    """Yield errors of the buses, and servos of different protocols on one bus."""
    if buses:
        names = [getattr(bus, "name", str(k)) for k, bus in enumerate(buses)]
        if len(buses) < 2:
            yield config.Misfit("buses", "two buses or more, or no such table for a single one,", "one")
        if len(set(names)) < len(names):
            yield config.Misfit("buses", "a different name for each", ", ".join(names))
        if name := _missing(buses):
            yield config.Misfit("buses", "each joint on one bus", f"none for the {name}")
    models = models_of(servo, groups)
    if any(model is not None and Feedback.POSITION not in model.feedback for model in models):
        if buses:
            yield config.Misfit("buses", "bus servos on several buses", "hobby servos, whose board has one port")
        return
    rows = [(f"buses[{k}]", _all_selected(getattr(bus, "joints", ()))) for k, bus in enumerate(buses)]
    for place, on_bus in rows or [("servo_groups", tuple(range(_N)))]:
        known = {model.name: model for index in on_bus if (model := models[index]) is not None}
        if len({(model.protocol.NAME, model.bus_rate) for model in known.values()}) > 1:
            found = " and ".join(f"{name} ({model.protocol.NAME})" for name, model in known.items())
            expected = (
                "servos with one protocol and baud rate on one bus, since the driver reads one kind of packets at a port,"
            )
            yield config.Misfit(place, expected, f"{found}; give each protocol a bus in [[buses]]")


def limits_in_radians(limits: tuple[tuple[float, float], ...]) -> Iterator[config.Misfit]:
    """Yield limits of a leg that are all as small as radians."""
    if max(abs(end) for joint in limits for end in joint) < _LARGEST_RAD:
        yield config.Misfit("servo_limits_deg", "limits in degrees", f"{limits[0]} and others, which look like radians")


def beyond_servo(servo: Servo, groups: tuple[ServoGroup, ...], legs: tuple[object, ...]) -> Iterator[config.Misfit]:
    """Yield limits and ids of legs that the servos of their joints do not have."""
    models = models_of(servo, groups)
    for i, leg in enumerate(legs):
        for model, k in zip(models[3 * i : 3 * i + 3], range(3), strict=False):
            if model is None:
                continue
            most = math.degrees(model.units.range_rad)
            for limits in getattr(leg, "servo_limits_deg", ())[k : k + 1]:
                if max(map(abs, limits)) > most + 1e-6:
                    expected = f"limits within -{most:.0f} and {most:.0f} deg, the range of {model.name} servos,"
                    yield config.Misfit(f"legs[{i}].servo_limits_deg[{k}]", expected, str(list(limits)))
            for servo_id in getattr(leg, "servo_ids", ())[k : k + 1]:
                if servo_id > model.protocol.MAX_ID:
                    yield config.Misfit(f"legs[{i}].servo_ids[{k}]", f"an id up to {model.protocol.MAX_ID}", str(servo_id))
