"""Servos on several buses as one list. Each bus has a separate port.

The buses get their requests at the same time. So reading takes as long as on the slowest bus. The robot has lost its bus
if it has lost one of them, whose name is in the error.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sextant.services.actuator.servo_bus.bus_driver import BusSetupError, Polling, ServoBus
from sextant.services.actuator.servo_bus.bus_scan import Problem
from sextant.services.actuator.servo_bus.other_device import PingResponses
from sextant.services.actuator.servo_bus.serial_port import BusDisconnectedError
from sextant.services.actuator.servo_bus.servo_reading import ServoReading
from sextant.shared.robot.joint_servos import BusRows
from sextant.shared.servo.servo_model import Register, ServoError, ServoModel


class SeveralBuses:
    """Driver for the servos on several buses; it has the interface of `ServoBus`, and arrays are in the order of the robot."""

    def __init__(self, parts: Mapping[BusRows, ServoBus]) -> None:
        """Take over one driver for each bus, whose servos are in the order of the rows."""
        self._parts = [(part.name, np.array(part.rows), bus) for part, bus in parts.items()]
        places = {int(row): (bus, k) for _, rows, bus in self._parts for k, row in enumerate(rows)}
        self.servo_ids = tuple(places[row][0].servo_ids[places[row][1]] for row in range(len(places)))
        self._bus_of = {servo_id: places[row][0] for row, servo_id in enumerate(self.servo_ids)}
        self.names = {servo_id: self._bus_of[servo_id].names[servo_id] for servo_id in self.servo_ids}

    def __len__(self) -> int:
        """Number of servos."""
        return len(self.servo_ids)

    @property
    def between(self) -> Callable[[], None]:
        """Called before each request outside the loop."""
        return self._parts[0][2].between

    @between.setter
    def between(self, between: Callable[[], None]) -> None:
        for _, _, bus in self._parts:
            bus.between = between

    @property
    def errors(self) -> NDArray[np.uint8]:
        """(n,) error bits of the last status packets; a copy."""
        found = np.zeros(len(self), dtype=np.uint8)
        for _, rows, bus in self._parts:
            found[rows] = bus.errors
        return found

    @property
    def missed(self) -> NDArray[np.int64]:
        """(n,) consecutive unanswered requests of each servo in the loop; a copy."""
        found = np.zeros(len(self), dtype=np.int64)
        for _, rows, bus in self._parts:
            found[rows] = bus.missed
        return found

    @property
    def lost(self) -> Counter[str]:
        """Lost packets and requests of all buses, by reason."""
        return sum((bus.lost for _, _, bus in self._parts), Counter[str]())

    @property
    def garbled(self) -> int:
        """Number of invalid bytes and packets so far."""
        return sum(bus.garbled for _, _, bus in self._parts)

    @property
    def loss(self) -> float:
        """Recent share of requests without a usable answer, on the worst bus."""
        return max(bus.loss for _, _, bus in self._parts)

    @property
    def trouble(self) -> str:
        """Problem of the link; always empty here, because silent servos show it."""
        return ""

    @property
    def newest_age_s(self) -> float:
        """Time [s] since the newest reading of any servo was requested, on the worst bus; infinite before the first."""
        return max(bus.newest_age_s for _, _, bus in self._parts)

    def model_of(self, servo_id: int) -> ServoModel:
        """Return the expected model of a servo."""
        return self._bus_of[servo_id].model_of(servo_id)

    def close(self) -> None:
        """Close all ports; the servos keep their torque and last goals."""
        for _, _, bus in self._parts:
            bus.close()

    # ----------------------------------------------------------------------------------------------- outside the loop

    def open_session(self) -> None:
        """Do nothing: the buses have no microcontroller that needs a session."""

    def setup(self) -> None:
        """Set up each bus, see `ServoBus.setup`.

        Raises:
            BusSetupError: Servos are missing or wrong; all are named, with their bus.
            BusDisconnectedError: A port is gone.
        """
        wrong = []
        for name, _, bus in self._parts:
            try:
                with _named(name):
                    bus.setup()
            except BusSetupError as error:
                wrong.append(f"bus {name}: {error}")
        if wrong:
            raise BusSetupError("; ".join(wrong))

    def ping(self, servo_id: int) -> ServoError | None:
        """Return the error bits of a servo, None when it does not answer."""
        return self._bus_of[servo_id].ping(servo_id)

    def ping_responses(self, servo_id: int) -> PingResponses:
        """Return all responses to one ping within the timeout; of all buses for an id that is not the robot's."""
        on = [self._bus_of[servo_id]] if servo_id in self._bus_of else [bus for _, _, bus in self._parts]
        found = [bus.ping_responses(servo_id) for bus in on]
        return PingResponses(sum(one.answers for one in found), b"".join(one.garbage for one in found))

    def echo_problem(self) -> Problem | None:
        """Return the problem of the first adapter whose echo is not as set, with its bus, or None."""
        for name, _, bus in self._parts:
            if found := bus.echo_problem():
                return found._replace(words=f"bus {name}: {found.words}")
        return None

    def unrequested_bytes(self) -> bytes:
        """Return the first bytes within a second without a request, of each bus."""
        return b"".join(bus.unrequested_bytes() for _, _, bus in self._parts)

    def change_rate(self, rate: int) -> bool:
        """Change the baud rate [1/s] of the host on each bus; return whether all ports have one."""
        return sum(bus.change_rate(rate) for _, _, bus in self._parts) == len(self._parts)

    def read(self, servo_id: int, register: Register) -> int | None:
        """Return the value of a register, None when the servo does not answer."""
        return self._bus_of[servo_id].read(servo_id, register)

    def read_bytes(self, servo_id: int, address: int, size: int) -> bytes | None:
        """Return bytes of a control table, None when the servo does not answer or refuses."""
        return self._bus_of[servo_id].read_bytes(servo_id, address, size)

    def write(self, servo_id: int, register: Register, value: int) -> bool:
        """Write one register; return whether it is acknowledged."""
        return self._bus_of[servo_id].write(servo_id, register, value)

    def write_unacknowledged(self, servo_id: int, register: Register, value: int) -> None:
        """Write a register without an expected answer."""
        self._bus_of[servo_id].write_unacknowledged(servo_id, register, value)

    def reboot(self, servo_id: int) -> None:
        """Restart a servo, which loses its torque and is silent meanwhile."""
        self._bus_of[servo_id].reboot(servo_id)

    # --------------------------------------------------------------------------------------------------- in the loop

    def sync_write_goals(self, goal_ticks: ArrayLike, speed_ticks: ArrayLike = 0) -> None:
        """Send all goal positions and moving speeds, one packet for each bus; see `ServoBus`."""
        goals, speeds = (np.broadcast_to(values, (len(self),)) for values in (goal_ticks, speed_ticks))
        self._each(lambda rows, bus: bus.sync_write_goals(goals[rows], speeds[rows]))

    def set_torque(self, enabled: bool) -> None:
        """Turn the torque of all servos on or off, on the buses that are there; see `ServoBus`."""
        self._each(lambda _, bus: bus.set_torque(enabled))

    def poll(self, budget_ns: int, first: Sequence[int] = ()) -> list[ServoReading]:
        """Read servos of all buses at the same time, within one time budget; see `ServoBus`.

        Raises:
            BusDisconnectedError: A port is gone.
        """
        readings: list[ServoReading] = []
        running: list[tuple[str, Polling]] = []
        for name, rows, bus in self._parts:
            here = rows.tolist()
            running.append((name, bus.polling(budget_ns, [here.index(i) for i in first if i in here])))
        while running:
            for one in tuple(running):
                name, polling = one
                try:
                    with _named(name):
                        next(polling)
                except StopIteration as end:
                    running.remove(one)
                    readings += end.value
        return readings

    def _each(self, call: Callable[[NDArray[np.int64], ServoBus], object]) -> None:
        """Call something for each bus, also after one is lost, and raise the error of the first lost one."""
        lost: BusDisconnectedError | None = None
        for name, rows, bus in self._parts:
            try:
                with _named(name):
                    call(rows, bus)
            except BusDisconnectedError as error:
                lost = lost or error
        if lost is not None:
            raise lost


AnyBus = ServoBus | SeveralBuses


@contextmanager
def _named(bus: str) -> Iterator[None]:
    """Name the bus in the error of a lost port."""
    try:
        yield
    except BusDisconnectedError as error:
        raise BusDisconnectedError(f"bus {bus}: {error}") from error
