"""Servos behind a microcontroller bridge; see docs/bridge.md for the protocol.

It uses no thread and no sleep; time comes from a clock argument. In the loop only `BusDisconnectedError` is raised. Broken, old
and out-of-order frames are counted by reason, and the servo readings age.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sextant.services.actuator.servo_bus.bus_driver import (
    LOST,
    BusSetupError,
    Port,
    ServoReading,
    gone,
    reading,
)
from sextant.services.actuator.servo_bus.bus_setup import BoardSilentError
from sextant.services.actuator.servo_bus.command_bus import bus_of
from sextant.services.actuator.servo_bus.group_writes import whole
from sextant.services.actuator.servo_bus.reading_validation import State as Registers
from sextant.services.actuator.servo_bus.servo_reading import PositionReadings
from sextant.shared.servo import bridge_protocol
from sextant.shared.servo.bridge_protocol import (
    ANGLE_RAD,
    LOAD,
    SPEED_RAD_S,
    VOLT,
    Answer,
    Instruction,
    Message,
    Mode,
    Receiver,
    RemoteClock,
    Result,
    State,
    Welcome,
)
from sextant.shared.servo.models import AX_12A
from sextant.shared.servo.servo_model import Feedback, Kind, Register, ServoError, ServoModel

READ_NS = 1_000_000  # [ns] longest wait of one read of the port
_LIFETIME_MS = 200  # [ms] validity of goals
_CHUNK_BYTES = 4096  # [bytes] per read
_HELLO_NS = 300_000_000  # [ns] timeout of a welcome
_GREET_AGAIN_NS = 100_000_000  # [ns] between two hellos in the loop
_SILENT_NS = 100_000_000  # [ns] without a state, or without the effect of an order, after which a problem is reported
_ANSWER_NS = 40_000_000  # [ns] timeout of a servo's answer through the bridge
_NEW_US = 1_000  # [us] by which a new reading is newer than the last one
_CYCLE_NS = 20_000_000  # [ns] in which the bridge reads every servo ...
_TURN_NS = 100_000_000  # [ns] ... that has registers; one with commands is read in this time
_BITS_PER_BYTE = 10
_OTHER_GOALS_US = 5_000  # [us] after the newest goals from which goals count as newer ones
_NEVER_US = -1_000_000_000  # [us] long ago
_NS_PER_US = 1_000
_INSTRUCTIONS = {
    Kind.PING: Instruction.PING,
    Kind.READ: Instruction.READ,
    Kind.WRITE: Instruction.WRITE,
    Kind.REBOOT: Instruction.REBOOT,
}


class Bridge:
    """Driver for servos behind a microcontroller; arrays are in their list order."""

    def __init__(
        self,
        port: Port,
        servo_ids: Sequence[int],
        clock: Callable[[], int],
        *,
        model: ServoModel = AX_12A,
        names: Mapping[int, str] | None = None,
        lock: bool = False,
        stiffness: Sequence[float] | None = None,
    ) -> None:
        """Take over an open port. Nothing is sent before `setup` or another call.

        Args:
            port: Open port whose read timeout is about `READ_NS`.
            servo_ids: At most 24 ids, 0 to 253, all different.
            clock: Monotonic time [ns]; of an emulated port, the port's own.
            model: The servo type, for which the board must be configured.
            names: Leg and joint of each id, for messages.
            lock: `setup` locks the EEPROM of the servos, see `ServoBus`.
            stiffness: (n,) [1/rad] of servos with commands, see `CommandBus`.

        Raises:
            ValueError: Too many ids, one out of range or given twice.
        """
        if len(servo_ids) > bridge_protocol.MAX_SERVOS:
            raise ValueError(f"at most {bridge_protocol.MAX_SERVOS} servos behind a bridge expected, found {len(servo_ids)}")
        n = len(servo_ids)
        self.errors: NDArray[np.uint8] = np.zeros(n, dtype=np.uint8)  # (n,) error bits of the last status packets
        self.state: State | None = None  # the newest
        self.restarts = 0  # of the microcontroller, while in use
        self._port = port
        self._clock = clock
        self._receiver = Receiver(bridge_protocol.TO_HOST)
        self.model, self._table = model, model.table
        questions = _Questions(self)
        self._registers = bus_of(model)(questions, servo_ids, clock, model=model, names=names, reply_timeout_ns=0, lock=lock)
        self.servo_ids = self._registers.servo_ids
        self._invalid_reason: Counter[str] = Counter()  # ignored states
        self._session = 0
        self._sequence = 0  # of orders
        self._boot: int | None = None  # of the microcontroller
        self._remote = RemoteClock()
        self._state_ns = clock()  # when the newest state arrived, or when waiting for the first one began
        self._greeted_ns = clock()
        self._welcomed = False
        self._welcome: Welcome | None = None  # the newest
        self._answer: Answer | None = None  # the newest
        self._fresh: dict[int, ServoReading] = {}  # unread readings, by index in the list
        self._read_ns = [-1] * n  # stamp of the newest reading
        self._measured_us = [-_NEW_US - 1] * n  # the same, by the microcontroller's clock
        self._taken_us = (_NEVER_US, _NEVER_US)  # when, by that clock, it accepted the previous goals and the newest ones
        own = [model.gain_stiffness] * n if stiffness is None else stiffness
        self._estimates = None if model.commands is None else PositionReadings(model.units, own)
        self._turn_ns = _CYCLE_NS if model.commands is None else _TURN_NS
        self._goal_us = _goal_us(model)
        self._first: tuple[int, ...] = ()  # indices of servos to be read and moved first
        self._written_us = [0] * n  # [us] between the acceptance of goals and the end of the packet to each servo
        self._torque: bool | None = None  # as ordered last
        self._torque_ns = 0
        self._goals_since_ns, self._goals_ns = 0, -1  # start of the gapless sequence of goals, and time of the newest ones

    @property
    def between(self) -> Callable[[], None]:
        """Callback before each request to a servo outside the loop."""
        return self._registers.between

    @between.setter
    def between(self, do: Callable[[], None]) -> None:
        self._registers.between = do

    def model_of(self, servo_id: int) -> ServoModel:
        """Return the model of a servo, which is that of all."""
        return self.model

    def __len__(self) -> int:
        """Number of servos."""
        return len(self.servo_ids)

    @property
    def lost(self) -> Counter[str]:
        """Unusable frames and requests, by reason, also those of the microcontroller."""
        there = Counter(
            {
                "bridge: frame broken or refused": self.state.broken,
                "bridge: order refused": self.state.refused,
                "bridge: no answer": self.state.silent,
                "bridge: garbled packet": self.state.garbled,
            }
            if self.state
            else {}
        )
        return self._registers.lost + self._receiver.dropped + self._invalid_reason + there

    @property
    def trouble(self) -> str:
        """Problem of the link to the servos, or an empty string."""
        now_ns = self._clock()
        if now_ns - self._state_ns > _SILENT_NS:
            return f"the bridge has been silent for {(now_ns - self._state_ns) * 1e-9:.1f} s"
        if self.state is None:
            return ""
        mode, why = self.state.mode, self.state.refusal.words
        late = now_ns - self._torque_ns > _SILENT_NS
        if self._torque and late and mode is Mode.OFF:
            return (
                f"the bridge keeps torque off; it last refused {why}" if self.state.refused else "the bridge keeps torque off"
            )
        if mode in (Mode.ADOPTING, Mode.CATCHING_UP):
            return f"the bridge is {mode.words}: goals are followed slowly or not yet"
        if mode is Mode.HOLDING and now_ns - self._goals_ns <= _SILENT_NS < self._goals_ns - self._goals_since_ns:
            return "the bridge holds the last goals: no fresh goals reach it"
        return ""

    @property
    def missed(self) -> NDArray[np.int64]:
        """(n,) turns of reading in which each servo has sent nothing new."""
        ages = self.ages()
        return (np.where(np.isfinite(ages), ages, 0.0) * 1e9 // self._turn_ns).astype(np.int64)

    @property
    def loss(self) -> float:
        """Always zero: the microcontroller repeats requests itself."""
        return 0.0

    def close(self) -> None:
        """Close the port, gone or not; the servos keep their torque and last goals."""
        self._port.close()

    # ----------------------------------------------------------------------------------------------- outside the loop

    def setup(self) -> None:
        """Open a session, check presence and type of servos, configure fast answers.

        Torque and limits stay as they are.

        Raises:
            BusSetupError: No bridge answers, its version or servo type differs, or servos are missing or wrong; all are named.
            BusDisconnectedError: The port is gone.
        """
        self.open_session()
        self._registers.setup()

    def open_session(self) -> None:
        """Open a session; the servos and their goals stay as they are.

        Raises:
            BoardSilentError: No bridge answers.
            BusSetupError: Its version or servo type differs.
            BusDisconnectedError: The port is gone.
        """
        self._session = self._clock() // _NS_PER_US % 0xFFFF_FFFF + 1  # differs from the last session
        self._sequence = 0
        self._welcomed, self._welcome = False, None
        self._greet()
        until = self._clock() + _HELLO_NS
        while not self._welcomed:
            self._pump()
            if self._receiver.other_version is not None:
                found = self._receiver.other_version
                raise BusSetupError(
                    f"the bridge uses protocol version {found}, version {bridge_protocol.VERSION} expected; "
                    f"flash firmware of version {bridge_protocol.VERSION}, see docs/bridge.md"
                )
            if self._welcome is not None and self._welcome.servo != self.model.name:
                raise BusSetupError(
                    f"the bridge drives servos {self._welcome.servo}, the profile has {self.model.name}; "
                    f"set SERVO in the board's config.py, or `model` in the profile's table [servo]"
                )
            if self._clock() >= until:
                raise BoardSilentError(
                    "no bridge answers on the port; check its power and cable; "
                    "for a servo adapter turn the setting `bridge` off"
                )

    def read(self, servo_id: int, register: Register) -> int | None:
        """Return the value of a register, None when the servo does not answer."""
        return self._registers.read(servo_id, register)

    def read_bytes(self, servo_id: int, address: int, size: int) -> bytes | None:
        """Return bytes of a control table, None when the servo does not answer or refuses."""
        return self._registers.read_bytes(servo_id, address, size)

    def write(self, servo_id: int, register: Register, value: int) -> bool:
        """Write one register; return whether it is acknowledged.

        The bridge refuses to turn torque on this way, unless torque is ordered on and the servo is near its goal.

        Raises:
            ValueError: The value is outside the register's range.
        """
        return self._registers.write(servo_id, register, value)

    def reboot(self, servo_id: int) -> None:
        """Restart a servo; the bridge passes it on."""
        self._registers.reboot(servo_id)

    # --------------------------------------------------------------------------------------------------- in the loop

    def sync_write_goals(self, goal_ticks: ArrayLike, speed_ticks: ArrayLike = 0) -> None:
        """Send every servo its goal position and moving speed, valid for 200 ms.

        Args:
            goal_ticks: (n,) goal position registers of the model.
            speed_ticks: (n,) or one goal speed register, 0 for no limit.

        Raises:
            ValueError: A value out of range, not a whole number, or of another shape.
            BusDisconnectedError: The port is gone.
        """
        now_ns = self._clock()
        if self._goals_ns < 0 or now_ns - self._goals_ns > _SILENT_NS:
            self._goals_since_ns = now_ns
        self._goals_ns = now_ns
        units = self.model.units
        angles = (self._whole(goal_ticks, self._table.goal_position) - units.centre) * (units.tick_rad / ANGLE_RAD)
        speeds = self._whole(speed_ticks, self._table.goal_speed) * (units.speed_rad_s / SPEED_RAD_S)
        if self._first:
            self._send(bridge_protocol.First(*self._head(), bytes(self.servo_ids[index] for index in self._first)))
        self._send(bridge_protocol.Goals(*self._head(), _LIFETIME_MS, _rounded(angles), _rounded(speeds)))

    def set_torque(self, enabled: bool) -> None:
        """Turn the torque of all servos on or off; off is repeated until it is done.

        The bridge turns it on only with valid goals that are near the servo positions.
        """
        self._torque, self._torque_ns = enabled, self._clock()
        self._order_torque()

    def poll(self, budget_ns: int, first: Sequence[int] = ()) -> list[ServoReading]:
        """Return new readings since the last call, at most ten milliseconds old.

        Args:
            budget_ns: [ns] time for this call; 0 reads nothing.
            first: Indices of servos with commands that the bridge moves and reads first. Others are all read in every cycle.

        Raises:
            BusDisconnectedError: The port is gone.
        """
        if self._estimates is not None:
            self._first = tuple(sorted(set(first)))
            for place, index in enumerate(self._first):
                self._written_us[index] = (place + 1) * self._goal_us
        until = self._clock() + budget_ns
        while self._clock() < until and self._pump() == _CHUNK_BYTES:
            pass
        self._keep_in_touch()
        # Of legs that may touch ground, a reading tells something only about the newest goals.
        readings = [found for i, found in self._fresh.items() if i not in self._first or found.told_ns >= self._goals_ns]
        self._fresh.clear()
        return readings

    @property
    def newest_age_s(self) -> float:
        """Time [s] since the newest reading of any servo was requested, infinite before the first."""
        newest_ns = max(self._read_ns)
        return (self._clock() - newest_ns) * 1e-9 if newest_ns >= 0 else math.inf

    def ages(self) -> NDArray[np.float64]:
        """Return (n,) [s] since each newest reading was requested, infinite before."""
        now = self._clock()
        return np.array([(now - t) * 1e-9 if t >= 0 else np.inf for t in self._read_ns])

    def _keep_in_touch(self) -> None:
        """Greet a restarted or silent bridge, and repeat torque off until it is done."""
        now_ns = self._clock()
        lost = not self._welcomed or now_ns - self._state_ns > _SILENT_NS
        if self._session and lost and now_ns - self._greeted_ns > _GREET_AGAIN_NS:
            self._greet()
        if self._torque is False and not (self.state and self.state.mode is Mode.OFF):
            self._order_torque()

    # ------------------------------------------------------------------------------------------------- below the words

    def ask(self, servo_id: int, instruction: int, address: int = 0, size: int = 0, data: bytes = b"") -> int:
        """Forward an instruction to one servo; return the number of the request.

        Raises:
            BusDisconnectedError: The port is gone.
        """
        self._send(bridge_protocol.Ask(*self._head(), servo_id, int(instruction), address, size, data))
        return self._sequence

    def answer(self, question: int) -> Answer | None:
        """Wait for the answer to a request; None after a timeout."""
        until = self._clock() + _ANSWER_NS
        while True:
            if self._answer is not None and self._answer.sequence == question:
                return self._answer
            if self._clock() >= until:
                return None
            self._pump()

    def _head(self) -> tuple[int, int, int]:
        """Return session, number and time of the next order."""
        self._sequence += 1
        return max(self._session, 1), self._sequence, self._clock() // _NS_PER_US

    def _greet(self) -> None:
        self._greeted_ns = self._clock()
        self._send(
            bridge_protocol.Hello(bridge_protocol.VERSION, self._session, self._clock() // _NS_PER_US, bytes(self.servo_ids))
        )

    def _order_torque(self) -> None:
        self._send(bridge_protocol.Torque(*self._head(), int(bool(self._torque))))

    def _whole(self, values: ArrayLike, register: Register) -> NDArray[np.int64]:
        return np.broadcast_to(whole(values, register, len(self)), (len(self),))

    def _send(self, message: Message) -> None:
        try:
            self._port.write(bridge_protocol.encode(message))
        except LOST as error:
            raise gone(error) from error

    def _pump(self) -> int:
        """Process received data; return the number of bytes."""
        try:
            data = self._port.read(_CHUNK_BYTES)
        except LOST as error:
            raise gone(error) from error
        for message in self._receiver.feed(data):
            match message:
                case Welcome():
                    self._meet(message)
                case State():
                    self._take(message)
                case Answer() if message.session == self._session:
                    self._answer = message
        return len(data)

    def _meet(self, welcome: Welcome) -> None:
        """Process a welcome: reset after a restart, and check the session."""
        if welcome.boot != self._boot:
            self.restarts += self._boot is not None
            self._boot, self._remote = welcome.boot, RemoteClock()
            self.state = None
            self._measured_us = [-_NEW_US - 1] * len(self)
            self._taken_us = (_NEVER_US, _NEVER_US)
        if welcome.session == self._session:
            self._welcome = welcome
        self._welcomed = welcome.session == self._session and welcome.servo == self.model.name

    def _take(self, state: State) -> None:
        """Accept a newer state of this session with the right number of servos."""
        if state.session != self._session or not self._welcomed:
            self._invalid_reason["state of another session"] += 1
        elif self.state is not None and state.sequence <= self.state.sequence:
            self._invalid_reason["state out of order"] += 1
        elif len(state.position) != len(self):
            self._invalid_reason["state of other servos"] += 1
        else:
            now_ns = self._clock()
            stamp_ns = now_ns - self._remote.age_ns(state.time_us, now_ns)
            self.state, self._state_ns = state, stamp_ns
            self.errors[:] = np.frombuffer(state.error, dtype=np.uint8)
            self._note_goals(state)
            for index in range(len(self)):
                self._note(state, index, stamp_ns)

    def _note_goals(self, state: State) -> None:
        """Store when the microcontroller accepted the newest goals.

        The age is rounded down.
        """
        if state.goals_age != bridge_protocol.NEVER:
            taken_us = state.time_us - bridge_protocol.AGE_UNIT_US * state.goals_age - bridge_protocol.AGE_UNIT_US // 2
            if taken_us - self._taken_us[1] > _OTHER_GOALS_US:
                self._taken_us = (self._taken_us[1], taken_us)

    def _note(self, state: State, index: int, stamp_ns: int) -> None:
        """Store the reading of one servo, if it is new."""
        if state.age[index] == bridge_protocol.NEVER:
            return
        age_us = state.age[index] * bridge_protocol.AGE_UNIT_US
        measured_us = state.time_us - age_us
        if measured_us - self._measured_us[index] < _NEW_US:
            return
        self._measured_us[index] = measured_us
        self._read_ns[index] = stamp_ns - age_us * _NS_PER_US
        before_us, newest_us = (taken_us + self._written_us[index] for taken_us in self._taken_us)
        told_us = newest_us if measured_us >= newest_us else before_us
        told_ns = self._read_ns[index] - (measured_us - told_us) * _NS_PER_US
        units, error = self.model.units, ServoError(state.error[index])
        registers = Registers(
            stamp_ns=self._read_ns[index],
            position=units.ticks(state.position[index] * ANGLE_RAD),
            speed=round(state.speed[index] * SPEED_RAD_S / units.speed_rad_s),
            load=round(state.load[index] * LOAD / units.load),
            voltage=round(state.voltage[index] * VOLT / units.volt),
            temperature=state.temperature[index],
            error=int(error),
        )
        before = self._fresh.pop(index, None)  # keep the order of reading
        if self._estimates is None:
            found = reading(index, self.servo_ids[index], told_ns, registers, error, units)
        else:
            found = self._estimated(self._estimates, index, told_ns, registers)
            if before is not None:  # a voltage or temperature is in one state only
                _keep_slow_values(found, before)
        self._fresh[index] = found

    def _estimated(self, estimates: PositionReadings, index: int, told_ns: int, state: Registers) -> ServoReading:
        """Return the reading of a servo that measures no speed and no load; its load tells the goal that it had.

        A voltage or temperature of 0 was not read.
        """
        units, model = self.model.units, self.model
        goal = units.angle(state.position) + state.load * units.load / model.gain_stiffness
        extra = Feedback.VOLTAGE if state.voltage else Feedback.NONE
        extra |= Feedback.TEMPERATURE if state.temperature else Feedback.NONE
        return estimates.reading(index, self.servo_ids[index], told_ns, state, goal, extra)


def _keep_slow_values(found: ServoReading, before: ServoReading) -> None:
    """Add the voltage and temperature of a reading that a newer one replaces."""
    if Feedback.VOLTAGE not in found.measured:
        found.voltage = before.voltage
    if Feedback.TEMPERATURE not in found.measured:
        found.temperature = before.temperature
    found.measured |= before.measured


def _goal_us(model: ServoModel) -> int:
    """Return the time [us] of a packet with the goal of one servo with commands."""
    table = model.table
    size = model.protocol.OVERHEAD + table.goal_position.size + (table.goal_time.size if table.goal_time else 0)
    return size * _BITS_PER_BYTE * 1_000_000 // model.bus_rate


def _rounded(values: NDArray[np.floating]) -> tuple[int, ...]:
    """Return values (n,) as whole numbers, limited to the range of the wire."""
    return tuple(np.clip(np.rint(values), -bridge_protocol.SIGNED_MAX, bridge_protocol.SIGNED_MAX).astype(int).tolist())


class _Questions:
    """Port for a `ServoBus` on a bridge: converts packets to bridge requests."""

    def __init__(self, asked: Bridge) -> None:
        self._bridge = asked
        self._protocol = asked.model.protocol
        self._parser = self._protocol.instruction_parser()
        self._open: tuple[int, int] | None = None  # servo and number of the pending request

    def write(self, data: bytes, /) -> int:
        has_commands = self._bridge.model.commands is not None
        for packet in self._parser.feed(data):
            request = self._protocol.request(packet)
            if request is not None and request.kind in _INSTRUCTIONS:
                size = request.size if request.kind is Kind.READ else 0
                address = packet.code if has_commands else request.address
                number = self._bridge.ask(packet.servo_id, _INSTRUCTIONS[request.kind], address, size, request.data)
                self._open = packet.servo_id, number
        return len(data)

    def read(self, size: int = 1, /) -> bytes:
        if self._open is None:
            return b""
        servo_id, question = self._open
        self._open = None
        answer = self._bridge.answer(question)
        if answer is None or answer.result is not Result.ANSWERED:
            return b""
        return self._protocol.status(servo_id, answer.error, answer.data)

    def reset_input_buffer(self) -> None:
        self._open = None

    def close(self) -> None:
        """Do nothing: the bridge closes the port itself."""
