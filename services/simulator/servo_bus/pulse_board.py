"""Emulated boards that send pulses to hobby servos: a Pololu Maestro and PCA9685.

Like `ServoBusEmulator`, a board converts bytes of the host into timed answers. Its pulses reach the servos when simulated time
reaches them (`advance`). A servo without pulses has no torque, and the first pulse makes it jump to its goal.
"""

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field

from sextant.services.simulator.servo_bus.host_link import AdapterPort, AnswersOnly, Reply
from sextant.services.simulator.servo_bus.pca9685_chip import Pca9685Chip
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.shared.servo import maestro, pca9685
from sextant.shared.servo.maestro import Command
from sextant.shared.servo.pwm import TICKS_PER_US, Pulses

_SEC = 1_000_000_000
_USB_NS = 1_000_000  # [ns] of a USB transaction
_BITS_PER_BYTE = 10
_BOARD = 255  # sender of the answers, for faults; no channel has this number
_I2C_BIT_NS = 2_500  # [ns] of a bit at 400 kbit/s; each byte has an acknowledgement, too
_STALE_NS = 100_000_000  # [ns] pause that no transfer has


@dataclass(slots=True)
class _Change:
    """Pulses that begin at a time."""

    time_ns: int
    widths_us: dict[int, float]  # row of the bank -> width, 0 for no pulses


@dataclass(slots=True)
class BoardCounts:
    """Statistics of the board, for tests and for the operator."""

    commands: Counter[str] = field(default_factory=Counter)


class PulseBoardEmulator(AnswersOnly):
    """Board with the servos of a bank at its channels; it has neither thread nor clock."""

    def __init__(self, bank: ServoBank, pulses: Pulses) -> None:
        """Connect a bank whose ids are channels. Its servos with torque have pulses."""
        self.counts = BoardCounts()
        self.overhear: Callable[[bytes, int], object] = _nobody  # receives the arriving bytes and their time [ns]
        self._bank, self._pulses = bank, pulses
        self._rows = {int(channel): row for row, channel in enumerate(bank.column(bank.table.id).tolist())}
        self._period_ns = round(_SEC / pulses.rate_hz)
        self._changes: deque[_Change] = deque()
        self._cut_off: frozenset[int] = frozenset()  # rows of disconnected servos
        table = bank.table
        torque, goals = bank.column(table.torque_enable).tolist(), bank.column(table.goal_position).tolist()
        self._start = {
            channel: pulses.width_us(goals[row]) if torque[row] else 0.0 for channel, row in self._rows.items()
        }  # [us] pulses at the beginning

    def adapter_port(self, now_ns: int) -> AdapterPort | None:
        """Return the identity of the port, which never changes here."""
        return AdapterPort()

    def cut_off(self, rows: frozenset[int]) -> None:
        """Disconnect the servos in these rows; the board does not notice."""
        for row in rows - self._cut_off:
            self._apply(row, 0.0)
        self._cut_off = rows

    def advance(self, now_ns: int) -> None:
        """Apply the pulses that have begun by a time [ns]; call it before each physics step."""
        while self._changes and self._changes[0].time_ns <= now_ns:
            for row, width_us in self._changes.popleft().widths_us.items():
                if row not in self._cut_off:
                    self._apply(row, width_us)

    def _apply(self, row: int, width_us: float) -> None:
        """Move a servo to its pulses; without pulses, or beyond its range, as it would."""
        table, most = self._bank.table, self._bank.model.units.max_position
        if not width_us:
            if self._bank.column(table.torque_enable)[row]:
                self._bank.write(row, table.torque_enable.address, b"\x00")
            return
        ticks = min(max(self._pulses.ticks(width_us), 0), most)
        if not self._bank.column(table.torque_enable)[row]:
            self._bank.write(row, table.torque_enable.address, b"\x01" + table.goal_position.encode(ticks))
        else:
            self._bank.write(row, table.goal_position.address, table.goal_position.encode(ticks))

    def _change(self, now_ns: int, widths_us: dict[int, float]) -> None:
        """Change the pulses of channels [us] from their next period on."""
        rows = {self._rows[channel]: width for channel, width in widths_us.items() if channel in self._rows}
        self._changes.append(_Change(-(-now_ns // self._period_ns) * self._period_ns, rows))


class MaestroEmulator(PulseBoardEmulator):
    """Mini Maestro 24 whose channels start without pulses and ignore errors; both of its protocols."""

    def __init__(self, bank: ServoBank, pulses: Pulses, *, on_uart: bool = False) -> None:
        """Connect a bank of servos; the host is at its UART, or at USB."""
        super().__init__(bank, pulses)
        self._byte_ns = _BITS_PER_BYTE * _SEC // bank.model.bus_rate if on_uart else 0
        self._delay_ns = 0 if on_uart else _USB_NS
        self._in_free_ns = self._out_free_ns = 0  # [ns] times up to which the UART is busy, per direction
        self._parser = maestro.CommandParser(pulses.device or maestro.DEVICE)
        start = {channel: round(width * TICKS_PER_US) for channel, width in self._start.items()}
        self._targets = [start.get(channel, maestro.OFF) for channel in range(maestro.MAX_CHANNELS)]  # [quarter us]

    def restart(self, now_ns: int) -> None:
        """Lose the power of the board: no channel has pulses afterwards."""
        self._parser = maestro.CommandParser(self._pulses.device or maestro.DEVICE)
        self._targets = [maestro.OFF] * maestro.MAX_CHANNELS
        self._change(now_ns, dict.fromkeys(range(maestro.MAX_CHANNELS), 0.0))

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        """Process bytes that the host sends at a time [ns], and return the answers."""
        self.overhear(data, now_ns)
        replies = []
        self._in_free_ns = max(now_ns, self._in_free_ns) + len(data) * self._byte_ns
        for packet in self._parser.feed(data):
            self.counts.commands[packet.command.name] += 1
            if answer := self._execute(packet, self._in_free_ns):
                self._out_free_ns = max(self._in_free_ns, self._out_free_ns) + len(answer) * self._byte_ns
                replies.append(Reply(self._out_free_ns + self._delay_ns, answer, _BOARD))
        return replies

    def _execute(self, packet: maestro.Packet, now_ns: int) -> bytes:
        """Execute a command, and return its answer."""
        data = packet.data
        match packet.command:
            case Command.SET_TARGET | Command.SET_MULTIPLE_TARGETS | Command.GO_HOME:
                self._set(maestro.targets(packet), now_ns)
            case Command.GET_POSITION:
                target = self._targets[data[0]] if data[0] < maestro.MAX_CHANNELS else maestro.OFF
                return target.to_bytes(2, "little")
            case Command.GET_MOVING_STATE:
                return b"\x00"
            case Command.GET_ERRORS:
                errors, self._parser.errors = self._parser.errors, maestro.BoardError.NONE
                return int(errors).to_bytes(2, "little")
            case Command.SET_SPEED | Command.SET_ACCELERATION:
                pass  # the host sets none
        return b""

    def _set(self, targets: dict[int, int], now_ns: int) -> None:
        """Set targets [quarter us] of channels."""
        if max(targets, default=0) >= maestro.MAX_CHANNELS:
            self._parser.errors |= maestro.BoardError.PROTOCOL
            return
        for channel, target in targets.items():
            self._targets[channel] = target
        self._change(now_ns, {channel: target / TICKS_PER_US for channel, target in targets.items()})


class Pca9685Emulator(PulseBoardEmulator):
    """Two PCA9685 on an I2C bus, behind a port that takes encoded transfers."""

    def __init__(self, bank: ServoBank, pulses: Pulses) -> None:
        """Connect a bank of servos; the boards are awake if any of them has pulses."""
        super().__init__(bank, pulses)
        first, hertz = pulses.device or pca9685.ADDRESS, pulses.oscillator_mhz * 1e6
        self._parser, self._heard_ns = pca9685.FrameParser(), 0
        self._chips = {first + number: Pca9685Chip(hertz) for number in range(2)}
        for number, chip in enumerate(self._chips.values()):
            widths = [self._start.get(number * pca9685.CHANNELS + channel, 0.0) for channel in range(pca9685.CHANNELS)]
            if any(widths):
                chip.start(pulses.rate_hz, widths)

    def restart(self, now_ns: int) -> None:
        """Lose the power of the boards: they sleep afterwards."""
        for chip in self._chips.values():
            chip.power_on()
        self._change(now_ns, dict.fromkeys(self._rows, 0.0))

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        """Process encoded transfers that the host sends at a time [ns], and return the answers."""
        self.overhear(data, now_ns)
        if now_ns > self._heard_ns + _STALE_NS:  # bytes before a pause are no part of a transfer
            self._parser = pca9685.FrameParser()
        self._heard_ns = now_ns
        replies = []
        for transfer in self._parser.feed(data):
            chip = self._chips.get(transfer.address)
            self.counts.commands["transfer" if chip else "not acknowledged"] += 1
            read = None if chip is None else chip.transfer(transfer.data, transfer.size)
            if chip is not None and len(transfer.data) > 1:
                self._change(now_ns, self._widths_us())
            answer = pca9685.answer(read)
            now_ns += 9 * _I2C_BIT_NS * (2 + len(transfer.data) + transfer.size)
            replies.append(Reply(now_ns, answer + bytes(transfer.size + 1 - len(answer)), _BOARD))
        return replies

    def _widths_us(self) -> dict[int, float]:
        """Return the pulses [us] of all channels, 0 for none."""
        widths = [width for chip in self._chips.values() for width in chip.widths_us()]
        return dict(enumerate(widths))


def make_board(bank: ServoBank, pulses: Pulses, *, on_uart: bool = False) -> MaestroEmulator | Pca9685Emulator:
    """Return the emulated board of a profile with a bank of servos; a Maestro is at a UART or at USB."""
    return MaestroEmulator(bank, pulses, on_uart=on_uart) if pulses.board == "maestro" else Pca9685Emulator(bank, pulses)


def _nobody(data: bytes, now_ns: int) -> None:
    """Ignore the bytes."""
