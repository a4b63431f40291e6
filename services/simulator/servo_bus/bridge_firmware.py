"""Reference firmware of the bridge; see docs/bridge.md.

The bridge is a microcontroller that controls the servo bus for a host. It is a state machine without clock, thread or port,
which can be ported to C: inputs are time and bytes, outputs are bytes. It turns torque on or off only by command. Without fresh
goals it keeps the last ones.
"""

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from sextant.services.simulator.servo_bus.bus_master import BusMaster
from sextant.shared.servo import bridge_protocol
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.bridge_protocol import NEVER, Message, Mode, Receiver, Refusal, RemoteClock, Result
from sextant.shared.servo.dynamixel import BROADCAST_ID, PRESENT_STATE, Instruction
from sextant.shared.servo.servo_model import Packet, Register

NAME = "reference firmware, simulated"
CYCLE_NS = 10_000_000  # [ns] period in which each servo is read once and a state is sent
GREETING_NS = 100_000_000  # [ns] period of Welcome messages before a session
ATTEMPTS = 3  # attempts to read a servo in mode ADOPTING
NEAR_TICKS = 6  # [ticks] 1.8 deg: distance between received and last written goals at which catching up ends
CATCH_UP_TICKS_S = 102  # [ticks/s] 30 deg/s: speed of catching up
FAR_TICKS = 34  # [ticks] 10 deg: maximum distance of a goal from its servo for turning torque on
FRESH_NS = 200_000_000  # [ns] maximum age of readings for turning torque on
QUESTIONS = 4  # maximum number of waiting requests

_PASSED_ON = (Instruction.PING, Instruction.READ, Instruction.WRITE)
_ADOPTED = (dxl.TORQUE_ENABLE.address, dxl.PRESENT_POSITION.address + 2 - dxl.TORQUE_ENABLE.address)  # address and size
_TORQUE_OFF = dxl.write(BROADCAST_ID, dxl.TORQUE_ENABLE.address, b"\0")
_COUNT = 0xFFFF_FFFF  # counters wrap to 0 after this value


class Said(NamedTuple):
    """Output of one step."""

    to_host: bytes
    to_bus: bytes


@dataclass(slots=True)
class _Servo:
    """Known state of one servo."""

    servo_id: int
    asked_ns: int | None = None  # time of the request of the newest reading
    state: tuple[int, int, int, int, int] = (0, 0, 0, 0, 0)  # position, speed, load, voltage, temperature
    error: int = 0
    torque: bool | None = None  # torque state read in mode ADOPTING, None without a response
    goal: int | None = None  # [ticks] last written goal, or the one read in mode ADOPTING; None if unknown


class Firmware:
    """Firmware between a host link and a servo bus."""

    def __init__(self, boot: int, now_ns: int = 0, name: str = NAME):
        """Start without a session and without access to the bus.

        Args:
            boot: Boot number, different from that of the last boot.
            now_ns: Current time [ns].
            name: Name of board and firmware.
        """
        self.mode = Mode.WAITING
        self._boot, self._name = boot, name
        self._now_ns = now_ns
        self._from_host = Receiver(bridge_protocol.FROM_HOST)
        self._to_host = bytearray()
        # Session.
        self._session = 0
        self._servos: list[_Servo] = []
        self._heard = 0  # sequence of the newest accepted command
        self._host_clock = RemoteClock()
        self._goals: bridge_protocol.Goals | None = None  # newest goals
        self._goals_ns = 0  # their time of arrival
        self._goals_due = False  # whether they are still to be written
        self._written_ns = 0
        self._limits: bridge_protocol.Limits | None = None  # to be written
        self._torque_on_due = self._torque_off_due = False
        self._off_ordered = False
        self._questions: deque[bridge_protocol.Ask] = deque()
        # Servo bus.
        self._bus: BusMaster[_Servo | bridge_protocol.Ask] = BusMaster(now_ns)
        self._to_read: deque[tuple[_Servo, int]] = deque()  # servos to read, with the remaining attempts
        # State messages.
        self._tick_ns = now_ns + CYCLE_NS
        self._state_sequence = 0
        self._refusal, self._refused = Refusal.NONE, 0

    @property
    def due_ns(self) -> int:
        """Latest time [ns] of the next `step` if no bytes arrive."""
        return min(self._tick_ns, self._bus.due_ns) if self._bus.waits or self._has_work() else self._tick_ns

    def step(self, now_ns: int, from_host: bytes = b"", from_bus: bytes = b"") -> Said:
        """Process received bytes, and return the bytes to send.

        Args:
            now_ns: Current time [ns], monotonic.
            from_host: Bytes received from the host.
            from_bus: Bytes received from the servos.
        """
        self._now_ns = now_ns
        # 1. Process responses and timeouts of servos.
        for closed in self._bus.hear(from_bus, now_ns):
            self._learn(*closed)
        # 2. Process messages of the host.
        for message in self._from_host.feed(from_host):
            self._obey(message)
        if self._from_host.other_version is not None:
            self._from_host.other_version = None
            self._refuse(Refusal.VERSION)
            self._welcome()
        # 3. Process the time.
        self._judge_freshness()
        if now_ns >= self._tick_ns:
            self._tick()
        # 4. Start the next packet to the servos.
        to_bus = self._next_packet() if not self._bus.waits and now_ns >= self._bus.due_ns else b""
        to_host = bytes(self._to_host)
        self._to_host.clear()
        return Said(to_host, to_bus)

    # ------------------------------------------------------------------------------------------------- commands

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
        """Open a session unless it is already open.

        A new session discards the state of the previous one.
        """
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
        """Return whether a command is accepted.

        It must belong to the session, be newer than the last one, be fresh, and have one value per servo.
        """
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
        """Turn torque off and discard the goals.

        Torque off is repeated in each cycle until a torque-on command.
        """
        self._off_ordered = self._torque_off_due = True
        self._torque_on_due = self._goals_due = False
        self._goals = None
        if self._session and self.mode is not Mode.ADOPTING:
            self.mode = Mode.OFF

    def _turn_on(self) -> None:
        """Turn torque on if the goals are fresh and each servo is near its goal."""
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
        """Return whether the newest goals are within their lifetime."""
        return self._goals is not None and self._now_ns - self._goals_ns <= self._goals.lifetime_ms * 1_000_000

    def _judge_freshness(self) -> None:
        """Change to HOLDING without fresh goals, and to CATCHING_UP when they return."""
        if self.mode in (Mode.ON, Mode.CATCHING_UP) and not self._fresh():
            self.mode = Mode.HOLDING
        elif self.mode is Mode.HOLDING and self._fresh():
            self.mode = Mode.CATCHING_UP

    def _tick(self) -> None:
        """Start a cycle: send the state, and read all servos again.

        Without a session, send a Welcome message instead.
        """
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
        """Return whether there are packets to send to the servos."""
        goals = self._goals_due and self.mode in (Mode.ON, Mode.CATCHING_UP)
        orders = self._torque_off_due or self._torque_on_due or self._limits is not None
        return orders or goals or bool(self._questions or self._to_read)

    def _next_packet(self) -> bytes:
        """Return the most urgent packet to the servos.

        The order is: torque off, goals, torque on, torque limits, requests of the host, the next reading.
        """
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
        """Return the packet of goals.

        They are the received goals. While catching up, they move toward these slowly, so that all servos arrive together.
        """
        assert self._goals is not None
        aims = list(zip(self._servos, self._goals.position, self._goals.speed, strict=True))
        furthest = max(abs(goal - servo.goal) if servo.goal is not None else 0 for servo, goal, _ in aims)
        if furthest <= NEAR_TICKS or self._torque_on_due:  # before torque on, servos are near their goals
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

    def _for_all(self, register: Register, values: "list[int] | tuple[int, ...]") -> bytes:
        rows = [(servo.servo_id, register.encode(value)) for servo, value in zip(self._servos, values, strict=True)]
        return dxl.sync_write(register.address, register.size, rows)

    def _learn(self, about: "_Servo | bridge_protocol.Ask", began_ns: int, packet: Packet | None) -> None:
        """Process the response of a servo, or its timeout (None)."""
        if isinstance(about, _Servo):
            self._note(about, began_ns, packet)
        elif packet is None:
            self._say(bridge_protocol.Answer(self._session, about.sequence, Result.SILENT, 0, b""))
        else:
            self._say(bridge_protocol.Answer(self._session, about.sequence, Result.ANSWERED, packet.code, packet.parameters))

    def _note(self, servo: _Servo, began_ns: int, packet: Packet | None) -> None:
        """Store the response of a servo, and continue with the next one."""
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
        """Leave mode ADOPTING.

        Torque counts as on if it is on in all servos that responded.
        """
        known = [servo.torque for servo in self._servos if servo.torque is not None]
        on = bool(known) and all(known) and not self._off_ordered
        self.mode = Mode.HOLDING if on else Mode.OFF

    # ------------------------------------------------------------------------------------------------- messages

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
    """Return whether a request may be sent to a servo.

    Allowed requests are pings, reads, and writes that do not turn torque on.
    """
    if ask.instruction not in _PASSED_ON:
        return False
    if ask.instruction == Instruction.READ:
        return len(ask.parameters) == 2 and sum(ask.parameters) <= dxl.TABLE_SIZE
    if ask.instruction == Instruction.PING:
        return not ask.parameters
    at = dxl.TORQUE_ENABLE.address - ask.parameters[0] + 1 if ask.parameters else 0
    return len(ask.parameters) > 1 and not (1 <= at < len(ask.parameters) and ask.parameters[at])


def _is_plausible(parameters: bytes) -> bool:
    """Return whether measured values are within the range of a servo."""
    if len(parameters) != PRESENT_STATE.size:
        return False
    position, speed, load, _, _ = PRESENT_STATE.unpack(parameters)
    return bool(position <= dxl.TICK_MAX and max(speed, load) <= bridge_protocol.SIGNED_MAX)


def _adopt(servo: _Servo, table: bytes) -> None:
    """Adopt torque state and goal of a servo.

    The present position replaces a goal that is more than 10 deg away from it.
    """
    start = dxl.TORQUE_ENABLE.address
    goal, position = (
        int.from_bytes(table[register.address - start : register.address - start + 2], "little")
        for register in (dxl.GOAL_POSITION, dxl.PRESENT_POSITION)
    )
    servo.torque = bool(table[0])
    servo.goal = goal if abs(goal - position) <= FAR_TICKS else position
