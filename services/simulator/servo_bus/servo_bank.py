"""Emulated Dynamixel servos: control tables, controllers, heat and supply.

The physics engine simulates the joints with damping and friction. In each step it passes joint angles, speeds and motor torques
to the bank. The bank returns the servos' position controllers: setpoint, stiffness and torque limit.

Not emulated: wheel mode (both angle limits 0; torque is off in it), and punch, which about cancels the friction of the gear.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.simulator.servo_bus.motors import AX_12A_MOTOR, Motor, Supply, motor_and_supply, powered_by
from sextant.services.simulator.servo_bus.servo_faults import ServoFaults
from sextant.services.simulator.servo_bus.servo_kernels import measure, update_controllers, update_heat
from sextant.shared.robot.servo import Battery, Servo
from sextant.shared.servo import x_series
from sextant.shared.servo.dynamixel import full_torque_ticks
from sextant.shared.servo.models import AX_12A
from sextant.shared.servo.protection import Protection
from sextant.shared.servo.servo_model import Recovery, Register, ServoError, ServoModel, Sign

Array = NDArray[np.float64]

_EPS = 1e-9  # rounding tolerance of a duty, or of a sum of time steps, at a limit


@dataclass(frozen=True, slots=True)
class ServoVariation:
    """Deviations of n servos from their data sheet."""

    stiffness: Array  # (n,) [1] factors of the torque per position error
    torque: Array  # (n,) [1] factors of the torque at a duty of 1
    backlash: Array  # (n,) [rad] play of the gears, in which a motor exerts no torque


# [ns] maximum extrapolation of joint motion from a physics step; in lockstep, a cycle reads up to this far ahead of the step.
_MAX_EXTRAPOLATION_NS = 6_000_000
_JAM_RATIO = 5.0  # [1] stiffness and torque that hold a jammed joint, as multiples of those of its servo
_BUCKETS = 100  # number of time slices of the sliding window of the mean duty


@dataclass(frozen=True, slots=True)
class ServoCommand:
    """Position controllers of n servos for one physics step.

    The torque is clip(stiffness (setpoint - q), +-torque_limit). The arrays belong to the bank and change at its next step.
    """

    setpoint: Array  # (n,) [rad] servo angle, with the compliance margin subtracted
    stiffness: Array  # (n,) [N m/rad]
    torque_limit: Array  # (n,) [N m] 0 with torque off


class ServoBank:
    """Emulation of n servos on one supply.

    Servo angles are 0 rad at the centre of the position register, counterclockwise positive.
    """

    def __init__(
        self,
        servo_ids: Sequence[int],
        model: ServoModel = AX_12A,
        motor: Motor = AX_12A_MOTOR,
        protection: Protection | None = None,
        supply: Supply | None = None,
        *,
        q: Array | None = None,
        charge: float = 1.0,
        temperature: float | None = None,
        variation: ServoVariation | None = None,
        stiffness: float = 0.0,
        dead_band_rad: float = 0.0,
    ) -> None:
        """Create servos with factory values and torque off.

        Args:
            servo_ids: Ids that the protocol allows, all different.
            model: Control table and units of the servo type.
            motor: Torque and currents of the servo type.
            protection: Overload and heat parameters.
            supply: The battery.
            q: (n,) [rad] initial joint angles in servo coordinates, 0 by default.
            charge: Initial charge of the battery, 0 to 1.
            temperature: Initial temperature of the motors [deg C], ambient by default.
            variation: Deviations from the data sheet, none by default.
            stiffness: [N m/rad] of servos without registers for it; 0 for that of their model.
            dead_band_rad: [rad] change of the goal that these servos ignore.

        Raises:
            ValueError: An id is out of range or not unique, or the charge is outside 0 to 1.
        """
        n = len(servo_ids)
        if len(set(servo_ids)) != n or not all(0 <= i <= model.protocol.MAX_ID for i in servo_ids):
            raise ValueError(f"servo ids 0 to {model.protocol.MAX_ID}, each once, expected, found {list(servo_ids)}")
        if not 0.0 <= charge <= 1.0:
            raise ValueError(f"a battery charge from 0 to 1 expected, found {charge}")
        self.model = model
        self.motor = motor
        self._variation = variation or ServoVariation(np.ones(n), np.ones(n), np.zeros(n))
        self._stall_torque = motor.stall_torque * self._variation.torque  # (n,) [N m]
        self._spring, self._dead_band_rad = stiffness or motor.stall_torque * model.gain_stiffness, dead_band_rad
        self.slipped = np.zeros(n)  # (n,) [rad] by which each encoder is ahead of its link
        self.protection = protection or Protection()
        p = self.protection
        stalls, most = (p.stall_duty - _EPS, p.stall_time - _EPS), (p.mean_duty + _EPS) * p.mean_time
        self._protection_limits = (*stalls, most, p.ambient, p.cooling_time, p.heating)  # they tolerate rounding
        self.supply = supply or Supply()
        self.charge = charge  # of the battery, 0 to 1
        self.current = 0.0  # [A] drawn from the supply in the last step
        self.servo_current = 0.0  # [A] of it, drawn by these servos
        self.other_current = 0.0  # [A] drawn by servos of other banks on the same supply

        self._bytes = bytearray(model.factory_table() * n)
        table, units = model.table, model.units
        self.table, self._units = table, units
        self.tables: NDArray[np.uint8] = np.frombuffer(self._bytes, dtype=np.uint8).reshape(n, table.size)
        self._stored: dict[int, bytearray] = {}  # row -> EEPROM after a loss of power, where it differs from the table
        self._columns = {register.name: self._view(register) for register in (*table.registers, table.torque_limit)}
        self.column(table.id)[:] = servo_ids
        self._torque_limits = self.column(table.torque_limit)
        self._torque_limits[:] = self.column(table.max_torque)
        self._goals = self.column(table.goal_position)
        self._values = np.zeros((n, 5), dtype=np.int64)  # measured position, speed, load, temperature, motion
        magnitudes = (units.speed_sign.largest(table.present_speed.size), units.load_sign.largest(table.present_load.size))
        bits = (0 if sign is Sign.COMPLEMENT else sign.largest(2) + 1 for sign in (units.speed_sign, units.load_sign))
        # The compiled functions take units as arguments, because they differ between models.
        self._measure_units = tuple(
            map(float, (units.centre, units.tick_rad, units.max_position, units.speed_rad_s, units.load, *magnitudes, *bits))
        )
        measured = (*table.measured, table.moving)
        self._measured_addresses = (
            min(register.address for register in measured),
            max(register.address + register.size for register in measured),
        )

        start = self.protection.ambient if temperature is None else temperature
        self.temperature: Array = np.full(n, start)  # (n,) [deg C]
        self.voltage = self._open_circuit()  # [V] at the servos
        self._latched_errors = np.zeros(n, dtype=np.uint8)  # error bits OVERLOAD and OVERHEATING
        self._tripped_share = np.ones(n)  # [1] of the torque that a shutdown leaves, where the torque limit does not tell
        # What a shutdown sets to 0: a register, or the share of the torque where no register tells.
        self._shut_down_by: NDArray[Any] = {
            Recovery.TORQUE_LIMIT: self._torque_limits,
            Recovery.TORQUE_ENABLE: self._tripped_share,
            Recovery.REBOOT: self.column(table.torque_enable),
            Recovery.ITSELF: self._tripped_share,
        }[model.recovery]
        self._tripped = np.zeros(n, dtype=np.uint8)  # error bits whose conditions are met now
        self._stalled_for = np.zeros(n)  # [s]
        self._buckets = np.zeros((_BUCKETS, n))  # [s] duty integrated over each slice of the window
        self._bucket, self._bucket_time = 0, 0.0
        self._duty_sum = np.zeros(n)  # [s] over the window without the current slice

        self._q = np.zeros(n) if q is None else np.array(q, dtype=np.float64)  # [rad]
        self._qd, self._load = np.zeros(n), np.zeros(n)  # [rad/s], fraction of stall
        self._setpoint = self._q.copy()  # [rad] current angle of the ramp to the goal, without compliance margin
        self._at_ns: int | None = None  # bus time of the last physics step, None if unknown
        self._measured_after_ns = 0  # [ns] after that step, the time of the measured values in the tables
        self._measured = False  # whether the tables contain the measured values of that step
        self._out = ServoCommand(np.zeros(n), np.zeros(n), np.zeros(n))
        self._goals_changed = True  # whether a goal or a moving speed has changed
        self._settings_changed = True  # whether another register has changed
        self._goal, self._speed, self._limit = np.zeros(n), np.zeros(n), np.zeros(n)
        self._temperature_limit = np.zeros(n)
        self._margin, self._stiffness = np.zeros((2, n)), np.zeros((2, n))  # clockwise, counterclockwise
        self._torque_off = np.ones(n, dtype=np.bool_)
        self._active_faults, self._load_direction = ServoFaults.none(n), np.ones(n)
        self._has_faults = False
        self._jammed_at = np.zeros(n)  # [rad]

    def __len__(self) -> int:
        """Number of servos."""
        return len(self._q)

    # --------------------------------------------------------------------------------------- methods for the bus

    def model_of(self, row: int) -> ServoModel:
        """Return the model of a servo, which is that of all."""
        return self.model

    def read(self, row: int, address: int, size: int, at_ns: int | None = None) -> bytes:
        """Return bytes of one servo's control table.

        Measured values are those of the last physics step. If its bus time is known, they are extrapolated with the joint
        speeds to the time `at_ns` of the reading, because the registers of real servos change continuously.
        """
        if address < self._measured_addresses[1] and address + size > self._measured_addresses[0]:
            after_ns = 0
            if at_ns is not None and self._at_ns is not None:
                after_ns = min(max(at_ns - self._at_ns, -_MAX_EXTRAPOLATION_NS), _MAX_EXTRAPOLATION_NS)
            if not self._measured or after_ns != self._measured_after_ns:
                self._write_measured(after_ns)
        start = row * self.table.size + address
        return bytes(self._bytes[start : start + size])

    def write(self, row: int, address: int, data: bytes) -> None:
        """Write to one servo's control table; the caller has validated the values.

        Turning torque on makes the present position the goal, so that the servo does not jump to an old goal (ROBOTIS forum
        24472, RX-28). Writing a goal does not turn torque on, because no source states this for the AX-12A. Writing Torque
        Limit ends a shutdown, which the next step repeats if its condition is still met.
        """
        end, goals = address + len(data), self.table.goals
        self._keep_eeprom(row, address, data)
        start = row * self.table.size
        self._goals_changed = True
        if address >= goals.address and end <= goals.address + goals.size:  # the usual case
            self._bytes[start + address : start + end] = data
            if self.table.goal_time is not None:
                self._set_speed(row, self.table.goal_time)
            return
        enable = start + self.table.torque_enable.address
        was_on = self._bytes[enable]
        mode = self.table.operating_mode
        before = None if mode is None else self.column(mode)[row]
        self._bytes[start + address : start + end] = data
        if mode is not None and self.column(mode)[row] != before:
            self._reset_for_mode(row)
        if self.model.recovery is Recovery.REBOOT and self._latched_errors[row] & self._shuts_down_for(row):
            self._bytes[enable] = 0  # until it reboots
        turned_on = self._bytes[enable] and not was_on
        if turned_on and not (address <= self.table.goal_position.address < end):
            self._goals[row] = self._position_ticks(row)
        if self._ends_shutdown(row, address, end):
            self._latched_errors[row], self._tripped_share[row] = 0, 1.0
        self._settings_changed = True

    def _reset_for_mode(self, row: int) -> None:
        """Reset what another operating mode resets: gains, assumed to those of the factory, speed and limits of the torque."""
        table = self.table
        if table.position_gain is not None:
            self.column(table.position_gain)[row] = self.model.default(table.position_gain)
        self.column(table.goal_speed)[row] = 0
        self._torque_limits[row] = self.column(table.max_torque)[row]
        self.column(x_series.GOAL_PWM)[row] = self.column(x_series.PWM_LIMIT)[row]

    def _set_speed(self, row: int, goal_time: Register) -> None:
        """Set the goal speed with which a servo reaches its goal in its time, from the present angle of its ramp."""
        time_ms, units = int(self.column(goal_time)[row]), self._units
        way = abs(units.angle(int(self._goals[row])) - self._setpoint[row])
        speed = math.ceil(way / (time_ms * 1e-3) / units.speed_rad_s) if time_ms else 0
        self.column(self.table.goal_speed)[row] = min(speed, self.table.goal_speed.max)

    def _keep_eeprom(self, row: int, address: int, data: bytes) -> None:
        """Before a write: keep what the EEPROM of a locked servo will be after a loss of power."""
        lock, base, end = self.table.lock, row * self.table.size, self.table.eeprom.stop
        if not self.model.unlocks or lock is None or address >= end:
            return
        if self.column(lock)[row]:  # the write acts, but is not stored
            self._stored.setdefault(row, bytearray(self._bytes[base : base + end]))
        elif row in self._stored:
            self._stored[row][address : address + len(data)] = data

    def _ends_shutdown(self, row: int, address: int, end: int) -> bool:
        """Return whether a write to these addresses, just done, ends the shutdown of a servo."""
        match self.model.recovery:
            case Recovery.TORQUE_LIMIT:
                return address <= self.table.torque_limit.address < end
            case Recovery.TORQUE_ENABLE:
                return address <= self.table.torque_enable.address < end and not self.column(self.table.torque_enable)[row]
            case Recovery.REBOOT | Recovery.ITSELF:
                return False

    def set_faults(self, faults: ServoFaults | None) -> None:
        """Set the active faults, None for no faults, and apply their immediate effects."""
        before, now = self._active_faults, ServoFaults.none(len(self)) if faults is None else faults
        if not self._measured:
            self._write_measured(0)  # frozen registers keep the current values
        for row in np.flatnonzero(before.unpowered & ~now.unpowered):
            self.power_up(int(row))
        self._jammed_at = np.where(now.jammed & ~before.jammed, self._q, self._jammed_at)
        self._load_direction = np.where(now.wrong_sign, -1.0, 1.0)
        self._active_faults, self._has_faults = now, faults is not None or bool(self.slipped.any())
        self._stall_torque = self.motor.stall_torque * self._variation.torque * now.strength
        self._measured, self._settings_changed, self._goals_changed = False, True, True

    def power_up(self, row: int) -> None:
        """Reset the RAM registers of a servo to factory values.

        Torque is off and no error is latched.
        """
        start = self.table.torque_enable.address
        for byte, value in enumerate(self._stored.pop(row, b"")):
            self._bytes[row * self.table.size + byte] = value
        self.tables[row, start:] = np.frombuffer(self.model.factory_table(), dtype=np.uint8)[start:]
        self._torque_limits[row] = self.column(self.table.max_torque)[row]
        self._latched_errors[row], self._tripped_share[row] = 0, 1.0
        self._goals_changed = self._settings_changed = True

    @property
    def shutdown(self) -> NDArray[np.bool_]:
        """Servos (n,) that have latched an overload or overheating error."""
        return np.asarray(self._latched_errors != 0)

    def error(self, row: int) -> int:
        """Return the error bits of one servo's state, without those of an instruction."""
        volts = round(self.voltage / self._units.volt)
        low, high = self.column(self.table.min_voltage)[row], self.column(self.table.max_voltage)[row]
        return int(self._latched_errors[row]) | (0 if low <= volts <= high else int(ServoError.INPUT_VOLTAGE))

    # ----------------------------------------------------------------------------------- methods for the physics

    def step(self, q: Array, qd: Array, torque: Array, dt: float) -> ServoCommand:
        """Advance the servos by one physics step.

        Args:
            q: (n,) [rad] joint angles in servo coordinates.
            qd: (n,) [rad/s] joint speeds.
            torque: (n,) [N m] motor torques that acted in the last step.
            dt: Duration of the step [s].

        Returns:
            The position controllers for the next physics step.
        """
        self.set_joint_state(q, qd, torque)
        return self.advance(dt)

    def advance(self, dt: float) -> ServoCommand:
        """Advance the servos by one physics step `dt` [s], from the joint state that was set last."""
        if self._has_faults:
            self._apply_faults(dt)
        if self._goals_changed:
            self._convert_goals()
        if self._settings_changed:
            self._convert_settings()
        self._discharge(self._update_protection(dt), dt)
        if self._settings_changed:  # by a shutdown
            self._convert_settings()
        return self._control(dt)

    def set_joint_state(self, q: Array, qd: Array, torque: Array, at_ns: int | None = None) -> None:
        """Set the joint angles, speeds and torques that the servos measure.

        The arguments are those of `step`; `at_ns` [ns] is the bus time of this state, if known.
        """
        self._measured, self._at_ns = False, at_ns
        self._q[:] = q
        self._qd[:] = qd
        np.divide(torque, self._stall_torque, out=self._load)

    def _apply_faults(self, dt: float) -> None:
        """Apply the active faults to heat, charge and load for one step."""
        faults = self._active_faults
        self.temperature += faults.heating * dt
        self.charge = max(self.charge - faults.drain * dt, 0.0)
        if (self.slipped != faults.slips).any():
            most = faults.slip_rate * dt
            self.slipped += np.minimum(np.maximum(faults.slips - self.slipped, -most), most)
        if faults.jammed.any():  # the motor works against the jam, up to its torque limit
            pull = np.clip(self._out.stiffness * (self._goal - self._q), -self._limit, self._limit)
            self._load[:] = np.where(faults.jammed, pull / self._stall_torque, self._load)

    def _update_protection(self, dt: float) -> float:
        """Update heat and overload by one step, and shut down tripped servos.

        The result is the sum of the duties.
        """
        p = self.protection
        duty_sum, tripped = update_heat(
            self._load, self.temperature, self._temperature_limit, self._stalled_for, self._buckets[self._bucket],
            self._duty_sum, self._tripped, dt, self._protection_limits,
        )  # fmt: skip
        self._bucket_time += dt
        if self._bucket_time >= p.mean_time / _BUCKETS - _EPS:
            self._bucket, self._bucket_time = (self._bucket + 1) % _BUCKETS, 0.0
            self._buckets[self._bucket] = 0.0
            self._duty_sum = self._buckets.sum(axis=0)
        if self._has_faults:
            self._tripped |= self._active_faults.tripped
            tripped = bool(self._tripped.any())
        if self.model.recovery is Recovery.ITSELF:
            self._unload()
        elif tripped:
            self._latched_errors |= self._tripped & np.uint8(self.model.errors)  # a servo that reports none has no protection
            kinds = np.array([self._shuts_down_for(row) for row in range(len(self))])
            down = (self._tripped & kinds != 0) & (self._shut_down_by != 0)
            if down.any():
                self._shut_down(down)
        return float(duty_sum)

    def _shuts_down_for(self, row: int) -> int:
        """Return the errors for which a servo shuts down."""
        return int(self.model.hardware_errors(int(self.column(self.table.shutdown)[row])))

    def _unload(self) -> None:
        """Give no torque to servos that are too hot, or whose voltage is outside its limits."""
        table, volts = self.table, self.voltage / self._units.volt
        low = (volts < self.column(table.min_voltage)) | (volts > self.column(table.max_voltage))
        found = (self._tripped | np.where(low, np.uint8(ServoError.INPUT_VOLTAGE), 0)) & self.column(table.shutdown)
        if (found != self._latched_errors).any():
            self._latched_errors[:] = found
            self._tripped_share[:] = found == 0
            self._settings_changed = True

    def _shut_down(self, down: NDArray[np.bool_]) -> None:
        """Turn the motors of servos (n,) off, as their model does."""
        self._shut_down_by[down] = 0
        self._settings_changed = True

    def _discharge(self, duty_sum: float, dt: float) -> None:
        """Update current, charge and voltage of the supply by one step."""
        s, m = self.supply, self.motor
        self.current = s.computer_current + len(self) * m.standby_current + m.stall_current * duty_sum + self.other_current
        self.servo_current = self.current - s.computer_current - self.other_current
        self.charge = max(self.charge - self.current * dt / (3600.0 * s.capacity_ah), 0.0)
        self.voltage = self._open_circuit() - s.resistance * self.current - self._active_faults.sag

    def _open_circuit(self) -> float:
        return self.supply.empty_voltage + self.charge * (self.supply.full_voltage - self.supply.empty_voltage)

    def _control(self, dt: float) -> ServoCommand:
        """Advance the ramps to the goals by one step, and return the position controllers."""
        out = self._out
        update_controllers(
            self._goal, self._speed, dt, self._torque_off, self._q, self._margin, self._stiffness,
            self._setpoint, out.setpoint, out.stiffness,
        )  # fmt: skip
        if self._has_faults and self._active_faults.jammed.any():
            return self._jam(out)
        return out

    def _jam(self, out: ServoCommand) -> ServoCommand:
        """Return the controllers, with jammed joints held in place by more torque than that of their motors."""
        jammed, stiffest = self._active_faults.jammed, _JAM_RATIO * self._stiffness.max(axis=0)
        return ServoCommand(
            np.where(jammed, self._jammed_at, out.setpoint),
            np.where(jammed, stiffest, out.stiffness),
            np.where(jammed, _JAM_RATIO * self._stall_torque, out.torque_limit),
        )

    def _convert_goals(self) -> None:
        """Convert goal positions and moving speeds to physical values; a host writes them in every cycle."""
        self._goals_changed = False
        if self._has_faults:
            self._goals[:] = (self._goals | self._active_faults.stuck_ones) & ~self._active_faults.stuck_zeros
        self._goal[:] = (self._goals - float(self._units.centre)) * self._units.tick_rad
        speed = self.column(self.table.goal_speed)
        self._speed[:] = np.where(speed == 0, np.inf, speed * self._units.speed_rad_s)

    def _convert_settings(self) -> None:
        """Convert the other registers to physical values, after one of them has changed."""
        self._settings_changed = False
        table = self.table
        self._temperature_limit[:] = self.column(table.temperature_limit)
        self._convert_compliance()
        wheel_mode = (self.column(table.low_limit) == 0) & (self.column(table.high_limit) == 0)
        limit = np.minimum(self._torque_limits, self.column(table.max_torque)) / self.model.full_torque
        if self.model.limits_current:
            limit = self._current_limited(limit)
        off = (self.column(table.torque_enable) == 0) | wheel_mode | self._active_faults.unpowered
        self._limit[:] = np.where(off, 0.0, self._stall_torque * limit * self._tripped_share)
        self._torque_off = self._limit == 0.0
        self._out.torque_limit[:] = self._limit

    def _current_limited(self, share: Array) -> Array:
        """Return shares (n,) of the stall torque of servos whose current is limited to a share, in the mode that limits it."""
        mode = self.column(self.table.operating_mode) if self.table.operating_mode else x_series.CURRENT_MODE
        most = np.minimum(self.column(x_series.GOAL_PWM), self.column(x_series.PWM_LIMIT)) / float(x_series.MAX_PWM)
        return np.asarray(np.where(mode == x_series.CURRENT_MODE, np.minimum(share, most), most))

    def _convert_compliance(self) -> None:
        """Convert the settings of the position controllers to margins and stiffness."""
        table = self.table
        if table.position_gain is not None:
            self._margin[:] = self._variation.backlash / 2
            share = self.column(table.position_gain) * self.model.gain_stiffness
            self._stiffness[:] = self._stall_torque * share * self._variation.stiffness
            return
        if not table.compliance:
            self._margin[:] = self._dead_band_rad / 2 + self._variation.backlash / 2
            self._stiffness[:] = self._spring * self._variation.stiffness
            return
        for i, (margin, slope) in enumerate(zip(table.compliance[:2], table.compliance[2:], strict=True)):
            self._margin[i] = self.column(margin) * self._units.tick_rad + self._variation.backlash / 2
            steps = np.array([full_torque_ticks(value) for value in self.column(slope).tolist()])
            self._stiffness[i] = self._stall_torque / (steps * self._units.tick_rad) * self._variation.stiffness

    def column(self, register: Register) -> NDArray[np.unsignedinteger]:
        """Return one register (n,) of all servos, as a view of the tables."""
        return self._columns[register.name]

    def _view(self, register: Register) -> NDArray[np.unsignedinteger]:
        n, width = self.tables.shape
        return np.ndarray((n,), register.dtype, buffer=self._bytes, offset=register.address, strides=(width,))

    def _position_ticks(self, row: int) -> int:
        return min(max(self._units.ticks(float(self._q[row])), 0), self._units.max_position)

    def _write_measured(self, after_ns: int) -> None:
        """Write what all servos measure at `after_ns` [ns] after the last physics step to their tables.

        If the bus time of the step is unknown, they measure the state that was set last, whose torques are those at the
        beginning of the step.
        """
        self._measured, self._measured_after_ns = True, after_ns
        values, faults, out, table = self._values, self._active_faults, self._out, self.table
        before = self.column(table.present_position).copy() if self._has_faults else None
        measure(
            self._measure_units, math.nan if self._at_ns is None else after_ns * 1e-9, self._stall_torque, self._q, self._qd,
            self._load, out.setpoint, out.stiffness, out.torque_limit, self.temperature, self._goal, self._setpoint,
            self._torque_off, self._load_direction, values,
        )  # fmt: skip
        if before is not None:
            off = np.clip(values[:, 0] + faults.offset, 0, self._units.max_position)
            values[:, 0] = np.where(faults.frozen, before, off)
            values[:, 3] = np.where(faults.reads_hot >= 0, faults.reads_hot, values[:, 3])
        self.column(table.present_position)[:] = values[:, 0]
        self.column(table.present_speed)[:] = values[:, 1]
        self.column(table.present_load)[:] = values[:, 2]
        self.column(table.present_voltage)[:] = min(max(round(self.voltage / self._units.volt), 0), table.present_voltage.max)
        self.column(table.present_temperature)[:] = values[:, 3]
        self.column(table.moving)[:] = values[:, 4]
        if table.hardware_error is not None:
            self.column(table.hardware_error)[:] = [self.model.hardware_error_code(self.error(row)) for row in range(len(self))]


def make_servo_bank(
    servo: Servo,
    servo_ids: Sequence[int],
    q: Array,
    battery_ah: float = Supply().capacity_ah,
    battery_resistance: float = 1.0,
    variation: ServoVariation | None = None,
    powered_like: Servo | None = None,
    battery: Battery | None = None,
) -> ServoBank:
    """Create the servos of a profile: registers of their model, torque and stiffness of the profile, voltages of its battery.

    The profile states the torque at the robot's own voltage, and the actuator converts loads with it. The current of a motor is
    proportional to its torque. The servos start at joint angles q (n,) [rad]. The capacity [A h] has no effect on a supply with
    constant voltage, and `battery_resistance` is a factor. The supply is that of the servo `powered_like`, by default of this;
    without a battery it has the usual voltages of the model.
    """
    motor, supply = motor_and_supply(servo)
    current = motor.stall_current * servo.stall_torque / motor.stall_torque
    motor = replace(motor, stall_torque=servo.stall_torque, stall_current=current)
    if powered_like is not None:
        supply = motor_and_supply(powered_like)[1]
    if battery is not None:
        supply = powered_by(supply, battery)
    supply = replace(supply, capacity_ah=battery_ah, resistance=supply.resistance * battery_resistance)
    model, n = servo.servo_model, len(servo_ids)
    dead_band_rad = servo.pulses.dead_band_us / servo.pulses.us_per_rad if servo.pulses else 0.0
    variation = variation or ServoVariation(np.ones(n), np.ones(n), np.zeros(n))
    variation = replace(variation, stiffness=variation.stiffness * servo.stiffness / servo.nominal_stiffness)
    return ServoBank(
        servo_ids, model, motor, supply=supply, q=q, variation=variation, stiffness=servo.stiffness, dead_band_rad=dead_band_rad
    )
