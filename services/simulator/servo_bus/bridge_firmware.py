"""The reference firmware of the bridge: a microcontroller that masters the servo bus for a host. docs/bridge.md says the same.

A state machine without clock, thread or port, written to be carried over to C: time and bytes come in, bytes go out. It never
turns torque on by itself, and never off but when told to; without fresh goals it lets the last ones stand.
"""

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from sextant.services.simulator.servo_bus.bus_master import BusMaster
from sextant.shared.servo import bridge_protocol
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.bridge_protocol import NEVER, Message, Mode, Receiver, Refusal, RemoteClock, Result
from sextant.shared.servo.dynamixel import BROADCAST_ID, PRESENT_STATE, Instruction, Packet

NAME = "reference firmware, simulated"
CYCLE_NS = 10_000_000  # [ns] in each of which all servos are read, once, and a state is sent
GREETING_NS = 100_000_000  # [ns] between two welcomes while nobody has said hello
ATTEMPTS = 3  # to read a servo while adopting
NEAR_TICKS = 6  # 1.8 deg: a goal so near to the last one ends catching up
CATCH_UP_TICKS_S = 102  # [ticks/s] 30 deg/s, at which goals further away are followed
FAR_TICKS = 34  # 10 deg: torque is not turned on with a goal further than this from its servo
FRESH_NS = 200_000_000  # [ns] by which the readings are new enough to turn torque on by
QUESTIONS = 4  # that may wait

_PASSED_ON = (Instruction.PING, Instruction.READ, Instruction.WRITE)
_ADOPTED = (dxl.TORQUE_ENABLE.address, dxl.PRESENT_POSITION.address + 2 - dxl.TORQUE_ENABLE.address)  # one read of a table
_TORQUE_OFF = dxl.write(BROADCAST_ID, dxl.TORQUE_ENABLE.address, b"\0")
_COUNT = 0xFFFF_FFFF  # counts begin anew beyond it


class Said(NamedTuple):
    """What goes out."""

    to_host: bytes
    to_bus: bytes


@dataclass(slots=True)
class _Servo:
    """What is known of one servo."""

    servo_id: int
    asked_ns: int | None = None  # when the newest answered reading was asked for
    state: tuple[int, int, int, int, int] = (0, 0, 0, 0, 0)  # position, speed, load, voltage, temperature
    error: int = 0
    torque: bool | None = None  # on, as adopted; None where it did not answer
    goal: int | None = None  # [ticks] written last, or found; None where nobody knows


class Firmware:
    """Between a host's line and a servo bus."""

    def __init__(self, boot: int, now_ns: int = 0, name: str = NAME):
        """Start up: nothing is known and nothing is touched.

        Args:
            boot: Another number than at the last start.
            now_ns: [ns] the time.
            name: Of board and firmware.
        """
        self.mode = Mode.WAITING
        self._boot, self._name = boot, name
        self._now_ns = now_ns
        self._from_host = Receiver(bridge_protocol.FROM_HOST)
        self._to_host = bytearray()
        # The session.
        self._session = 0
        self._servos: list[_Servo] = []
        self._heard = 0  # sequence of the newest order taken
        self._host_clock = RemoteClock()
        self._goals: bridge_protocol.Goals | None = None  # the newest
        self._goals_ns = 0  # when they came
        self._goals_due = False  # they are to be written
        self._written_ns = 0
        self._limits: bridge_protocol.Limits | None = None  # to be written
        self._torque_on_due = self._torque_off_due = False
        self._off_ordered = False
        self._questions: deque[bridge_protocol.Ask] = deque()
        # The bus.
        self._bus: BusMaster[_Servo | bridge_protocol.Ask] = BusMaster(now_ns)
        self._to_read: deque[tuple[_Servo, int]] = deque()  # servos, and attempts left
        # What is told.
        self._tick_ns = now_ns + CYCLE_NS
        self._state_sequence = 0
        self._refusal, self._refused = Refusal.NONE, 0

    @property
    def due_ns(self) -> int:
        """[ns] when it has to be given the time again, though no byte has come."""
        return min(self._tick_ns, self._bus.due_ns) if self._bus.waits or self._has_work() else self._tick_ns

    def step(self, now_ns: int, from_host: bytes = b"", from_bus: bytes = b"") -> Said:
        """Take the time and what has come, and say what is to be said.

        Args:
            now_ns: [ns] the time, never back.
            from_host: Bytes that the host has sent.
            from_bus: Bytes that the servos have sent.
        """
        self._now_ns = now_ns
        # 1. What the servos answer, or do not.
        for closed in self._bus.hear(from_bus, now_ns):
            self._learn(*closed)
        # 2. What the host wants.
        for message in self._from_host.feed(from_host):
            self._obey(message)
        if self._from_host.other_version is not None:
            self._from_host.other_version = None
            self._refuse(Refusal.VERSION)
            self._welcome()
        # 3. What time brings.
        self._judge_freshness()
        if now_ns >= self._tick_ns:
            self._tick()
        # 4. The next packet for the servos.
        to_bus = self._next_packet() if not self._bus.waits and now_ns >= self._bus.due_ns else b""
        to_host = bytes(self._to_host)
        self._to_host.clear()
        return Said(to_host, to_bus)

    # --------------------------------------------------------------------------------------------------- orders

    def _obey(self, message: Message) -> None:
        match message:
            case bridge_protocol.Hello():
                self._greet(message)
            case bridge_protocol.Torque(on=0):
                self._turn_off()
            case bridge_protocol.Goals() if self._admits(message, message.lifetime_ms, len(message.position)):
                self._goals, self._goals_ns, self._goals_due = message, self._now_ns, True
            case bridge_protocol.Torque() if self._admits(message):
                self._turn_on()
            case bridge_protocol.Limits() if self._admits(message, count=len(message.limit)):
                self._limits = message
            case bridge_protocol.Ask() if self._admits(message):
                self._take_question(message)

    def _greet(self, hello: bridge_protocol.Hello) -> None:
        """Open a session, unless it is open already; nothing of an older one is left but what the servos hold."""
        if hello.session != self._session:
            self._session, self._heard = hello.session, 0
            self._servos = [_Servo(servo_id) for servo_id in hello.ids]
            self._host_clock = RemoteClock()
            self._goals, self._goals_due, self._torque_on_due = None, False, False
            self._limits = None
            self._questions.clear()
            self._bus.forget()
            self._to_read = deque((servo, ATTEMPTS) for servo in self._servos)
            self.mode = Mode.ADOPTING
        self._host_clock.age_ns(hello.time_us, self._now_ns)
        self._welcome()

    def _admits(
        self,
        order: bridge_protocol.Goals | bridge_protocol.Torque | bridge_protocol.Limits | bridge_protocol.Ask,
        lifetime_ms: int = bridge_protocol.ORDER_LIFETIME_MS,
        count: int | None = None,
    ) -> bool:
        """Whether an order is of this session, newer than the last, fresh, and for as many servos as there are."""
        if not self._session or order.session != self._session:
            return self._refuse(Refusal.SESSION)
        if order.sequence <= self._heard:
            return self._refuse(Refusal.ORDER)
        if self._host_clock.age_ns(order.time_us, self._now_ns) > lifetime_ms * 1_000_000:
            return self._refuse(Refusal.AGE)
        if count not in (None, len(self._servos)):
            return self._refuse(Refusal.COUNT)
        self._heard = order.sequence
        return True

    def _turn_off(self) -> None:
        """Torque off, at once and in every cycle until on is ordered; goals from before count no more."""
        self._off_ordered = self._torque_off_due = True
        self._torque_on_due = self._goals_due = False
        self._goals = None
        if self._session and self.mode is not Mode.ADOPTING:
            self.mode = Mode.OFF

    def _turn_on(self) -> None:
        """Torque on, where fresh goals say where to and each servo is near its own."""
        if self.mode is Mode.ADOPTING or not self._fresh():
            self._refuse(Refusal.NO_GOALS)
        elif not self._are_near():
            self._refuse(Refusal.FAR)
        else:
            self._off_ordered = self._torque_off_due = False
            self._torque_on_due = self._goals_due = True
            self.mode = Mode.ON

    def _are_near(self) -> bool:
        assert self._goals is not None
        return all(
            servo.asked_ns is not None and self._now_ns - servo.asked_ns <= FRESH_NS and abs(servo.state[0] - goal) <= FAR_TICKS
            for servo, goal in zip(self._servos, self._goals.position, strict=True)
        )

    def _take_question(self, ask: bridge_protocol.Ask) -> None:
        if not _is_passed_on(ask):
            self._refuse(Refusal.QUESTION)
        elif len(self._questions) >= QUESTIONS:
            self._refuse(Refusal.BUSY)
        else:
            self._questions.append(ask)
            return
        self._say(bridge_protocol.Answer(self._session, ask.sequence, Result.REFUSED, 0, b""))

    def _refuse(self, why: Refusal) -> bool:
        self._refusal, self._refused = why, self._refused + 1 & _COUNT
        return False

    # ----------------------------------------------------------------------------------------------------- time

    def _fresh(self) -> bool:
        """Whether the newest goals have not outlived themselves."""
        return self._goals is not None and self._now_ns - self._goals_ns <= self._goals.lifetime_ms * 1_000_000

    def _judge_freshness(self) -> None:
        """Hold when goals stop coming; when they come again, catch up with them if they have gone ahead."""
        if self.mode in (Mode.ON, Mode.CATCHING_UP) and not self._fresh():
            self.mode = Mode.HOLDING
        elif self.mode is Mode.HOLDING and self._fresh():
            self.mode = Mode.CATCHING_UP

    def _tick(self) -> None:
        """The beat of a cycle: tell all, and begin to read all again; while nobody is there, say that it is here."""
        if not self._session:
            self._tick_ns = self._now_ns + GREETING_NS
            self._welcome()
        else:
            late = self._now_ns - self._tick_ns
            self._tick_ns = self._now_ns + CYCLE_NS - late % CYCLE_NS
            if not self._to_read:
                self._to_read.extend((servo, 1) for servo in self._servos)
            self._say(self._state())
        self._torque_off_due |= self._off_ordered

    # -------------------------------------------------------------------------------------------------- the bus

    def _has_work(self) -> bool:
        """Whether there is anything to be sent to the servos."""
        goals = self._goals_due and self.mode in (Mode.ON, Mode.CATCHING_UP)
        orders = self._torque_off_due or self._torque_on_due or self._limits is not None
        return orders or goals or bool(self._questions or self._to_read)

    def _next_packet(self) -> bytes:
        """The most urgent packet for the servos: off, goals, on, limits, the host's questions, the next reading."""
        if self._torque_off_due:
            self._torque_off_due = False
            return self._bus.tell(_TORQUE_OFF, self._now_ns)
        if self._goals_due and self.mode in (Mode.ON, Mode.CATCHING_UP):
            self._goals_due = False
            return self._bus.tell(self._goals_packet(), self._now_ns)
        if self._torque_on_due:
            self._torque_on_due = False
            return self._bus.tell(self._for_all(dxl.TORQUE_ENABLE, [1] * len(self._servos)), self._now_ns)
        if self._limits is not None:
            limits, self._limits = self._limits, None
            return self._bus.tell(self._for_all(dxl.TORQUE_LIMIT, limits.limit), self._now_ns)
        if self._questions:
            ask = self._questions.popleft()
            packet = dxl.encode(ask.servo_id, ask.instruction, ask.parameters)
            size = ask.parameters[1] if ask.instruction == Instruction.READ else 0
            return self._bus.ask(packet, ask.servo_id, size, ask, self._now_ns)
        if self._to_read:
            servo, _ = self._to_read[0]
            address, size = _ADOPTED if self.mode is Mode.ADOPTING else (dxl.PRESENT_POSITION.address, PRESENT_STATE.size)
            return self._bus.ask(dxl.read(servo.servo_id, address, size), servo.servo_id, size, servo, self._now_ns)
        return b""

    def _goals_packet(self) -> bytes:
        """The goals as they are to be written: as they came, or on the way to them, all servos together and slowly."""
        assert self._goals is not None
        aims = list(zip(self._servos, self._goals.position, self._goals.speed, strict=True))
        furthest = max(abs(goal - servo.goal) if servo.goal is not None else 0 for servo, goal, _ in aims)
        if furthest <= NEAR_TICKS or self._torque_on_due:  # torque comes on where the servos are
            self.mode = Mode.ON
        elapsed_ns = min(self._now_ns - self._written_ns, 2 * CYCLE_NS)
        reach = max(CATCH_UP_TICKS_S * elapsed_ns // 1_000_000_000, 1)
        rows = []
        for servo, goal, speed in aims:
            if servo.goal is None or self.mode is Mode.ON:
                servo.goal = goal
            else:
                servo.goal += round((goal - servo.goal) * reach / furthest)
            rows.append((servo.servo_id, dxl.GOAL_POSITION.encode(servo.goal) + dxl.MOVING_SPEED.encode(speed)))
        self._written_ns = self._now_ns
        return dxl.sync_write(dxl.GOAL_POSITION.address, dxl.GOAL_POSITION.size + dxl.MOVING_SPEED.size, rows)

    def _for_all(self, register: dxl.Register, values: "list[int] | tuple[int, ...]") -> bytes:
        rows = [(servo.servo_id, register.encode(value)) for servo, value in zip(self._servos, values, strict=True)]
        return dxl.sync_write(register.address, register.size, rows)

    def _learn(self, about: "_Servo | bridge_protocol.Ask", began_ns: int, packet: Packet | None) -> None:
        """Take what a servo has said, or that it has said nothing."""
        if isinstance(about, _Servo):
            self._note(about, began_ns, packet)
        elif packet is None:
            self._say(bridge_protocol.Answer(self._session, about.sequence, Result.SILENT, 0, b""))
        else:
            self._say(bridge_protocol.Answer(self._session, about.sequence, Result.ANSWERED, packet.code, packet.parameters))

    def _note(self, servo: _Servo, began_ns: int, packet: Packet | None) -> None:
        """Keep what a servo has said, and go on to the next one."""
        _, attempts = self._to_read.popleft()
        if packet is not None and len(packet.parameters) == _ADOPTED[1]:
            _adopt(servo, packet.parameters)
        elif packet is not None and _is_plausible(packet.parameters):
            servo.asked_ns, servo.error = began_ns, packet.code
            servo.state = PRESENT_STATE.unpack(packet.parameters)
        elif packet is not None:
            self._bus.garbled += 1
        elif attempts > 1:
            self._to_read.append((servo, attempts - 1))
        if self.mode is Mode.ADOPTING and not self._to_read:
            self._take_over()

    def _take_over(self) -> None:
        """Go on as the servos stand: torque counts as on when every servo that answers has it on."""
        known = [servo.torque for servo in self._servos if servo.torque is not None]
        on = bool(known) and all(known) and not self._off_ordered
        self.mode = Mode.HOLDING if on else Mode.OFF

    # -------------------------------------------------------------------------------------------------- telling

    def _say(self, message: Message) -> None:
        self._to_host += bridge_protocol.encode(message)

    def _welcome(self) -> None:
        self._say(bridge_protocol.Welcome(bridge_protocol.VERSION, self._session, self._boot, self._now_ns // 1000, self._name))

    def _state(self) -> bridge_protocol.State:
        self._state_sequence = self._state_sequence + 1 & _COUNT
        servos = self._servos
        columns = list(zip(*(servo.state for servo in servos), strict=True))
        age_ms = NEVER if self._goals is None else min((self._now_ns - self._goals_ns) // 1_000_000, NEVER - 1)
        return bridge_protocol.State(
            session=self._session,
            sequence=self._state_sequence,
            time_us=self._now_ns // 1000,
            mode=self.mode,
            heard=self._heard,
            goals_age_ms=age_ms,
            refusal=self._refusal,
            refused=self._refused,
            broken=self._from_host.dropped.total() & _COUNT,
            silent=self._bus.silent & _COUNT,
            garbled=self._bus.broken & _COUNT,
            position=columns[0],
            speed=columns[1],
            load=columns[2],
            voltage=bytes(columns[3]),
            temperature=bytes(columns[4]),
            error=bytes(servo.error for servo in servos),
            age=tuple(self._age(servo) for servo in servos),
        )

    def _age(self, servo: _Servo) -> int:
        if servo.asked_ns is None:
            return NEVER
        return min((self._now_ns - servo.asked_ns) // (1000 * bridge_protocol.AGE_UNIT_US), NEVER - 1)


def _is_passed_on(ask: bridge_protocol.Ask) -> bool:
    """Whether a question may go to a servo: pings, reads, and writes that do not turn torque on."""
    if ask.instruction not in _PASSED_ON:
        return False
    if ask.instruction == Instruction.READ:
        return len(ask.parameters) == 2 and sum(ask.parameters) <= dxl.TABLE_SIZE
    if ask.instruction == Instruction.PING:
        return not ask.parameters
    at = dxl.TORQUE_ENABLE.address - ask.parameters[0] + 1 if ask.parameters else 0
    return len(ask.parameters) > 1 and not (1 <= at < len(ask.parameters) and ask.parameters[at])


def _is_plausible(parameters: bytes) -> bool:
    """Whether registers hold what a servo can measure."""
    if len(parameters) != PRESENT_STATE.size:
        return False
    position, speed, load, _, _ = PRESENT_STATE.unpack(parameters)
    return bool(position <= dxl.TICK_MAX and max(speed, load) <= bridge_protocol.SIGNED_MAX)


def _adopt(servo: _Servo, table: bytes) -> None:
    """Take torque and goal as they stand in a servo; a goal far from where it is counts as where it is."""
    start = dxl.TORQUE_ENABLE.address
    goal, position = (
        int.from_bytes(table[register.address - start : register.address - start + 2], "little")
        for register in (dxl.GOAL_POSITION, dxl.PRESENT_POSITION)
    )
    servo.torque = bool(table[0])
    servo.goal = goal if abs(goal - position) <= FAR_TICKS else position
