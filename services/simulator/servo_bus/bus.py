"""The servo bus as bytes: what a host sends at a time comes back as what the servos would answer, and when.

Packets are understood in the order of the wire, at once; what they write reaches the servos when simulated time reaches
the packet's end (`ServoBusEmulator.advance`), and reads see writes that are still on their way. So a host that talks
faster than the physics advances, as in lockstep, is answered as on a real bus, and joints move when real ones would.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import lru_cache

from sextant.services.simulator.servo_bus.host_link import AnswersOnly, Outbox, Outlet, Reply, Wire
from sextant.services.simulator.servo_bus.servos import ServoBank
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.dynamixel import Access, Instruction, Packet, PacketParser, Register, ServoError

_SEC = 1_000_000_000
_INTER_BYTE_NS = 100_000_000  # a servo gives a packet up when its next byte takes longer (AX-12 user's manual)
_ANSWER_ALL, _ANSWER_READ = 2, 1  # status return levels
# Baud rate, return delay and status level lie close: one read gives id, delay and level.
_HEAD_START, _HEAD_SIZE = dxl.ID.address, dxl.STATUS_RETURN_LEVEL.address - dxl.ID.address + 1
_FREE = dxl.TORQUE_ENABLE.address, dxl.TORQUE_LIMIT.address + dxl.TORQUE_LIMIT.size  # written also where the rest is locked
_HEAD_DELAY = dxl.RETURN_DELAY.address - dxl.ID.address


@dataclass(frozen=True, slots=True)
class BusTiming:
    """What the wire and the adapter cost."""

    baud_rate: int = 1_000_000  # [1/s]
    usb_transaction_ns: int = 1_000_000  # [ns] from the last byte on the wire to the host: the FTDI latency timer

    def __post_init__(self) -> None:
        if self.baud_rate <= 0 or self.usb_transaction_ns < 0:
            raise ValueError(f"a baud rate above 0 and a USB time of at least 0 ns expected, found {self}")

    def wire_ns(self, count: int) -> int:
        """Time [ns] that bytes take on the wire."""
        return count * dxl.BITS_PER_BYTE * _SEC // self.baud_rate


@dataclass(frozen=True, slots=True)
class _Change:
    """A write on its way to the servos."""

    time_ns: int  # end of its packet on the wire
    address: int
    size: int
    rows: dict[int, bytes]  # row of the bank -> data


@dataclass(slots=True)
class BusCounts:
    """What went over the bus, for tests and for the operator."""

    instructions: Counter[int] = field(default_factory=Counter)  # by code, intact packets only
    refused: Counter[str] = field(default_factory=Counter)  # by error words
    unanswered: int = 0  # instructions to an id that nobody has


class ServoBusEmulator(AnswersOnly):
    """n servos on one half-duplex wire behind a USB adapter. No thread, no clock: times come in as arguments."""

    def __init__(self, bank: ServoBank, timing: BusTiming | None = None, *, echo: bool = False) -> None:
        """Connect a bank of servos.

        Args:
            bank: The servos.
            timing: What the wire and the adapter cost.
            echo: The adapter hears itself and returns every byte sent, as single-wire adapters do.
        """
        self.counts = BusCounts()
        self.overhear: Callable[[bytes, int], object] = _nobody  # hears what arrives, and when
        self._bank = bank
        self._timing = timing or BusTiming()
        self._echo = echo
        self._parser = PacketParser(keep_broken=True)
        self._received = 0  # bytes so far
        self._last_ns = 0  # time of the last bytes from the host
        self._wire_free_ns = 0
        self._answered_ns = 0  # end of the last answer on the wire
        self._changes: deque[_Change] = deque()
        self._registered: dict[int, tuple[int, bytes]] = {}  # row -> address and data that wait for an action
        self._listeners: dict[int, list[int]] = {}  # id -> rows
        self._cut_off: frozenset[int] = frozenset()  # rows that the wire does not reach
        self._find_listeners()

    @property
    def dropped(self) -> Counter[str]:
        """Bytes and packets that the servos could not use, by reason."""
        return self._parser.dropped

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        """Take bytes that the host sends at a time and return the answers with the time each is due.

        Bytes queue behind what is still on the wire: the adapter's buffer holds them.
        """
        replies = []
        self.overhear(data, now_ns)
        if self._parser.pending and now_ns - self._last_ns > _INTER_BYTE_NS:
            self._parser.flush()  # nobody answers what arrives late
        self._last_ns = now_ns
        offset, start = self._received, max(now_ns, self._wire_free_ns)
        self._received += len(data)
        end = start + self._timing.wire_ns(len(data))
        self._wire_free_ns = end
        if self._echo and data:
            replies.append(Reply(end + self._timing.usb_transaction_ns, data))
        for packet in self._parser.feed(data):
            replies += self._execute(packet, start + self._timing.wire_ns(packet.end - offset))
        return replies

    def outlet(self, now_ns: int) -> Outlet | None:
        """How the bus is reached: as ever."""
        return Outlet()

    def cut_off(self, rows: frozenset[int]) -> None:
        """Let servos neither hear nor answer from now on, by their rows; all others do."""
        if rows != self._cut_off:
            self._cut_off = rows
            self._find_listeners()

    def advance(self, now_ns: int) -> None:
        """Let the writes whose packets ended by now take effect. Call before each physics step."""
        while self._changes and self._changes[0].time_ns <= now_ns:
            change = self._changes.popleft()
            for row, data in change.rows.items():
                self._bank.write(row, change.address, data)

    # -------------------------------------------------------------------------------------------- instructions

    def _execute(self, packet: Packet, time_ns: int) -> Iterable[Reply]:
        broadcast = packet.servo_id == dxl.BROADCAST_ID
        if broadcast:
            rows = [row for listening in self._listeners.values() for row in listening]
        else:
            rows = self._listeners.get(packet.servo_id, [])
        if not rows:
            self.counts.unanswered += 1
            return ()
        if not packet.intact:
            self._refuse(ServoError.CHECKSUM)
            return () if broadcast else self._answer(rows, time_ns, ServoError.CHECKSUM)
        self.counts.instructions[packet.code] += 1
        parameters = packet.parameters
        match packet.code:
            case Instruction.PING:
                error = self._refuse(ServoError.INSTRUCTION if parameters else ServoError.NONE)
                return self._answer(rows, time_ns, error, always=True)
            case Instruction.READ if len(parameters) == 2:
                return () if broadcast else self._read(rows, time_ns, *parameters)
            case Instruction.WRITE if len(parameters) >= 2:
                error = self._write(rows, time_ns, parameters[0], parameters[1:])
            case Instruction.REG_WRITE if len(parameters) >= 2:
                error = self._register(rows, time_ns, parameters[0], parameters[1:])
            case Instruction.ACTION if not parameters:
                error = self._action(rows, time_ns, broadcast)
            case Instruction.RESET if not parameters and not broadcast:
                # The answer still goes out as the servo was: the caller listens there.
                replies = self._answer(rows, time_ns, ServoError.NONE)
                self._change(time_ns, 0, {row: self._factory(row) for row in rows})
                return replies
            case Instruction.SYNC_WRITE if broadcast:
                self._sync_write(time_ns, parameters)
                return ()
            case _:
                error = self._refuse(ServoError.INSTRUCTION)
        return () if broadcast else self._answer(rows, time_ns, error)

    def _read(self, rows: list[int], time_ns: int, address: int, size: int) -> list[Reply]:
        if size == 0 or address + size > dxl.TABLE_SIZE:
            return self._answer(rows, time_ns, self._refuse(ServoError.RANGE))
        return self._answer(rows, time_ns, ServoError.NONE, read=(address, size))

    def _write(self, rows: list[int], time_ns: int, address: int, data: bytes) -> ServoError:
        error = ServoError.NONE
        accepted: dict[int, bytes] = {}
        for row in rows:
            refused = self._check(row, address, data)
            if refused:
                error |= self._refuse(refused)
            else:
                accepted[row] = data
        self._change(time_ns, address, accepted)
        return error

    def _register(self, rows: list[int], time_ns: int, address: int, data: bytes) -> ServoError:
        for row in rows:
            error = self._check(row, address, data)
            if error:
                return self._refuse(error)
            self._registered[row] = (address, data)
        self._change(time_ns, dxl.REGISTERED.address, dict.fromkeys(rows, b"\x01"))
        return ServoError.NONE

    def _action(self, rows: list[int], time_ns: int, broadcast: bool) -> ServoError:
        waiting = [row for row in rows if row in self._registered]
        for row in waiting:
            address, data = self._registered.pop(row)
            self._change(time_ns, address, {row: data})
        self._change(time_ns, dxl.REGISTERED.address, dict.fromkeys(waiting, b"\x00"))
        return ServoError.NONE if waiting or broadcast else self._refuse(ServoError.INSTRUCTION)

    def _sync_write(self, time_ns: int, parameters: bytes) -> None:
        size = parameters[1] if len(parameters) > 1 else 0
        if size == 0 or (len(parameters) - 2) % (size + 1):
            self._refuse(ServoError.INSTRUCTION)  # nobody answers a broadcast, not even to refuse it
            return
        address = parameters[0]
        accepted: dict[int, bytes] = {}
        for start in range(2, len(parameters), size + 1):
            data = parameters[start + 1 : start + 1 + size]
            for row in self._listeners.get(parameters[start], ()):
                error = self._check(row, address, data)
                if error:
                    self._refuse(error)
                else:
                    accepted[row] = data
        self._change(time_ns, address, accepted)

    # ------------------------------------------------------------------------------------------------- registers

    def _check(self, row: int, address: int, data: bytes) -> ServoError:
        """Whether a servo takes a write: whole registers that may be written, in range, goals within the limits."""
        registers = _registers_in(address, len(data))
        if registers is None or (not _FREE[0] <= address <= _FREE[1] - len(data) and self._value(row, dxl.LOCK)):
            return ServoError.RANGE  # locked until the power goes
        for register in registers:
            start = register.address - address
            value = data[start] if register.size == 1 else data[start] | data[start + 1] << 8
            if not register.min <= value <= register.max:
                return ServoError.RANGE
            if register is dxl.GOAL_POSITION:
                limits = self._table(row, dxl.CW_ANGLE_LIMIT.address, 4)  # clockwise, counterclockwise; both 0 is wheel mode
                low, high = limits[0] | limits[1] << 8, limits[2] | limits[3] << 8
                if not low <= value <= high and high:
                    return ServoError.ANGLE_LIMIT
        return ServoError.NONE

    def _table(self, row: int, address: int, size: int, at_ns: int | None = None) -> bytes:
        """Bytes of a servo as its next reader sees them, at a time: with the writes that are on their way."""
        data = self._bank.read(row, address, size, at_ns)
        for change in self._changes:
            if change.address < address + size and address < change.address + change.size and row in change.rows:
                table = bytearray(dxl.TABLE_SIZE)
                table[address : address + size] = data
                table[change.address : change.address + change.size] = change.rows[row]
                data = bytes(table[address : address + size])
        return data

    def _value(self, row: int, register: Register) -> int:
        data = self._table(row, register.address, register.size)
        return data[0] if register.size == 1 else data[0] | data[1] << 8

    def _change(self, time_ns: int, address: int, rows: dict[int, bytes]) -> None:
        if not rows:
            return
        size = len(next(iter(rows.values())))
        self._changes.append(_Change(time_ns, address, size, rows))
        if address <= dxl.BAUD_RATE.address and dxl.ID.address < address + size:
            self._find_listeners()

    def _factory(self, row: int) -> bytes:
        """Factory table of a servo; what it measures stays."""
        start, end = dxl.PRESENT_POSITION.address, dxl.LOCK.address
        table = bytearray(self._bank.model.factory_table())
        table[start:end] = self._bank.read(row, start, end - start)
        return bytes(table)

    def _find_listeners(self) -> None:
        """Which servos hear the host, by their ids."""
        self._listeners = {}
        for row in filter(self._hears, range(len(self._bank))):
            self._listeners.setdefault(self._value(row, dxl.ID), []).append(row)

    def _hears(self, row: int) -> bool:
        """Whether a servo hears the host: plugged in and set to its baud rate, within the 3 % that a receiver tolerates."""
        if row in self._cut_off:
            return False
        rate = dxl.baud_rate(self._value(row, dxl.BAUD_RATE))
        return abs(rate - self._timing.baud_rate) <= 0.03 * self._timing.baud_rate

    # --------------------------------------------------------------------------------------------------- answers

    def _refuse(self, error: ServoError) -> ServoError:
        if error:
            self.counts.refused[dxl.error_words(error)] += 1
        return error

    def _answer(
        self,
        rows: list[int],
        time_ns: int,
        error: ServoError,
        *,
        always: bool = False,
        read: tuple[int, int] | None = None,
    ) -> list[Reply]:
        """Status packets of the servos that answer at their status return level, one after the other on the wire."""
        needed = 0 if always else _ANSWER_READ if read else _ANSWER_ALL
        answers: dict[int, list[tuple[int, bytes]]] = {}  # id -> delay and answer of each servo that has it
        for row in rows:
            head = self._table(row, _HEAD_START, _HEAD_SIZE)
            if head[-1] < needed:
                continue
            servo_id, delay = head[0], head[_HEAD_DELAY] * dxl.RETURN_DELAY_NS
            said = dxl.status(
                servo_id, int(error) | self._bank.error(row), self._table(row, *read, at_ns=time_ns) if read else b""
            )
            answers.setdefault(servo_id, []).append((delay, said))
        replies: list[Reply] = []
        heard = ((servo_id, *one) for servo_id, said in answers.items() for one in self._heard(said))
        for servo_id, delay, data in heard:
            self._answered_ns = max(time_ns + delay, self._answered_ns) + self._timing.wire_ns(len(data))
            replies.append(Reply(self._answered_ns + self._timing.usb_transaction_ns, data, servo_id))
        self._wire_free_ns = max(self._wire_free_ns, self._answered_ns)
        return replies

    def _heard(self, answers: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
        """Delays [ns] and what is heard of servos with one id: those who speak at the same time spoil each other's answer."""
        heard: list[tuple[int, bytes]] = []
        for delay, said in sorted(answers):
            if heard and delay < heard[-1][0] + self._timing.wire_ns(len(heard[-1][1])):
                heard[-1] = heard[-1][0], _collision(heard[-1][1], said)
            else:
                heard.append((delay, said))
        return heard


def _collision(*packets: bytes) -> bytes:
    """What a host hears when servos with the same id speak at once: an open-drain wire is low when any of them is."""
    size = max(len(packet) for packet in packets)
    heard = bytearray(b"\xff" * size)
    for packet in packets:
        for i, byte in enumerate(packet):
            heard[i] &= byte
    return bytes(heard)


def _nobody(data: bytes, now_ns: int) -> None:
    """Hear nothing."""


@lru_cache(maxsize=1024)
def _registers_in(address: int, size: int) -> tuple[Register, ...] | None:
    """The registers that a write of `size` bytes covers, or None where it may not: read-only, or half a register.

    Unused addresses between registers take anything.
    """
    end = address + size
    if end > dxl.TABLE_SIZE:
        return None
    found = []
    for register in dxl.REGISTERS:
        if register.address < end and address < register.address + register.size:
            whole = address <= register.address and register.address + register.size <= end
            if not whole or register.access is not Access.READ_WRITE:
                return None
            found.append(register)
    return tuple(found)


class MemoryPort:
    """A serial port whose other end is an emulated bus, or a board before it, in the same process, for lockstep.

    It has the part of pyserial's interface that the driver uses. Its time is virtual: the later of the given clock and its last
    transfer. A read waits by moving that time on, never by sleeping, so the driver sees the bus's real delays at once.
    """

    def __init__(
        self, bus: Wire, clock: Callable[[], int], timeout: float | None = 0.006, name: int | None = None, start_ns: int = 0
    ) -> None:
        """Open the port.

        Args:
            bus: The emulated bus; somebody else calls its `advance`.
            clock: Simulated time [ns].
            timeout: [s] longest wait of a read; None and 0 both mean no wait, for nothing else would move time on.
            name: Of the port, as in `Outlet`; None for whichever is there.
            start_ns: Virtual time is not before this: that of the port opened before, where one clock goes by both.

        Raises:
            OSError: There is no port, or none of that name.
        """
        self.timeout = timeout
        self.is_open = True
        self._bus = bus
        self._clock = clock
        self._last_ns = start_ns
        self._outbox = Outbox()
        self._buffer = bytearray()  # arrived, not read
        self._outlet = bus.outlet(self.now_ns())
        if self._outlet is None or name not in (None, self._outlet.name):
            found = "none" if self._outlet is None else f"{self._outlet.name}"
            raise OSError(f"port {'any' if name is None else name} of the simulated bus expected, found {found}")

    def now_ns(self) -> int:
        """Virtual time [ns]: give it to the driver as its clock."""
        return max(self._clock(), self._last_ns)

    @property
    def in_waiting(self) -> int:
        """Bytes that a read gets without waiting."""
        self._collect(self._check_open())
        return len(self._buffer)

    def write(self, data: bytes) -> int:
        """Send bytes now; the adapter's buffer takes them at once."""
        now = self._check_open()
        self._last_ns = now
        self._outbox.put(self._bus.receive(bytes(data), now))
        return len(data)

    def read(self, size: int = 1) -> bytes:
        """At most `size` bytes: as soon as there are as many, or what there is when the timeout is over."""
        now = self._check_open()
        deadline = now + round((self.timeout or 0.0) * _SEC)
        self._outbox.put(self._bus.speak(deadline))
        self._collect(now)
        while len(self._buffer) < size and (due_ns := self._outbox.due_ns) is not None and due_ns <= deadline:
            now = max(now, due_ns)
            self._collect(now)
        if len(self._buffer) < size:
            now = deadline
        self._last_ns = max(self._last_ns, now)
        data = bytes(self._buffer[:size])
        del self._buffer[:size]
        return data

    def reset_input_buffer(self) -> None:
        """Throw away what has arrived."""
        self._collect(self._check_open())
        self._buffer.clear()

    def close(self) -> None:
        """Close the port; any later use is an OSError."""
        self.is_open = False

    def _check_open(self) -> int:
        now = self.now_ns()
        if not self.is_open:
            raise OSError("the port is closed; open a new one")
        if self._bus.outlet(now) != self._outlet:
            raise OSError("the adapter was unplugged; open the port anew")
        return now

    def _collect(self, now_ns: int) -> None:
        self._buffer += self._outbox.take(now_ns)
