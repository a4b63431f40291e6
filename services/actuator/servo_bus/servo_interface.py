"""Interface to the servos: on a bus, behind a microcontroller bridge, or behind a board that sends pulses."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sextant.services.actuator.config import Settings
from sextant.services.actuator.servo_bus import mcu_bridge, usb_adapter
from sextant.services.actuator.servo_bus.bus_driver import (
    BAUD_RATE,
    REPLY_TIMEOUT_NS,
    BusDisconnectedError,
    BusSetupError,
    Port,
    ServoBus,
    ServoReading,
    open_port,
)
from sextant.services.actuator.servo_bus.command_bus import CommandBus
from sextant.services.actuator.servo_bus.mcu_bridge import Bridge
from sextant.services.actuator.servo_bus.pulse_bridge import PulseBridge
from sextant.services.actuator.servo_bus.pwm_servos import PwmServos
from sextant.services.actuator.servo_bus.several_buses import SeveralBuses
from sextant.shared.robot.joint_servos import BusRows
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.servo import Servo
from sextant.shared.servo.bus_ports import bus_ports, wrong_ports
from sextant.shared.servo.servo_model import Register, ServoModel

_ONE_BEHIND_BRIDGE = "one servo model and one bus behind a bridge expected, found several in the profile {}"


class Servos(Protocol):
    """Interface to a fixed list of servos, as `ServoBus` and `Bridge` have it.

    Arrays are in the order of the list.
    """

    servo_ids: tuple[int, ...]
    between: Callable[[], None]  # called before each request outside the loop

    @property
    def errors(self) -> NDArray[np.uint8]:
        """(n,) error bits of the last status packets."""
        ...

    @property
    def lost(self) -> Counter[str]:
        """Lost packets and requests, by reason."""
        ...

    @property
    def trouble(self) -> str:
        """Problem of the link to the servos, or an empty string."""
        ...

    @property
    def missed(self) -> NDArray[np.int64]:
        """(n,) consecutive unanswered requests of each servo in the loop."""
        ...

    @property
    def loss(self) -> float:
        """Recent share of requests without a usable answer."""
        ...

    def model_of(self, servo_id: int) -> ServoModel:
        """Return the expected model of a servo."""
        ...

    def open_session(self) -> None:
        """Open a session with a microcontroller, if there is one, on a newly opened port."""
        ...

    def setup(self) -> None:
        """Open a session, check all servos, configure fast answers; torque stays."""
        ...

    def read(self, servo_id: int, register: Register) -> int | None:
        """Return the value of a register, None when the servo does not answer."""
        ...

    def read_bytes(self, servo_id: int, address: int, size: int) -> bytes | None:
        """Return bytes of a control table, None when the servo does not answer."""
        ...

    def write(self, servo_id: int, register: Register, value: int) -> bool:
        """Write one register; return whether the servo acknowledges it."""
        ...

    def reboot(self, servo_id: int) -> None:
        """Restart a servo, which loses its torque and is silent meanwhile."""
        ...

    def sync_write_goals(self, goal_ticks: ArrayLike, speed_ticks: ArrayLike = 0) -> None:
        """Send every servo its goal position and moving speed."""
        ...

    def set_torque(self, enabled: bool) -> None:
        """Turn all torque on or off; send the goals to hold before turning it on."""
        ...

    def poll(self, budget_ns: int, first: Sequence[int] = ()) -> list[ServoReading]:
        """Return new readings within a time budget; those of `first` in any case."""
        ...

    @property
    def newest_age_s(self) -> float:
        """Time [s] since the newest reading of any servo was requested, infinite before the first."""
        ...

    def close(self) -> None:
        """Close the port; the servos keep their torque and last goals."""
        ...


def read_timeout_ns(settings: Settings) -> int:
    """Return the read timeout [ns] of the port to a servo bus or a bridge."""
    return mcu_bridge.READ_NS if settings.bridge else REPLY_TIMEOUT_NS


class PortFinder:
    """Finds a servo port by any of its names or its adapter's USB identity."""

    def __init__(self, settings: Settings, rate: int = BAUD_RATE, bus: str = ""):
        """Store the names that the settings give the port of a bus, and the baud rate [1/s]."""
        self._rate = rate
        self._names = bus_ports(settings.port).get(bus, [])
        self._timeout_ns = read_timeout_ns(settings)
        self._adapter: tuple[int, int, str] | None = None

    def open(self) -> Port:
        """Open the first port that is available.

        Raises:
            BusDisconnectedError: None can be opened.
        """
        found: list[str] = []
        for name in dict.fromkeys([*self._names, *usb_adapter.renamed_devices(self._adapter)]):
            try:
                port = open_port(name, self._rate, self._timeout_ns)
            except BusDisconnectedError as error:
                found.append(str(error))
            else:
                self._adapter = usb_adapter.identity(name) or self._adapter
                return port
        raise BusDisconnectedError("; ".join(found))


Opener = Callable[[], Port]
Openers = Mapping[str, Opener]  # by the name of the bus, empty for the only one


def port_openers(profile: RobotProfile, settings: Settings) -> Openers:
    """Return what opens the port of each bus of a robot, by the setting `port`.

    Raises:
        BusSetupError: The setting does not name a port for each bus, or names others.
    """
    ports, buses = bus_ports(settings.port), profile.servos.buses
    if wrong := wrong_ports(ports, [bus.name for bus in buses]):
        raise BusSetupError(f"actuator.port: {wrong}")
    # The line to a microcontroller has another rate than its servos.
    rates = {bus.name: BAUD_RATE if settings.bridge else profile.servos.models[bus.rows[0]].bus_rate for bus in buses}
    return {bus.name: PortFinder(settings, rates[bus.name], bus.name).open for bus in buses}


def connect(
    profile: RobotProfile,
    settings: Settings,
    openers: Openers,
    clock: Callable[[], int],
    off: Callable[[], bool] = lambda: False,
) -> Servos:
    """Open the ports of a robot, and return its servos.

    Args:
        profile: The robot.
        settings: Settings of the actuator.
        openers: Open the port of each bus.
        clock: Monotonic time [ns].
        off: Returns whether torque must be off: it is then turned off on the buses that are there if another one is not.

    Raises:
        BusDisconnectedError: A port cannot be opened.
    """
    if not profile.buses:
        return on_port(profile, settings, openers[""](), clock)
    if settings.bridge:
        raise BusSetupError(_ONE_BEHIND_BRIDGE.format(profile.name))
    parts: dict[BusRows, ServoBus] = {}
    lost: list[str] = []
    for bus in profile.servos.buses:
        try:
            port = openers[bus.name]()
        except OSError as error:
            lost.append(f"bus {bus.name}: {error}")
        else:
            parts[bus] = of_bus(profile, bus, port, clock, echo=settings.echo)
    if lost:
        for part in parts.values():
            with closing(part), suppress(BusDisconnectedError):
                if off():
                    part.set_torque(False)
        raise BusDisconnectedError("; ".join(lost))
    return SeveralBuses(parts)


def of_bus(
    profile: RobotProfile,
    bus: BusRows,
    port: Port,
    clock: Callable[[], int],
    *,
    echo: bool = False,
    reply_timeout_ns: int = REPLY_TIMEOUT_NS,
) -> ServoBus:
    """Return the servos on one bus of a robot, on its open port."""
    all_ids, each = list(profile.servo_names), [profile.servos.each[row] for row in bus.rows]
    ids, model = [all_ids[row] for row in bus.rows], each[0].servo_model
    connected = ServoBus if model.commands is None else partial(CommandBus, stiffness=_stiffness(each))
    return connected(
        port,
        ids,
        clock,
        model=model,
        models=profile.servo_models,
        rows=bus.rows,
        names={i: profile.servo_names[i] for i in ids},
        echo=echo,
        reply_timeout_ns=reply_timeout_ns,
        lock=all(servo.lock_eeprom for servo in each),
    )


def _stiffness(servos: Sequence[Servo]) -> list[float]:
    """Return the share of the stall torque per position error [1/rad] of each servo."""
    return [servo.stiffness / servo.stall_torque for servo in servos]


def behind_bridge(profile: RobotProfile, port: Port, clock: Callable[[], int]) -> Bridge | PulseBridge:
    """Return the servos of a robot, taken to be of one model, behind a microcontroller on an open port."""
    names, servo = profile.servo_names, profile.servo
    if servo.pulses is not None:
        return PulseBridge(port, list(names), clock, servo.pulses)
    stiffness, lock = _stiffness(profile.servos.each), servo.lock_eeprom
    return Bridge(port, list(names), clock, model=profile.servo_model, names=names, lock=lock, stiffness=stiffness)


def on_port(profile: RobotProfile, settings: Settings, port: Port, clock: Callable[[], int]) -> Servos:
    """Return the servos of a robot with one bus on its open port.

    Raises:
        BusSetupError: Servos of several models or buses are behind a microcontroller.
    """
    if settings.bridge:
        if profile.servo_groups or profile.buses:
            raise BusSetupError(_ONE_BEHIND_BRIDGE.format(profile.name))
        return behind_bridge(profile, port, clock)
    if profile.servo.pulses is not None:
        return PwmServos(port, list(profile.servo_names), clock, profile.servo.pulses)
    return of_bus(profile, profile.servos.buses[0], port, clock, echo=settings.echo)
