"""The bridge for servos with commands, such as the LX-16A, on a bus that is too slow for all goals and readings.

At 115 200 bit/s, 20 ms carry twelve goals and seven positions. The goals that have changed most are written, those of the
servos that the host names first before all others. Just before the state after the goals, these servos are read. The rest of
the time reads the others in turn, and ten times a second, in this order, a voltage and a temperature of the next servo in turn,
and the temperature of the hottest servo that answers.
"""

from . import wire
from .bridge import _ADOPTED, _STATE, AFTER_GOALS_US, FAR, FRESH_US, Firmware, _Servo
from .packets import BROADCAST_ID, READS, WRITES

GOALS_US = 20_000  # [us] period of the host's goals
IN_TURN = 4  # servos that are read in that time besides the first ones
LEAST_GOALS = 4  # number of goals in that time, at least
REPEATED = 2  # unchanged goals of them that are written again, because a lost one is not noticed
QUIET_US = 4_000  # [us] after the start of a request of the host in which no servo is read in turn, because it may ask again
TURN_US = 10_000  # [us] between two readings in turn at most, nevertheless
SLOW_US = 100_000  # [us] between readings of a voltage or a temperature

_TORQUE, _GOAL, _VOLTAGE, _TEMPERATURE = _ADOPTED, 3, 4, 5  # further kinds of a reading
_SLOW, _HOTTEST = (_VOLTAGE, _TEMPERATURE, _TEMPERATURE), 2  # kinds of the slow readings, and which is of the hottest servo
_BLOCKS = {_TORQUE: (32, 1), _GOAL: (2, 4), _STATE: (28, 2), _VOLTAGE: (27, 2), _TEMPERATURE: (26, 1)}  # command and size
_MOVES, _MODE = (1, 7), 29  # commands that set goals, and the mode, which is 0 for positions
_UNKNOWN_WAY = 10_000  # [0.1 mrad] 1 rad: way of a servo whose position is unknown, so that it is slow
_MAX_MS = 30_000  # [ms] longest time of a goal


class _CommandServo(_Servo):
    """Known state of one servo with commands."""

    def __init__(self, servo_id: int):
        super().__init__(servo_id)
        self.aim = self.speed = 0  # goal to be written, and its speed [1 mrad/s]
        self.sent_speed = 0  # of the last written goal
        self.sent_us = 0  # when that has left the board
        self.start = self.way_us = 0  # angle and time [us] of the way to it; 0 us for the highest speed
        self.voltage = self.temperature = 0  # read since the last position
        self.heat = 0  # [deg C] newest temperature


class CommandFirmware(Firmware):
    """Firmware between a host link and a bus of servos with commands."""

    _SERVO = _CommandServo
    _ADOPTED_BY = (_STATE, _TORQUE, _GOAL)

    def __init__(self, *settings: object):
        """Start without a session; the settings are those of `Firmware`."""
        super().__init__(*settings)  # type: ignore[arg-type]
        self._servos: list[_CommandServo] = []  # type: ignore[assignment]
        self._goal_us = self._bus.bytes_us(self._model.goals_size + self._model.protocol.OVERHEAD)
        self._reading_us = self._bus.reading_us(self._model.state_size)  # smoothed, with all delays
        self._is_new = False  # whether goals have arrived since `_to_write` was chosen
        self._all_again = False  # whether all goals are to be written, because torque on may have replaced them
        self._to_write: list[_CommandServo] = []  # their goals are still to be written
        self._urgent: list[_CommandServo] = []  # still to be read before the state after the goals
        self._ahead: list[_CommandServo] = []  # servos that the host has named for the newest goals
        self._urgent_us = 0  # [us] when reading them begins
        self._next = self._next_again = self._next_slow = 0  # turns of readings, repeated goals and slow readings
        self._slow_us = 0  # [us] time of the last slow reading
        self._turn_us = 0  # [us] time of the last reading in turn
        self._quiet_us = 0  # [us] time until which the host may ask again

    # ------------------------------------------------------------------------------------------------- commands

    def _greet(self, session: int, stamp_us: int, ids: bytes) -> None:
        if session != self._session:
            self._to_write, self._urgent, self._ahead = [], [], []
        super()._greet(session, stamp_us, ids)

    def _is_readable(self, address: int, size: int) -> bool:
        return READS.get(address) == size

    def _is_writable(self, address: int, size: int) -> bool:
        return WRITES.get(address) == size

    def _may_turn_on(self, address: int, data: bytes) -> bool:
        """Return whether a command may turn torque on; whether a goal does so is not published."""
        return address in _MOVES or (address in (self._model.torque_enable, _MODE) and bool(data[0]))

    def _turn_on(self) -> None:
        super()._turn_on()
        self._is_new = True

    def _turn_off(self) -> None:
        super()._turn_off()
        self._to_write, self._urgent = [], []

    def _align(self) -> None:
        """Note that goals have arrived, and when the servos that the host names are to be read."""
        super()._align()
        self._is_new = True
        self._ahead = [servo for servo in self._servos if servo.servo_id in self._first]
        self._first = b""
        self._urgent = list(self._ahead)
        # One packet more may be on its way at that time.
        self._urgent_us = self._now_us + AFTER_GOALS_US - (len(self._urgent) + 1) * self._reading_us

    # ----------------------------------------------------------------------------------------------------- time

    def _tick(self) -> None:
        super()._tick()
        self._round_due = False  # servos are read all the time
        for servo in self._servos:
            if servo.state[3] or servo.state[4]:  # a state has a voltage or a temperature once
                servo.state = servo.state[:3] + (0, 0)

    @property
    def due_us(self) -> int:
        """Latest time [us] of the next `step` if no bytes arrive."""
        due_us = super().due_us
        return min(due_us, max(self._bus.due_us, self._quiet_us)) if self._session else due_us

    # -------------------------------------------------------------------------------------------------- the bus

    def _next_packet(self) -> bytes:
        """Return the most urgent packet to the servos.

        The order is: torque off, torque on after all goals, requests of the host, urgent readings, goals, the next reading.
        """
        if self.mode in (wire.WAITING, wire.ADOPTING):
            return super()._next_packet()
        if not self._torque_off_due and not self._torque_on_due:
            packet = self._next_question()
            if packet:
                return packet
            if self._urgent and self._now_us >= self._urgent_us:
                self._to_read = [self._reading_of(self._urgent.pop(0))]
                return self._next_reading()
        return super()._next_packet()

    def _next_reading(self) -> bytes:
        if self._servos and not self._to_read and self._now_us >= self._quiet_us:
            self._turn_us = self._now_us
            self._to_read = [self._reading_in_turn()]
        return super()._next_reading()

    def _reading_in_turn(self) -> tuple:
        """Return the next reading of the servos in turn."""
        count = len(self._servos)
        if self._now_us - self._slow_us >= SLOW_US:
            self._slow_us = self._now_us
            self._next_slow = (self._next_slow + 1) % (len(_SLOW) * count)
            turn = self._next_slow % len(_SLOW)
            hottest = max(self._servos, key=lambda servo: servo.heat if self._answers(servo) else 0)
            return hottest if turn == _HOTTEST else self._servos[self._next_slow // len(_SLOW)], _SLOW[turn], 1
        for _ in range(count):
            self._next = (self._next + 1) % count
            if self._servos[self._next] not in self._ahead:
                break
        return self._reading_of(self._servos[self._next])

    def _reading_of(self, servo: _CommandServo) -> tuple:
        """Return the reading of a position; one that gets lost is repeated, but not that of a silent servo."""
        return servo, _STATE, 2 if self._answers(servo) else 1

    def _answers(self, servo: _CommandServo) -> bool:
        """Return whether a servo has answered lately."""
        return servo.asked_us is not None and self._now_us - servo.asked_us < FRESH_US

    def _goals_packet(self) -> bytes:
        """Return the packet of the next goal. New goals replace those that wait, but not while torque on waits for them."""
        if self._is_new and not (self._torque_on_due and self._to_write):
            self._choose_goals()
        servo = self._to_write.pop(0)
        self._goals_due = bool(self._to_write)
        position = None if servo.asked_us is None else servo.state[0]
        ms = self._way_ms(servo, position)
        servo.goal, servo.sent_speed = servo.aim, servo.speed
        servo.start, servo.way_us = servo.aim if position is None else position, ms * 1000
        servo.sent_us = self._now_us + self._goal_us
        return self._model.protocol.write(servo.servo_id, self._model.goals_address, self._model.goal(servo.aim, ms))

    def _way_ms(self, servo: _CommandServo, position: int | None) -> int:
        """Return the time [ms] of the way to the next goal of a servo, 0 without a limit of its speed."""
        if not servo.speed:
            return 0
        way = _UNKNOWN_WAY if position is None else abs(servo.aim - position)
        return min((way * 100 + servo.speed - 1) // servo.speed, _MAX_MS)

    def _choose_goals(self) -> None:
        """Choose the goals to write: of the servos that the host names, then those that have changed most."""
        assert self._goals is not None
        servos, everything = self._servos, self._torque_on_due or self._all_again
        self._is_new = self._all_again = False
        changes = []  # each with the index of its servo, so that all differ
        for index, aim in enumerate(self._next_goals()):
            servo = servos[index]
            servo.aim, servo.speed = aim, self._goals[2][index]
            change = abs(aim - servo.goal) if servo.goal is not None else _UNKNOWN_WAY
            change += servo.speed != servo.sent_speed
            if servo in self._ahead:
                changes.append(((1 << 20) - index, servo))
            elif change or everything:
                changes.append((((change + 1) << 5) - index, servo))
        left = GOALS_US - (len(self._ahead) + IN_TURN) * self._reading_us
        most = len(servos) if everything else max(left // self._goal_us, LEAST_GOALS)
        changes.sort(key=lambda found: -found[0])
        self._to_write = [servo for _, servo in changes[:most]]
        for _ in range(min(most - len(self._to_write), REPEATED)):
            self._next_again = (self._next_again + 1) % len(servos)
            if servos[self._next_again] not in self._to_write:
                self._to_write.append(servos[self._next_again])

    def _torque_on_packet(self) -> bytes:
        self._goals_due = self._is_new = self._all_again = True
        return self._model.protocol.write(BROADCAST_ID, self._model.torque_enable, b"\1")

    def _ask_question(self, question: list) -> bytes:
        """Start a request of the host; one that writes has no answer."""
        sequence, servo_id, instruction, address, _, data = question
        self._quiet_us = min(self._now_us + QUIET_US, self._turn_us + TURN_US)
        if instruction != wire.WRITE:
            return super()._ask_question(question)
        self._to_host += wire.answer(self._session, sequence, wire.ANSWERED, 0, b"")
        return self._bus.tell(self._model.protocol.write(servo_id, address, data), self._now_us)

    def _block(self, kind: int) -> tuple:
        return _BLOCKS[kind]

    def _take(self, servo: _CommandServo, kind: int, began_us: int, code: int, data: bytes) -> None:  # type: ignore[override]
        if kind == _TORQUE:
            servo.torque = bool(data[0])
        elif kind == _GOAL:
            servo.goal = self._model.position(data[:2])
        elif kind == _VOLTAGE:
            servo.voltage = min(self._model.voltage(data[0] | data[1] << 8), 0xFF)
        elif kind == _TEMPERATURE:
            servo.temperature = servo.heat = data[0]
        else:
            self._take_position(servo, began_us, self._model.position(data))

    def _take_position(self, servo: _CommandServo, began_us: int, position: int | None) -> None:
        """Store a position, with the load of the position controller and what else was read since the last state."""
        if position is None:
            self._bus.garbled += 1
            return
        self._reading_us += (self._now_us - began_us - self._reading_us) // 8
        load = 0
        if servo.goal is not None and self.mode not in (wire.ADOPTING, wire.OFF):
            goal, since_us = servo.goal, began_us - servo.sent_us
            if 0 <= since_us < servo.way_us:
                goal = servo.start + (goal - servo.start) * since_us // servo.way_us
            load = self._model.spring_load(goal - position)
        voltage, temperature = servo.voltage or servo.state[3], servo.temperature or servo.state[4]
        servo.asked_us, servo.state = began_us, (position, 0, load, voltage, temperature)
        servo.voltage = servo.temperature = 0

    def _take_over(self) -> None:
        """Leave mode ADOPTING. A position replaces a goal that is more than 10 deg away from it."""
        for servo in self._servos:
            position = None if servo.asked_us is None else servo.state[0]
            if servo.goal is None or position is None or abs(servo.goal - position) > FAR:
                servo.goal = position
        super()._take_over()
