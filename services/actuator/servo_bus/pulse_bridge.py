"""Driver for hobby servos behind a microcontroller with a board that sends the pulses; see docs/bridge.md for the protocol.

A state of the microcontroller has the pulses that were read back, as angles, in place of measurements. Goals, torque and speeds
have the form of registers, as in `pwm_servos`. It uses no thread and no sleep; time comes from a clock argument.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.servo_bus.bridge_link import SILENT_NS, BridgeLink
from sextant.services.actuator.servo_bus.bus_driver import BusSetupError, Port, ServoReading
from sextant.services.actuator.servo_bus.pwm_servos import LOST_PULSES, PER_LEG, TURNING, settings_block
from sextant.shared.servo import maestro
from sextant.shared.servo.bridge_protocol import AGE_UNIT_US, ANGLE_RAD, NEVER, Mode, State
from sextant.shared.servo.firmware.pulse_senders import sender_for
from sextant.shared.servo.pwm import Pulses, model_of
from sextant.shared.servo.servo_model import Register

_ADOPTED_NS = 1_000_000_000  # [ns] in which the microcontroller reads all pulses
_NS_PER_US = 1_000


class PulseBridge(BridgeLink):
    """Driver for a fixed list of servos; arrays are in the order of that list."""

    def __init__(self, port: Port, channels: Sequence[int], clock: Callable[[], int], pulses: Pulses) -> None:
        """Take over an open port. Nothing is sent before `setup` or another call.

        Args:
            port: Open port to the microcontroller.
            channels: Channel of each servo, all different.
            clock: Monotonic time [ns]; of an emulated port, the port's own.
            pulses: The pulses, for which the board must be configured.
        """
        advice, model = f'set SERVO = "PWM" and PULSES = {pulses.of_board} in the board\'s config.py', model_of(pulses)
        super().__init__(port, channels, clock, model, sender_for(pulses.of_board, model.bus_rate).name, advice)
        self._board_errors: Counter[str] = Counter()  # reports of a Maestro
        self.between: Callable[[], None] = _nothing  # called before each request outside the loop
        self._sent_on = 0  # number of the newest order that turns torque on or off
        self._had_pulses: NDArray[np.bool_] = np.zeros(len(channels), dtype=np.bool_)  # since that order

    @property
    def trouble(self) -> str:
        """Problem of the link or of the pulses, or which legs still wait for them; or an empty string."""
        found = super().trouble
        if self.state is None or not self._is_fresh:
            return found
        has_pulses = self._has_pulses
        if self.state.mode is Mode.CATCHING_UP and not has_pulses.all():
            return TURNING.format(done=np.count_nonzero(has_pulses) // PER_LEG, legs=len(self) // PER_LEG)
        if self.state.mode is Mode.OFF and (lost := np.count_nonzero(self._had_pulses & ~has_pulses)):
            return LOST_PULSES.format(count=lost)
        if not found and self.newest_age_s > SILENT_NS * 1e-9:
            return f"the board of the servos has been silent for {self.newest_age_s:.1f} s"
        return found

    @property
    def lost(self) -> Counter[str]:
        """Unusable frames and requests, and errors of the board, by reason."""
        return super().lost + self._board_errors

    @property
    def missed(self) -> NDArray[np.int64]:
        """(n,) zeros: a servo that does not follow is not noticed; `trouble` reports a silent board."""
        return np.zeros(len(self), dtype=np.int64)

    @property
    def newest_age_s(self) -> float:
        """Time [s] since pulses of any servo were read back; without pulses, that since the newest state."""
        if self.state is None:
            return math.inf
        ages = [age for age in self.state.age if age != NEVER]
        since_ns = self._clock() - self._state_ns
        return (since_ns + min(ages, default=0) * AGE_UNIT_US * _NS_PER_US) * 1e-9

    # ----------------------------------------------------------------------------------------------- outside the loop

    def setup(self) -> None:
        """Open a session; there is nothing else to check or to configure."""
        self.open_session()

    def open_session(self) -> None:
        """Open a session, and wait until the microcontroller has adopted the pulses that its boards send.

        Raises:
            BusSetupError: No bridge answers, its version or its pulses differ, or it adopts nothing.
            BusDisconnectedError: The port is gone.
        """
        self.between()
        self.state = None
        super().open_session()
        until = self._clock() + _ADOPTED_NS
        while self.state is None or self.state.mode is Mode.ADOPTING:
            if self._clock() >= until:
                raise BusSetupError(
                    f"the bridge does not tell which pulses the {self.model.protocol.NAME} behind it sends; "
                    "check its cable and power"
                )
            self._pump()

    def read(self, servo_id: int, register: Register) -> int | None:
        """Return a setting; None for what a servo would have to measure, and without a fresh state.

        A servo with torque has pulses, or waits for its first ones.
        """
        self.between()
        index, table = self.servo_ids.index(servo_id), self._table
        if register in table.measured or self.state is None:
            return None
        if register is table.torque_enable:
            if not (self._is_fresh and self._is_obeyed):
                return None
            return int(self._has_pulses[index] or self.state.mode in (Mode.ON, Mode.CATCHING_UP))
        units = self.model.units
        ticks = units.ticks(self.state.position[index] * ANGLE_RAD)
        goal = min(max(ticks, 0), units.max_position) if self._has_pulses[index] else units.centre
        return {table.goal_position: goal, table.id: servo_id, table.goal_speed: 0}.get(register, self.model.default(register))

    def read_bytes(self, servo_id: int, address: int, size: int) -> bytes | None:
        """Return a block of settings; measured values in it are zero."""
        return settings_block(self.model, lambda register: self.read(servo_id, register), address, size)

    def write(self, servo_id: int, register: Register, value: int) -> bool:
        """Write nothing, because goals and torque are those of all servos; return whether this servo has that torque.

        Raises:
            ValueError: The value is outside the register's range.
        """
        register.encode(value)
        if register is not self._table.torque_enable:
            return False
        until = self._clock() + SILENT_NS
        while (found := self.read(servo_id, register)) != value and self._clock() < until:
            self._pump()
        return found == value

    def reboot(self, servo_id: int) -> None:
        """Do nothing: hobby servos have no command."""

    # --------------------------------------------------------------------------------------------------- in the loop

    def set_torque(self, enabled: bool) -> None:
        """Turn torque on, leg by leg, at the goals sent before; or off for all servos at once, repeated until it is done."""
        super().set_torque(enabled)
        self._sent_on = self._sequence
        self._had_pulses[:] = False

    def poll(self, budget_ns: int, first: Sequence[int] = ()) -> list[ServoReading]:
        """Process states; return no readings, because servos give none.

        Raises:
            BusDisconnectedError: The port is gone.
        """
        self._read(budget_ns)
        return []

    # -------------------------------------------------------------------------------------------------- below the words

    @property
    def _has_pulses(self) -> NDArray[np.bool_]:
        """(n,) servos whose pulses were read back."""
        ages = (NEVER,) * len(self) if self.state is None else self.state.age
        return np.array([age != NEVER for age in ages])

    @property
    def _is_fresh(self) -> bool:
        return self._clock() - self._state_ns <= SILENT_NS

    @property
    def _is_obeyed(self) -> bool:
        """Whether the newest state is one after the newest order about torque; off is in no count."""
        if self.state is None or self._torque is None:
            return True
        return self.state.heard >= self._sent_on if self._torque else self.state.mode is Mode.OFF

    def _note_errors(self, state: State) -> None:
        """Count the errors that a Maestro has reported; servos report none."""
        for errors in state.error:
            if errors:
                self._board_errors[f"Maestro: {maestro.error_words(errors) or 'unknown error'}"] += 1

    def _forget(self) -> None:
        """Do nothing: no pulses are compared by that clock."""

    def _note(self, state: State, index: int, stamp_ns: int) -> None:
        self._had_pulses[index] |= state.age[index] != NEVER and self._torque is not False


def _nothing() -> None:
    pass
