"""The bridge: a microcontroller that controls the servo bus for a host; see docs/bridge.md.

It is a state machine without clock, thread or port: inputs are time and bytes, outputs are bytes. It turns torque on or off
only by command. Without fresh goals it keeps the last ones.
"""

from . import wire
from .bus import BusMaster
from .packets import BROADCAST_ID
from .servo import ServoModel

CYCLE_US = 10_000  # [us] period in which each servo is read once and a state is sent
AFTER_GOALS_US = 12_000  # [us] after goals at which a state is sent, so that it arrives before the next goals are computed
GREETING_US = 100_000  # [us] period of Welcome messages before a session
ATTEMPTS = 3  # attempts to read a servo in mode ADOPTING
NEAR = 314  # [0.1 mrad] 1.8 deg: distance between received and last written goals at which catching up ends
CATCH_UP_SPEED = 5236  # [0.1 mrad/s] 30 deg/s: speed of catching up
FAR = 1745  # [0.1 mrad] 10 deg: maximum distance of a goal from its servo for turning torque on
FRESH_US = 200_000  # [us] maximum age of readings for turning torque on
QUESTIONS = 4  # maximum number of waiting requests
ALERT_US = 100_000  # [us] after which the hardware errors of a servo that alerts are read again

_COUNT = 0xFFFF_FFFF  # counters wrap to 0 after this value
_STATE, _ADOPTED, _HARDWARE = 0, 1, 2  # kinds of a reading


class _Servo:
    """Known state of one servo; angles are in 0.1 mrad."""

    def __init__(self, servo_id: int):
        self.servo_id = servo_id
        self.asked_us: int | None = None  # time of the request of the newest reading
        self.state: tuple = (0, 0, 0, 0, 0)  # position, speed, load, voltage, temperature
        self.error = 0
        self.hardware_error = 0  # read after an alert, until it ends
        self.alert_us: int | None = None  # when that was last requested
        self.torque: bool | None = None  # torque state read in mode ADOPTING, None without a response
        self.goal: int | None = None  # last written goal, or the one read in mode ADOPTING; None if unknown


class Firmware:
    """Firmware between a host link and a servo bus."""

    _SERVO: type = _Servo
    _ADOPTED_BY: tuple = (_ADOPTED,)  # kinds of readings in mode ADOPTING

    def __init__(
        self,
        boot: int,
        servo: str,
        name: str,
        now_us: int = 0,
        baud_rate: int = 1_000_000,
        cycle_us: int = CYCLE_US,
    ):
        """Start without a session and without access to the bus.

        Args:
            boot: Boot number, different from that of the last boot.
            servo: Model of all servos, a name in models.py.
            name: Name of board and firmware.
            now_us: Current time [us].
            baud_rate: [bit/s] of the servo bus.
            cycle_us: [us] period of states and readings; longer for a slow board.

        Raises:
            ValueError: The table has no such servo.
        """
        self.mode = wire.WAITING
        self._boot, self._name = boot, name
        self._cycle_us = cycle_us
        self._model: ServoModel
        self._bus: BusMaster
        self._open(servo, baud_rate, now_us)
        self._now_us = now_us
        self._from_host = wire.Receiver()
        self._to_host = b""
        # Session.
        self._session = 0
        self._servos: list[_Servo] = []
        self._heard = 0  # sequence of the newest accepted command
        self._host_clock = wire.RemoteClock()
        self._goals: tuple | None = None  # newest goals: lifetime [us], angles, speeds
        self._goals_us = 0  # their time of arrival
        self._goals_due = False  # whether they are still to be written
        self._written_us = 0
        self._limits: tuple | None = None  # [0.1 %] to be written
        self._first = b""  # ids of the servos that the next goals go to first
        self._torque_on_due = self._torque_off_due = False
        self._off_ordered = False
        self._questions: list[list] = []  # sequence, servo id, instruction, address, size and data of each
        # Servo bus.
        self._to_read: list[tuple] = []  # servo, kind of reading and remaining attempts of each
        # State messages.
        self._tick_us = now_us + self._cycle_us
        self._ticked_us = now_us
        self._round_us = 0  # [us] that one reading of all servos takes, with a margin
        self._round_began_us = 0
        self._round_due = False  # whether all servos are still to be read in this cycle
        self._state_sequence = 0
        self._refusal, self._refused = wire.NONE, 0

    def _open(self, servo: str, baud_rate: int, now_us: int) -> None:
        self._model = ServoModel(servo)
        self._bus = BusMaster(self._model.protocol, wire.MAX_TABLE, baud_rate, now_us)

    @property
    def due_us(self) -> int:
        """Latest time [us] of the next `step` if no bytes arrive."""
        due_us = self._tick_us - self._round_us if self._round_due and not self._to_read else self._tick_us
        return min(due_us, self._bus.due_us) if self._bus.waits or self._has_work() else due_us

    def step(self, now_us: int, from_host: bytes = b"", from_bus: bytes = b"") -> tuple:
        """Process received bytes, and return the bytes to send: to the host, and to the servos.

        Args:
            now_us: Current time [us], monotonic.
            from_host: Bytes received from the host.
            from_bus: Bytes received from the servos.
        """
        self._now_us = now_us
        # 1. Process responses and timeouts of servos.
        for about, began_us, packet in self._bus.hear(from_bus, now_us):
            self._learn(about, began_us, packet)
        # 2. Process messages of the host.
        if from_host:
            for message in self._from_host.feed(from_host):
                self._obey(message)
        # 3. Process the time.
        self._judge_freshness()
        if now_us >= self._tick_us:
            self._tick()
        if self._round_due and not self._to_read and now_us >= self._tick_us - self._round_us:
            self._round_due, self._round_began_us = False, now_us
            self._to_read = [(servo, _STATE, 1) for servo in self._servos]
        # 4. Start the next packet to the servos.
        to_bus = b"" if self._bus.waits or now_us < self._bus.due_us else self._next_packet()
        to_host, self._to_host = self._to_host, b""
        return to_host, to_bus

    # ------------------------------------------------------------------------------------------------- commands

    def _obey(self, message: list) -> None:
        code = message[0]
        if code == wire.HELLO:
            if len(message) == 2:
                self._refuse(wire.OTHER_VERSION)
                self._welcome()
            else:
                self._greet(message[2], message[3], message[4])
            return
        session, sequence, stamp_us = message[1:4]
        if code == wire.TORQUE and not message[4]:
            self._turn_off()
        elif code == wire.GOALS:
            lifetime_ms, angles, speeds = message[4:]
            if self._admits(session, sequence, stamp_us, lifetime_ms, len(angles)):
                self._goals, self._goals_us, self._goals_due = (lifetime_ms * 1000, angles, speeds), self._now_us, True
                self._align()
        elif code == wire.LIMITS:
            if self._admits(session, sequence, stamp_us, wire.ORDER_LIFETIME_MS, len(message[4])):
                if self._model.limit_size:
                    self._limits = message[4]
                else:
                    self._refuse(wire.QUESTION)
        elif self._admits(session, sequence, stamp_us, wire.ORDER_LIFETIME_MS, len(self._servos)):
            if code == wire.TORQUE:
                self._turn_on()
            elif code == wire.FIRST:
                self._first = message[4]
            else:
                self._take_question(sequence, message[4:])

    def _greet(self, session: int, stamp_us: int, ids: bytes) -> None:
        """Open a session unless it is already open.

        A new session discards the state of the previous one.
        """
        if session != self._session:
            self._session, self._heard = session, 0
            self._servos = [self._SERVO(servo_id) for servo_id in ids]
            self._host_clock = wire.RemoteClock()
            self._goals, self._goals_due, self._torque_on_due = None, False, False
            self._limits = None
            self._questions = []
            self._bus.forget()
            self._first = b""
            self._to_read = [(servo, kind, ATTEMPTS) for kind in self._ADOPTED_BY for servo in self._servos]
            self._round_due = False
            reading_us = self._bus.reading_us(self._model.state_size)
            self._round_us = min(len(ids) * reading_us * 5 // 4, self._cycle_us)
            self.mode = wire.ADOPTING
        self._host_clock.age_us(stamp_us, self._now_us)
        self._welcome()

    def _admits(self, session: int, sequence: int, stamp_us: int, lifetime_ms: int, count: int) -> bool:
        """Return whether a command is accepted.

        It must belong to the session, be newer than the last one, be fresh, and have one value per servo.
        """
        if not self._session or session != self._session:
            return self._refuse(wire.SESSION)
        if sequence <= self._heard:
            return self._refuse(wire.ORDER)
        if self._host_clock.age_us(stamp_us, self._now_us) > lifetime_ms * 1000:
            return self._refuse(wire.AGE)
        if count != len(self._servos):
            return self._refuse(wire.COUNT)
        self._heard = sequence
        return True

    def _turn_off(self) -> None:
        """Turn torque off and discard the goals.

        Torque off is repeated in each cycle until a torque-on command.
        """
        self._off_ordered = self._torque_off_due = True
        self._torque_on_due = self._goals_due = False
        self._goals = None
        if self._session and self.mode != wire.ADOPTING:
            self.mode = wire.OFF

    def _turn_on(self) -> None:
        """Turn torque on if the goals are fresh and each servo is near its goal."""
        if self.mode == wire.ADOPTING or not self._fresh():
            self._refuse(wire.NO_GOALS)
        elif not all(map(self._is_near, range(len(self._servos)))):
            self._refuse(wire.FAR)
        else:
            self._off_ordered = self._torque_off_due = False
            self._torque_on_due = self._goals_due = True
            self.mode = wire.ON

    def _is_near(self, index: int) -> bool:
        """Return whether a servo was read lately and is near its goal."""
        servo = self._servos[index]
        if self._goals is None or servo.asked_us is None or self._now_us - servo.asked_us > FRESH_US:
            return False
        return bool(abs(servo.state[0] - self._goals[1][index]) <= FAR)

    def _take_question(self, sequence: int, question: list) -> None:
        refusal = self._objection(question)
        if refusal == wire.NONE:
            self._questions.append([sequence] + question)
        else:
            self._refuse_question(sequence, refusal)

    def _refuse_question(self, sequence: int, why: int) -> None:
        self._refuse(why)
        self._to_host += wire.answer(self._session, sequence, wire.REFUSED, 0, b"")

    def _objection(self, question: list) -> int:
        """Return why a request may not be sent to a servo, NONE if it may."""
        servo_id, instruction, address, size, data = question
        if instruction == wire.READ:
            valid = size and not data and self._is_readable(address, size)
        elif instruction == wire.WRITE:
            valid = data and not size and self._is_writable(address, len(data))
        else:
            known = instruction == wire.PING or (instruction == wire.REBOOT and self._model.protocol.reboot(servo_id))
            valid = known and not address and not size and not data
        if not valid:
            return wire.QUESTION
        refusal = self._torque_objection(question)
        return wire.BUSY if refusal == wire.NONE and len(self._questions) >= QUESTIONS else refusal

    def _is_readable(self, address: int, size: int) -> bool:
        return address + size <= self._model.size

    def _is_writable(self, address: int, size: int) -> bool:
        return address + size <= self._model.size

    def _may_turn_on(self, address: int, data: bytes) -> bool:
        """Return whether a write may turn torque on."""
        at = self._model.torque_enable - address
        return 0 <= at < len(data) and bool(data[at])

    def _torque_objection(self, question: list) -> int:
        """Return why a request may not turn torque on, NONE if it may or does not.

        It may do so for one servo near its goal while torque is ordered on: this ends the shutdown of some servos.
        """
        servo_id, instruction, address, _, data = question
        if instruction != wire.WRITE or not self._may_turn_on(address, data):
            return wire.NONE
        indices = [index for index, servo in enumerate(self._servos) if servo.servo_id == servo_id]
        if data != b"\1" or self.mode != wire.ON or not indices:
            return wire.QUESTION
        return wire.NONE if self._is_near(indices[0]) else wire.FAR

    def _refuse(self, why: int) -> bool:
        self._refusal, self._refused = why, (self._refused + 1) & _COUNT
        return False

    # ----------------------------------------------------------------------------------------------------- time

    def _fresh(self) -> bool:
        """Return whether the newest goals are within their lifetime."""
        return self._goals is not None and self._now_us - self._goals_us <= self._goals[0]

    def _judge_freshness(self) -> None:
        """Change to HOLDING without fresh goals, and to CATCHING_UP when they return."""
        if self.mode in (wire.ON, wire.CATCHING_UP) and not self._fresh():
            self.mode = wire.HOLDING
        elif self.mode == wire.HOLDING and self._fresh():
            self.mode = wire.CATCHING_UP

    def _align(self) -> None:
        """Let a cycle end at a fixed time after goals, so that the readings before its end are not those of changing goals.

        A cycle takes twice its period at most.
        """
        tick_us = self._now_us + AFTER_GOALS_US % self._cycle_us
        if tick_us - self._ticked_us <= 2 * self._cycle_us:
            self._tick_us = tick_us

    def _tick(self) -> None:
        """Start a cycle: send the state, and let all servos be read at the end of the cycle.

        Without a session, send a Welcome message instead.
        """
        if not self._session:
            self._tick_us = self._now_us + GREETING_US
            self._welcome()
        else:
            late = self._now_us - self._tick_us
            self._tick_us = self._now_us + self._cycle_us - late % self._cycle_us
            self._round_due = True
            self._to_host += self._state()
        self._ticked_us = self._now_us
        self._torque_off_due = self._torque_off_due or self._off_ordered

    # -------------------------------------------------------------------------------------------------- the bus

    def _has_work(self) -> bool:
        """Return whether there are packets to send to the servos."""
        goals = self._goals_due and self.mode in (wire.ON, wire.CATCHING_UP)
        orders = self._torque_off_due or self._torque_on_due or self._limits is not None
        return bool(orders or goals or self._questions or self._to_read)

    def _next_packet(self) -> bytes:
        """Return the most urgent packet to the servos.

        The order is: torque off, goals, torque on, torque limits, requests of the host, the next reading.
        """
        model, protocol = self._model, self._model.protocol
        if self._torque_off_due:
            self._torque_off_due = False
            return self._bus.tell(protocol.write(BROADCAST_ID, model.torque_enable, b"\0"), self._now_us)
        if self._goals_due and self.mode in (wire.ON, wire.CATCHING_UP):
            self._goals_due = False
            return self._bus.tell(self._goals_packet(), self._now_us)
        if self._torque_on_due:
            self._torque_on_due = False
            return self._bus.tell(self._torque_on_packet(), self._now_us)
        if self._limits is not None:
            rows = [model.limit(share) for share in self._limits]
            self._limits = None
            return self._bus.tell(self._for_all(model.limit_address, model.limit_size, rows), self._now_us)
        return self._next_question() or self._next_reading()

    def _next_question(self) -> bytes:
        """Return the packet of the next request of the host."""
        while self._questions:
            question = self._questions.pop(0)
            refusal = self._torque_objection(question[1:])  # again: torque off may have been ordered since
            if refusal == wire.NONE:
                return self._ask_question(question)
            self._refuse_question(question[0], refusal)
        return b""

    def _next_reading(self) -> bytes:
        """Return the packet of the next reading."""
        if not self._to_read:
            return b""
        servo, kind, _ = self._to_read[0]
        address, size = self._block(kind)
        packet = self._model.protocol.read(servo.servo_id, address, size)
        return self._bus.ask(packet, servo.servo_id, size, servo, self._now_us)

    def _ask_question(self, question: list) -> bytes:
        """Start a request of the host."""
        sequence, servo_id, instruction, address, size, data = question
        protocol = self._model.protocol
        if instruction == wire.READ:
            packet = protocol.read(servo_id, address, size)
        elif instruction == wire.WRITE:
            packet = protocol.write(servo_id, address, data)
        elif instruction == wire.REBOOT:
            packet = protocol.reboot(servo_id)
        else:
            packet, size = protocol.ping(servo_id), protocol.PING_SIZE
        return self._bus.ask(packet, servo_id, size, sequence, self._now_us)

    def _block(self, kind: int) -> tuple:
        """Return address and size of a reading."""
        if kind == _STATE:
            return self._model.state_address, self._model.state_size
        if kind == _ADOPTED:
            return self._model.adopted_address, self._model.adopted_size
        return self._model.hardware_address, 1

    def _goals_packet(self) -> bytes:
        """Return the packet of goals."""
        assert self._goals is not None
        rows = []
        for servo, goal, speed in zip(self._servos, self._next_goals(), self._goals[2]):
            servo.goal = goal
            rows.append(self._model.goal(goal, speed))
        return self._for_all(self._model.goals_address, self._model.goals_size, rows)

    def _next_goals(self) -> list[int]:
        """Return the angles to write.

        They are the received goals. While catching up, they move toward these slowly, so that all servos arrive together.
        """
        assert self._goals is not None
        angles = self._goals[1]
        furthest = 0
        for servo, angle in zip(self._servos, angles):
            if servo.goal is not None:
                furthest = max(furthest, abs(angle - servo.goal))
        if furthest <= NEAR or self._torque_on_due:  # before torque on, servos are near their goals
            self.mode = wire.ON
        elapsed_us = min(self._now_us - self._written_us, 2 * self._cycle_us)
        reach = max(CATCH_UP_SPEED * elapsed_us // 1_000_000, 1)
        self._written_us = self._now_us
        if self.mode == wire.ON:
            return list(angles)
        found = []
        for servo, angle in zip(self._servos, angles):
            way = 0 if servo.goal is None else angle - servo.goal
            found.append(angle - way + (way * reach * 2 + furthest) // (2 * furthest))  # rounded
        return found

    def _torque_on_packet(self) -> bytes:
        return self._for_all(self._model.torque_enable, 1, [b"\1"] * len(self._servos))

    def _for_all(self, address: int, size: int, rows: list[bytes]) -> bytes:
        """Return a packet that writes a block of each servo."""
        body = b"".join([bytes((servo.servo_id,)) + row for servo, row in zip(self._servos, rows)])
        return self._model.protocol.sync_write(address, size, body)

    def _learn(self, about: object, began_us: int, packet: tuple | None) -> None:
        """Process the response of a servo, or its timeout (None), to a reading or to a request of the host."""
        if isinstance(about, _Servo):
            self._note(about, began_us, packet)
        elif packet is None:
            self._to_host += wire.answer(self._session, about, wire.SILENT, 0, b"")  # type: ignore[arg-type]
        else:
            self._to_host += wire.answer(self._session, about, wire.ANSWERED, packet[1], packet[2])  # type: ignore[arg-type]

    def _note(self, servo: _Servo, began_us: int, packet: tuple | None) -> None:
        """Store the response of a servo, and continue with the next one."""
        _, kind, attempts = self._to_read.pop(0)
        if packet is None:
            if attempts > 1:
                self._to_read.append((servo, kind, attempts - 1))
        elif len(packet[2]) != self._block(kind)[1] or packet[1] & ~self._model.known_errors:
            self._bus.garbled += 1
        else:
            self._take(servo, kind, began_us, packet[1], packet[2])
        if self._to_read:
            return
        if self.mode == wire.ADOPTING:
            self._take_over()
        else:
            self._round_us = min((self._now_us - self._round_began_us) * 9 // 8, self._cycle_us)

    def _take(self, servo: _Servo, kind: int, began_us: int, code: int, data: bytes) -> None:
        """Store what was read, a kind of reading that was requested at `began_us`."""
        if kind == _ADOPTED:
            self._adopt(servo, data)
        elif kind == _HARDWARE:
            servo.hardware_error |= self._model.hardware_errors(data[0])
        else:
            self._note_state(servo, began_us, code, self._model.state(data))

    def _note_state(self, servo: _Servo, began_us: int, code: int, state: tuple | None) -> None:
        if state is None:
            self._bus.garbled += 1
            return
        servo.asked_us, servo.state = began_us, state
        if not code & self._model.alert:
            servo.hardware_error, servo.alert_us = 0, None
        elif servo.alert_us is None or began_us - servo.alert_us >= ALERT_US:
            servo.alert_us = began_us
            self._to_read.insert(0, (servo, _HARDWARE, 1))
        servo.error = self._model.errors(code) | servo.hardware_error

    def _adopt(self, servo: _Servo, data: bytes) -> None:
        """Adopt torque state and goal of a servo.

        The present position replaces a goal that is more than 10 deg away from it.
        """
        servo.torque, goal, position = self._model.adopted(data)
        if position is not None:
            servo.goal = goal if abs(goal - position) <= FAR else position

    def _take_over(self) -> None:
        """Leave mode ADOPTING.

        Torque counts as on if it is on in all servos that responded.
        """
        known = [servo.torque for servo in self._servos if servo.torque is not None]
        on = bool(known) and all(known) and not self._off_ordered
        self.mode = wire.HOLDING if on else wire.OFF

    # ------------------------------------------------------------------------------------------------- messages

    def _welcome(self) -> None:
        self._to_host += wire.welcome(self._session, self._boot, self._now_us, self._name, self._model.name)

    def _state(self) -> bytes:
        self._state_sequence = (self._state_sequence + 1) & _COUNT
        goals_us = None if self._goals is None else self._goals_us
        numbers = [
            self._session,
            self._state_sequence,
            self._now_us,
            self.mode,
            self._heard,
            self._age(goals_us),
            self._refusal,
            self._refused,
            self._from_host.dropped & _COUNT,
            self._bus.silent & _COUNT,
            self._bus.broken & _COUNT,
        ]
        columns = [[servo.state[k] for servo in self._servos] for k in range(5)]
        columns.append([servo.error for servo in self._servos])
        columns.append([self._age(servo.asked_us) for servo in self._servos])
        return wire.state(numbers, columns)

    def _age(self, time_us: int | None) -> int:
        if time_us is None:
            return wire.NEVER
        return min((self._now_us - time_us) // wire.AGE_UNIT_US, wire.NEVER - 1)
