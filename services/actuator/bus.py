"""The servo bus driver: Dynamixel Protocol 1.0 over anything with pyserial's read and write.

No thread and no sleep; time comes from a clock argument. In the loop nothing that the bus does raises but `BusGone`: a packet
that is lost, broken or refused is counted by reason, and its servo's reading grows old.
"""

import logging
import os
import socket
import termios
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np
import serial
from numpy.typing import ArrayLike, NDArray

from services.actuator import roll_call, usb_adapter
from services.actuator.roll_call import Chorus, Problem, Voice
from shared import dynamixel as dxl
from shared.dynamixel import PRESENT_STATE, Packet, PacketParser, Register, ServoError, ServoModel

log = logging.getLogger(__name__)

REPLY_TIMEOUT_NS = 6_000_000  # [ns] 5 ms, ten times a servo's factory return delay, and one USB transaction
BAUD_RATE = 1_000_000
_WRITE_TIMEOUT = 0.5  # [s] a port that takes no bytes for so long is gone
_PATIENCE = 3  # questions in a row that a servo may leave open before it is asked more rarely: a busy host loses answers
_MAX_BACKOFF = 32  # a silent servo is still asked every this many turns
_TYPICAL_NS = 1_300_000  # [ns] a read of 8 bytes over USB, until measured
_SMOOTHING = 8  # transactions over which the typical time is smoothed
_SEC = 1e9
_REFUSAL = int(ServoError.ANGLE_LIMIT | ServoError.RANGE | ServoError.CHECKSUM | ServoError.INSTRUCTION)
LOST = (OSError, termios.error)  # SerialException is an OSError; termios.error is not


class BusGone(ConnectionError):  # noqa: N818  (a state of the bus, handled by the caller)
    """The port was closed, unplugged or hung up; open a new one and set the bus up again."""


class BusSetupError(RuntimeError):
    """The bus does not have the servos that the robot needs; the message names each and what to do."""


class Port(Protocol):
    """The part of pyserial's `Serial` that the driver uses."""

    def write(self, data: bytes, /) -> int | None:
        """Send bytes."""

    def read(self, size: int = 1, /) -> bytes:
        """At most `size` bytes, fewer after the port's timeout."""

    def reset_input_buffer(self) -> None:
        """Throw away what has arrived."""

    def close(self) -> None:
        """Close the port."""


class Lost(StrEnum):
    """Why a question got no usable answer; a parser's `Dropped` reasons are counted beside these."""

    TIMEOUT = "no answer"
    STRANGER = "answer from another servo"
    SIZE = "answer of the wrong size"
    ECHO = "echo differs from what was sent"
    REFUSED = "refused by the servo"


@dataclass(frozen=True, slots=True)
class ServoReading:
    """What one servo measured."""

    index: int  # in the driver's list of ids
    servo_id: int
    stamp_ns: int  # [ns] when it was asked; the servo sampled after that, within the answer time
    position_ticks: int  # 0..1023
    position: float  # [rad] servo angle, 0 at tick 512, counterclockwise positive
    speed: float  # [rad/s] counterclockwise positive
    load: float  # fraction of the stall torque, counterclockwise positive
    voltage: float  # [V]
    temperature: float  # [deg C]
    error: ServoError


def reading(index: int, servo_id: int, stamp_ns: int, registers: tuple[int, ...], error: ServoError) -> ServoReading:
    """What a servo's five registers from present position on say: position, speed, load, voltage, temperature."""
    position, speed, load, voltage, temperature = registers
    return ServoReading(
        index=index,
        servo_id=servo_id,
        stamp_ns=stamp_ns,
        position_ticks=position,
        position=dxl.angle_from_ticks(position),
        speed=dxl.speed_from_register(speed),
        load=dxl.load_from_register(load),
        voltage=voltage * dxl.VOLT_UNIT,
        temperature=float(temperature),
        error=error,
    )


def whole(values: ArrayLike, register: Register, count: int) -> NDArray[np.int64]:
    """Values of a register for each of `count` servos or one for all, checked.

    Raises:
        ValueError: A value out of range, not a whole number, or of another shape.
    """
    array = np.asarray(values)
    if array.dtype.kind not in "iu" or array.shape not in ((), (count,)):
        raise ValueError(f"{register.name}: integers of shape ({count},) expected, found {array.dtype} of shape {array.shape}")
    if array.min() < register.min or array.max() > register.max:
        raise ValueError(f"{register.name} takes {register.min} to {register.max}, found {array.tolist()}")
    return array.astype(np.int64, copy=False)


def open_port(url: str, baud_rate: int = BAUD_RATE, timeout_ns: int = REPLY_TIMEOUT_NS) -> Port:
    """Open a serial device (`/dev/ttyUSB0`) or a network port (`socket://host:port`).

    Args:
        url: Anything `serial.serial_for_url` takes.
        baud_rate: [1/s] the servos' baud rate.
        timeout_ns: [ns] longest wait of one read. It is set once: changing it on an open device costs system calls.

    Raises:
        BusGone: The port cannot be opened.
    """
    alone = None if "://" in url else True  # two programs would read each other's answers
    try:
        port = serial.serial_for_url(
            url, baudrate=baud_rate, timeout=timeout_ns / _SEC, write_timeout=_WRITE_TIMEOUT, exclusive=alone
        )
        if url.startswith("socket://"):
            # pyserial leaves Nagle's algorithm on: a read request behind a sync write would wait 40 ms for the first
            # packet's acknowledgement. The option belongs to the connection, so a duplicate of the handle can set it.
            with socket.socket(fileno=os.dup(port.fileno())) as connection:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    except LOST as error:
        raise BusGone(
            f"cannot open servo port {url}: {error}; is the adapter plugged in and nobody else using it, or the simulator up?"
        ) from error
    if slow := usb_adapter.quicken(url, port):
        log.warning(slow)
    return port


class ServoBus:
    """Asks and commands a fixed list of servos; arrays are in the order of that list."""

    def __init__(
        self,
        port: Port,
        servo_ids: Sequence[int],
        clock: Callable[[], int],
        *,
        model: ServoModel = dxl.AX_12A,
        names: Mapping[int, str] | None = None,
        echo: bool = False,
        reply_timeout_ns: int = REPLY_TIMEOUT_NS,
    ) -> None:
        """Take over an open port. Nothing is sent before `setup` or another call.

        Args:
            port: Open port whose read timeout is about `reply_timeout_ns`.
            servo_ids: Ids 0 to 253, all different.
            clock: Monotonic time [ns]; of an emulated port, the port's own.
            model: The servo type that `setup` expects.
            names: Leg and joint of each id, for what is said of it.
            echo: The adapter returns every byte sent; exactly those are dropped.
            reply_timeout_ns: [ns] after which an answer is given up.

        Raises:
            ValueError: An id out of range or given twice.
        """
        if len(set(servo_ids)) != len(servo_ids) or not all(0 <= i <= dxl.MAX_ID for i in servo_ids):
            raise ValueError(f"servo ids 0 to {dxl.MAX_ID}, each once, expected, found {list(servo_ids)}")
        n = len(servo_ids)
        self.servo_ids = tuple(servo_ids)
        self.names = {i: (names or {}).get(i, "") for i in servo_ids}
        self.errors: NDArray[np.uint8] = np.zeros(n, dtype=np.uint8)  # (n,) error bits of the last status packets
        self._port = port
        self._clock = clock
        self._model = model
        self._echo = echo
        self._reply_timeout_ns = reply_timeout_ns
        self._index = {servo_id: i for i, servo_id in enumerate(servo_ids)}
        self._parser = PacketParser(max_length=dxl.TABLE_SIZE + 2)
        self._lost: Counter[str] = Counter()
        self._stale = False  # bytes of a lost answer may still lie in the port
        self._unheard = bytearray()  # sent, its echo not yet read

        self._requests = [dxl.read(i, dxl.PRESENT_POSITION.address, PRESENT_STATE.size) for i in servo_ids]
        self._next = 0
        self._typical_ns = _TYPICAL_NS
        self._read_ns = [-1] * n  # stamp of the newest reading
        self._missed = [0] * n  # questions that it left open in a row
        self._backoff = [1] * n  # ask every so many turns
        self._skips = [0] * n  # turns left to skip

        self._goal_rows = np.zeros((n, 5), dtype=np.uint8)  # id, goal position, moving speed: a sync write's rows
        self._goal_rows[:, 0] = servo_ids
        size = dxl.GOAL_POSITION.size + dxl.MOVING_SPEED.size
        self._goal_head = bytes((dxl.GOAL_POSITION.address, size))

    def __len__(self) -> int:
        """Number of servos."""
        return len(self.servo_ids)

    @property
    def lost(self) -> Counter[str]:
        """Questions without a usable answer and bytes dropped, by reason (`Lost` and `dynamixel.Dropped`)."""
        return self._lost + self._parser.dropped

    @property
    def trouble(self) -> str:
        """What is wrong between here and the servos, in words: nothing that their silence does not say."""
        return ""

    def close(self) -> None:
        """Close the port, gone or not; the servos keep their torque and their last goal."""
        with warnings.catch_warnings():
            # When the other end has gone first, pyserial's socket port drops its socket instead of closing it.
            warnings.simplefilter("ignore", ResourceWarning)
            self._port.close()

    # ----------------------------------------------------------------------------------------------- outside the loop

    def ping(self, servo_id: int) -> ServoError | None:
        """Error bits of a servo, None when it does not answer."""
        answer = self._ask(dxl.ping(servo_id), servo_id, 0)
        return None if answer is None else ServoError(answer.code)

    def scan(self, servo_ids: Iterable[int] = range(dxl.MAX_ID + 1)) -> list[int]:
        """The ids that answer a ping; each absent one costs a timeout."""
        return [servo_id for servo_id in servo_ids if self.ping(servo_id) is not None]

    def read(self, servo_id: int, register: Register) -> int | None:
        """Value of one register, None when the servo does not answer."""
        data = self.read_bytes(servo_id, register.address, register.size)
        return None if data is None else int.from_bytes(data, "little")

    def read_bytes(self, servo_id: int, address: int, size: int) -> bytes | None:
        """Bytes of a control table, None when the servo does not answer or refuses."""
        answer = self._ask(dxl.read(servo_id, address, size), servo_id, size)
        return None if answer is None else answer.parameters

    def write(self, servo_id: int, register: Register, value: int) -> bool:
        """Write one register; True when the servo says that it took it (status return level 2).

        Raises:
            ValueError: The value is outside the register's range.
        """
        answer = self._ask(dxl.write(servo_id, register.address, register.encode(value)), servo_id, 0)
        return answer is not None

    def tell(self, servo_id: int, register: Register, value: int) -> None:
        """Write one register of a servo that may not answer, or under another id."""
        self._send(dxl.write(servo_id, register.address, register.encode(value)))
        if self._await(servo_id, 0) is None:
            self._stale = True

    def chorus(self, servo_id: int) -> Chorus:
        """All that comes back on one ping while an answer may be awaited: of two servos with one id, more than an answer."""
        parser, answers = PacketParser(max_length=dxl.TABLE_SIZE + 2), 0
        self._send(dxl.ping(servo_id))
        deadline = self._clock() + self._reply_timeout_ns
        while (data := self._receive(dxl.OVERHEAD)) is not None:
            answers += sum(packet.servo_id == servo_id for packet in parser.feed(data))
            if self._clock() >= deadline:
                break
        self._stale = True
        answers += sum(packet.servo_id == servo_id for packet in parser.flush())
        return Chorus(answers, parser.dropped.total() > 0)

    def setup(self) -> None:
        """Check that every servo is there, alone and of the right type, and make it answer everything without delay.

        Registers of the EEPROM are written only where they differ. Torque and limits stay as they are.

        Raises:
            BusSetupError: Servos are missing, doubled, of another model, in wheel mode or refuse; all are named.
            BusGone: The port is gone.
        """
        seen = roll_call.call(self, self.names)
        for i, mute in [(i, found) for i, found in seen.items() if found.voice is Voice.MUTE]:
            seen[i] = roll_call.wake(self, i) or mute
        if not seen:
            raise BusSetupError(
                f"none of the {len(self)} servos answers; check their power, the adapter, its echo setting and the baud rate, "
                f"then try `sextant servos scan`"
            )
        wrong = roll_call.problems(self.names, seen, self._model)
        for i in self.names.keys() - wrong.keys():
            if words := roll_call.prepare(self, seen[i]):
                wrong[i] = Problem(f"{roll_call.named(i, self.names)} {words}", "")
        if wrong:
            words = "; ".join(problem.words for problem in wrong.values())
            raise BusSetupError(
                f"{len(wrong.keys() & self.names.keys())} of {len(self)} servos are not ready: {words}; "
                f"`sextant servos scan` says what to do"
            )

    # --------------------------------------------------------------------------------------------------- in the loop

    def sync_write_goals(self, goal_ticks: ArrayLike, speed_ticks: ArrayLike = 0) -> None:
        """Send every servo its goal position and moving speed in one packet; nobody answers.

        Args:
            goal_ticks: (n,) goal positions, 0 to 1023.
            speed_ticks: (n,) or one moving speed, 0 to 1023 of 0.111 rpm, 0 for uncontrolled.

        Raises:
            ValueError: A value out of range, not a whole number, or of another shape.
            BusGone: The port is gone.
        """
        goals = whole(goal_ticks, dxl.GOAL_POSITION, len(self))
        speeds = whole(speed_ticks, dxl.MOVING_SPEED, len(self))
        rows = self._goal_rows
        rows[:, 1], rows[:, 2] = goals & 0xFF, goals >> 8
        rows[:, 3], rows[:, 4] = speeds & 0xFF, speeds >> 8
        self._send(dxl.encode(dxl.BROADCAST_ID, dxl.Instruction.SYNC_WRITE, self._goal_head + rows.tobytes()))

    def sync_write(self, register: Register, values: ArrayLike) -> None:
        """Send every servo its value of one register, (n,) or one for all, in one packet; nobody answers.

        Raises:
            ValueError: A value out of range, not a whole number, or of another shape.
            BusGone: The port is gone.
        """
        wanted = np.broadcast_to(whole(values, register, len(self)), (len(self),))
        rows = [(i, register.encode(int(value))) for i, value in zip(self.servo_ids, wanted, strict=True)]
        self._send(dxl.sync_write(register.address, register.size, rows))

    def set_torque(self, enabled: bool) -> None:
        """Turn the torque of all servos on or off.

        Before turning it on, send the measured positions as goals: not every firmware holds where it is.
        """
        self.sync_write(dxl.TORQUE_ENABLE, int(enabled))

    def write_torque_limit(self, limit_ticks: ArrayLike) -> None:
        """Set Torque Limit, (n,) or one for all, 0 to 1023 of the stall torque.

        This ends the shutdown of a servo that was overloaded or hot: call it only when an operator asks for that.
        """
        self.sync_write(dxl.TORQUE_LIMIT, limit_ticks)

    def poll(self, budget_ns: int, first: Sequence[int] = ()) -> list[ServoReading]:
        """Read the next servos of the rotation, as many as typically fit a time budget.

        A servo that does not answer costs a timeout; after the third in a row it is asked every 2nd, 4th ... 32nd turn only.

        Args:
            budget_ns: [ns] time for this call; 0 reads nothing. A timeout may overrun it.
            first: Servos by their place in the list that are read in every call, before the rotation goes on with the others.

        Raises:
            BusGone: The port is gone.
        """
        readings: list[ServoReading] = []
        start = self._clock()
        end = start + budget_ns
        urgent = iter(first)
        for _ in range(len(self)):
            if start + self._typical_ns > end:
                break
            i = next(urgent, -1)
            if i < 0:
                i = self._next
                self._next = (i + 1) % len(self)
                if i in first:  # has been
                    continue
            if self._skips[i]:
                self._skips[i] -= 1
                continue
            answer = self._ask(self._requests[i], self.servo_ids[i], PRESENT_STATE.size)
            done = self._clock()
            if answer is None:
                self._missed[i] += 1
                if self._missed[i] > _PATIENCE:
                    self._backoff[i] = min(2 * self._backoff[i], _MAX_BACKOFF)
                self._skips[i] = self._backoff[i] - 1
            else:
                self._missed[i], self._backoff[i] = 0, 1
                self._read_ns[i] = start
                self._typical_ns += (done - start - self._typical_ns) // _SMOOTHING
                readings.append(
                    reading(i, answer.servo_id, start, PRESENT_STATE.unpack(answer.parameters), ServoError(answer.code))
                )
            start = done
        return readings

    def ages(self) -> NDArray[np.float64]:
        """(n,) [s] since each servo's newest reading was asked for, infinite when there was none."""
        now = self._clock()
        return np.array([(now - t) / _SEC if t >= 0 else np.inf for t in self._read_ns])

    # ----------------------------------------------------------------------------------------------- below the words

    def _send(self, data: bytes) -> None:
        """Put a packet on the wire."""
        try:
            if self._stale:
                self._port.reset_input_buffer()
                self._unheard.clear()
                self._stale = False
            self._port.write(data)
        except LOST as error:
            raise gone(error) from error
        if self._echo:
            self._unheard += data

    def _ask(self, request: bytes, servo_id: int, size: int) -> Packet | None:
        """Send a request and return the answer, with `size` parameters; None, and counted, when there is no good one."""
        self._send(request)
        answer = self._await(servo_id, size)
        if answer is None:
            self._lost[Lost.TIMEOUT] += 1
            self._stale = True
            return None
        index = self._index.get(servo_id)
        if index is not None:
            self.errors[index] = answer.code
        if answer.code & _REFUSAL and not answer.parameters:
            self._lost[Lost.REFUSED] += 1
            return None
        return answer

    def _await(self, servo_id: int, size: int) -> Packet | None:
        deadline = self._clock() + self._reply_timeout_ns
        wanted = dxl.OVERHEAD + size
        while True:
            data = self._receive(wanted)
            if data is None:
                return None
            for packet in self._parser.feed(data):
                if self._is_answer(packet, servo_id, size):
                    return packet
            if self._clock() >= deadline:
                break
            # Noise in front has pushed the packet's tail out of what was read.
            wanted = max(dxl.OVERHEAD + size - self._parser.pending, 1)
        for packet in self._parser.flush():  # noise may have announced a longer packet than what came
            if self._is_answer(packet, servo_id, size):
                return packet
        return None

    def _receive(self, count: int) -> bytes | None:
        """Up to `count` bytes from the servos, behind the adapter's echo; None when the echo is not what was sent."""
        due = len(self._unheard)
        try:
            data = self._port.read(count + due)
        except LOST as error:
            raise gone(error) from error
        if not due:
            return data
        echo, data = data[:due], data[due:]
        if echo != self._unheard[: len(echo)]:
            self._lost[Lost.ECHO] += 1
            return None
        del self._unheard[: len(echo)]
        return data

    def _is_answer(self, packet: Packet, servo_id: int, size: int) -> bool:
        if packet.servo_id != servo_id:
            self._lost[Lost.STRANGER] += 1
            return False
        if len(packet.parameters) == size or (packet.code & _REFUSAL and not packet.parameters):
            return True
        self._lost[Lost.SIZE] += 1
        return False


def gone(error: Exception) -> BusGone:
    """What a failure of the port means."""
    return BusGone(f"the servo port is gone ({error}); check the adapter's cable, or the simulator, and open it again")
