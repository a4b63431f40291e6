"""Requests and answers on one serial port to the servos.

The parser resynchronises on noise, drops echoes of single-wire adapters and counts every loss. There is no thread and no
sleep; time is an argument.
"""

import errno
import logging
import os
import re
import socket
import termios
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from enum import StrEnum
from typing import Any, Protocol

import serial
from serial.urlhandler import protocol_socket

from sextant.services.actuator.servo_bus import i2c_port, usb_adapter
from sextant.shared.errors import SextantError
from sextant.shared.runtime.clock import now_ns
from sextant.shared.runtime.simulated_time import REACTION_NS, SERVO_BUS, hold, limit_of
from sextant.shared.servo import dynamixel2
from sextant.shared.servo.bus_ports import find_port
from sextant.shared.servo.servo_model import REFUSAL, Packet, ServoModel

log = logging.getLogger(__name__)

REPLY_TIMEOUT_NS = 6_000_000  # [ns] 5 ms, ten times a servo's factory return delay, and one USB transaction
BAUD_RATE = 1_000_000
_WRITE_TIMEOUT_S = 0.5  # [s] without progress of a write after which the port is gone
_SETTLES_NS = 100_000_000  # [ns] after which a lost answer cannot arrive any more: six USB transactions at the slowest
_UNASKED_NS = 1_100_000_000  # [ns] of silence of another device: many send once a second
_UNASKED_BYTES, _UNASKED_READS = 1024, 2000  # limits of bytes and reads from it
_ECHO_ATTEMPTS = 2  # to find an echo: noise may break one
_READ_ALL_BYTES = 4096  # [bytes] to read at once: more than can arrive within a timeout
_SIMULATOR_S = 1.0  # [s] of real time after which the simulator does not answer any more
_UNDERWAY_NS = 2_000_000  # [ns] of a USB transaction and the return delays, after which all answers have arrived
BYTE_NS = 10_000  # [ns] of a byte at the usual rate
_NS_PER_S = 1e9
LOST = (OSError, termios.error)  # SerialException is an OSError; termios.error is not
_LAST_PORT = 65535
_EXPECTED = "a serial device such as /dev/ttyUSB0, or socket://HOST:PORT,"


class BusDisconnectedError(SextantError, ConnectionError):
    """The port was closed, unplugged or hung up; open a new one and run setup."""

    exit_status = 1


class Port(Protocol):
    """The part of pyserial's `Serial` that the driver uses."""

    def write(self, data: bytes, /) -> int | None:
        """Send bytes."""

    def read(self, size: int = 1, /) -> bytes:
        """Return at most `size` bytes, fewer after the port's timeout."""

    def reset_input_buffer(self) -> None:
        """Discard received bytes."""

    def close(self) -> None:
        """Close the port."""


class _Connection(protocol_socket.Serial):
    """TCP port with immediate close; pyserial's own sleeps for 0.3 s.

    No control cycle can wait that long.
    """

    _socket: socket.socket | None

    def read(self, size: int = 1) -> bytes:
        """Return at most `size` bytes, fewer after the timeout.

        The timeout runs in simulated time if that is shared. An answer that is due before it is then not lost if the simulator
        sends it late, up to a second of real time.
        """
        until_ns = now_ns() + round((self.timeout or 0.0) * 1e9)
        reads = round(_SIMULATOR_S / max(self.timeout or 0.0, 1e-3))  # each takes at most a timeout of real time
        data: bytes = super().read(size)
        while len(data) < size:
            reads -= 1
            is_due = limit_of(SERVO_BUS) - REACTION_NS < until_ns and reads > 0
            if now_ns() >= until_ns and not is_due and not self.in_waiting:  # in this order: it may arrive meanwhile
                break
            data += super().read(size - len(data))
        hold(SERVO_BUS, None)
        return data

    def write(self, data: Any, /) -> int | None:
        """Send bytes; simulated time waits until the bus has received them."""
        hold(SERVO_BUS, now_ns() + REACTION_NS)
        sent: int | None = super().write(data)
        return sent

    def close(self) -> None:
        """Close the connection, whether or not the peer is still there."""
        connection, self._socket, self.is_open = self._socket, None, False
        if connection is not None:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()


class Lost(StrEnum):
    """Why a request got no usable answer.

    `Dropped` reasons of a parser and final `Implausibility` reasons are counted separately.
    """

    TIMEOUT = "no answer"
    STRANGER = "answer from another servo"
    SIZE = "answer of the wrong size"
    ECHO = "echo differs from what was sent"
    REFUSED = "refused by the servo"


def open_port(url: str, baud_rate: int = BAUD_RATE, timeout_ns: int = REPLY_TIMEOUT_NS) -> Port:
    """Open a serial device (`/dev/ttyUSB0`), an I2C bus (`/dev/i2c-1`) or a network port (`socket://host:port`).

    Args:
        url: Anything `serial.serial_for_url` takes.
        baud_rate: [1/s] the servos' baud rate.
        timeout_ns: [ns] longest wait of one read. It is set once: changing it on an open device costs system calls.

    Raises:
        BusDisconnectedError: The port cannot be opened.
    """
    if url.startswith(i2c_port.PREFIX):
        return _open_i2c(url)
    address = re.fullmatch(r"(socket|rfc2217)://[^/]+:(\d{1,5})([/?].*)?", url)
    if url.startswith(("socket://", "rfc2217://")) and (address is None or int(address[2]) > _LAST_PORT):
        raise BusDisconnectedError(f"cannot open servo port {url}: {_EXPECTED} expected")
    alone = None if "://" in url else True  # two programs would read each other's answers
    network = url.startswith("socket://")
    kind = _Connection if network else serial.serial_for_url
    try:
        port = kind(url, baudrate=baud_rate, timeout=timeout_ns / _NS_PER_S, write_timeout=_WRITE_TIMEOUT_S, exclusive=alone)
        if network:
            # pyserial leaves Nagle's algorithm on: a read request behind a sync write would wait 40 ms for the first
            # packet's acknowledgement. The option belongs to the connection, so a duplicate of the handle can set it.
            with socket.socket(fileno=os.dup(port.fileno())) as connection:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    except LOST as error:
        number = _errno(error)
        cause = os.strerror(number) if number else str(error)  # the text of pyserial repeats the port and the number
        raise BusDisconnectedError(f"cannot open servo port {url}: {cause}; {_advice(number, url)}") from error
    except (ValueError, TypeError) as error:  # raised by pyserial for an invalid address
        raise BusDisconnectedError(f"cannot open servo port {url}: {_EXPECTED} expected") from error
    if slow := usb_adapter.lower_latency(url, port):
        log.warning(slow)
    return port


def _open_i2c(path: str) -> Port:
    """Open an I2C bus of boards that send pulses."""
    try:
        return i2c_port.I2cPort(path)
    except OSError as error:
        advice = find_port(path) if error.errno == errno.ENOENT else "join the group i2c, then log in again"
        raise BusDisconnectedError(f"cannot open I2C bus {path}: {error.strerror}; {advice}") from error


def _errno(error: Exception) -> int | None:
    """Return the number of a system error, None if it is none; pyserial hides that of a socket."""
    reason = error.__context__
    if isinstance(reason, termios.error):
        return int(reason.args[0])
    return getattr(error, "errno", None) or getattr(reason, "errno", None)


def _advice(number: int | None, url: str) -> str:
    """Return what to do about a port that cannot be opened, by the number of the system error."""
    match number:
        case errno.EACCES | errno.EPERM:
            return "this user may not open it: run `sudo usermod -aG dialout $USER`, then log in again"
        case errno.EAGAIN | errno.EBUSY:
            return "another program uses it; end that program first"
        case errno.ENOENT:
            return find_port(url)
        case errno.ENOTTY:
            return f"{_EXPECTED} expected; `ls /dev/ttyUSB* /dev/ttyACM*` lists the ports"
        case errno.ECONNREFUSED:
            return "is the simulator, or `sextant servos emulate`, running?"
    return "check that the adapter is plugged in and no other program uses it, or that the simulator is running"


class SerialLine:
    """Requests and answers over an open port."""

    def __init__(
        self, port: Port, clock: Callable[[], int], models: Sequence[ServoModel], *, echo: bool, reply_timeout_ns: int
    ) -> None:
        """Take over an open port to servos of models with one protocol; see `ServoBus`."""
        self.lost: Counter[str] = Counter()  # by `Lost`
        self.reply_timeout_ns = reply_timeout_ns
        self._port = port
        self._clock = clock
        self._echo = echo
        model = models[0]
        self._protocol, self._max_parameters = model.protocol, max(one.table.size for one in models)
        self._parser = self._protocol.answer_parser(self._max_parameters)
        self._answer_code = model.commands.answer_code if model.commands else None
        self._code = -1  # of the right answer to the last request, where answers have one
        self._stale = False  # bytes of a lost answer may remain in the port ...
        self._settled_ns = 0  # ... or arrive until then
        self._unheard = bytearray()  # sent, echo not yet read

    @property
    def dropped(self) -> Counter[str]:
        """Bytes and packets that were no answer, by reason."""
        return self._parser.dropped

    def send(self, data: bytes, now_ns: int | None = None) -> None:
        """Send a packet; `now_ns` [ns] is the present time if the caller has just read its clock.

        Raises:
            BusDisconnectedError: The port is gone.
        """
        try:
            # A late answer would be taken for that to the next request; with echo it is recognised, as it precedes the echo.
            now_ns = self._clock() if now_ns is None else now_ns
            if self._stale or (not self._echo and now_ns < self._settled_ns):
                self._port.reset_input_buffer()
                self._unheard.clear()
                self._stale = False
            self._port.write(data)
        except LOST as error:
            raise gone(error) from error
        if self._echo:
            self._unheard += data

    def exchange(self, request: bytes, servo_id: int, size: int, end_ns: int, now_ns: int | None = None) -> Packet | None:
        """Like `attempt`, and count a missing answer."""
        answer = self.attempt(request, servo_id, size, end_ns, now_ns)
        if answer is None:
            self.lost[Lost.TIMEOUT] += 1
        return answer

    def attempt(self, request: bytes, servo_id: int, size: int, end_ns: int, now_ns: int | None = None) -> Packet | None:
        """Send a request and return the servo's answer or refusal, else None.

        An answer has `size` parameters. `now_ns` [ns] is the present time if the caller has just read its clock.

        A read that may take a whole timeout begins by `end_ns`, except for the first.

        Raises:
            BusDisconnectedError: The port is gone.
        """
        now_ns = self._clock() if now_ns is None else now_ns
        self.ask(request, now_ns)
        return self._answer(servo_id, size, end_ns, now_ns)

    def ask(self, request: bytes, now_ns: int) -> None:
        """Send a request at the present time [ns], and discard what remains of earlier answers; see `answer`.

        Raises:
            BusDisconnectedError: The port is gone.
        """
        if self._parser.pending:  # from earlier data
            self._parser.flush()
        if self._answer_code is not None:
            self._code = self._answer_code(request)
        self.send(request, now_ns)

    def answer(self, servo_id: int, size: int, end_ns: int, asked_ns: int) -> Packet | None:
        """Return the servo's answer or refusal to a request that was sent at `asked_ns` [ns]; count a missing one."""
        answer = self._answer(servo_id, size, end_ns, asked_ns)
        if answer is None:
            self.lost[Lost.TIMEOUT] += 1
        return answer

    def _answer(self, servo_id: int, size: int, end_ns: int, asked_ns: int) -> Packet | None:
        answer = self._await(servo_id, size, end_ns, asked_ns)
        if answer is None:
            self._stale, self._settled_ns = True, self._clock() + _SETTLES_NS
        return answer

    def answers(self, servo_ids: Sequence[int], size: int, asked_ns: int) -> dict[int, Packet]:
        """Return the answers to a request to several servos, which answer one after the other, by id.

        A missing answer is counted. The request was sent at `asked_ns` [ns]; the answers have `size` parameters.

        Raises:
            BusDisconnectedError: The port is gone.
        """
        whole, found = self._protocol.OVERHEAD + size, dict[int, Packet]()
        deadline = asked_ns + len(servo_ids) * whole * BYTE_NS + _UNDERWAY_NS
        while len(found) < len(servo_ids):
            data = self._receive(max((len(servo_ids) - len(found)) * whole - self._parser.pending, 1))
            if data is None:
                break
            self._keep_answers(self._parser.feed(data), servo_ids, size, found)
            if self._clock() >= deadline:  # the rest is missing: this read has waited for it
                break
        if len(found) < len(servo_ids):
            self._keep_answers(self._parser.flush(), servo_ids, size, found)
        self._note_missing(len(servo_ids) - len(found))
        return found

    def fast_answers(self, servo_ids: Sequence[int], size: int, asked_ns: int) -> dict[int, Packet]:
        """Return the parts of the common answer to a fast sync read, by id.

        A missing part is counted. The request was sent at `asked_ns` [ns]; the parts have `size` bytes of data.

        Raises:
            BusDisconnectedError: The port is gone.
        """
        sizes = [size] * len(servo_ids)
        length = dynamixel2.combined_length(sizes)
        parser, whole, packets = dynamixel2.PacketParser(length, keep_broken=True), dynamixel2.HEAD + length, list[Packet]()
        deadline = asked_ns + whole * BYTE_NS + _UNDERWAY_NS
        while not packets and (data := self._receive(max(whole - parser.pending, 1))) is not None:
            packets = parser.feed(data)
            if self._clock() >= deadline:
                break
        packets += parser.flush()
        self._parser.dropped.update(parser.dropped)
        combined = [packet for packet in packets if packet.servo_id == dynamixel2.BROADCAST_ID]
        parts = dynamixel2.split_status(combined[0], sizes) if combined else []
        found = {part.servo_id: part for part in parts if part.servo_id in servo_ids}
        if list(found) != [i for i in servo_ids if i in found]:  # an old answer: servos answer in turn
            self.lost[Lost.STRANGER] += len(found)
            found = {}
        self._note_missing(len(servo_ids) - len(found))
        return found

    def _note_missing(self, missing: int) -> None:
        """Count answers that are missing; their bytes may still arrive."""
        if missing:
            self.lost[Lost.TIMEOUT] += missing
            self._stale, self._settled_ns = True, self._clock() + _SETTLES_NS

    def _keep_answers(self, packets: Iterable[Packet], servo_ids: Sequence[int], size: int, found: dict[int, Packet]) -> None:
        """Add answers with `size` parameters of servos that were asked.

        Servos answer in turn. Of answers that are not in order, one is old: none of them is kept.
        """
        for packet in packets:
            if packet.servo_id not in servo_ids:
                self.lost[Lost.STRANGER] += 1
            elif len(packet.parameters) != size:
                self.lost[Lost.SIZE] += 1
            elif early := [i for i in servo_ids[servo_ids.index(packet.servo_id) :] if i in found]:
                self.lost[Lost.STRANGER] += 1 + len(early)
                for servo_id in early:
                    del found[servo_id]
            else:
                found[packet.servo_id] = packet

    def overhear(self, request: bytes) -> tuple[list[Packet], bytes]:
        """Return all packets after a request, and all bytes if some of them are in no packet.

        It listens for the reply timeout.
        """
        parser, packets, heard = self._protocol.answer_parser(self._max_parameters), [], b""
        self.send(request)
        deadline = self._clock() + self.reply_timeout_ns
        while (data := self._receive(self._protocol.OVERHEAD + self._protocol.PING_SIZE)) is not None:
            heard += data
            packets += parser.feed(data)
            if self._clock() >= deadline:
                break
        self._stale = True
        packets += parser.flush()
        return packets, heard if parser.dropped.total() else b""

    def echoes(self, request: bytes) -> bool:
        """Return whether the port returns a request, of which no answer is a copy. It listens for the reply timeout.

        Raises:
            BusDisconnectedError: The port is gone.
        """
        heard = b""
        for _ in range(_ECHO_ATTEMPTS):
            heard += self.bytes_after(request)
            if request in heard:
                return True
        return False

    def bytes_after(self, request: bytes) -> bytes:
        """Return all bytes after a request, with its echo if there is one. It listens for the reply timeout.

        Raises:
            BusDisconnectedError: The port is gone.
        """
        self.send(request)
        try:
            heard = self._port.read(_READ_ALL_BYTES)
        except LOST as error:
            raise gone(error) from error
        self._unheard.clear()
        self._stale = True
        return heard

    def change_rate(self, rate: int) -> bool:
        """Change the baud rate [1/s] of the host; return whether the port has one.

        Raises:
            BusDisconnectedError: The port is gone.
        """
        if isinstance(self._port, _Connection) or not hasattr(self._port, "baudrate"):
            return False
        try:
            self._port.baudrate = rate
        except LOST as error:
            raise gone(error) from error
        return True

    def unrequested_bytes(self) -> bytes:
        """Return the first bytes within a second without a request; servos send none.

        Raises:
            BusDisconnectedError: The port is gone.
        """
        heard = b""
        try:
            self._port.read(_READ_ALL_BYTES)  # rest of an answer
            deadline = self._clock() + _UNASKED_NS
            for _ in range(_UNASKED_READS):
                heard += self._port.read(_UNASKED_BYTES - len(heard))
                if len(heard) >= _UNASKED_BYTES or self._clock() >= deadline:
                    break
        except LOST as error:
            raise gone(error) from error
        return heard

    def _await(self, servo_id: int, size: int, end_ns: int, now_ns: int) -> Packet | None:
        deadline = min(now_ns + self.reply_timeout_ns, end_ns + 1)
        whole = wanted = self._protocol.OVERHEAD + size
        while True:
            data = self._receive(wanted)
            if data is None:
                self._drain(end_ns)
                return None
            for packet in self._parser.feed(data):
                if self._is_answer(packet, servo_id, size):
                    return packet
            # A broken answer has arrived, and no other will follow.
            broken = not self._parser.pending and len(data) == whole and data.startswith(self._protocol.answer_start(servo_id))
            if broken or self._clock() >= deadline:
                break
            # Noise before the packet has displaced its end from the bytes read.
            wanted = max(whole - self._parser.pending, 1)
        for packet in self._parser.flush():  # noise may have announced a longer packet than received
            if self._is_answer(packet, servo_id, size):
                return packet
        return None

    def _drain(self, end_ns: int) -> None:
        """Discard late bytes, which would be taken for the next echo, if time allows."""
        if self._clock() <= end_ns:
            try:
                self._port.read(_READ_ALL_BYTES)
            except LOST as error:
                raise gone(error) from error

    def _receive(self, count: int) -> bytes | None:
        """Return up to `count` bytes after the adapter's echo; None for a wrong echo."""
        due = len(self._unheard)
        try:
            data = self._port.read(count + due)
        except LOST as error:
            raise gone(error) from error
        if not due:
            return data
        echo, data = data[:due], data[due:]
        if echo != self._unheard[: len(echo)]:
            self.lost[Lost.ECHO] += 1
            return None
        del self._unheard[: len(echo)]
        return data

    def _is_answer(self, packet: Packet, servo_id: int, size: int) -> bool:
        if packet.servo_id != servo_id or (self._answer_code is not None and packet.code != self._code):
            self.lost[Lost.STRANGER] += 1
            return False
        if len(packet.parameters) == size or (self._protocol.ERRORS[packet.code] & REFUSAL and not packet.parameters):
            return True
        self.lost[Lost.SIZE] += 1
        return False


def gone(error: Exception) -> BusDisconnectedError:
    """Return the `BusDisconnectedError` error for a failure of the port."""
    return BusDisconnectedError(
        f"the servo port is gone ({error}); check the adapter's cable, or the simulator, and whether another program uses it"
    )
