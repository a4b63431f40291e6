"""Plausibility check of servo readings; an 8-bit checksum misses some errors.

A reading that leaps is doubted, and accepted only when the next one confirms it. Of 3463 positions of a walk over `steps`, all
but one were within the range of `_leaps`, and 99 % within 4 ticks of the goals of the last three cycles.
"""

from collections import Counter, deque
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.shared.servo import dynamixel as dxl

_SEC = 1e9
_PUSHED = 1.3  # largest speed of a servo in a leg that is pushed, as a multiple of its no-load speed
_LEAP = 10  # [ticks] off the expected range; 3 deg
_REPEATED = 5  # [ticks] between two readings of one position, and ...
_MOVED = 20  # [ticks] ... largest motion of the joint between them
_SAG = 0.8  # [V] between two readings of one supply
_WARMING = 2.0  # [K] between two readings, and ...
_WARMING_RATE = 2.0  # [K/s] ... in the time between them: a stalled motor warms by 1 K/s
_UNKNOWN_BITS = 0x80  # undefined bit of the error byte
_MAGNITUDE = 0x7FF  # of the speed and load registers: ten bits and the direction
# Leaps of load and speed are normal, and are doubted only while answers get lost or broken.
_LOAD_LEAP, _SPEED_LEAP = 400, round(2.5 / dxl.SPEED_RAD_S)  # [ticks] 0.4 of the stall torque, 2.5 rad/s
_STANDS = 3  # [ticks] of motion from which two identical readings are doubtful
_RECENT_GOALS = 3  # cycles in which a servo may still be moving to a goal


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
        self._believed: list[State | None] = [None] * n
        self._rejected: list[tuple[State, Implausibility] | None] = [None] * n
        self._voltage: int | None = None  # of any servo, because they share one supply
        self._goals: deque[NDArray[np.int64]] = deque(maxlen=_RECENT_GOALS)
        self._fastest = _PUSHED * no_load_speed  # [rad/s]
        self._aside = [0] * n  # [ticks] distance of each last accepted position from the range of its recent goals

    def sent(self, goal_ticks: NDArray[np.int64]) -> None:
        """Store the goals (n,) that were sent to the servos."""
        self._goals.append(goal_ticks)

    def accepts(self, index: int, state: State, noisy: bool) -> bool:
        """Return whether to accept a reading; repeat the request if it is doubtful.

        Args:
            index: Index of the servo.
            state: Its reading.
            noisy: Answers were recently broken. The checksum then misses about 1 of 256 errors.
        """
        doubt = self._find_implausibility(index, state, noisy)
        if doubt is Implausibility.RANGE:  # repetition does not make it right
            self.refused[doubt] += 1
            return False
        doubted = self._rejected[index]
        if doubt is not None and doubted is not None and _same(doubted[0], state, self._fastest):
            doubt, doubted = None, None
        if doubted is not None:
            self.refused[doubted[1]] += 1
        self._rejected[index] = None if doubt is None else (state, doubt)
        if doubt is None:
            self._accept(index, state)
        return doubt is None

    def _accept(self, index: int, state: State) -> None:
        self._believed[index], self._voltage = state, state.voltage
        low, high = self._bound(index, state.position)
        self._aside[index] = state.position - min(max(state.position, low), high)

    def _bound(self, index: int, position: int) -> tuple[int, int]:
        """Return lowest and highest recent goal of a servo; without one, its position."""
        goals = [int(goals[index]) for goals in self._goals] or [position]
        return min(goals), max(goals)

    def _find_implausibility(self, index: int, state: State, noisy: bool) -> Implausibility | None:
        """Return why a reading is doubtful, or None."""
        if state.position > dxl.TICK_MAX or max(state.speed, state.load) > _MAGNITUDE or state.error & _UNKNOWN_BITS:
            return Implausibility.RANGE
        before = self._believed[index]
        if before is None:
            return Implausibility.FIRST if noisy else None
        elapsed = (state.stamp_ns - before.stamp_ns) / _SEC
        speed, load = dxl.signed_magnitude(state.speed), dxl.signed_magnitude(state.load)
        speed_leap, load_leap = abs(speed - dxl.signed_magnitude(before.speed)), abs(load - dxl.signed_magnitude(before.load))
        if self._leaps(index, before.position, state.position, elapsed):
            return Implausibility.POSITION
        if speed_leap > _SPEED_LEAP and (noisy or abs(speed) * dxl.SPEED_RAD_S > self._fastest):
            return Implausibility.SPEED
        if noisy and load_leap > _LOAD_LEAP:
            return Implausibility.LOAD
        if self._voltage is not None and abs(state.voltage - self._voltage) * dxl.VOLT_UNIT > _SAG:
            return Implausibility.VOLTAGE
        if abs(state.temperature - before.temperature) > _WARMING + _WARMING_RATE * elapsed:
            return Implausibility.TEMPERATURE
        if state.error != before.error:
            return Implausibility.ERROR
        alike = state[1:] == before[1:] and abs(speed) * dxl.SPEED_RAD_S * elapsed > _STANDS * dxl.TICK_RAD
        return Implausibility.AGAIN if alike else None

    def _leaps(self, index: int, before: int, position: int, elapsed: float) -> bool:
        """Return whether a position is off the goal range, or too far to reach.

        The range is widened by the last load and lag.
        """
        low, high = self._bound(index, before)
        aside = self._aside[index]
        near = low + min(aside, 0) - _LEAP <= position <= high + max(aside, 0) + _LEAP
        return not near or abs(position - before) > self._fastest / dxl.TICK_RAD * elapsed + _LEAP


def _same(one: State, other: State, fastest: float) -> bool:
    """Return whether two readings of a servo, shortly after each other, agree.

    Its speed is at most `fastest` [rad/s].
    """
    elapsed = abs(other.stamp_ns - one.stamp_ns) / _SEC
    near = abs(other.position - one.position) <= _REPEATED + min(fastest / dxl.TICK_RAD * elapsed, _MOVED)
    speeds = abs(dxl.signed_magnitude(one.speed) - dxl.signed_magnitude(other.speed)) <= _SPEED_LEAP
    loads = abs(dxl.signed_magnitude(one.load) - dxl.signed_magnitude(other.load)) <= _LOAD_LEAP
    volts = abs(other.voltage - one.voltage) * dxl.VOLT_UNIT <= _SAG
    warmth = abs(other.temperature - one.temperature) <= _WARMING
    return near and speeds and loads and volts and warmth and one.error == other.error
