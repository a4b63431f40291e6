"""Plausibility check of servo readings, because an 8-bit checksum misses some errors.

A reading that leaps is doubted, and accepted only if the next one confirms it. Of 3463 positions of a walk over `steps`, all
but one were within the range of `_leaps`, and 99 % within 4 ticks of the goals of the last three cycles.
"""

from collections import Counter, deque
from enum import StrEnum
from typing import NamedTuple

from sextant.shared.servo import dynamixel as dxl

_NS_PER_S = 1e9
_MAX_SPEED_RATIO = 1.3  # [1] maximum speed of a servo whose leg is pushed, as a multiple of its no-load speed
_LEAP_TICKS = 10  # [ticks] outside the expected range, beyond which a position is doubted; 3 deg
_SAME_POSITION_TICKS = 5  # [ticks] maximum difference of two readings of one position ...
_MAX_MOTION_TICKS = 20  # [ticks] ... plus the maximum motion of the joint between them
_VOLTAGE_LEAP_V = 0.8  # [V] between two readings of the common supply, beyond which one is doubted
_TEMPERATURE_LEAP_K = 2.0  # [K] between two readings, beyond which one is doubted ...
_WARMING_RATE_K_S = 2.0  # [K/s] ... plus this in the time between them: a stalled motor warms by 1 K/s
_UNKNOWN_BITS = 0x80  # undefined bit of the error byte
_MAGNITUDE = 0x7FF  # of the speed and load registers: ten bits and the direction
# Leaps of load and of possible speeds are normal, and are doubted only while answers get lost or broken.
_LOAD_LEAP_TICKS, _SPEED_LEAP_TICKS = 400, round(2.5 / dxl.SPEED_RAD_S)  # [ticks] 0.4 of the stall torque, 2.5 rad/s
_MIN_MOTION_TICKS = 3  # [ticks] of motion by the measured speed, beyond which an unchanged reading is doubted
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
    speed: int  # with its direction bit
    load: int  # with its direction bit
    voltage: int
    temperature: int
    error: int


class ReadingValidator:
    """Checks the next readings of n servos against their last accepted ones."""

    def __init__(self, n: int, no_load_speed: float) -> None:
        """Begin without readings.

        Args:
            n: Number of servos.
            no_load_speed: [rad/s] of their model.
        """
        self.refused: Counter[str] = Counter()  # readings that were rejected, by `Implausibility`
        self.refusals = 0  # number of them
        self._accepted: list[State | None] = [None] * n  # last accepted reading of each servo
        self._doubted: list[tuple[State, Implausibility] | None] = [None] * n  # its newest reading if that is doubted, and why
        self._voltage: int | None = None  # [0.1 V] last accepted one of any servo, because they share one supply
        self._goals: deque[list[int]] = deque(maxlen=_RECENT_GOALS)
        self._lowest: list[int] = []  # [ticks] of the recent goals of each servo
        self._highest: list[int] = []
        self._max_speed = _MAX_SPEED_RATIO * no_load_speed  # [rad/s]
        self._goal_offset = [0] * n  # [ticks] distance of each last accepted position from the range of its recent goals

    def sent(self, goal_ticks: list[int]) -> None:
        """Store the goals that were sent to the n servos."""
        self._goals.append(goal_ticks)
        self._lowest = [min(goals) for goals in zip(*self._goals, strict=True)]
        self._highest = [max(goals) for goals in zip(*self._goals, strict=True)]

    def accepts(self, index: int, state: State, noisy: bool) -> bool:
        """Return whether to accept a reading; otherwise the caller should request it again.

        A doubted reading is accepted if the next one agrees with it.

        Args:
            index: Index of the servo.
            state: Its reading.
            noisy: Answers were recently broken. The checksum then misses about 1 of 256 errors.
        """
        doubt = self._find_implausibility(index, state, noisy)
        if doubt is Implausibility.RANGE:  # a second reading like this would be as wrong
            self._refuse(doubt)
            return False
        doubted = self._doubted[index]
        if doubt is not None and doubted is not None and _agree(doubted[0], state, self._max_speed):
            doubt, doubted = None, None
        if doubted is not None:
            self._refuse(doubted[1])
        self._doubted[index] = None if doubt is None else (state, doubt)
        if doubt is None:
            self._accept(index, state)
        return doubt is None

    def _refuse(self, why: Implausibility) -> None:
        self.refused[why] += 1
        self.refusals += 1

    def _accept(self, index: int, state: State) -> None:
        self._accepted[index], self._voltage = state, state.voltage
        low, high = self._bound(index, state.position)
        self._goal_offset[index] = state.position - min(max(state.position, low), high)

    def _bound(self, index: int, position: int) -> tuple[int, int]:
        """Return lowest and highest recent goal of a servo; without one, its position."""
        return (self._lowest[index], self._highest[index]) if self._goals else (position, position)

    def _find_implausibility(self, index: int, state: State, noisy: bool) -> Implausibility | None:
        """Return why a reading is doubtful, or None."""
        if state.position > dxl.TICK_MAX or max(state.speed, state.load) > _MAGNITUDE or state.error & _UNKNOWN_BITS:
            return Implausibility.RANGE
        before = self._accepted[index]
        if before is None:
            return Implausibility.FIRST if noisy else None
        elapsed = (state.stamp_ns - before.stamp_ns) / _NS_PER_S
        speed, load = dxl.signed_magnitude(state.speed), dxl.signed_magnitude(state.load)
        speed_leap, load_leap = abs(speed - dxl.signed_magnitude(before.speed)), abs(load - dxl.signed_magnitude(before.load))
        if self._leaps(index, before.position, state.position, elapsed):
            return Implausibility.POSITION
        if speed_leap > _SPEED_LEAP_TICKS and (noisy or abs(speed) * dxl.SPEED_RAD_S > self._max_speed):
            return Implausibility.SPEED
        if noisy and load_leap > _LOAD_LEAP_TICKS:
            return Implausibility.LOAD
        if self._voltage is not None and abs(state.voltage - self._voltage) * dxl.VOLT_UNIT > _VOLTAGE_LEAP_V:
            return Implausibility.VOLTAGE
        if abs(state.temperature - before.temperature) > _TEMPERATURE_LEAP_K + _WARMING_RATE_K_S * elapsed:
            return Implausibility.TEMPERATURE
        if state.error != before.error:
            return Implausibility.ERROR
        alike = state[1:] == before[1:] and abs(speed) * dxl.SPEED_RAD_S * elapsed > _MIN_MOTION_TICKS * dxl.TICK_RAD
        return Implausibility.AGAIN if alike else None

    def _leaps(self, index: int, before: int, position: int, elapsed: float) -> bool:
        """Return whether a position is far outside the range of recent goals, or too far to reach in the time.

        The range is extended by the last accepted distance from it, because load and delay keep a servo off its goals.
        """
        low, high = self._bound(index, before)
        aside = self._goal_offset[index]
        near = low + min(aside, 0) - _LEAP_TICKS <= position <= high + max(aside, 0) + _LEAP_TICKS
        return not near or abs(position - before) > self._max_speed / dxl.TICK_RAD * elapsed + _LEAP_TICKS


def _agree(one: State, other: State, fastest: float) -> bool:
    """Return whether two readings of a servo, shortly after each other, agree.

    Its speed is at most `fastest` [rad/s].
    """
    elapsed = abs(other.stamp_ns - one.stamp_ns) / _NS_PER_S
    near = abs(other.position - one.position) <= _SAME_POSITION_TICKS + min(fastest / dxl.TICK_RAD * elapsed, _MAX_MOTION_TICKS)
    speeds = abs(dxl.signed_magnitude(one.speed) - dxl.signed_magnitude(other.speed)) <= _SPEED_LEAP_TICKS
    loads = abs(dxl.signed_magnitude(one.load) - dxl.signed_magnitude(other.load)) <= _LOAD_LEAP_TICKS
    volts = abs(other.voltage - one.voltage) * dxl.VOLT_UNIT <= _VOLTAGE_LEAP_V
    warmth = abs(other.temperature - one.temperature) <= _TEMPERATURE_LEAP_K
    return near and speeds and loads and volts and warmth and one.error == other.error
