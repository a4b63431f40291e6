"""The servos as the actuator uses them, whether it speaks their bus itself or through a bridge."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sextant.services.actuator.config import Settings
from sextant.services.actuator.servo_bus import mcu_bridge, usb_adapter
from sextant.services.actuator.servo_bus.dynamixel_bus import REPLY_TIMEOUT_NS, BusGone, Port, ServoBus, ServoReading, open_port
from sextant.services.actuator.servo_bus.mcu_bridge import Bridge
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.dynamixel import Register


class Servos(Protocol):
    """A fixed list of servos; arrays are in its order. `ServoBus` and `Bridge` are such."""

    servo_ids: tuple[int, ...]
    errors: NDArray[np.uint8]  # (n,) error bits of the last status packets
    between: Callable[[], None]  # done before each question outside the loop

    @property
    def lost(self) -> Counter[str]:
        """What was lost on the way, by reason."""
        ...

    @property
    def trouble(self) -> str:
        """What is wrong between here and the servos, in words, or nothing."""
        ...

    @property
    def missed(self) -> NDArray[np.int64]:
        """(n,) questions in the loop that each servo has left open in a row."""
        ...

    @property
    def loss(self) -> float:
        """Share of the questions of late without a usable answer."""
        ...

    def meet(self) -> None:
        """Open a session with whoever stands between here and the servos, if somebody does, on a port that was opened anew."""
        ...

    def setup(self) -> None:
        """Meet them, check that all servos are there and right, and make them answer quickly; torque and limits stay."""
        ...

    def read(self, servo_id: int, register: Register) -> int | None:
        """Value of one register, None when the servo does not answer."""
        ...

    def read_bytes(self, servo_id: int, address: int, size: int) -> bytes | None:
        """Bytes of a control table, None when the servo does not answer."""
        ...

    def write(self, servo_id: int, register: Register, value: int) -> bool:
        """Write one register; whether the servo took it."""
        ...

    def sync_write_goals(self, goal_ticks: ArrayLike, speed_ticks: ArrayLike = 0) -> None:
        """Send every servo its goal position and moving speed."""
        ...

    def set_torque(self, enabled: bool) -> None:
        """Turn the torque of all servos on or off; the goals that shall hold have been sent before it goes on."""
        ...

    def write_torque_limit(self, limit_ticks: ArrayLike) -> None:
        """Set every servo's torque limit, which ends a shutdown."""
        ...

    def poll(self, budget_ns: int, first: Sequence[int] = ()) -> list[ServoReading]:
        """New readings, as many as a time budget allows, those of `first` in any case."""
        ...

    def ages(self) -> NDArray[np.float64]:
        """(n,) [s] since each servo's newest reading was asked for, infinite when there was none."""
        ...

    def close(self) -> None:
        """Close the port; the servos keep their torque and their last goal."""
        ...


def read_timeout_ns(settings: Settings) -> int:
    """[ns] longest wait of one read of the port that suits what is at its other end."""
    return mcu_bridge.READ_NS if settings.bridge else REPLY_TIMEOUT_NS


class Outlet:
    """Where the servos' port is found, again and again: by any of its names, or by what the adapter says of itself."""

    def __init__(self, settings: Settings):
        """Look at the port that the settings name; several are separated by commas."""
        self._names = [name.strip() for name in settings.port.split(",")]
        self._timeout_ns = read_timeout_ns(settings)
        self._adapter: tuple[int, int, str] | None = None

    def open(self) -> Port:
        """Open the first port that there is.

        Raises:
            BusGone: None can be opened.
        """
        found: list[str] = []
        for name in dict.fromkeys([*self._names, *usb_adapter.named_anew(self._adapter)]):
            try:
                port = open_port(name, timeout_ns=self._timeout_ns)
            except BusGone as error:
                found.append(str(error))
            else:
                self._adapter = usb_adapter.identity(name) or self._adapter
                return port
        raise BusGone("; ".join(found))


def connect(profile: RobotProfile, settings: Settings, port: Port, clock: Callable[[], int]) -> Servos:
    """The robot's servos, on an open port."""
    model, names, lock = dxl.MODEL_NAMED[profile.servo.model], profile.servo_names, profile.servo.lock_eeprom
    if settings.bridge:
        return Bridge(port, list(names), clock, model=model, names=names, lock=lock)
    return ServoBus(port, list(names), clock, model=model, names=names, echo=settings.echo, lock=lock)
