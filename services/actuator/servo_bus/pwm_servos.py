"""Driver for hobby servos behind a board that sends pulses. They report nothing.

Goals, torque and speeds are kept here, in the form of registers; `pwm.TABLE` lists them. Measured values are never
returned. Torque on makes a servo jump to its goal, so the legs get their pulses one after another.

It uses no thread and no sleep; time comes from a clock argument.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sextant.services.actuator.servo_bus.bus_driver import BusSetupError
from sextant.services.actuator.servo_bus.bus_setup import BoardSilentError
from sextant.services.actuator.servo_bus.group_writes import whole
from sextant.services.actuator.servo_bus.pulse_boards import PulseBoard, open_board
from sextant.services.actuator.servo_bus.serial_port import Port
from sextant.services.actuator.servo_bus.servo_reading import ServoReading
from sextant.shared.servo.pwm import SPEED_TICKS_S, Pulses, model_of
from sextant.shared.servo.servo_model import Register, ServoModel

LEG_S = 0.5  # [s] between the first pulses of two legs
PER_LEG = 3  # servos that get their first pulses together
TURNING = "the legs get their torque one after another, and jump to the sit pose: {done} of {legs}"
LOST_PULSES = (
    "the pulses of {count} servos are lost, as after a restart of their board: "
    "these have no torque; lay the robot down, then order `ready`"
)
_REPEATS = 2  # of requests that find a channel without its pulses: a byte of the answer may be broken
_SAME_US = 5.0  # [us] difference of ordered pulses and those that the board reports, which a count of a PCA9685 explains
_OTHER = "other pulses than ordered"
_LONGEST_NS = 100_000_000  # [ns] between two goals for which a speed limit is integrated
_LONG_AGO_NS = -(10**18)
_SILENT_NS = 100_000_000  # [ns] without an answer of the board after which it counts as silent


class PwmServos:
    """Driver for a fixed list of servos; arrays are in the order of that list."""

    def __init__(self, port: Port, channels: Sequence[int], clock: Callable[[], int], pulses: Pulses) -> None:
        """Take over an open port. Nothing is sent before `setup` or another call.

        Args:
            port: Open port of the board.
            channels: Channel of each servo, all different.
            clock: Monotonic time [ns]; of an emulated port, the port's own.
            pulses: The board and its pulses.
        """
        n = len(channels)
        self.model = model_of(pulses)
        self.servo_ids = tuple(channels)
        self.errors: NDArray[np.uint8] = np.zeros(n, dtype=np.uint8)  # servos report none
        self.between: Callable[[], None] = _nothing  # called before each request outside the loop
        self._lost_pulses = 0  # servos without the pulses that they should have, until torque is turned on
        self._port, self._clock, self._pulses = port, clock, pulses
        self._board: PulseBoard = open_board(port, pulses)
        self._goals = np.full(n, self.model.units.centre, dtype=np.float64)  # (n,) [ticks]
        self._sent = self._goals.copy()  # (n,) [ticks] on the way to the goals
        self._sent_ns = 0
        self._enabled: NDArray[np.bool_] = np.zeros(n, dtype=np.bool_)  # (n,) servos that should have pulses ...
        self._powered_from_ns = np.full(n, _LONG_AGO_NS, dtype=np.int64)  # (n,) [ns] ... from these times on
        self._ordered_us: dict[int, float] = {}  # channel -> newest pulses [us]
        self._next = 0  # channel to ask for next
        self._answered_ns = -1  # [ns] newest answer of the board
        self._unanswered = 0  # consecutive requests in the loop

    def model_of(self, servo_id: int) -> ServoModel:
        """Return the model of a servo, which is that of all."""
        return self.model

    def __len__(self) -> int:
        """Number of servos."""
        return len(self.servo_ids)

    @property
    def lost(self) -> Counter[str]:
        """Missing answers and errors of the board, by reason."""
        return self._board.lost

    @property
    def trouble(self) -> str:
        """Problem of the board, or which legs still wait for their pulses; or an empty string."""
        now_ns = self._clock()
        if self._answered_ns >= 0 and now_ns - self._answered_ns > _SILENT_NS and self._unanswered:
            other = ", or its pulses are others than ordered," if self.lost[_OTHER] else ""
            return f"the board of the servos has been silent{other} for {(now_ns - self._answered_ns) * 1e-9:.1f} s"
        if self._lost_pulses:
            return LOST_PULSES.format(count=self._lost_pulses)
        waiting = self._enabled & (self._powered_from_ns > now_ns)
        if waiting.any() or self._is_turning:
            done = int(np.count_nonzero(self._enabled & ~waiting)) // PER_LEG
            return TURNING.format(done=done, legs=len(self) // PER_LEG)
        return ""

    @property
    def _is_turning(self) -> bool:
        """Whether servos may still jump to their first pulses."""
        first_ns = self._powered_from_ns[self._enabled]
        return bool(len(first_ns)) and self._clock() < int(first_ns.max()) + round(LEG_S * 1e9)

    @property
    def missed(self) -> NDArray[np.int64]:
        """(n,) zeros: a servo that does not follow is not noticed; `trouble` reports a silent board."""
        return np.zeros(len(self), dtype=np.int64)

    @property
    def loss(self) -> float:
        """Always zero: goals are not acknowledged."""
        return 0.0

    @property
    def newest_age_s(self) -> float:
        """Time [s] since the newest request that the board has answered, infinite before the first."""
        return (self._clock() - self._answered_ns) * 1e-9 if self._answered_ns >= 0 else math.inf

    def width_us(self, ticks: int) -> float:
        """Return the pulse width [us] of a goal [ticks]."""
        return self._pulses.width_us(ticks)

    def close(self) -> None:
        """Close the port; the board goes on with the last pulses."""
        self._port.close()

    # ----------------------------------------------------------------------------------------------- outside the loop

    def setup(self) -> None:
        """Open a session; there is nothing else to check or to configure."""
        self.open_session()

    def open_session(self) -> None:
        """Check that the board answers on a newly opened port, and adopt the pulses that it sends.

        Raises:
            BoardSilentError: It does not answer.
            BusSetupError: It sends other pulses than those of the profile.
            BusDisconnectedError: The port is gone.
        """
        self.between()
        if why := self._board.open(self.servo_ids):
            raise BoardSilentError(why)
        for index, channel in enumerate(self.servo_ids):
            width_us = self._ask(channel)
            if width_us is None:
                raise BusSetupError(f"the board does not answer what channel {channel} sends; check its cable")
            ticks = self._pulses.ticks(width_us)
            self._enabled[index] = width_us > 0.0
            if not width_us:
                continue
            if not -1 <= ticks <= self.model.units.max_position + 1:
                raise BusSetupError(
                    f"channel {channel} has pulses of {width_us:.0f} us, outside the range of the profile; "
                    "is this the robot's board?"
                )
            self._goals[index] = self._sent[index] = min(max(ticks, 0), self.model.units.max_position)

    def read(self, servo_id: int, register: Register) -> int | None:
        """Return a setting; None for what a servo would have to measure, and if the board does not answer.

        Whether a servo has torque is read from the board.
        """
        index, table = self.servo_ids.index(servo_id), self.model.table
        if register is table.torque_enable:
            return self._read_torque(index)
        if register in table.measured:
            return None
        own = {table.goal_position: round(float(self._goals[index])), table.id: servo_id, table.goal_speed: 0}
        return own.get(register, self.model.default(register))

    def read_bytes(self, servo_id: int, address: int, size: int) -> bytes | None:
        """Return a block of settings; measured values in it are zero."""
        return settings_block(self.model, lambda register: self.read(servo_id, register), address, size)

    def write(self, servo_id: int, register: Register, value: int) -> bool:
        """Set the goal or the torque of one servo at once; return whether the board sends these pulses.

        Raises:
            ValueError: The value is outside the register's range.
        """
        register.encode(value)
        index, table = self.servo_ids.index(servo_id), self.model.table
        if register is table.goal_position:
            self._goals[index] = self._sent[index] = min(value, self.model.units.max_position)
        elif register is table.torque_enable:
            self._enabled[index], self._powered_from_ns[index] = bool(value), _LONG_AGO_NS
        else:
            return register not in table.measured
        self.between()
        width_us = self._pulses.width_us(self._sent[index]) if self._enabled[index] else 0.0
        self._board.send({servo_id: width_us})
        self._ordered_us = self._ordered_us | {servo_id: width_us}
        found = self._ask(servo_id)
        return found is not None and bool(found) == bool(width_us)

    def reboot(self, servo_id: int) -> None:
        """Do nothing: hobby servos have no command."""

    # --------------------------------------------------------------------------------------------------- in the loop

    def sync_write_goals(self, goal_ticks: ArrayLike, speed_ticks: ArrayLike = 0) -> None:
        """Send the pulses of all servos with torque. With a speed limit, pulses approach the goal step by step.

        Args:
            goal_ticks: (n,) goals [ticks].
            speed_ticks: (n,) or one speed limit, 0 for none.

        Raises:
            ValueError: A value out of range, not a whole number, or of another shape.
            BusDisconnectedError: The port is gone.
        """
        goals = whole(goal_ticks, self.model.table.goal_position, len(self))
        speeds = np.broadcast_to(whole(speed_ticks, self.model.table.goal_speed, len(self)), (len(self),))
        now_ns = self._clock()
        self._goals[:] = np.minimum(goals, self.model.units.max_position)
        since_s = min(now_ns - self._sent_ns, _LONGEST_NS) * 1e-9
        most = np.where(speeds > 0, speeds * SPEED_TICKS_S * since_s, np.inf)
        ways = self._goals - self._sent
        self._sent = np.where(self._enabled, self._sent + np.clip(ways, -most, most), self._goals)
        self._sent_ns = now_ns
        self._send()

    def set_torque(self, enabled: bool) -> None:
        """Turn torque on, leg by leg, at the goals sent before; or off for all servos at once."""
        now_ns = self._clock()
        if not enabled:
            self._enabled[:] = False
            for _ in range(2):  # it is not acknowledged
                self._board.end_pulses(self.servo_ids)
            return
        if self._lost_pulses and self._board.open(self.servo_ids):  # it does not answer
            return
        self._lost_pulses = 0
        off = np.flatnonzero(~self._enabled)
        legs = off // PER_LEG
        turn = np.searchsorted(np.unique(legs), legs)
        self._powered_from_ns[off] = now_ns + np.round(turn * LEG_S * 1e9).astype(np.int64)
        self._enabled[:] = True
        self._send()

    def poll(self, budget_ns: int, first: Sequence[int] = ()) -> list[ServoReading]:
        """Ask the board for the pulses of one channel, in turn; return no readings, because servos give none.

        A board that has restarted sends no pulses. Then the torque of its servos stays off until it is ordered, because goals
        would turn it on by themselves.

        Raises:
            BusDisconnectedError: The port is gone.
        """
        if budget_ns <= 0:
            return []
        self._next = (self._next + 1) % len(self)
        self._read_torque(self._next)
        return []

    # -------------------------------------------------------------------------------------------------- below the words

    def _is_powered(self, index: int) -> bool:
        """Return whether a servo should have pulses now."""
        return bool(self._enabled[index] and self._powered_from_ns[index] <= self._sent_ns)

    def _read_torque(self, index: int) -> int | None:
        """Return whether a servo has torque, or waits for its first pulses; None without an answer of the board.

        A servo that has lost its pulses gets none until torque is turned on, and so do all others that have lost theirs.
        """
        for _ in range(1 + _REPEATS):
            width_us = self._ask(self.servo_ids[index])
            if width_us is None:
                return None
            if width_us or not self._is_powered(index):
                return int(bool(width_us) or bool(self._enabled[index]))
        self._enabled[index] = False
        for other, channel in enumerate(self.servo_ids):  # before the next goals, which would turn their torque on again
            self._enabled[other] &= not self._is_powered(other) or self._ask(channel) != 0.0
        self._lost_pulses = int(np.count_nonzero(~self._enabled))
        return 0

    def _send(self) -> None:
        """Send the pulses of all servos whose turn has come."""
        now = self._enabled & (self._powered_from_ns <= self._clock())
        widths = {
            channel: self._pulses.width_us(round(ticks))
            for channel, ticks, powered in zip(self.servo_ids, self._sent.tolist(), now.tolist(), strict=True)
            if powered
        }
        if widths:
            self._board.send(widths)
            self._ordered_us = widths

    def _ask(self, channel: int) -> float | None:
        """Ask for the pulses [us] of a channel, and note whether the board answers."""
        self.between()
        asked_ns = self._clock()
        ordered_us = self._ordered_us.get(channel)
        width_us = self._board.width_us(channel) if ordered_us else self._confirmed_us(channel)
        if width_us and ordered_us and abs(width_us - ordered_us) > _SAME_US:
            self.lost[_OTHER] += 1
            width_us = None
        if width_us is None:
            self._unanswered += 1
        else:
            self._answered_ns, self._unanswered = asked_ns, 0
        return width_us

    def _confirmed_us(self, channel: int) -> float | None:
        """Ask for the pulses [us] of a channel to which none were ordered. Two answers must agree: they have no checksum."""
        found: list[float | None] = []
        for _ in range(1 + _REPEATS):
            width_us = self._board.width_us(channel)
            if width_us is not None and width_us in found:
                return width_us
            found.append(width_us)
        self.lost[_OTHER] += len(set(found) - {None}) > 1
        return None


def settings_block(model: ServoModel, read: Callable[[Register], int | None], address: int, size: int) -> bytes | None:
    """Return bytes of a table of settings, of which `read` returns each; None if it returns None."""
    found = bytearray(model.table.size)
    for register in model.table.registers:
        if address <= register.address < address + size and register not in model.table.measured:
            value = read(register)
            if value is None:
                return None
            found[register.address : register.address + register.size] = value.to_bytes(register.size, "little")
    return bytes(found[address : address + size])


def _nothing() -> None:
    pass
