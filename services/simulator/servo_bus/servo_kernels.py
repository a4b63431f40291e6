"""Compiled parts of the emulated servos: heat, measurements and controllers."""

import numpy as np
from numpy.typing import NDArray

from sextant.shared.runtime.compiled import compiled
from sextant.shared.servo.servo_model import ServoError

Array = NDArray[np.float64]

_HOT, _OVERLOAD = int(ServoError.OVERHEATING), int(ServoError.OVERLOAD)


@compiled
def update_heat(
    load: Array,
    temperature: Array,
    temperature_limit: Array,
    stalled_for: Array,
    bucket: Array,
    duty_sum: Array,
    tripped: NDArray[np.uint8],
    dt: float,
    protection: tuple[float, ...],
) -> tuple[float, bool]:
    """Update temperature and overload of n servos by one physics step, in place.

    Args:
        load: (n,) motor torque as a fraction of the stall torque.
        temperature: (n,) [deg C] of the motors, updated.
        temperature_limit: (n,) [deg C].
        stalled_for: (n,) [s] of uninterrupted stall, updated.
        bucket: (n,) [s] duty integrated over the current slice of the window, updated.
        duty_sum: (n,) [s] the same over all other slices.
        tripped: (n,) error bits whose conditions are met, overwritten.
        dt: [s] duration of the step.
        protection: [1] duty from which a servo stalls, [s] of a stall after which it trips, [s] maximum integral of the duty
            over the sliding window, [deg C] ambient temperature, [s] time constant of cooling, [K/s] heating at a duty of 1.

    Returns:
        The sum of the duties, and whether any servo trips.
    """
    stall_duty, stall_time, max_duty_integral, ambient, cooling_time, heating = protection
    total, any_tripped = 0.0, False
    for i in range(load.size):
        duty = abs(load[i])
        total += duty
        temperature[i] += dt * ((ambient - temperature[i]) / cooling_time + heating * duty * duty)
        stalled_for[i] = stalled_for[i] + dt if duty >= stall_duty else 0.0
        bucket[i] += dt * duty
        bits = 0
        if stalled_for[i] >= stall_time or duty_sum[i] + bucket[i] > max_duty_integral:
            bits |= _OVERLOAD
        if temperature[i] > temperature_limit[i]:
            bits |= _HOT
        tripped[i] = bits
        any_tripped = any_tripped or bits != 0
    return total, any_tripped


@compiled
def measure(
    units: tuple[float, ...],
    after: float,
    stall_torque: Array,
    q: Array,
    qd: Array,
    load: Array,
    setpoint: Array,
    stiffness: Array,
    torque_limit: Array,
    temperature: Array,
    goal: Array,
    ramp: Array,
    torque_off: NDArray[np.bool_],
    load_direction: Array,
    values: NDArray[np.int64],
) -> None:
    """Compute what n servos measure `after` [s] a physics step, in register units.

    Angles and loads are extrapolated: the load is that of the motor at the extrapolated angle. With `after` NaN they are those
    of the step. The position is clipped.

    Args:
        units: Centre, size and last of the position ticks, units of speed and load, their largest magnitudes, and the bit that
            marks negative ones, 0 for two's complement.
        load_direction: (n,) -1 for load registers with the wrong sign.
        values: (n, 5) position, speed, load, temperature, and whether the servo moves; overwritten.
    """
    centre, tick, last_tick, speed_unit, load_unit, most_speed, most_load, speed_bit, load_bit = units
    for i in range(q.size):
        angle, share = q[i], load[i]
        if not np.isnan(after):
            angle = angle + after * qd[i]
            torque = stiffness[i] * (setpoint[i] - angle)
            share = min(max(torque, -torque_limit[i]), torque_limit[i]) / stall_torque[i]
        values[i, 0] = np.int64(min(max(np.rint(centre + angle / tick), 0.0), last_tick))
        for k, value, unit, most, bit in (
            (1, qd[i], speed_unit, most_speed, speed_bit),
            (2, share * load_direction[i], load_unit, most_load, load_bit),
        ):
            size = min(np.rint(abs(value) / unit), most)
            negative = bit + size if bit > 0.0 and size > 0.0 else -size
            values[i, k] = np.int64(negative if value < 0.0 else size)
        values[i, 3] = np.int64(min(max(np.rint(temperature[i]), 0.0), 255.0))
        values[i, 4] = abs(goal[i] - ramp[i]) > tick and not torque_off[i]


@compiled
def update_controllers(
    goal: Array,
    speed: Array,
    dt: float,
    torque_off: NDArray[np.bool_],
    q: Array,
    margin: Array,
    stiffness: Array,
    ramp: Array,
    out_setpoint: Array,
    out_stiffness: Array,
) -> None:
    """Compute setpoint and stiffness of n servos.

    The ramp moves toward the goal with a speed [rad/s] for a time [s], in place.

    margin and stiffness (2, n) are those for clockwise and counterclockwise torque. Outside the compliance margin the torque
    rises from zero at its edge. Inside the margin the setpoint is the joint angle. While torque is off, the ramp follows the
    joint, so that it starts there when torque is turned on.
    """
    for i in range(goal.size):
        step, reach = goal[i] - ramp[i], speed[i] * dt
        ramp[i] = goal[i] if abs(step) <= reach else ramp[i] + (reach if step > 0.0 else -reach)
        if torque_off[i]:
            ramp[i] = q[i]
        error = ramp[i] - q[i]
        side = 1 if error > 0.0 else 0
        inside = min(max(error, -margin[side, i]), margin[side, i])
        out_setpoint[i] = (error - inside) + q[i]
        out_stiffness[i] = stiffness[side, i]
