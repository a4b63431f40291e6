"""Measurements of one servo, in physical units."""

from dataclasses import dataclass

from sextant.services.actuator.servo_bus.reading_validation import State
from sextant.shared.servo.servo_model import ServoError, Units


@dataclass(frozen=True, slots=True)
class ServoReading:
    """Measurements of one servo."""

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


def reading(index: int, servo_id: int, told_ns: int, state: State, error: ServoError, units: Units) -> ServoReading:
    """Return the reading from a servo's state."""
    return ServoReading(
        index=index,
        servo_id=servo_id,
        stamp_ns=state.stamp_ns,
        told_ns=told_ns,
        position_ticks=state.position,
        position=(state.position - units.centre) * units.tick_rad,
        speed=state.speed * units.speed_rad_s,
        load=state.load * units.load,
        voltage=state.voltage * units.volt,
        temperature=float(state.temperature),
        error=error,
    )
