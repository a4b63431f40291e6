"""Settings of the actuator."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import ClassVar, Literal

from sextant.services.actuator.estimation.params import ContactParams, TouchdownParams
from sextant.services.actuator.locomotion.params import PostureParams
from sextant.shared.files import config
from sextant.shared.files.config import ranged
from sextant.shared.params import Params
from sextant.shared.robot.profile import SHORTEST_STEP_S


@dataclass(frozen=True, slots=True, kw_only=True)
class ActuatorParams(Params):
    """Parameters of the motion of the legs; the guard's limits are constants."""

    unload_s: float = ranged(0.05, 0.005, 0.25)  # [s] before a swing in which its legs are unloaded
    load_s: float = ranged(0.10, 0.005, 0.25)  # [s] at the end of a step in which landed legs are loaded
    brake_s: float = ranged(0.10, 0.01, 2.0)  # [s] time constant in which the body stops when no plan follows
    stand_s: float = ranged(2.5, 0.5, 30.0)  # [s] for standing up
    correct_horns: bool = False  # whether horns that a walk has shown to be off are corrected, by up to 4 deg
    touchdown: TouchdownParams = field(default_factory=TouchdownParams)
    contact: ContactParams = field(default_factory=ContactParams)
    posture: PostureParams = field(default_factory=PostureParams)

    renamed: ClassVar[Mapping[str, str]] = MappingProxyType({"level_gain": "posture.gain"})  # settings of version 0.1
    checks = (
        config.together(
            "unload_s load_s",
            lambda *shares: sum(shares) < SHORTEST_STEP_S,
            f"less than the shortest step, {SHORTEST_STEP_S} s, in all",
        ),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings(ActuatorParams):
    """Settings of the actuator: its parameters, its port and its cycle; the defaults walk."""

    # A serial device, or socket://host:port; several possible names separated by commas. With several buses, each has its name:
    # left=/dev/ttyUSB0, right=/dev/ttyUSB1.
    port: str = "/dev/ttyUSB0"
    bridge: bool = False  # a microcontroller on the port drives the servo bus, see docs/bridge.md
    echo: bool = False  # the adapter returns every byte sent, as some single-wire adapters do
    rate_hz: float = ranged(50.0, 20.0, 200.0)  # of the control cycle
    read_budget_ms: float = 9.0  # [ms] of each cycle for reading servos: over USB six, up to three of them urgent
    arc: Literal["flow", "sixth_order"] = "flow"  # path of swinging feet: Lotriet's flow, or Erasmus' polynomial for reference
    plan_age_s: float = ranged(0.6, 0.01, 10.0)  # [s] older plans are refused

    def __post_init__(self) -> None:
        config.verify(self)
        if not 0 < self.read_budget_ms < 1e3 / self.rate_hz:
            raise ValueError(
                f"read_budget_ms within a cycle of {1e3 / self.rate_hz:.1f} ms expected, found {self.read_budget_ms}"
            )
