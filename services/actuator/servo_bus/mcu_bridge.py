"""Servos behind a microcontroller bridge; see docs/bridge.md for the protocol.

It uses no thread and no sleep; time comes from a clock argument. In the loop only `BusDisconnectedError` is raised. Without new
states the servo readings age.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.servo_bus.bridge_link import READ_NS, BridgeLink
from sextant.services.actuator.servo_bus.bus_driver import Port, ServoReading, reading
from sextant.services.actuator.servo_bus.command_bus import bus_of
from sextant.services.actuator.servo_bus.reading_validation import State as Registers
from sextant.services.actuator.servo_bus.servo_reading import PositionReadings
from sextant.shared.servo import bridge_protocol
from sextant.shared.servo.bridge_protocol import ANGLE_RAD, LOAD, SPEED_RAD_S, VOLT, Instruction, Result, State
from sextant.shared.servo.models import AX_12A
from sextant.shared.servo.servo_model import Feedback, Kind, Register, ServoError, ServoModel

__all__ = ["READ_NS", "Bridge"]

_NEW_US = 1_000  # [us] by which a new reading is newer than the last one
_CYCLE_NS = 20_000_000  # [ns] in which the bridge reads every servo ...
_TURN_NS = 100_000_000  # [ns] ... that has registers; one with commands is read in this time
_BITS_PER_BYTE = 10
_NS_PER_US = 1_000
_INSTRUCTIONS = {
    Kind.PING: Instruction.PING,
    Kind.READ: Instruction.READ,
    Kind.WRITE: Instruction.WRITE,
    Kind.REBOOT: Instruction.REBOOT,
}


class Bridge(BridgeLink):
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
        advice = "set SERVO in the board's config.py, or `model` in the profile's table [servo]"
        super().__init__(port, servo_ids, clock, model, model.name, advice)
        n, questions = len(servo_ids), _Questions(self)
        self.registers = bus_of(model)(questions, servo_ids, clock, model=model, names=names, reply_timeout_ns=0, lock=lock)
        self._fresh: dict[int, ServoReading] = {}  # unread readings, by index in the list
        self._read_ns = [-1] * n  # stamp of the newest reading
        self._measured_us = [-_NEW_US - 1] * n  # the same, by the microcontroller's clock
        own = [model.gain_stiffness] * n if stiffness is None else stiffness
        self._estimates = None if model.commands is None else PositionReadings(model.units, own)
        self._turn_ns = _CYCLE_NS if model.commands is None else _TURN_NS
        self._goal_us = _goal_us(model)
        self._written_us = [0] * n  # [us] between the acceptance of goals and the end of the packet to each servo

    @property
    def between(self) -> Callable[[], None]:
        """Callback before each request to a servo outside the loop."""
        return self.registers.between

    @between.setter
    def between(self, do: Callable[[], None]) -> None:
        self.registers.between = do

    @property
    def lost(self) -> Counter[str]:
        """Unusable frames and requests, by reason, also those of the microcontroller."""
        return self.registers.lost + super().lost

    @property
    def missed(self) -> NDArray[np.int64]:
        """(n,) turns of reading in which each servo has sent nothing new."""
        ages = self.ages()
        return (np.where(np.isfinite(ages), ages, 0.0) * 1e9 // self._turn_ns).astype(np.int64)

    # ----------------------------------------------------------------------------------------------- outside the loop

    def setup(self) -> None:
        """Open a session, check presence and type of servos, configure fast answers.

        Torque and limits stay as they are.

        Raises:
            BusSetupError: No bridge answers, its version or servo type differs, or servos are missing or wrong; all are named.
            BusDisconnectedError: The port is gone.
        """
        self.open_session()
        self.registers.setup()

    def read(self, servo_id: int, register: Register) -> int | None:
        """Return the value of a register, None when the servo does not answer."""
        return self.registers.read(servo_id, register)

    def read_bytes(self, servo_id: int, address: int, size: int) -> bytes | None:
        """Return bytes of a control table, None when the servo does not answer or refuses."""
        return self.registers.read_bytes(servo_id, address, size)

    def write(self, servo_id: int, register: Register, value: int) -> bool:
        """Write one register; return whether it is acknowledged.

        The bridge refuses to turn torque on this way, unless torque is ordered on and the servo is near its goal.

        Raises:
            ValueError: The value is outside the register's range.
        """
        return self.registers.write(servo_id, register, value)

    def reboot(self, servo_id: int) -> None:
        """Restart a servo; the bridge passes it on."""
        self.registers.reboot(servo_id)

    # --------------------------------------------------------------------------------------------------- in the loop

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
        self._read(budget_ns)
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

    def _forget(self) -> None:
        self._measured_us = [-_NEW_US - 1] * len(self)

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
