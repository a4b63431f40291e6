"""Servo bus driver: servos with a control table, over a port like pyserial's.

It uses no thread and no sleep; time comes from a clock argument. In the loop only `BusDisconnectedError` is raised. Lost,
broken, refused and implausible packets are counted by reason, and the last reading of their servo ages.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sextant.services.actuator.servo_bus import bus_scan, bus_setup
from sextant.services.actuator.servo_bus.bus_scan import Problem
from sextant.services.actuator.servo_bus.bus_setup import BusSetupError
from sextant.services.actuator.servo_bus.common_read import CommonRead, common_reads
from sextant.services.actuator.servo_bus.group_writes import GroupWrites
from sextant.services.actuator.servo_bus.other_device import PingResponses
from sextant.services.actuator.servo_bus.packet_loss import LossRate
from sextant.services.actuator.servo_bus.reading_validation import ReadingValidator, State, state_decoder
from sextant.services.actuator.servo_bus.serial_port import (
    BAUD_RATE,
    BYTE_NS,
    LOST,
    REPLY_TIMEOUT_NS,
    BusDisconnectedError,
    Lost,
    Port,
    SerialLine,
    gone,
    open_port,
)
from sextant.services.actuator.servo_bus.servo_reading import ServoReading, reading
from sextant.shared.servo import dynamixel2
from sextant.shared.servo.models import AX_12A
from sextant.shared.servo.servo_model import REFUSAL, Packet, Register, ServoError, ServoModel, SyncRead

__all__ = [
    "BAUD_RATE",
    "LOST",
    "REPLY_TIMEOUT_NS",
    "BusDisconnectedError",
    "BusSetupError",
    "Lost",
    "Port",
    "ServoBus",
    "ServoReading",
    "gone",
    "open_port",
    "reading",
]

_MAX_UNANSWERED = 3  # consecutive unanswered requests, beyond which a servo is read more rarely: a busy host loses answers
_AT_ONCE = 3  # consecutive unanswered requests, up to which a servo is still read first in the next call
_OVERDUE_NS = 100_000_000  # [ns] without a request after which a servo comes before the urgent ones
_DOUBTFUL_NS = 30_000_000  # [ns] after an unanswered request from which a servo comes before the urgent ones
_MAX_BACKOFF = 8  # [turns] maximum time between two requests to a silent servo
_TYPICAL_NS = 1_300_000  # [ns] a read of 8 bytes over USB, until measured
_MAX_REQUESTS = 3  # requests to one servo per turn, if its answers are broken or doubtful
_LOSS_WINDOW_NS = 200_000_000  # [ns]
_NOISY_NS = 1_000_000_000  # [ns] after a lost request for which the bus counts as noisy
_MAX_PACKET_BYTES = 256  # [bytes] largest length that a packet header of Protocol 1.0 can announce
_SMOOTHING = 8  # transactions over which the typical time is smoothed
_ALERT_NS = 100_000_000  # [ns] after which the hardware errors of a servo that alerts are read again
_SINGLY_NS = 1_000_000_000  # [ns] for which servos are read one by one after a read of several broke off
_NS_PER_S = 1e9


Polling = Generator[None, None, list[ServoReading]]


class ServoBus:
    """Driver for a fixed list of servos; arrays are in the order of that list."""

    def __init__(
        self,
        port: Port,
        servo_ids: Sequence[int],
        clock: Callable[[], int],
        *,
        model: ServoModel = AX_12A,
        models: Mapping[int, ServoModel] | None = None,
        rows: Sequence[int] | None = None,
        names: Mapping[int, str] | None = None,
        echo: bool = False,
        reply_timeout_ns: int = REPLY_TIMEOUT_NS,
        lock: bool = False,
    ) -> None:
        """Take over an open port. Nothing is sent before `setup` or another call.

        Args:
            port: Open port whose read timeout is about `reply_timeout_ns`.
            servo_ids: Ids that the protocol allows, all different.
            clock: Monotonic time [ns]; of an emulated port, the port's own.
            model: The type of the servos, which `setup` verifies.
            models: The types of servos by id, where they differ from `model`; they have the same protocol.
            rows: Indices of the servos in their readings, by default those in the list.
            names: Leg and joint of each id, for messages.
            echo: The adapter returns every byte sent; exactly those are dropped.
            reply_timeout_ns: [ns] timeout of an answer.
            lock: `setup` locks the EEPROM of the servos until power-off, so that broken packets cannot change it.

        Raises:
            ValueError: An id out of range or given twice.
        """
        if len(set(servo_ids)) != len(servo_ids) or not all(0 <= i <= model.protocol.MAX_ID for i in servo_ids):
            raise ValueError(f"servo ids 0 to {model.protocol.MAX_ID}, each once, expected, found {list(servo_ids)}")
        n = len(servo_ids)
        self.servo_ids = tuple(servo_ids)
        self.names = {i: (names or {}).get(i, "") for i in servo_ids}
        self.errors: NDArray[np.uint8] = np.zeros(n, dtype=np.uint8)  # (n,) error bits of the last status packets
        self.missed: NDArray[np.int64] = np.zeros(n, dtype=np.int64)  # (n,) consecutive unanswered requests in the loop
        self.between: Callable[[], None] = _nothing  # called before each request outside the loop
        self._port = port
        self._clock = clock
        self.model, self._lock, self._models = model, lock, models or {}
        of_servos = [self.model_of(i) for i in servo_ids]
        self._unit = [one.units for one in of_servos]  # of each servo
        self._rows = tuple(range(n)) if rows is None else tuple(rows)
        self._protocol, self._table, self._echo = model.protocol, model.table, echo
        self._line = SerialLine(port, clock, of_servos or [model], echo=echo, reply_timeout_ns=reply_timeout_ns)
        self._index = {servo_id: i for i, servo_id in enumerate(servo_ids)}
        self._loss = LossRate(_LOSS_WINDOW_NS)
        self._validator, self._writes = ReadingValidator(of_servos), GroupWrites(self._protocol, servo_ids, of_servos)

        decoders = {one: state_decoder(one) for one in of_servos}
        self._states = [(one.table.state.unpack, decoders[one]) for one in of_servos]
        reads = list(map(self._state_bytes, of_servos))  # what is read in the loop
        self._answer_sizes = [size for _, size in reads]
        self._requests = [self._protocol.read(i, *read) for i, read in zip(servo_ids, reads, strict=True)]
        self._overdue_ns = _OVERDUE_NS
        self._most_late = n  # late servos that come before the urgent ones in one call
        self._next = 0
        self._singly_until_ns = 0  # [ns] time up to which no request reads several servos
        self._common = common_reads(of_servos)
        self._again: list[int] = []  # indices to be read first in the next call
        self._typical_ns = _TYPICAL_NS
        self._read_ns = [-1] * n  # stamp of the newest reading
        self._asked_ns = [0] * n  # when it was last requested
        self._told_ns = 0  # when goals were last sent
        self._alerts: dict[int, ServoError] = {}  # index of a servo that alerts -> its hardware errors, once read
        self._alerts_read_ns: dict[int, int] = {}  # index -> [ns] when they were read
        self._backoff = [1] * n  # read every this many turns
        self._skips = [0] * n  # turns left to skip

    def __len__(self) -> int:
        """Number of servos."""
        return len(self.servo_ids)

    def model_of(self, servo_id: int) -> ServoModel:
        """Return the expected model of a servo."""
        return self._models.get(servo_id, self.model)

    @property
    def lost(self) -> Counter[str]:
        """Requests without a usable answer and dropped bytes, by reason.

        Reasons are `Lost`, `dynamixel.Dropped` and `reading_validation.Implausibility`.
        """
        return self._line.lost + self._line.dropped + self._validator.refused

    @property
    def loss(self) -> float:
        """Share of the loop's requests of the last 200 ms without a usable answer.

        Without requests in that time, it is that of the last request.
        """
        return self._loss.share(self._clock())

    @property
    def trouble(self) -> str:
        """Problem of the link; always empty here, because silent servos show it."""
        return ""

    @property
    def garbled(self) -> int:
        """Number of invalid bytes and packets so far."""
        return self._line.dropped.total()

    def close(self) -> None:
        """Close the port, gone or not; the servos keep their torque and last goals."""
        self._port.close()

    # ----------------------------------------------------------------------------------------------- outside the loop

    def ping(self, servo_id: int) -> ServoError | None:
        """Return the error bits of a servo, None when it does not answer."""
        answer = self._ask(self._protocol.ping(servo_id), servo_id, self._protocol.PING_SIZE)
        return None if answer is None else self._protocol.ERRORS[answer.code]

    def scan(self, servo_ids: Iterable[int] | None = None) -> list[int]:
        """Return the ids that answer a ping, of all by default; each absent one costs a timeout."""
        asked = range(self._protocol.MAX_ID + 1) if servo_ids is None else servo_ids
        return [servo_id for servo_id in asked if self.ping(servo_id) is not None]

    def read(self, servo_id: int, register: Register) -> int | None:
        """Return the value of a register, None when the servo does not answer."""
        data = self.read_bytes(servo_id, register.address, register.size)
        return None if data is None else register.decode(data)

    def read_bytes(self, servo_id: int, address: int, size: int) -> bytes | None:
        """Return bytes of a control table, None when the servo does not answer or refuses."""
        answer = self._ask(self._protocol.read(servo_id, address, size), servo_id, size)
        return None if answer is None else answer.parameters

    def write(self, servo_id: int, register: Register, value: int) -> bool:
        """Write one register; return whether it is acknowledged (return level 2).

        Raises:
            ValueError: The value is outside the register's range.
        """
        answer = self._ask(self._protocol.write(servo_id, register.address, register.encode(value)), servo_id, 0)
        return answer is not None

    def reboot(self, servo_id: int) -> None:
        """Restart a servo with Protocol 2.0, which loses its torque and is silent meanwhile."""
        self._ask(dynamixel2.reboot(servo_id), servo_id, 0)

    def write_unacknowledged(self, servo_id: int, register: Register, value: int) -> None:
        """Write a register without an expected answer, or with one of another id."""
        request = self._protocol.write(servo_id, register.address, register.encode(value))
        self._line.attempt(request, servo_id, 0, self._clock() + self._line.reply_timeout_ns)

    def ping_responses(self, servo_id: int) -> PingResponses:
        """Return all responses to one ping within the timeout.

        Two servos with one id send more than one answer.
        """
        packets, garbage = self._line.overhear(self._protocol.ping(servo_id))
        return PingResponses(sum(packet.servo_id == servo_id for packet in packets), garbage)

    def unrequested_bytes(self) -> bytes:
        """Return the first bytes within a second without a request; servos send none."""
        return self._line.unrequested_bytes()

    def bytes_after(self, request: bytes) -> bytes:
        """Return all bytes after a request that need not be one to servos."""
        return self._line.bytes_after(request)

    def change_rate(self, rate: int) -> bool:
        """Change the baud rate [1/s] of the host; return whether the port has one."""
        return self._line.change_rate(rate)

    @property
    def is_clean(self) -> bool:
        """Whether all requests so far were answered, with no other bytes."""
        return not self._line.lost and not self._line.dropped

    def echo_problem(self) -> Problem | None:
        """Return the problem of an adapter that returns what is sent although none is set, or the reverse; else None."""
        # The id has one byte, so its answer is shorter than the request in every protocol, or has other bytes.
        servo_id = self.servo_ids[0]
        register = self.model_of(servo_id).table.id
        found = self._line.echoes(self._protocol.read(servo_id, register.address, register.size))
        if found == self._echo:
            return None
        return bus_scan.ECHO if found else bus_scan.NO_ECHO

    def open_session(self) -> None:
        """Do nothing: the bus has no microcontroller that needs a session."""

    def setup(self) -> None:
        """Check presence, uniqueness and type of all servos; configure fast answers.

        Registers of the EEPROM are written only where they differ. Torque and limits stay as they are.

        Raises:
            BusSetupError: Servos are missing, doubled, of another model, in wheel mode or refuse; all are named.
            BusDisconnectedError: The port is gone.
        """
        seen = bus_setup.set_up(self, self._lock)
        for common in self._common:
            common.fast.set_firmware(min((seen[self.servo_ids[i]].firmware or 0 for i in common.indices), default=0))

    # --------------------------------------------------------------------------------------------------- in the loop

    def sync_write_goals(self, goal_ticks: ArrayLike, speed_ticks: ArrayLike = 0) -> None:
        """Send all goal positions and moving speeds in one unacknowledged packet, or one for each kind of goal registers.

        While requests get lost, it is sent twice, because it is not acknowledged and is the longest packet of all.

        Args:
            goal_ticks: (n,) goal position registers.
            speed_ticks: (n,) or one goal speed register, 0 for no limit.

        Raises:
            ValueError: A value out of range, not a whole number, or of another shape.
            BusDisconnectedError: The port is gone.
        """
        goals, packets = self._writes.goals(goal_ticks, speed_ticks)
        self._validator.sent(goals)
        self._told_ns = self._clock()
        for _ in range(2 if self._loss.within(self._told_ns, _NOISY_NS) else 1):
            for packet in packets:
                self._line.send(packet)

    def set_torque(self, enabled: bool) -> None:
        """Turn the torque of all servos on or off.

        Before turning it on, send the measured positions as goals: not every firmware holds the present position. Off is
        broadcast twice in the shortest possible packet, which is the likeliest to arrive on a noisy bus. After a loss, zeros
        precede it: a servo that has read a wrong length consumes them as the rest of its packet, and then listens again.
        """
        if not enabled and self._loss.within(self._clock(), _NOISY_NS):
            self._line.send(bytes(_MAX_PACKET_BYTES))
        for packet in self._writes.torque_on() if enabled else 2 * self._writes.torque_off():
            self._line.send(packet)

    def poll(self, budget_ns: int, first: Sequence[int] = ()) -> list[ServoReading]:
        """Read as many of the next servos in the rotation as a time budget typically allows.

        A servo that does not answer costs a timeout. After the third in a row it is read only every 2nd, 4th, then 8th turn. A
        broken answer, or a position that leaps from the last one and the goal, is requested again at once. If that fails, the
        servo comes first in the next call.

        Args:
            budget_ns: [ns] time for this call; 0 reads nothing. One timeout may overrun it.
            first: Indices of servos that are read in every call, before the rotation. A servo without a request for 100 ms,
                or for 30 ms after an unanswered one, comes before them, so that a silent servo is detected.

        Raises:
            BusDisconnectedError: The port is gone.
        """
        polling = self.polling(budget_ns, first)
        while True:
            try:
                next(polling)
            except StopIteration as end:
                readings: list[ServoReading] = end.value
                return readings

    def polling(self, budget_ns: int, first: Sequence[int] = ()) -> Polling:
        """Do the same as `poll`, and yield after each request, so that other buses can send theirs."""
        if self.model.sync_read is not None and self._clock() >= self._singly_until_ns:
            return (yield from self._poll_together(self.model.sync_read, budget_ns, first))
        readings: list[ServoReading] = []
        start = self._clock()
        end = start + budget_ns
        turn, others = self._turn(first, start)
        self._again = []
        while turn and start + min(self._typical_ns, max(budget_ns, 1)) <= end:  # at least one
            i = turn.popleft()
            if i in others:
                self._next = (i + 1) % len(self)
            if self._is_skipped(i):
                continue
            found = yield from self._look(i, end)
            if found is not None:
                readings.append(found)
            elif self.missed[i] <= _AT_ONCE:
                self._again.append(i)
            start = self._clock()
        self._again += [i for i in turn if i not in others]  # not read for lack of time
        if self._alerts:
            self._read_alert(end)
        return readings

    @property
    def newest_age_s(self) -> float:
        """Time [s] since the newest reading of any servo was requested, infinite before the first."""
        newest_ns = max(self._read_ns)
        return (self._clock() - newest_ns) / _NS_PER_S if newest_ns >= 0 else math.inf

    def ages(self) -> NDArray[np.float64]:
        """Return (n,) [s] since each newest reading was requested, infinite before."""
        now = self._clock()
        return np.array([(now - t) / _NS_PER_S if t >= 0 else np.inf for t in self._read_ns])

    # ----------------------------------------------------------------------------------------------- below the words

    def _turn(self, first: Sequence[int], now_ns: int) -> tuple[deque[int], list[int]]:
        """Return the order in which to read the servos, and those of them that only the rotation reads.

        Late servos come first, then those of `first`, then those left over, then the rotation.
        """
        urgent = sorted(dict.fromkeys((*first, *self._again)), key=lambda i: (i not in first, i not in self._again))
        others = [i for i in (*range(self._next, len(self)), *range(self._next)) if i not in urgent]
        turn = [*urgent, *others]
        if np.count_nonzero(self.missed) or now_ns - min(self._asked_ns) > self._overdue_ns:
            late = [i for i in turn if i not in first and self._is_late(i, now_ns)]
            late = sorted(late, key=lambda i: (self.missed[i] == 0, self._asked_ns[i]))[: self._most_late]
            turn = list(dict.fromkeys((*late, *turn)))
        return deque(turn), others

    def _is_late(self, index: int, now_ns: int) -> bool:
        """Return whether a request to a servo is late. One that has been silent for long waits for its rare turns instead."""
        most_ns = _DOUBTFUL_NS if self.missed[index] else self._overdue_ns
        return not self._skips[index] and now_ns - self._asked_ns[index] > most_ns

    def _look(self, index: int, end_ns: int, *, heard: bool = False) -> Generator[None, None, ServoReading | None]:
        """Read one servo until its answer is plausible; `heard` tells whether it has just answered.

        A request begins by `end_ns` and ends within a timeout. A servo whose position is none that it has counts as silent.
        """
        for _ in range(_MAX_REQUESTS):
            start = self._clock()
            if start > end_ns:
                break
            self._asked_ns[index] = start
            self._line.ask(self._requests[index], start)
            yield
            answer = self._line.answer(self.servo_ids[index], self._answer_sizes[index], end_ns, start)
            done = self._clock()
            heard = answer is not None and not self._refuses(answer)
            found = self._taken(index, start, answer if heard else None, done)
            if found is not None:
                # A longer time is no property of the bus: this process was suspended meanwhile.
                took = min(done - start, self._line.reply_timeout_ns)
                self._typical_ns += (took - self._typical_ns) // _SMOOTHING
                return found
            if done - start >= self._line.reply_timeout_ns:  # another request would cost another timeout
                break
        if not heard or self._validator.is_impossible(index):
            self._leave_alone(index)
        return None

    def _poll_together(self, sync_read: SyncRead, budget_ns: int, first: Sequence[int]) -> Polling:
        """Read as many servos as fit a time budget with one request, then those again whose answers are missing or doubtful."""
        start = self._clock()
        end = start + budget_ns
        whole = not self.missed.any()
        is_fast = whole and all(common.fast.is_usable(start) for common in self._common)
        overhead = dynamixel2.ROW_OVERHEAD if is_fast else self._protocol.OVERHEAD
        answer_ns = (overhead + max(self._answer_sizes)) * BYTE_NS
        most = max(int((budget_ns - _TYPICAL_NS) // answer_ns) + 1, 1) if budget_ns > 0 else 0
        turn = (*first, *self._again, *((self._next + k) % len(self) for k in range(len(self))))
        asked = [i for i in dict.fromkeys(turn) if not self._is_skipped(i)][:most]
        if not asked:
            return []
        self._next = (asked[-1] + 1) % len(self)
        taken, answers = dict[int, ServoReading | None](), dict[int, Packet]()
        for common in self._common:
            if here := [i for i in asked if i in common.indices]:
                found = yield from self._read_common(sync_read, common, here, fast=whole)
                done = self._clock()
                taken |= {i: self._taken(i, self._asked_ns[i], found.get(self.servo_ids[i]), done) for i in here}
                answers |= found
        self._again = []
        for i in asked:
            taken[i] = taken[i] or (yield from self._look(i, end, heard=self.servo_ids[i] in answers))
            if taken[i] is None and self.missed[i] <= _AT_ONCE:
                self._again.append(i)
        if self._alerts:
            self._read_alert(end)
        return [found for found in taken.values() if found is not None]

    def _read_common(
        self, sync_read: SyncRead, common: CommonRead, asked: Sequence[int], *, fast: bool
    ) -> Generator[None, None, dict[int, Packet]]:
        """Read servos with the same registers by one request, and return their answers by id; a fast one if it may be."""
        start, state, ids = self._clock(), common.block, [self.servo_ids[i] for i in asked]
        for i in asked:
            self._asked_ns[i] = start
        if fast and common.fast.is_usable(start):
            self._line.ask(dynamixel2.fast_sync_read(state.address, state.size, ids), start)
            yield
            answers = self._line.fast_answers(ids, state.size, start)
            common.fast.note(self._clock(), complete=len(answers) == len(ids))
            return answers
        self._line.ask(sync_read(state.address, state.size, ids), start)
        yield
        answers = self._line.answers(ids, state.size, start)
        if ids[-1] not in answers:  # whether those behind a silent servo answer is not published
            self._singly_until_ns = self._clock() + _SINGLY_NS
        return answers

    def _is_skipped(self, index: int) -> bool:
        """Return whether to leave out a silent servo in this turn."""
        skipped = self._skips[index] > 0
        self._skips[index] -= skipped
        return skipped

    def _taken(self, index: int, stamp_ns: int, answer: Packet | None, now_ns: int) -> ServoReading | None:
        """Return the reading in an answer, or None without an answer or if it is not plausible yet."""
        if answer is None:
            self._loss.note(now_ns, True)
            return None
        found = self._believed(index, stamp_ns, answer, now_ns)
        if found is not None:
            if self.missed[index] > _MAX_UNANSWERED:  # the bus may be back: other silent servos have their turn, too
                self._skips = [0] * len(self)
            self.missed[index], self._backoff[index] = 0, 1
            self._read_ns[index] = stamp_ns
        return found

    def _is_noisy(self, index: int, now_ns: int) -> bool:
        """Return whether answers were recently lost or broken.

        Before a servo's first reading, broken bytes at any earlier time count, too.
        """
        broken = self._read_ns[index] < 0 and self._line.dropped.total() > 0
        return broken or self._loss.within(now_ns, _NOISY_NS)

    def _leave_alone(self, index: int) -> None:
        """Skip turns of a servo that has not answered, more the longer it is silent."""
        self.missed[index] += 1
        if self.missed[index] > _MAX_UNANSWERED:
            self._backoff[index] = min(2 * self._backoff[index], _MAX_BACKOFF)
        self._skips[index] = self._backoff[index] - 1

    def _believed(self, index: int, stamp_ns: int, answer: Packet, now_ns: int) -> ServoReading | None:
        """Return the reading in an answer, or None if it is not plausible yet."""
        error = self._protocol.ERRORS[answer.code]
        if answer.code & self._protocol.ALERT:
            error |= self._alerts.setdefault(index, ServoError.NONE)
        elif self._alerts:
            self._alerts.pop(index, None)
        state = self._state_in(index, stamp_ns, answer.parameters, int(error))
        refused = self._validator.refusals
        believed = self._validator.accepts(index, state, self._is_noisy(index, now_ns))
        for _ in range(self._validator.refusals - refused):  # this reading, or the earlier one that it contradicts
            self._loss.note(now_ns, True)
        if not believed:
            return None
        self._loss.note(now_ns, False)
        self.errors[index] = state.error
        return self._reading_of(index, state, error)

    def _state_bytes(self, model: ServoModel) -> tuple[int, int]:
        """Return address and size [bytes] of what is read from each servo of a model in the loop."""
        return model.table.state.address, model.table.state.size

    def _state_in(self, index: int, stamp_ns: int, data: bytes, error: int) -> State:
        """Return the state in the bytes that are read in the loop."""
        unpack, decode = self._states[index]
        return decode(stamp_ns, unpack(data), error)

    def _reading_of(self, index: int, state: State, error: ServoError) -> ServoReading:
        """Return the reading of an accepted state."""
        return reading(self._rows[index], self.servo_ids[index], self._told_ns, state, error, self._unit[index])

    def _read_alert(self, end_ns: int) -> None:
        """Read the hardware errors of one servo that alerts, that whose errors were read longest ago.

        The errors of an alert add up: the servo raises one alert for all of them.
        """
        start = self._clock()
        due = [i for i in self._alerts if start - self._alerts_read_ns.get(i, -_ALERT_NS) >= _ALERT_NS]
        if not due or start > end_ns:
            return
        index = min(due, key=lambda i: self._alerts_read_ns.get(i, 0))
        self._alerts_read_ns[index] = start
        servo_id = self.servo_ids[index]
        register = self.model_of(servo_id).table.hardware_error
        if register is None:
            return
        answer = self._line.exchange(self._protocol.read(servo_id, register.address, register.size), servo_id, 1, end_ns, start)
        if answer is not None and answer.parameters:
            self._alerts[index] |= self.model_of(servo_id).hardware_errors(answer.parameters[0])

    def _ask(self, request: bytes, servo_id: int, size: int) -> Packet | None:
        """Send a request and return the answer with `size` parameters, or None.

        A missing or bad answer is counted.
        """
        self.between()
        answer = self._line.exchange(request, servo_id, size, self._clock() + self._line.reply_timeout_ns)
        if answer is None:
            return None
        index = self._index.get(servo_id)
        if index is not None:
            self.errors[index] = self._protocol.ERRORS[answer.code] | self._alerts.get(index, ServoError.NONE)
        return None if self._refuses(answer) else answer

    def _refuses(self, answer: Packet) -> bool:
        if answer.parameters or not self._protocol.ERRORS[answer.code] & REFUSAL:
            return False
        self._line.lost[Lost.REFUSED] += 1
        return True


def _nothing() -> None:
    pass
