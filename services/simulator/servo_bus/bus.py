"""Byte-level emulation of the servo bus.

It converts bytes of the host into timed responses of the servos. Packets are parsed immediately, in the order of the wire. A
write reaches the servos when simulated time reaches the end of its packet (`ServoBusEmulator.advance`), but reads already
return pending writes. A host that is ahead of the physics, as in lockstep, therefore gets the responses of a real bus, and the
joints move at the right time.
"""

import itertools
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import lru_cache

from sextant.services.simulator.servo_bus.host_link import AdapterPort, AnswersOnly, Reply
from sextant.services.simulator.servo_bus.servo_banks import AnyBank
from sextant.shared.servo import dynamixel2, x_series
from sextant.shared.servo.servo_model import (
    Access,
    Block,
    ControlTable,
    Kind,
    Packet,
    Register,
    Request,
    ServoError,
    error_words,
)

_SEC = 1_000_000_000
_INTER_BYTE_NS = 100_000_000  # [ns] gap between bytes after which a servo discards a packet (AX-12 user's manual)
_BITS_PER_BYTE = 10  # start bit, eight data bits, stop bit
_REBOOT_NS = 300_000_000  # [ns] of silence; assumed, because no manual states it
_RETURN_DELAY_NS = 2_000  # [ns] per tick of the return delay register, of all families


@dataclass(frozen=True, slots=True)
class BusTiming:
    """Delays of the bus and of the USB adapter."""

    baud_rate: int = 1_000_000  # [bit/s]
    usb_transaction_ns: int = 1_000_000  # [ns] from the last byte on the wire to the host (FTDI latency timer)

    def __post_init__(self) -> None:
        if self.baud_rate <= 0 or self.usb_transaction_ns < 0:
            raise ValueError(f"a baud rate above 0 and a USB time of at least 0 ns expected, found {self}")

    def wire_ns(self, count: int) -> int:
        """Return the transmission time [ns] of a number of bytes."""
        return count * _BITS_PER_BYTE * _SEC // self.baud_rate


@dataclass(frozen=True, slots=True)
class _Change:
    """Pending write to the servos."""

    time_ns: int  # end of its packet on the wire
    address: int
    size: int
    rows: dict[int, bytes]  # row of the bank -> data


@dataclass(slots=True)
class BusCounts:
    """Statistics of the bus, for tests and for the operator."""

    instructions: Counter[int] = field(default_factory=Counter)  # intact packets, by instruction code
    refused: Counter[str] = field(default_factory=Counter)  # refused instructions, by error text
    unanswered: int = 0  # instructions to an id without a servo


class ServoBusEmulator(AnswersOnly):
    """Half-duplex bus with n servos behind a USB adapter.

    It has neither thread nor clock; times are arguments.
    """

    def __init__(self, bank: AnyBank, timing: BusTiming | None = None, *, echo: bool = False) -> None:
        """Connect a bank of servos.

        Args:
            bank: The servos.
            timing: Delays of the bus and of the adapter.
            echo: Whether the adapter echoes all sent bytes, as single-wire adapters do.
        """
        self.counts = BusCounts()
        self.breaks_off = False  # whether the servos behind a silent one do not answer a sync read: no manual tells
        self.overhear: Callable[[bytes, int], object] = _nobody  # receives the arriving bytes and their time [ns]
        self._bank = bank
        self._timing = timing or BusTiming(bank.model.bus_rate)
        self._echo = echo
        self._models = tuple(bank.model_of(row) for row in range(len(bank)))  # of each row
        self._tables = tuple(model.table for model in self._models)
        self._protocol = bank.model.protocol
        self._heads = tuple(map(_head, self._tables))
        self._parser = self._protocol.instruction_parser()
        self._received = 0  # number of bytes received
        self._last_ns = 0  # time of the last bytes from the host
        self._wire_free_ns = 0
        self._answered_ns = 0  # end of the last response on the wire
        self._changes: deque[_Change] = deque()
        self._registered: dict[int, tuple[int, bytes]] = {}  # row -> address and data of REG_WRITE that wait for ACTION
        self._listeners: dict[int, list[int]] = {}  # id -> rows
        self._deaf_until_ns: dict[int, int] = {}  # row -> [ns] end of its reboot
        self._cut_off: frozenset[int] = frozenset()  # rows of disconnected servos
        self._find_listeners()

    @property
    def dropped(self) -> Counter[str]:
        """Number of bytes and packets that the servos dropped, by reason."""
        return self._parser.dropped

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        """Process bytes that the host sends at a time [ns], and return the responses.

        The adapter's buffer holds the bytes while the wire is busy.
        """
        replies = []
        self.overhear(data, now_ns)
        if self._deaf_until_ns:
            self._end_reboots(now_ns)
        if self._parser.pending and now_ns - self._last_ns > _INTER_BYTE_NS:
            self._parser.flush()  # servos discard an incomplete packet
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

    def adapter_port(self, now_ns: int) -> AdapterPort | None:
        """Return the identity of the port, which never changes here."""
        return AdapterPort()

    def cut_off(self, rows: frozenset[int]) -> None:
        """Disconnect the servos in these rows from the bus, and connect all others."""
        if rows != self._cut_off:
            self._cut_off = rows
            self._find_listeners()

    def advance(self, now_ns: int) -> None:
        """Apply the writes whose packets have ended by a time [ns].

        Call it before each physics step.
        """
        while self._changes and self._changes[0].time_ns <= now_ns:
            change = self._changes.popleft()
            for row, data in change.rows.items():
                self._bank.write(row, change.address, data)

    # -------------------------------------------------------------------------------------------- instructions

    def _execute(self, packet: Packet, time_ns: int) -> Iterable[Reply]:
        broadcast = packet.servo_id == self._protocol.BROADCAST_ID
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
        request = self._protocol.request(packet)
        if request is None:
            error = self._refuse(ServoError.INSTRUCTION)
            return () if broadcast else self._answer(rows, time_ns, error)
        match request.kind:
            case Kind.PING:
                error = self._refuse(ServoError.INSTRUCTION if request.size else ServoError.NONE)
                return self._answer(rows, time_ns, error, always=True)
            case Kind.READ:
                return () if broadcast else self._read(rows, time_ns, request.address, request.size)
            case Kind.WRITE:
                error = self._write(rows, time_ns, request.address, request.data)
            case Kind.REGISTER:
                error = self._register(rows, time_ns, request.address, request.data)
            case Kind.ACTION:
                error = self._action(rows, time_ns, broadcast)
            case Kind.RESET:
                # The response is sent with the old id, where the caller expects it.
                replies = self._answer(rows, time_ns, ServoError.NONE)
                self._change(time_ns, 0, {row: self._factory(row) for row in rows})
                return replies
            case Kind.REBOOT:
                replies = [] if broadcast else self._answer(rows, time_ns, ServoError.NONE)
                self._reboot(rows, time_ns)
                return replies
            case Kind.SYNC_WRITE:
                self._sync_write(time_ns, request)
                return ()
            case Kind.SYNC_READ | Kind.FAST_SYNC_READ:
                return self._sync_read(time_ns, request)
        return () if broadcast else self._answer(rows, time_ns, error)

    def _read(self, rows: list[int], time_ns: int, address: int, size: int) -> list[Reply]:
        if size == 0 or any(address + size > self._tables[row].size for row in rows):
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
        self._note_registered(rows, time_ns, b"\x01")
        return ServoError.NONE

    def _note_registered(self, rows: list[int], time_ns: int, waits: bytes) -> None:
        """Set the register that tells whether a registered write waits."""
        for row in rows:
            self._change(time_ns, self._tables[row].registered.address, {row: waits})

    def _action(self, rows: list[int], time_ns: int, broadcast: bool) -> ServoError:
        waiting = [row for row in rows if row in self._registered]
        for row in waiting:
            address, data = self._registered.pop(row)
            self._change(time_ns, address, {row: data})
        self._note_registered(waiting, time_ns, b"\x00")
        return ServoError.NONE if waiting or broadcast else self._refuse(ServoError.INSTRUCTION)

    def _sync_write(self, time_ns: int, request: Request) -> None:
        accepted: dict[int, bytes] = {}
        for servo_id, data in request.rows:
            for row in self._listeners.get(servo_id, ()):
                error = self._check(row, request.address, data)
                if error:
                    self._refuse(error)
                else:
                    accepted[row] = data
        self._change(time_ns, request.address, accepted)

    def _end_reboots(self, now_ns: int) -> None:
        ended = [row for row, until_ns in self._deaf_until_ns.items() if until_ns <= now_ns]
        for row in ended:
            del self._deaf_until_ns[row]
        if ended:
            self._find_listeners()

    def _sync_read(self, time_ns: int, request: Request) -> list[Reply]:
        """Return the answers of several servos, in the order of the instruction; a silent one ends a combined answer."""
        read = (request.address, request.size)
        rows = [self._listeners.get(servo_id, []) for servo_id, _ in request.rows]
        rows = [[row for row in those if sum(read) <= self._tables[row].size] for those in rows]
        if self.breaks_off:
            rows = list(itertools.takewhile(len, rows))
        if request.kind is Kind.SYNC_READ:
            return self._answer([row for those in rows for row in those], time_ns, ServoError.NONE, read=read)
        heard = list(itertools.takewhile(lambda those: len(those) and self._knows_fast_read(those[0]), rows))
        parts = [
            (self._value(row, self._tables[row].id), self._error_code(row), self._table(row, *read, at_ns=time_ns))
            for row, *_ in heard
        ]
        if not parts:
            return []
        said = dynamixel2.combined_status(parts)
        if len(heard) < len(rows):  # the length in its header counts all servos
            missing = dynamixel2.combined_status([*parts, *((0, 0, bytes(request.size)) for _ in rows[len(heard) :])])
            said = missing[: len(said)]
        self._answered_ns = max(time_ns, self._answered_ns) + self._timing.wire_ns(len(said))
        self._wire_free_ns = max(self._wire_free_ns, self._answered_ns)
        due_ns, servo_ids = self._answered_ns + self._timing.usb_transaction_ns, tuple(servo_id for servo_id, *_ in parts)
        return [Reply(due_ns, said, self._protocol.BROADCAST_ID, servo_ids)]

    def _knows_fast_read(self, row: int) -> bool:
        """Return whether the firmware of a servo has the fast sync read."""
        since = self._models[row].fast_firmware
        return since is not None and self._value(row, self._tables[row].firmware) >= since

    def _reboot(self, rows: list[int], time_ns: int) -> None:
        """Restart servos: their RAM has factory values, no error is latched, and they are silent for some time."""
        for row in rows:
            self._registered.pop(row, None)
            self._bank.power_up(row)
            self._deaf_until_ns[row] = time_ns + _REBOOT_NS
        self._find_listeners()

    # ------------------------------------------------------------------------------------------------- registers

    def _check(self, row: int, address: int, data: bytes) -> ServoError:
        """Return the error of a write, NONE for a valid one.

        A valid write covers whole writable registers, has values in range, and goals within the angle limits.
        """
        model, table = self._models[row], self._tables[row]
        covered = _registers_in(table, address, len(data))
        if covered is None or self._is_protected(row, address, len(data)):
            return ServoError.RANGE
        for register in covered:
            value, most = register.decode(data[register.address - address :][: register.size]), register.max
            if model.limits_current and register.address == table.torque_limit.address:
                most = self._value(row, table.max_torque)
            if not register.min <= value <= most:
                return ServoError.RANGE
            if register is table.goal_position:
                limits = table.limits.unpack(self._table(row, table.limits.address, table.limits.size))
                low, high = limits  # both 0 is wheel mode
                if not low <= value <= high and high and self._has_limits(row):
                    return ServoError.ANGLE_LIMIT
        return ServoError.NONE

    def _has_limits(self, row: int) -> bool:
        """Return whether the angle limits of a servo have an effect in its operating mode."""
        mode = self._tables[row].operating_mode
        return mode is None or self._value(row, mode) == x_series.POSITION_MODE

    def _is_protected(self, row: int, address: int, size: int) -> bool:
        """Return whether a lock, which ends only with the power, or torque protects these registers."""
        model, table = self._models[row], self._tables[row]
        lock, free = table.lock, table.unlocked
        if model.eeprom_needs_torque_off:
            return address < table.torque_enable.address and bool(self._value(row, table.torque_enable))
        if model.unlocks:  # what is written is lost without power, but acts
            return False
        return lock is not None and not (free.start <= address <= free.stop - size) and bool(self._value(row, lock))

    def _table(self, row: int, address: int, size: int, at_ns: int | None = None) -> bytes:
        """Return bytes of a control table at a time [ns], with pending writes applied."""
        data = self._bank.read(row, address, size, at_ns)
        for change in self._changes:
            if change.address < address + size and address < change.address + change.size and row in change.rows:
                table = bytearray(max(change.address + change.size, address + size))
                table[address : address + size] = data
                table[change.address : change.address + change.size] = change.rows[row]
                data = bytes(table[address : address + size])
        return data

    def _value(self, row: int, register: Register) -> int:
        return register.decode(self._table(row, register.address, register.size))

    def _change(self, time_ns: int, address: int, rows: dict[int, bytes]) -> None:
        if not rows:
            return
        size = len(next(iter(rows.values())))
        self._changes.append(_Change(time_ns, address, size, rows))
        if any(
            address <= self._tables[row].baud_rate.address and self._tables[row].id.address < address + size for row in rows
        ):
            self._find_listeners()

    def _factory(self, row: int) -> bytes:
        """Return the factory table of a servo, with its current measured values."""
        table = bytearray(self._models[row].factory_table())
        for register in (*self._tables[row].measured, self._tables[row].moving):
            start, end = register.address, register.address + register.size
            table[start:end] = self._bank.read(row, start, register.size)
        return bytes(table)

    def _find_listeners(self) -> None:
        """Update the map from ids to the servos that receive the host's packets."""
        self._listeners = {}
        for row in filter(self._hears, range(len(self._bank))):
            self._listeners.setdefault(self._value(row, self._tables[row].id), []).append(row)

    def _hears(self, row: int) -> bool:
        """Return whether a servo is connected and has the host's baud rate.

        The receiver tolerates a difference of 3 %.
        """
        if row in self._cut_off or row in self._deaf_until_ns:
            return False
        rate = self._models[row].rates.get(self._value(row, self._tables[row].baud_rate), 0)
        return abs(rate - self._timing.baud_rate) <= 0.03 * self._timing.baud_rate

    # ------------------------------------------------------------------------------------------------- responses

    def _refuse(self, error: ServoError) -> ServoError:
        if error:
            self.counts.refused[error_words(error)] += 1
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
        """Return the status packets of the servos, in sequence on the wire.

        A servo responds if its status return level requires it.
        """
        answers: list[tuple[int, int, bytes]] = []  # id, delay [ns] and response of each servo
        for row in rows:
            commands, head = self._models[row].commands, self._heads[row]
            if commands is not None and read is None:  # only what reads is answered
                continue
            servo_id, delay, level = head.unpack(self._table(row, head.address, head.size))
            everything = self._tables[row].status_return_level.max
            if level < (0 if always else everything - 1 if read else everything):
                continue
            delay *= _RETURN_DELAY_NS
            data = self._table(row, *read, at_ns=time_ns) if read else self._identity(row) if always else b""
            code = self._error_code(row, error) if commands is None or read is None else commands.reading(*read)
            said = self._protocol.status(servo_id, code, data)
            answers.append((servo_id, delay, said))
        replies: list[Reply] = []
        for servo_id, delay, data in answers if len(answers) == 1 else self._heard(answers):
            self._answered_ns = max(time_ns + delay, self._answered_ns) + self._timing.wire_ns(len(data))
            replies.append(Reply(self._answered_ns + self._timing.usb_transaction_ns, data, servo_id))
        self._wire_free_ns = max(self._wire_free_ns, self._answered_ns)
        return replies

    def _identity(self, row: int) -> bytes:
        """Return the parameters of the answer to a ping: model number and firmware, or none."""
        registers = (self._tables[row].model_number, self._tables[row].firmware)
        return b"".join(self._table(row, one.address, one.size) for one in registers)[: self._protocol.PING_SIZE]

    def _error_code(self, row: int, error: ServoError = ServoError.NONE) -> int:
        """Return the error code of an answer of a servo, with the errors of an instruction."""
        return self._protocol.error_code(error, self._bank.error(row))

    def _heard(self, answers: list[tuple[int, int, bytes]]) -> list[tuple[int, int, bytes]]:
        """Return ids, delays [ns] and bytes on the wire of answers.

        Simultaneous responses of servos with the same id collide.
        """
        heard: list[tuple[int, int, bytes]] = []
        order = list(dict.fromkeys(servo_id for servo_id, _, _ in answers))
        for servo_id, delay, said in sorted(answers, key=lambda answer: (order.index(answer[0]), *answer[1:])):
            last_id, began_ns, data = heard[-1] if heard else (-1, 0, b"")
            if servo_id == last_id and delay < began_ns + self._timing.wire_ns(len(data)):
                heard[-1] = servo_id, began_ns, _collision(data, said)
            else:
                heard.append((servo_id, delay, said))
        return heard


@lru_cache(maxsize=64)
def _head(table: ControlTable) -> Block:
    """Return the registers on which the answer of a servo depends, which one read returns."""
    return Block((table.id, table.return_delay, table.status_return_level))


def _collision(*packets: bytes) -> bytes:
    """Return the bytes of a collision of packets.

    The wire is open-drain, so it is low if any servo pulls it low.
    """
    size = max(len(packet) for packet in packets)
    heard = bytearray(b"\xff" * size)
    for packet in packets:
        for i, byte in enumerate(packet):
            heard[i] &= byte
    return bytes(heard)


def _nobody(data: bytes, now_ns: int) -> None:
    """Ignore the bytes."""


@lru_cache(maxsize=1024)
def _registers_in(table: ControlTable, address: int, size: int) -> tuple[Register, ...] | None:
    """Return the registers that a write of `size` bytes covers.

    The result is None if it covers a read-only register, or a register only partly. Unused addresses between registers accept
    any value.
    """
    end = address + size
    if end > table.size:
        return None
    found = []
    for register in table.registers:
        if register.address < end and address < register.address + register.size:
            whole = address <= register.address and register.address + register.size <= end
            if not whole or register.access is not Access.READ_WRITE:
                return None
            found.append(register)
    return tuple(found)
