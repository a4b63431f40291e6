"""Plausibility check of servo readings, because an 8-bit checksum misses some errors.

A reading that leaps is doubted, and accepted only if the next one confirms it. Of 3463 positions of a walk over `steps`, all
but one were within the range of `_leaps`, and 99 % within 4 ticks of the goals of the last three cycles.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import NamedTuple

from sextant.shared.servo.servo_model import ServoModel, number_decoder

_NS_PER_S = 1e9
_UNSIGNED = 128  # values below need no decoding in any coding; 18 servos are read in every cycle
_MAX_SPEED_RATIO = 1.3  # [1] maximum speed of a servo whose leg is pushed, as a multiple of its no-load speed
_LEAP_RAD = math.radians(2.93)  # [rad] outside the expected range, beyond which a position is doubted
_SAME_POSITION_RAD = math.radians(1.47)  # [rad] maximum difference of two readings of one position ...
_MAX_MOTION_RAD = math.radians(5.87)  # [rad] ... plus the maximum motion of the joint between them
_VOLTAGE_LEAP_V = 0.8  # [V] between two readings of the common supply, beyond which one is doubted
_ROUNDING_V = 1e-9  # [V] of a difference
_TEMPERATURE_LEAP_K = 2.0  # [K] between two readings, beyond which one is doubted ...
_WARMING_RATE_K_S = 2.0  # [K/s] ... plus this in the time between them: a stalled motor warms by 1 K/s
# Leaps of load and of possible speeds are normal, and are doubted only while answers get lost or broken.
_LOAD_LEAP, _SPEED_LEAP_RAD_S = 0.4, 2.5  # [1] of the stall torque, [rad/s]
_MIN_MOTION_RAD = math.radians(0.88)  # [rad] of motion by the measured speed, beyond which an unchanged reading is doubted
_RECENT_GOALS = 3  # [cycles] within which a servo may still be moving to a goal


class Implausibility(StrEnum):
    """Why a reading is not accepted, or not yet."""

    RANGE = "value that no servo has"
    POSITION = "position leapt"
    SPEED = "speed leapt"
    LOAD = "load leapt"
    VOLTAGE = "voltage leapt"
    TEMPERATURE = "temperature leapt"
    ERROR = "error bits changed"
    AGAIN = "the same again of a joint that moves"
    FIRST = "first of a bus that breaks answers"


class State(NamedTuple):
    """Contents of one answer, in register units."""

    stamp_ns: int  # [ns] when it was requested
    position: int
    speed: int  # counterclockwise positive
    load: int  # counterclockwise positive
    voltage: int
    temperature: int
    error: int


def state_decoder(model: ServoModel) -> Callable[[int, tuple[int, ...], int], State]:
    """Return the function that makes a state of an answer to a servo of this model.

    Its arguments are the time [ns] of the request, the registers of `ControlTable.state` and the error bits.
    """
    table, units = model.table, model.units
    speed_of = number_decoder(units.speed_sign, table.present_speed.size)
    load_of = number_decoder(units.load_sign, table.present_load.size)
    position_of = number_decoder(units.position_sign, table.present_position.size)
    signed_position = units.position_sign is not None

    def decode(stamp_ns: int, registers: tuple[int, ...], error: int) -> State:
        position, speed, load, voltage, temperature = registers
        position = position_of(position) if signed_position else position
        speed = speed if speed < _UNSIGNED else speed_of(speed)
        load = load if load < _UNSIGNED else load_of(load)
        return State(stamp_ns, position, speed, load, voltage, temperature, error)

    return decode


class _Limits:
    """Limits of the readings of servos of a model, in its units."""

    def __init__(self, model: ServoModel) -> None:
        units = self.units = model.units
        self.max_speed = _MAX_SPEED_RATIO * model.no_load_speed  # [rad/s]
        self.unknown_errors = ~int(model.errors)
        self.speed_range = units.speed_sign.largest(model.table.present_speed.size)  # [ticks]
        self.load_range = units.load_sign.largest(model.table.present_load.size)  # [ticks]
        self.leap = round(_LEAP_RAD / units.tick_rad)  # [ticks]
        self.same_position, self.max_motion = (
            round(_SAME_POSITION_RAD / units.tick_rad),
            round(_MAX_MOTION_RAD / units.tick_rad),
        )
        self.speed_leap, self.load_leap = (
            round(_SPEED_LEAP_RAD_S / units.speed_rad_s),
            round(_LOAD_LEAP / units.load),
        )  # [ticks]


class ReadingValidator:
    """Checks the next readings of n servos against their last accepted ones."""

    def __init__(self, models: Sequence[ServoModel]) -> None:
        """Begin without readings of servos of these models (n,)."""
        n, limits = len(models), {model: _Limits(model) for model in models}
        self._limits = [limits[model] for model in models]
        self.refused: Counter[str] = Counter()  # readings that were rejected, by `Implausibility`
        self.refusals = 0  # number of them
        self._accepted: list[State | None] = [None] * n  # last accepted reading of each servo
        self._doubted: list[tuple[State, Implausibility] | None] = [None] * n  # its newest reading if that is doubted, and why
        self._impossible = [False] * n  # whether the newest reading of each servo has values that no servo has
        self._voltage: float | None = None  # [V] last accepted one of any servo, because they share one supply
        self._goals: deque[list[int]] = deque(maxlen=_RECENT_GOALS)
        self._lowest: list[int] = []  # [ticks] of the recent goals of each servo
        self._highest: list[int] = []
        self._goal_offset = [0] * n  # [ticks] distance of each last accepted position from the range of its recent goals

    def sent(self, goal_ticks: list[int]) -> None:
        """Store the goals that were sent to the n servos."""
        self._goals.append(goal_ticks)
        self._lowest = [*map(min, zip(*self._goals, strict=True))]
        self._highest = [*map(max, zip(*self._goals, strict=True))]

    def accepts(self, index: int, state: State, noisy: bool) -> bool:
        """Return whether to accept a reading; otherwise the caller should request it again.

        A doubted reading is accepted if the next one agrees with it.

        Args:
            index: Index of the servo.
            state: Its reading.
            noisy: Answers were recently broken. The checksum then misses about 1 of 256 errors.
        """
        doubt = self._find_implausibility(index, state, noisy)
        self._impossible[index] = doubt is Implausibility.RANGE
        if doubt is Implausibility.RANGE:  # a second reading like this would be as wrong
            self._refuse(doubt)
            return False
        doubted = self._doubted[index]
        if doubt is not None and doubted is not None and _agree(self._limits[index], doubted[0], state):
            doubt, doubted = None, None
        if doubted is not None:
            self._refuse(doubted[1])
        self._doubted[index] = None if doubt is None else (state, doubt)
        if doubt is None:
            self._accept(index, state)
        return doubt is None

    def is_impossible(self, index: int) -> bool:
        """Return whether the newest reading of a servo has values that no servo has."""
        return self._impossible[index]

    def _refuse(self, why: Implausibility) -> None:
        self.refused[why] += 1
        self.refusals += 1

    def _accept(self, index: int, state: State) -> None:
        self._accepted[index], self._voltage = state, state.voltage * self._limits[index].units.volt
        low, high = self._bound(index, state.position)
        self._goal_offset[index] = state.position - min(max(state.position, low), high)

    def _bound(self, index: int, position: int) -> tuple[int, int]:
        """Return lowest and highest recent goal of a servo; without one, its position."""
        return (self._lowest[index], self._highest[index]) if self._goals else (position, position)

    def _find_implausibility(self, index: int, state: State, noisy: bool) -> Implausibility | None:
        """Return why a reading is doubtful, or None."""
        limits = self._limits[index]
        units = limits.units
        too_large = abs(state.speed) > limits.speed_range or abs(state.load) > limits.load_range
        if (
            too_large
            or not -units.overrun <= state.position <= units.max_position + units.overrun
            or state.error & limits.unknown_errors
        ):
            return Implausibility.RANGE
        before = self._accepted[index]
        if before is None:
            return Implausibility.FIRST if noisy else None
        elapsed = (state.stamp_ns - before.stamp_ns) / _NS_PER_S
        speed, speed_leap, load_leap = abs(state.speed), abs(state.speed - before.speed), abs(state.load - before.load)
        if self._leaps(index, limits, before.position, state.position, elapsed):
            return Implausibility.POSITION
        if speed_leap > limits.speed_leap and (noisy or speed * units.speed_rad_s > limits.max_speed):
            return Implausibility.SPEED
        if noisy and load_leap > limits.load_leap:
            return Implausibility.LOAD
        if self._voltage is not None and abs(state.voltage * units.volt - self._voltage) > _VOLTAGE_LEAP_V + _ROUNDING_V:
            return Implausibility.VOLTAGE
        if abs(state.temperature - before.temperature) > _TEMPERATURE_LEAP_K + _WARMING_RATE_K_S * elapsed:
            return Implausibility.TEMPERATURE
        if state.error != before.error:
            return Implausibility.ERROR
        alike = state[1:] == before[1:] and speed * units.speed_rad_s * elapsed > _MIN_MOTION_RAD
        return Implausibility.AGAIN if alike else None

    def _leaps(self, index: int, limits: _Limits, before: int, position: int, elapsed: float) -> bool:
        """Return whether a position is far outside the range of recent goals, or too far to reach in the time.

        The range is extended by the last accepted distance from it, because load and delay keep a servo off its goals.
        """
        low, high = self._bound(index, before)
        aside = self._goal_offset[index]
        near = low + min(aside, 0) - limits.leap <= position <= high + max(aside, 0) + limits.leap
        return not near or abs(position - before) > limits.max_speed / limits.units.tick_rad * elapsed + limits.leap


def _agree(limits: _Limits, one: State, other: State) -> bool:
    """Return whether two readings of a servo, shortly after each other, agree."""
    units = limits.units
    elapsed = abs(other.stamp_ns - one.stamp_ns) / _NS_PER_S
    motion = min(limits.max_speed / units.tick_rad * elapsed, limits.max_motion)
    near = abs(other.position - one.position) <= limits.same_position + motion
    speeds = abs(one.speed - other.speed) <= limits.speed_leap
    loads = abs(one.load - other.load) <= limits.load_leap
    volts = abs(other.voltage - one.voltage) * units.volt <= _VOLTAGE_LEAP_V
    warmth = abs(other.temperature - one.temperature) <= _TEMPERATURE_LEAP_K
    return near and speeds and loads and volts and warmth and one.error == other.error
