"""One bus of a robot with several: a profile that names the servos on this bus only."""

from dataclasses import dataclass, fields
from functools import cached_property

from sextant.shared.robot.joint_servos import BusRows
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo.servo_model import ServoModel


@dataclass(frozen=True)
class OneBus(RobotProfile):
    """A robot whose servo names and models are those of one bus."""

    bus: str = ""  # its name

    @cached_property
    def _part(self) -> BusRows:
        return next(part for part in self.servos.buses if part.name == self.bus)

    @cached_property
    def _all_names(self) -> dict[int, str]:
        return super().servo_names

    @property
    def servo_model(self) -> ServoModel:
        """Registers and units of the first servo on the bus, whose protocol all others on it share."""
        return self.servos.models[self._part.rows[0]]

    @cached_property
    def servo_names(self) -> dict[int, str]:
        """Map of bus id -> name such as "left front coxa", of the servos on this bus."""
        everyone = list(self._all_names.items())
        return dict(everyone[row] for row in self._part.rows)

    @cached_property
    def servo_models(self) -> dict[int, ServoModel]:
        """Map of bus id -> model, of the servos on this bus."""
        return {i: self.servos.models[row] for i, row in zip(self.servo_names, self._part.rows, strict=True)}

    @cached_property
    def servos_elsewhere(self) -> dict[int, str]:
        """Map of bus id -> name and bus of the servos on the other buses."""
        names = list(self._all_names.items())
        others = (part for part in self.servos.buses if part.name != self.bus)
        return {names[row][0]: f"{names[row][1]}, of bus {part.name}" for part in others for row in part.rows}


def on_bus(profile: RobotProfile, bus: str) -> OneBus:
    """Return a robot whose servo names and models are those of one bus."""
    return OneBus(**{one.name: getattr(profile, one.name) for one in fields(RobotProfile)}, bus=bus)
