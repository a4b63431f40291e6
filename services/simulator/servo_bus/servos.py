"""A bank of emulated Dynamixel servos: control tables, and the electronics, heat and supply around each joint.

The joint itself, its damping and friction belong to the physics engine. Each step it tells the bank where the joints are and
what torque the motors gave; the bank answers with the position controller that the servos are: setpoint, stiffness, limit.

Not emulated: wheel mode (both angle limits 0; such a servo is limp) and punch, which about cancels the gear's friction.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.services.simulator.servo_bus.servo_faults import Ailments
from sextant.shared.runtime.compiled import compiled
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.dynamixel import ServoError, ServoModel

Array = NDArray[np.float64]

_EPS = 1e-9  # rounding: a duty, or a sum of time steps, may fall this much short of the limit it should reach


@dataclass(frozen=True, slots=True)
class Motor:
    """What one motor gives and takes. Source: ROBOTIS e-manual, AX-12A; standby current from the RX-64 page."""

    stall_torque: float = 1.5  # [N m] at a duty of 1
    stall_current: float = 1.5  # [A] at a duty of 1
    standby_current: float = 0.05  # [A] always


@dataclass(frozen=True, slots=True)
class Protection:
    """When a servo shuts itself down. Duty is |motor torque| / stall torque.

    Assumed, for no public measurement exists; chosen so that one third of the stall torque is the continuous limit.
    """

    stall_duty: float = 0.95  # overload latches at this duty ...
    stall_time: float = 1.5  # [s] ... held this long,
    mean_duty: float = 0.8  # or when the mean duty exceeds this ...
    mean_time: float = 10.0  # [s] ... over this window
    ambient: float = 25.0  # [deg C]
    cooling_time: float = 400.0  # [s] time constant of cooling to ambient
    heating: float = 1.01  # [K/s] at a duty of 1, in proportion to its square


@dataclass(frozen=True, slots=True)
class Supply:
    """One battery for all servos and the computer: a 3S lithium polymer pack, its voltage falling straight with charge."""

    full_voltage: float = 12.6  # [V] open circuit
    empty_voltage: float = 9.9  # [V] open circuit
    capacity_ah: float = 4.0  # [A h]
    resistance: float = 0.04  # [ohm]
    computer_current: float = 1.0  # [A]


AX_12A_MOTOR = Motor()
# At 14.8 V. The e-manual has 5.3 N m and 2.6 A at 18.5 V; both are in proportion to the voltage, as those of a DC motor are.
RX_64_MOTOR = Motor(stall_torque=4.24, stall_current=2.08, standby_current=0.05)
RX_64_SUPPLY = Supply(full_voltage=14.8, empty_voltage=14.8)  # a bench supply: Lotriet 2024, section 3.1
AX_18A_MOTOR = Motor(stall_torque=1.8, stall_current=2.2)
AX_12W_MOTOR = Motor(stall_torque=0.2, stall_current=1.4)
_ELECTRICS = {
    "AX-12A": (AX_12A_MOTOR, Supply()),
    "AX-18A": (AX_18A_MOTOR, Supply()),
    "AX-12W": (AX_12W_MOTOR, Supply()),
    "RX-64": (RX_64_MOTOR, RX_64_SUPPLY),
}

# For so long [ns] from a physics step joints are taken to go on as they do: in lockstep a cycle reads as far ahead of it.
_FURTHEST_NS = 6_000_000
_JAM = 5.0  # times as stiff and strong as its servo is what a jammed joint is held by
_BUCKETS = 100  # of the sliding window of the mean duty
_HOT, _OVERLOAD = int(ServoError.OVERHEATING), int(ServoError.OVERLOAD)
# Handed to the compiled loops: they would freeze a constant, and their cache does not notice when another file changes. The
# error bits above are the protocol's and will not.
_UNITS = tuple(map(float, (dxl.TICK_CENTRE, dxl.TICK_RAD, dxl.TICK_MAX, dxl.SPEED_RAD_S, dxl.LOAD_UNIT, dxl.DIRECTION_CW)))
_LIVE_START = dxl.PRESENT_POSITION.address
_AIM_START, _AIM_END = dxl.GOAL_POSITION.address, dxl.MOVING_SPEED.address + dxl.MOVING_SPEED.size
_LIVE_END = dxl.MOVING.address + dxl.MOVING.size


@dataclass(frozen=True, slots=True)
class ServoCommand:
    """The position controllers of n servos for one physics step: torque = clip(stiffness (setpoint - q), +-limit).

    The arrays belong to the bank and change at its next step.
    """

    setpoint: Array  # (n,) [rad] servo angle, the compliance margin already taken off
    stiffness: Array  # (n,) [N m/rad]
    torque_limit: Array  # (n,) [N m] 0 where the servo is limp


class _Wear(NamedTuple):
    """`Protection` for the compiled loop: numbers alone."""

    stall_duty: float
    stall_time: float  # [s]
    most_duty: float  # [s] greatest sum of duties over the window
    ambient: float  # [deg C]
    cooling_time: float  # [s]
    heating: float  # [K/s]


@compiled
def _age(
    load: Array,
    temperature: Array,
    temperature_limit: Array,
    stalled_for: Array,
    bucket: Array,
    duty_sum: Array,
    tripped: NDArray[np.uint8],
    dt: float,
    wear: _Wear,
) -> tuple[float, bool]:
    """One step of heat and overload of n servos, in place; the sum of the duties and whether any servo trips.

    `bucket` is the slice of the duty window being filled and `duty_sum` [s] the rest of it. `tripped` becomes the error bits
    whose cause is there.
    """
    total, any_tripped = 0.0, False
    for i in range(load.size):
        duty = abs(load[i])
        total += duty
        temperature[i] += dt * ((wear.ambient - temperature[i]) / wear.cooling_time + wear.heating * duty * duty)
        stalled_for[i] = stalled_for[i] + dt if duty >= wear.stall_duty else 0.0
        bucket[i] += dt * duty
        bits = 0
        if stalled_for[i] >= wear.stall_time or duty_sum[i] + bucket[i] > wear.most_duty:
            bits |= _OVERLOAD
        if temperature[i] > temperature_limit[i]:
            bits |= _HOT
        tripped[i] = bits
        any_tripped = any_tripped or bits != 0
    return total, any_tripped


@compiled
def _measure(
    units: tuple[float, ...],
    q: Array,
    qd: Array,
    load: Array,
    position: NDArray[np.uint16],
    speed: NDArray[np.uint16],
    effort: NDArray[np.uint16],
) -> None:
    """What n servos measure, into their registers: position clipped to the range, speed and load as magnitude and sign."""
    centre, tick, last_tick, speed_unit, load_unit, clockwise = units
    for i in range(q.size):
        position[i] = np.uint16(min(max(np.rint(centre + q[i] / tick), 0.0), last_tick))
        for value, unit, register in ((qd[i], speed_unit, speed), (load[i], load_unit, effort)):
            size = min(np.rint(abs(value) / unit), clockwise - 1.0)
            register[i] = np.uint16(size + clockwise if value < 0.0 and size > 0.0 else size)


@compiled
def _pull(
    goal: Array,
    reach: Array,
    limp: NDArray[np.bool_],
    q: Array,
    margin: Array,
    stiffness: Array,
    ramp: Array,
    out_setpoint: Array,
    out_stiffness: Array,
) -> None:
    """Where n servos pull to, and how stiffly: the ramp moves on to the goal by `reach` [rad] at most, in place.

    margin and stiffness (2, n) are those for a pull clockwise and counterclockwise. Outside the margin the torque starts
    from zero at its edge; inside, the setpoint is where the joint is. A limp servo's ramp starts where its joint is when
    torque returns.
    """
    for i in range(goal.size):
        step = goal[i] - ramp[i]
        ramp[i] = goal[i] if abs(step) <= reach[i] else ramp[i] + (reach[i] if step > 0.0 else -reach[i])
        if limp[i]:
            ramp[i] = q[i]
        error = ramp[i] - q[i]
        side = 1 if error > 0.0 else 0
        inside = min(max(error, -margin[side, i]), margin[side, i])
        out_setpoint[i] = (error - inside) + q[i]
        out_stiffness[i] = stiffness[side, i]


class ServoBank:
    """n servos in servo coordinates: 0 rad at tick 512, counterclockwise positive."""

    def __init__(
        self,
        servo_ids: Sequence[int],
        model: ServoModel = dxl.AX_12A,
        motor: Motor = AX_12A_MOTOR,
        protection: Protection | None = None,
        supply: Supply | None = None,
        *,
        q: Array | None = None,
        charge: float = 1.0,
        temperature: float | None = None,
    ) -> None:
        """Switch the servos on with factory values and torque off.

        Args:
            servo_ids: Ids 0 to 253, all different.
            model: Register defaults of the servo type.
            motor: Torque and currents of the servo type.
            protection: Overload and heat.
            supply: The battery.
            q: (n,) [rad] joint angles at the start in servo coordinates; None is all 0.
            charge: Charge of the battery at the start, 0 to 1.
            temperature: [deg C] of the motors at the start; None is ambient.

        Raises:
            ValueError: An id out of range or given twice, or a charge outside 0 to 1.
        """
        n = len(servo_ids)
        if len(set(servo_ids)) != n or not all(0 <= i <= dxl.MAX_ID for i in servo_ids):
            raise ValueError(f"servo ids 0 to {dxl.MAX_ID}, each once, expected, found {list(servo_ids)}")
        if not 0.0 <= charge <= 1.0:
            raise ValueError(f"a battery charge from 0 to 1 expected, found {charge}")
        self.model = model
        self.motor = motor
        self.protection = protection or Protection()
        p = self.protection
        stalls, most = (p.stall_duty - _EPS, p.stall_time - _EPS), (p.mean_duty + _EPS) * p.mean_time
        self._wear = _Wear(*stalls, most, p.ambient, p.cooling_time, p.heating)
        self.supply = supply or Supply()
        self.charge = charge  # of the battery, 0 to 1
        self.current = 0.0  # [A] drawn in the last step

        self._bytes = bytearray(model.factory_table() * n)
        self.tables: NDArray[np.uint8] = np.frombuffer(self._bytes, dtype=np.uint8).reshape(n, dxl.TABLE_SIZE)
        self._words = self.tables.view("<u2")  # every two-byte register lies at an even address
        self.tables[:, dxl.ID.address] = servo_ids
        self._torque_limits = self._column(dxl.TORQUE_LIMIT)
        self._torque_limits[:] = self._column(dxl.MAX_TORQUE)
        self._goals = self._column(dxl.GOAL_POSITION)

        start = self.protection.ambient if temperature is None else temperature
        self.temperature: Array = np.full(n, start)  # (n,) [deg C]
        self.voltage = self._open_circuit()  # [V] at the servos
        self._faults = np.zeros(n, dtype=np.uint8)  # latched OVERLOAD and OVERHEATING
        self._tripped = np.zeros(n, dtype=np.uint8)  # those whose cause is there now
        self._stalled_for = np.zeros(n)  # [s]
        self._buckets = np.zeros((_BUCKETS, n))  # [s] duty integrated over each slice of the window
        self._bucket, self._bucket_time = 0, 0.0
        self._duty_sum = np.zeros(n)  # [s] over the window but for the slice being filled

        self._q = np.zeros(n) if q is None else np.array(q, dtype=np.float64)  # [rad]
        self._qd, self._load = np.zeros(n), np.zeros(n)  # [rad/s], fraction of stall
        self._setpoint = self._q.copy()  # [rad] where the ramp to the goal is, margin not considered
        self._at_ns: int | None = None  # when that was, None where nobody has said
        self._shown_ns = 0  # [ns] after it of which the tables show what the servos measure
        self._measured = False  # whether they show any of it
        self._out = ServoCommand(np.zeros(n), np.zeros(n), np.zeros(n))
        self._aims_changed = self._others_changed = True  # a goal or speed changed, another register changed
        self._goal, self._speed, self._limit = np.zeros(n), np.zeros(n), np.zeros(n)
        self._temperature_limit = np.zeros(n)
        self._margin, self._stiffness = np.zeros((2, n)), np.zeros((2, n))  # clockwise, counterclockwise
        self._limp = np.ones(n, dtype=np.bool_)
        self._ailments = Ailments.none(n)
        self._ailing = False
        self._jammed_at = np.zeros(n)  # [rad]

    def __len__(self) -> int:
        """Number of servos."""
        return len(self._q)

    # ----------------------------------------------------------------------------------------------- the bus side

    def read(self, row: int, address: int, size: int, at_ns: int | None = None) -> bytes:
        """Bytes of one servo's control table.

        Measured values are those of the last physics step; where it is known when that was, moved on, or back, as the joints
        move, to the time `at_ns` of the reading: a servo's registers do not wait for anybody's step.
        """
        if address < _LIVE_END and address + size > _LIVE_START:
            after_ns = 0 if at_ns is None or self._at_ns is None else min(max(at_ns - self._at_ns, -_FURTHEST_NS), _FURTHEST_NS)
            if not self._measured or after_ns != self._shown_ns:
                self._refresh(after_ns)
        start = row * dxl.TABLE_SIZE + address
        return bytes(self._bytes[start : start + size])

    def write(self, row: int, address: int, data: bytes) -> None:
        """Change one servo's control table; the caller has checked the values.

        Turning torque on makes the present position the goal, so that no servo jumps to a forgotten one (ROBOTIS forum
        24472, RX-28). Writing a goal does not turn torque on: no source says so of the AX-12A. Writing Torque Limit
        ends a shutdown, until the next step finds its cause still there.
        """
        end = address + len(data)
        start = row * dxl.TABLE_SIZE
        enable = start + dxl.TORQUE_ENABLE.address
        was_on = self._bytes[enable]
        self._bytes[start + address : start + end] = data
        turned_on = self._bytes[enable] and not was_on
        if turned_on and not (address <= dxl.GOAL_POSITION.address < end):
            self._goals[row] = self._position_ticks(row)
        if address <= dxl.TORQUE_LIMIT.address < end:
            self._faults[row] = 0
        self._aims_changed = True
        self._others_changed |= not (address >= _AIM_START and end <= _AIM_END)

    def ail(self, ailments: Ailments | None) -> None:
        """Ail from now on as told, or be well again; what happens to a servo at the change happens here."""
        before, now = self._ailments, Ailments.none(len(self)) if ailments is None else ailments
        if not self._measured:
            self._refresh(0)  # registers freeze as they are
        for row in np.flatnonzero(before.unpowered & ~now.unpowered):
            self._power_up(int(row))
        self._jammed_at = np.where(now.jammed & ~before.jammed, self._q, self._jammed_at)
        self._ailments, self._ailing = now, ailments is not None
        self._measured, self._others_changed = False, True

    def _power_up(self, row: int) -> None:
        """Begin with factory values where nothing is kept without power; torque is off and no error is latched."""
        start = dxl.TORQUE_ENABLE.address
        self.tables[row, start:] = np.frombuffer(self.model.factory_table(), dtype=np.uint8)[start:]
        self._torque_limits[row] = self._column(dxl.MAX_TORQUE)[row]
        self._faults[row] = 0
        self._aims_changed = self._others_changed = True

    @property
    def shutdown(self) -> NDArray[np.bool_]:
        """(n,) servos that have latched an overload or a heat fault."""
        return np.asarray(self._faults != 0)

    def error(self, row: int) -> int:
        """Error bits of one servo that belong to its state and not to an instruction."""
        start = row * dxl.TABLE_SIZE
        volts = round(self.voltage / dxl.VOLT_UNIT)
        low, high = self._bytes[start + dxl.MIN_VOLTAGE.address], self._bytes[start + dxl.MAX_VOLTAGE.address]
        return int(self._faults[row]) | (0 if low <= volts <= high else int(ServoError.INPUT_VOLTAGE))

    # ------------------------------------------------------------------------------------------- the physics side

    def step(self, q: Array, qd: Array, torque: Array, dt: float) -> ServoCommand:
        """Advance the servos by one physics step.

        Args:
            q: (n,) [rad] joint angles in servo coordinates.
            qd: (n,) [rad/s] joint speeds.
            torque: (n,) [N m] motor torques that acted in the last step.
            dt: [s] the step.

        Returns:
            The position controllers for the coming step.
        """
        self.feel(q, qd, torque)
        if self._ailing:
            self._suffer(dt)
        if self._aims_changed:
            self._aims()
        if self._others_changed:
            self._settings()
        self._drain(self._protect(dt), dt)
        if self._others_changed:  # a shutdown
            self._settings()
        return self._control(dt)

    def feel(self, q: Array, qd: Array, torque: Array, at_ns: int | None = None) -> None:
        """Take in how the joints are, as `step` does: what is measured from now on; at a time of the bus, if that is known."""
        self._measured, self._at_ns = False, at_ns
        self._q[:] = q
        self._qd[:] = qd
        np.divide(torque, self.motor.stall_torque, out=self._load)

    def _suffer(self, dt: float) -> None:
        """What ails the servos in this step, but for what they measure."""
        ailments = self._ailments
        self.temperature += ailments.heating * dt
        self.charge = max(self.charge - ailments.drain * dt, 0.0)
        if ailments.jammed.any():  # the motor pulls as it can, against what holds the joint
            pull = np.clip(self._out.stiffness * (self._goal - self._q), -self._limit, self._limit)
            self._load[:] = np.where(ailments.jammed, pull / self.motor.stall_torque, self._load)

    def _protect(self, dt: float) -> float:
        """Age overload and heat by one step and shut down what they ask for; return the sum of the duties."""
        p = self.protection
        duty_sum, tripped = _age(
            self._load, self.temperature, self._temperature_limit, self._stalled_for, self._buckets[self._bucket],
            self._duty_sum, self._tripped, dt, self._wear,
        )  # fmt: skip
        self._bucket_time += dt
        if self._bucket_time >= p.mean_time / _BUCKETS - _EPS:
            self._bucket, self._bucket_time = (self._bucket + 1) % _BUCKETS, 0.0
            self._buckets[self._bucket] = 0.0
            self._duty_sum = self._buckets.sum(axis=0)
        if self._ailing:
            self._tripped |= self._ailments.tripped
            tripped = bool(self._tripped.any())
        if tripped:
            self._faults |= self._tripped
            down = (self._tripped & self.tables[:, dxl.SHUTDOWN.address] != 0) & (self._torque_limits != 0)
            if down.any():
                self._torque_limits[down] = 0
                self._others_changed = True
        return float(duty_sum)

    def _drain(self, duty_sum: float, dt: float) -> None:
        s, m = self.supply, self.motor
        self.current = s.computer_current + len(self) * m.standby_current + m.stall_current * duty_sum
        self.charge = max(self.charge - self.current * dt / (3600.0 * s.capacity_ah), 0.0)
        self.voltage = self._open_circuit() - s.resistance * self.current - self._ailments.sag

    def _open_circuit(self) -> float:
        return self.supply.empty_voltage + self.charge * (self.supply.full_voltage - self.supply.empty_voltage)

    def _control(self, dt: float) -> ServoCommand:
        out = self._out
        _pull(
            self._goal, self._speed * dt, self._limp, self._q, self._margin, self._stiffness,
            self._setpoint, out.setpoint, out.stiffness,
        )  # fmt: skip
        if self._ailing and self._ailments.jammed.any():
            return self._jam(out)
        return out

    def _jam(self, out: ServoCommand) -> ServoCommand:
        """The command with jammed joints held where they are, by more than their motors have."""
        jammed, stiffest = self._ailments.jammed, _JAM * self._stiffness.max(axis=0)
        return ServoCommand(
            np.where(jammed, self._jammed_at, out.setpoint),
            np.where(jammed, stiffest, out.stiffness),
            np.where(jammed, _JAM * self.motor.stall_torque, out.torque_limit),
        )

    def _aims(self) -> None:
        """Goals and speeds of the registers: what a host writes in every cycle."""
        self._aims_changed = False
        self._goal[:] = (self._goals - float(dxl.TICK_CENTRE)) * dxl.TICK_RAD
        speed = self._column(dxl.MOVING_SPEED)
        self._speed[:] = np.where(speed == 0, np.inf, speed * dxl.SPEED_RAD_S)

    def _settings(self) -> None:
        """Physical values of the other registers, made only when one of them has changed."""
        self._others_changed = False
        self._temperature_limit[:] = self._column(dxl.TEMPERATURE_LIMIT)

        # The AX-12A knows seven slopes, the powers of two; at an error of one slope it gives its full torque.
        for i, (margin, slope) in enumerate(
            [
                (dxl.CW_COMPLIANCE_MARGIN, dxl.CW_COMPLIANCE_SLOPE),
                (dxl.CCW_COMPLIANCE_MARGIN, dxl.CCW_COMPLIANCE_SLOPE),
            ]
        ):
            self._margin[i] = self._column(margin) * dxl.TICK_RAD
            steps = np.exp2(np.floor(np.log2(np.maximum(self._column(slope), 2))))
            self._stiffness[i] = self.motor.stall_torque / (steps * dxl.TICK_RAD)

        wheel_mode = (self._column(dxl.CW_ANGLE_LIMIT) == 0) & (self._column(dxl.CCW_ANGLE_LIMIT) == 0)
        limit = np.minimum(self._torque_limits, self._column(dxl.MAX_TORQUE)) / float(dxl.TORQUE_LIMIT.max)
        off = (self._column(dxl.TORQUE_ENABLE) == 0) | wheel_mode | self._ailments.unpowered
        self._limit[:] = np.where(off, 0.0, self.motor.stall_torque * limit)
        self._limp = self._limit == 0.0
        self._out.torque_limit[:] = self._limit

    def _column(self, register: dxl.Register) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """One register of all servos, a view of the tables."""
        return self.tables[:, register.address] if register.size == 1 else self._words[:, register.address // 2]

    def _after(self, s: float) -> tuple[Array, Array, Array]:
        """Angles [rad], speeds [rad/s] and loads (n,) a little after the last step: what a motor gives as its joint is then.

        Torques that acted in a step are of its beginning; they are shown only where nobody has said when that was.
        """
        if self._at_ns is None:
            return self._q, self._qd, self._load
        q, out = self._q + s * self._qd, self._out
        pull = np.clip(out.stiffness * (out.setpoint - q), -out.torque_limit, out.torque_limit)
        return q, self._qd, pull / self.motor.stall_torque

    def _position_ticks(self, row: int) -> int:
        return min(max(dxl.ticks_from_angle(float(self._q[row])), 0), dxl.TICK_MAX)

    def _refresh(self, after_ns: int) -> None:
        """Put what all servos measure so long after the last physics step into their tables, when somebody looks."""
        self._measured, self._shown_ns = True, after_ns
        words = [self._words[:, r.address // 2] for r in (dxl.PRESENT_POSITION, dxl.PRESENT_SPEED, dxl.PRESENT_LOAD)]
        position, before = words[0], words[0].copy() if self._ailing else None
        _measure(_UNITS, *self._after(after_ns * 1e-9), *words)
        if before is not None:
            off = np.clip(position + self._ailments.offset, 0, dxl.TICK_MAX)
            position[:] = np.where(self._ailments.frozen, before, off)
        self._column(dxl.PRESENT_VOLTAGE)[:] = min(max(round(self.voltage / dxl.VOLT_UNIT), 0), 255)
        temperature = np.minimum(np.maximum(np.rint(self.temperature), 0.0), 255.0)
        reads = self._ailments.reads_hot if before is not None else -1
        self._column(dxl.PRESENT_TEMPERATURE)[:] = np.where(reads >= 0, reads, temperature)
        self._column(dxl.MOVING)[:] = (np.abs(self._goal - self._setpoint) > dxl.TICK_RAD) & ~self._limp


def bank_of(model: str, servo_ids: Sequence[int], q: Array, battery_ah: float = Supply().capacity_ah) -> ServoBank:
    """Servos of a model, by its name, at joint angles q (n,) [rad], with the motors and the supply that go with it.

    What a battery holds [A h] counts where the supply is one.
    """
    motor, supply = _ELECTRICS[model]
    supply = replace(supply, capacity_ah=battery_ah)
    return ServoBank(servo_ids, dxl.MODEL_NAMED[model], motor, supply=supply, q=q)
