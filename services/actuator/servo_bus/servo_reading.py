"""Readings of servos in physical units, and estimates of what a servo does not measure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sextant.services.actuator.servo_bus.reading_validation import State
from sextant.shared.servo.servo_model import Feedback, ServoError, Units

_LONGEST_NS = 200_000_000  # [ns] between two positions from which a speed is estimated


@dataclass(slots=True)
class ServoReading:
    """Measurements of one servo; voltage and temperature are NaN if they were not read this time.

    It is not frozen, because making a frozen one takes three times as long.
    """

    index: int  # in the driver's list of ids
    servo_id: int
    stamp_ns: int  # [ns] when it was requested; the servo sampled after that, within the answer time
    told_ns: int  # [ns] when goals were last sent before that, or accepted by a microcontroller; long ago if never
    position_ticks: int  # position register
    position: float  # [rad] servo angle, counterclockwise positive
    speed: float  # [rad/s] counterclockwise positive
    load: float  # fraction of the stall torque, counterclockwise positive
    voltage: float  # [V]
    temperature: float  # [deg C]
    error: ServoError
    measured: Feedback = Feedback.ALL  # what the servo measured; speed and load are estimates if they are not among it


def reading(index: int, servo_id: int, told_ns: int, state: State, error: ServoError, units: Units) -> ServoReading:
    """Return the reading from the state of a servo that measures everything."""
    return ServoReading(
        index,
        servo_id,
        state.stamp_ns,
        told_ns,
        state.position,
        (state.position - units.centre) * units.tick_rad,
        state.speed * units.speed_rad_s,
        state.load * units.load,
        state.voltage * units.volt,
        float(state.temperature),
        error,
    )


class PositionReadings:
    """Readings of n servos that measure no speed and no load: both are estimated from positions and goals.

    The load is the torque of the position controller, in proportion to the distance from the position to the goal. A tick of
    the position is therefore a tick of the load, and a servo that has no torque seems to have one.
    """

    def __init__(self, units: Units, stiffness: Sequence[float]) -> None:
        """Begin without a reading.

        Args:
            units: Units of their positions and voltages.
            stiffness: (n,) [1/rad] share of the stall torque per position error of each servo.
        """
        self._units, self._stiffness = units, tuple(stiffness)
        self._before: list[tuple[int, float] | None] = [None] * len(self._stiffness)  # [ns] and [rad] of each last reading

    def reading(
        self, index: int, servo_id: int, told_ns: int, state: State, goal: float, extra: Feedback = Feedback.NONE
    ) -> ServoReading:
        """Return the reading from a servo's state.

        Args:
            index: Index of the servo.
            servo_id: Its id.
            told_ns: [ns] when goals were last sent to it.
            state: Its state, without speed and load.
            goal: [rad] servo angle that it controlled at that time; NaN if unknown.
            extra: What was read besides the position: voltage and temperature.
        """
        units = self._units
        position, before = units.angle(state.position), self._before[index]
        self._before[index] = state.stamp_ns, position
        since_ns = _LONGEST_NS if before is None else state.stamp_ns - before[0]
        speed = 0.0 if before is None or not 0 < since_ns < _LONGEST_NS else (position - before[1]) / (since_ns * 1e-9)
        load = 0.0 if math.isnan(goal) else spring_load(self._stiffness[index], goal - position)
        volts, degrees = state.voltage * units.volt, float(state.temperature)
        return ServoReading(
            index=index,
            servo_id=servo_id,
            stamp_ns=state.stamp_ns,
            told_ns=told_ns,
            position_ticks=state.position,
            position=position,
            speed=speed,
            load=load,
            voltage=volts if Feedback.VOLTAGE in extra else math.nan,
            temperature=degrees if Feedback.TEMPERATURE in extra else math.nan,
            error=ServoError(state.error),
            measured=Feedback.POSITION | extra,
        )


def spring_load(stiffness: float, error: float) -> float:
    """Return the load of a position controller as a share of the stall torque.

    Args:
        stiffness: [1/rad] share of the stall torque per position error.
        error: [rad] goal less position.
    """
    return min(max(stiffness * error, -1.0), 1.0)
