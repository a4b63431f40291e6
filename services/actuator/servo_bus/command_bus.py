"""Servo bus driver for servos with commands instead of registers, such as the LX-16A.

Their bus is slow: at 115 200 bit/s a goal takes 0.87 ms, and a position 1.2 ms and the time of the adapter. So a cycle of 20 ms
has no time for 18 goals and 18 positions. Within the budget of a call, `poll` reads the positions of about four servos, the
urgent ones first. The goals of the urgent ones and those that have changed most get the rest of the cycle, and the others
follow in the next one.

A write is not answered, so what is written outside the loop is read again. A position is the only value that is read in
every turn. Every fifth call reads, in this order, a voltage and a temperature of the next servo in turn, and the temperature of
the hottest servo that answers.
"""

import math
from collections.abc import Callable, Generator, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from sextant.services.actuator.servo_bus.bus_driver import REPLY_TIMEOUT_NS, Polling, Port, ServoBus
from sextant.services.actuator.servo_bus.group_writes import whole
from sextant.services.actuator.servo_bus.reading_validation import State
from sextant.services.actuator.servo_bus.servo_reading import PositionReadings, ServoReading
from sextant.shared.servo.servo_model import Feedback, Register, ServoError, ServoModel

_CYCLE_NS = 20_000_000  # [ns] in which the positions are read and the goals are sent
_MARGIN_NS = 500_000  # [ns] of it that stays free
_LEAST_GOALS = 4  # sent in a cycle that reading has used up
_LONGEST_NS = 4_000_000  # [ns] of goals on the wire for which a read still waits
_OVERDUE_NS = 200_000_000  # [ns] without a request after which a servo comes before the urgent ones: ten cycles
_SLOW_EVERY = 5  # calls, in one of which a voltage or a temperature is read
_SLOW_TURNS, _VOLTAGE_TURN, _HOTTEST_TURN = 3, 0, 2  # of these; in the others the temperature of the next servo is read
_REPEATED = 2  # unchanged goals in a cycle that are sent again, because a lost one is not noticed
_VOLTAGE_LEAP_V, _TEMPERATURE_LEAP_K = 0.8, 5.0  # from the last reading, beyond which a value is read once more
_UNKNOWN = -1_000_000  # [ticks] of a goal that a servo does not have
_NOISY_NS = 1_000_000_000  # [ns] after a lost request for which the bus counts as noisy
_ZEROS = bytes(16)  # more than the rest of any packet
_BITS_PER_BYTE = 10


def bus_of(model: ServoModel) -> type[ServoBus]:
    """Return the driver of servos of a model."""
    return ServoBus if model.commands is None else CommandBus


class CommandBus(ServoBus):
    """Driver for a fixed list of servos with commands; arrays are in the order of that list."""

    def __init__(
        self,
        port: Port,
        servo_ids: Sequence[int],
        clock: Callable[[], int],
        *,
        model: ServoModel,
        models: Mapping[int, ServoModel] | None = None,
        rows: Sequence[int] | None = None,
        names: Mapping[int, str] | None = None,
        echo: bool = False,
        reply_timeout_ns: int = REPLY_TIMEOUT_NS,
        lock: bool = False,
        stiffness: Sequence[float] | None = None,
    ) -> None:
        """Take over an open port, see `ServoBus`.

        Args:
            port: Open port.
            servo_ids: Ids that the protocol allows, all different.
            clock: Monotonic time [ns].
            model: The type of the servos, which do not tell it.
            models: The types of servos by id, where they differ from `model`; they have the same commands.
            rows: Indices of the servos in their readings, by default those in the list.
            names: Leg and joint of each id, for messages.
            echo: The adapter returns every byte sent.
            reply_timeout_ns: [ns] timeout of an answer.
            lock: Has no effect: the servos have no lock.
            stiffness: (n,) [1/rad] share of the stall torque per position error, those of the models by default.

        Raises:
            ValueError: An id out of range or given twice, or a model with registers.
        """
        if model.commands is None:
            raise ValueError(f"a model with commands expected, found {model.name}")
        self._commands = model.commands
        self._units = model.units
        super().__init__(
            port,
            servo_ids,
            clock,
            model=model,
            models=models,
            rows=rows,
            names=names,
            echo=echo,
            reply_timeout_ns=reply_timeout_ns,
            lock=lock,
        )
        n = len(self.servo_ids)
        own = [self.model_of(i).gain_stiffness for i in self.servo_ids]
        self._readings = PositionReadings(self._units, own if stiffness is None else stiffness)
        self._overdue_ns, self._most_late = _OVERDUE_NS, 1  # all of them would take the time of landing legs
        self._pulls = True  # whether torque may be on; without it no goals are sent, because they may turn it on
        self._goals = np.full(n, _UNKNOWN, dtype=np.int64)  # [ticks] wanted, and sent last
        self._sent = self._goals.copy()
        self._speeds = np.zeros(n, dtype=np.int64)  # goal speed registers wanted, and sent last
        self._sent_speeds = self._speeds.copy()
        self._sent_ns = np.zeros(n, dtype=np.int64)
        self._ways = [(0.0, 0.0, 0)] * n  # [rad] start and goal, and [ns] duration of the last goal sent
        self._angles = [math.nan] * n  # [rad] by the newest readings
        goal, time = self._table.goal_position, self._table.goal_time
        self._goal_at, self._goal_size = goal.address, goal.size + (time.size if time else 0)
        byte_ns = _BITS_PER_BYTE * 1_000_000_000 // model.bus_rate
        self._byte_ns, self._goal_ns = byte_ns, (self._protocol.OVERHEAD + self._goal_size) * byte_ns
        self._busy_until_ns = 0  # [ns] until which goals are on the wire
        self._began_ns = -_CYCLE_NS  # [ns] beginning of the last `poll`
        self._urgent: tuple[int, ...] = ()  # servos that it had to read first
        self._calls = self._slow = 0
        self._voltage: float | None = None  # [V] last one of any servo
        self._slow_values = [[math.nan, math.nan] for _ in range(n)]  # [V] and [deg C] of each servo
        self._new = [Feedback.NONE] * n  # which of them no reading has reported yet

    # ----------------------------------------------------------------------------------------------- outside the loop

    def read_bytes(self, servo_id: int, address: int, size: int) -> bytes | None:
        """Return bytes of the table, by all commands that read some of them; those of the model without a request."""
        table = bytearray(self.model_of(servo_id).factory_table())
        for first, count in self._commands.inside(address, size):
            answer = self._ask(self._protocol.read(servo_id, first, count), servo_id, count)
            if answer is None:
                return None
            table[first : first + count] = answer.parameters
        return bytes(table[address : address + size])

    def write(self, servo_id: int, register: Register, value: int) -> bool:
        """Write one value, with those of its command as they are, and return whether the servo then has it.

        Raises:
            ValueError: The value is outside the register's range.
        """
        encoded = register.encode(value)
        if register is self._table.goal_speed and servo_id in self._index:
            self._speeds[self._index[servo_id]] = value
            return True
        request = self._request(servo_id, register, encoded)
        if request is None:
            return False
        self.between()
        self._line.send(request)
        return self.read(servo_id, register) == value

    def write_unacknowledged(self, servo_id: int, register: Register, value: int) -> None:
        """Write a value without reading it again."""
        request = self._request(servo_id, register, register.encode(value))
        if request is not None:
            self._line.send(request)

    def _request(self, servo_id: int, register: Register, encoded: bytes) -> bytes | None:
        """Return the command that writes a value; None if no command does, or the servo does not answer."""
        if not self.model.has(register):
            return None
        first, size = self._commands.inside(register.address, register.size)[0]
        if register is self._table.goal_position and servo_id in self._index:
            index, position = self._index[servo_id], self.read(servo_id, self._table.present_position)
            self._angles[index] = math.nan if position is None else self._units.angle(self.model.position(position))
            return self._protocol.write(servo_id, first, encoded + self._time_ms(index, int.from_bytes(encoded, "little")))
        if size == register.size:
            return self._protocol.write(servo_id, first, encoded)
        before = self.read_bytes(servo_id, first, size)
        if before is None:
            return None
        at = register.address - first
        return self._protocol.write(servo_id, first, before[:at] + encoded + before[at + register.size :])

    # --------------------------------------------------------------------------------------------------- in the loop

    def sync_write_goals(self, goal_ticks: ArrayLike, speed_ticks: ArrayLike = 0) -> None:
        """Set the goals and speeds of all servos, and send as many as the rest of the cycle has time for.

        The changed goals of servos that `poll` had to read first come first, then those that have changed most; some that have
        not changed are repeated. With torque off, goals wait: whether a goal turns torque on is not published.

        Args:
            goal_ticks: (n,) goal positions.
            speed_ticks: (n,) or one goal speed, 0 for no limit.

        Raises:
            ValueError: A value out of range, not a whole number, or of another shape.
            BusDisconnectedError: The port is gone.
        """
        n = len(self)
        self._goals = np.broadcast_to(whole(goal_ticks, self._table.goal_position, n), (n,)).copy()
        self._speeds = np.broadcast_to(whole(speed_ticks, self._table.goal_speed, n), (n,)).copy()
        self._validator.sent(self._goals.tolist())
        if self._pulls:
            now_ns = self._clock()
            used = now_ns - self._began_ns
            left = _CYCLE_NS - _MARGIN_NS - (used if used < _CYCLE_NS else 0)
            self._send_goals(max(left // self._goal_ns, _LEAST_GOALS), now_ns)

    def _send_goals(self, most: int, now_ns: int) -> None:
        """Send up to `most` goals."""
        far = np.abs(self._goals - self._sent) + (self._speeds != self._sent_speeds)
        changed = np.flatnonzero(far)
        # A landing leg that lags its goal because it was not sent would seem to have met ground.
        chosen = changed[np.lexsort((-far[changed], ~np.isin(changed, self._urgent)))][:most].tolist()
        same = np.flatnonzero(far == 0)
        chosen += same[np.argsort(self._sent_ns[same], kind="stable")][: min(most - len(chosen), _REPEATED)].tolist()
        packets = []
        for index in chosen:
            ticks = int(self._goals[index])
            time = self._time_ms(index, ticks)
            data = ticks.to_bytes(self._table.goal_position.size, "little") + time
            packets.append(self._protocol.write(self.servo_ids[index], self._goal_at, data))
            goal, start, ms = self._units.angle(ticks), self._angles[index], int.from_bytes(time, "little")
            self._ways[index] = (goal if math.isnan(start) or not ms else start), goal, ms * 1_000_000
            self._sent[index], self._sent_speeds[index] = ticks, self._speeds[index]
        if packets:
            began_ns = max(self._busy_until_ns, now_ns)
            self._put(b"".join(packets), now_ns)
            self._sent_ns[chosen] = began_ns + np.arange(1, len(chosen) + 1) * self._goal_ns  # when each packet has ended

    def _put(self, data: bytes, now_ns: int) -> None:
        """Send bytes, and note for how long they keep the wire busy."""
        self._line.send(data)
        self._busy_until_ns = max(self._busy_until_ns, now_ns) + len(data) * self._byte_ns

    def _time_ms(self, index: int, ticks: int) -> bytes:
        """Return the time of a goal [ticks] at its servo's goal speed, encoded; 0 without a limit of the speed."""
        register = self._table.goal_time
        if register is None:
            return b""
        speed, ms = int(self._speeds[index]) * self._units.speed_rad_s, 0
        if speed > 0.0:
            start = self._angles[index]
            way = 1.0 if math.isnan(start) else abs(self._units.angle(ticks) - start)  # without a position: slowly
            ms = min(math.ceil(way / speed * 1e3), register.max)
        return register.encode(ms)

    def set_torque(self, enabled: bool) -> None:
        """Turn the torque of all servos on or off, see `ServoBus`. Goals that wait are sent before it is turned on."""
        enable, everyone = self._table.torque_enable, self._protocol.BROADCAST_ID
        if enabled:
            if not self._pulls and self._goals[0] != _UNKNOWN:
                self._sent[:] = _UNKNOWN
                self._send_goals(len(self), self._clock())
        elif self._loss.within(self._clock(), _NOISY_NS):
            self._line.send(_ZEROS)
        self._pulls = enabled
        for _ in range(1 if enabled else 2):
            self._put(self._protocol.write(everyone, enable.address, enable.encode(int(enabled))), self._clock())
        if enabled:
            self._sent[:] = _UNKNOWN  # whether it makes the present position the goal is not published

    def polling(self, budget_ns: int, first: Sequence[int] = ()) -> Polling:
        """Read positions within a time budget, see `ServoBus`; in some calls also the voltage or temperature of one servo."""
        began = self._began_ns = self._clock()
        self._urgent = tuple(first)
        if budget_ns <= 0 or self._busy_until_ns - began > _LONGEST_NS:  # goals of all servos are on the wire
            return []
        self._calls += 1
        if self._calls % _SLOW_EVERY == 0:
            index = yield from self._read_slowly(began + budget_ns)
            first = (index, *(i for i in first if i != index))  # its reading reports it
        return (yield from super().polling(max(began + budget_ns - self._clock(), 1), first))

    # ----------------------------------------------------------------------------------------------- below the words

    def _state_bytes(self, model: ServoModel) -> tuple[int, int]:
        register = model.table.present_position
        return register.address, register.size

    def _state_in(self, index: int, stamp_ns: int, data: bytes, error: int) -> State:
        return State(stamp_ns, self.model.position(int.from_bytes(data, "little")), 0, 0, 0, 0, error)

    def _reading_of(self, index: int, state: State, error: ServoError) -> ServoReading:
        volts, degrees = self._slow_values[index]
        new, self._new[index] = self._new[index], Feedback.NONE
        voltage = round(volts / self._units.volt) if Feedback.VOLTAGE in new else 0
        state = state._replace(voltage=voltage, temperature=round(degrees) if Feedback.TEMPERATURE in new else 0)
        goal = self._goal_angle(index, state.stamp_ns)
        told_ns = int(self._sent_ns[index])
        found = self._readings.reading(index, self.servo_ids[index], told_ns, state, goal, new)
        self._angles[index] = found.position
        found.index = self._rows[index]
        return found

    def _goal_angle(self, index: int, now_ns: int) -> float:
        """Return the angle [rad] that a servo controls: on the way to its last goal, or this goal; NaN without torque."""
        if not self._pulls or self._sent[index] == _UNKNOWN:
            return math.nan
        start, goal, duration_ns = self._ways[index]
        since_ns = now_ns - int(self._sent_ns[index])
        return goal if not 0 <= since_ns < duration_ns else start + (goal - start) * since_ns / duration_ns

    def _read_slowly(self, end_ns: int) -> Generator[None, None, int]:
        """Read the next voltage or temperature, and return the index of its servo; see `ServoBus.polling`."""
        index, turn = divmod(self._slow, _SLOW_TURNS)
        self._slow = (self._slow + 1) % (_SLOW_TURNS * len(self))
        kind = int(turn != _VOLTAGE_TURN)
        if turn == _HOTTEST_TURN:
            degrees = np.nan_to_num([degrees for _, degrees in self._slow_values])
            index = int(np.argmax(np.where(self.missed, 0.0, degrees)))
        if self.missed[index]:  # it costs a timeout, and its position tells when it is back
            return index
        register, unit, leap, flag = (
            (self._table.present_voltage, self._units.volt, _VOLTAGE_LEAP_V, Feedback.VOLTAGE),
            (self._table.present_temperature, 1.0, _TEMPERATURE_LEAP_K, Feedback.TEMPERATURE),
        )[kind]
        servo_id = self.servo_ids[index]
        last = self._slow_values[index][kind] if kind or self._voltage is None else self._voltage
        request = self._protocol.read(servo_id, register.address, register.size)
        for _ in range(2):
            start = self._clock()
            if start > end_ns:
                break
            self._line.ask(request, start)
            yield
            answer = self._line.answer(servo_id, register.size, end_ns, start)
            self._loss.note(self._clock(), answer is None)
            if answer is None:
                break
            value = int.from_bytes(answer.parameters, "little") * unit
            if abs(value - last) <= leap:
                self._slow_values[index][kind] = value
                self._voltage = self._voltage if kind else value
                self._new[index] |= flag
                break
            last = value  # a leap is believed if the next reading agrees
        return index
