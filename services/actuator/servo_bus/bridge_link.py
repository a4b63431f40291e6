"""Link to a microcontroller: session, orders and states; see docs/bridge.md for the protocol.

It uses no thread and no sleep; time comes from a clock argument. In the loop only `BusDisconnectedError` is raised. Broken, old
and out-of-order frames are counted by reason.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sextant.services.actuator.servo_bus.bus_driver import LOST, BusSetupError, Port, gone
from sextant.services.actuator.servo_bus.bus_setup import BoardSilentError
from sextant.services.actuator.servo_bus.group_writes import whole
from sextant.shared.servo import bridge_protocol
from sextant.shared.servo.bridge_protocol import (
    ANGLE_RAD,
    SPEED_RAD_S,
    Answer,
    Message,
    Mode,
    Receiver,
    RemoteClock,
    State,
    Welcome,
)
from sextant.shared.servo.servo_model import Register, ServoModel

READ_NS = 1_000_000  # [ns] longest wait of one read of the port
SILENT_NS = 100_000_000  # [ns] without a state, or without the effect of an order, after which a problem is reported
NEVER_US = -1_000_000_000  # [us] long ago
_LIFETIME_MS = 200  # [ms] validity of goals
_CHUNK_BYTES = 4096  # [bytes] per read
_HELLO_NS = 300_000_000  # [ns] timeout of a welcome
_GREET_AGAIN_NS = 100_000_000  # [ns] between two hellos in the loop
_ANSWER_NS = 40_000_000  # [ns] timeout of a servo's answer through the bridge
_OTHER_GOALS_US = 5_000  # [us] after the newest goals from which goals count as newer ones
_NS_PER_US = 1_000


class BridgeLink(ABC):
    """Session with a microcontroller that drives servos; arrays are in their list order."""

    def __init__(
        self, port: Port, servo_ids: Sequence[int], clock: Callable[[], int], model: ServoModel, servo: str, advice: str
    ) -> None:
        """Take over an open port. Nothing is sent before `open_session` or another call.

        Args:
            port: Open port whose read timeout is about `READ_NS`.
            servo_ids: At most 24 ids, 0 to 253, all different.
            clock: Monotonic time [ns]; of an emulated port, the port's own.
            model: The servo type.
            servo: Name by which the board must know it.
            advice: Says what to do if the board knows another model.

        Raises:
            ValueError: Too many ids.
        """
        if len(servo_ids) > bridge_protocol.MAX_SERVOS:
            raise ValueError(f"at most {bridge_protocol.MAX_SERVOS} servos behind a bridge expected, found {len(servo_ids)}")
        n = len(servo_ids)
        self.servo_ids = tuple(servo_ids)
        self.errors: NDArray[np.uint8] = np.zeros(n, dtype=np.uint8)  # (n,) error bits of the last status packets
        self.state: State | None = None  # the newest
        self.restarts = 0  # of the microcontroller, while in use
        self.model, self._table = model, model.table
        self._port = port
        self._clock = clock
        self._servo, self._advice = servo, advice
        self._receiver = Receiver(bridge_protocol.TO_HOST)
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
        self._taken_us = (NEVER_US, NEVER_US)  # when, by that clock, it accepted the previous goals and the newest ones
        self._first: tuple[int, ...] = ()  # indices of servos to be read and moved first
        self._torque: bool | None = None  # as ordered last
        self._torque_ns = 0
        self._goals_since_ns, self._goals_ns = 0, -1  # start of the gapless sequence of goals, and time of the newest ones

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
        return self._receiver.dropped + self._invalid_reason + there

    @property
    def trouble(self) -> str:
        """Problem of the link to the servos, or an empty string."""
        now_ns = self._clock()
        if now_ns - self._state_ns > SILENT_NS:
            return f"the bridge has been silent for {(now_ns - self._state_ns) * 1e-9:.1f} s"
        if self.state is None:
            return ""
        mode, why = self.state.mode, self.state.refusal.words
        late = now_ns - self._torque_ns > SILENT_NS
        if self._torque and late and mode is Mode.OFF:
            return (
                f"the bridge keeps torque off; it last refused {why}" if self.state.refused else "the bridge keeps torque off"
            )
        if mode in (Mode.ADOPTING, Mode.CATCHING_UP):
            return f"the bridge is {mode.words}: goals are followed slowly or not yet"
        if mode is Mode.HOLDING and now_ns - self._goals_ns <= SILENT_NS < self._goals_ns - self._goals_since_ns:
            return "the bridge holds the last goals: no fresh goals reach it"
        return ""

    @property
    def loss(self) -> float:
        """Always zero: the microcontroller repeats requests itself."""
        return 0.0

    def close(self) -> None:
        """Close the port, gone or not; the servos keep their torque and last goals."""
        self._port.close()

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
            if self._welcome is not None and self._welcome.servo != self._servo:
                raise BusSetupError(
                    f"the bridge drives servos {self._welcome.servo}, the profile has {self._servo}; {self._advice}"
                )
            if self._clock() >= until:
                raise BoardSilentError(
                    "no bridge answers on the port; check its power and cable; "
                    "for a servo adapter turn the setting `bridge` off"
                )

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
        if self._goals_ns < 0 or now_ns - self._goals_ns > SILENT_NS:
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

    def _read(self, budget_ns: int) -> None:
        """Process what has arrived, within a time budget, and keep in touch."""
        until = self._clock() + budget_ns
        while self._clock() < until and self._pump() == _CHUNK_BYTES:
            pass
        self._keep_in_touch()

    def _keep_in_touch(self) -> None:
        """Greet a restarted or silent bridge, and repeat torque off until it is done."""
        now_ns = self._clock()
        lost = not self._welcomed or now_ns - self._state_ns > SILENT_NS
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
            self._forget()
            self._taken_us = (NEVER_US, NEVER_US)
        if welcome.session == self._session:
            self._welcome = welcome
        self._welcomed = welcome.session == self._session and welcome.servo == self._servo

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
            self._note_errors(state)
            self._note_goals(state)
            for index in range(len(self)):
                self._note(state, index, stamp_ns)

    def _note_errors(self, state: State) -> None:
        """Store the error bits of the servos."""
        self.errors[:] = np.frombuffer(state.error, dtype=np.uint8)

    def _note_goals(self, state: State) -> None:
        """Store when the microcontroller accepted the newest goals.

        The age is rounded down.
        """
        if state.goals_age != bridge_protocol.NEVER:
            taken_us = state.time_us - bridge_protocol.AGE_UNIT_US * state.goals_age - bridge_protocol.AGE_UNIT_US // 2
            if taken_us - self._taken_us[1] > _OTHER_GOALS_US:
                self._taken_us = (self._taken_us[1], taken_us)

    @abstractmethod
    def _forget(self) -> None:
        """Forget what depends on the clock of a microcontroller that has restarted."""

    @abstractmethod
    def _note(self, state: State, index: int, stamp_ns: int) -> None:
        """Store what a state tells of one servo."""


def _rounded(values: NDArray[np.floating]) -> tuple[int, ...]:
    """Return values (n,) as whole numbers, limited to the range of the wire."""
    return tuple(np.clip(np.rint(values), -bridge_protocol.SIGNED_MAX, bridge_protocol.SIGNED_MAX).astype(int).tolist())
