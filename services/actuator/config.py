"""Settings of the actuator."""

from dataclasses import dataclass
from typing import Literal

SHORTEST_STEP_S = 0.3  # [s] shorter steps are refused


@dataclass(frozen=True, slots=True)
class Settings:
    """Servo port and leg motion; the defaults walk."""

    port: str = "/dev/ttyUSB0"  # a serial device, or socket://host:port; several possible names separated by commas
    bridge: bool = False  # a microcontroller on the port drives the servo bus, see docs/bridge.md
    echo: bool = False  # the adapter returns every byte sent, as some single-wire adapters do
    rate_hz: float = 50.0  # of the control cycle
    read_budget_ms: float = 9.0  # [ms] of each cycle for reading servos: over USB six, up to three of them urgent
    unload_s: float = 0.05  # [s] before a swing in which its legs are unloaded
    load_s: float = 0.10  # [s] at the end of a step in which landed legs are loaded
    level_gain: float = 6.0  # [1/s] of the integrator that holds height, roll and pitch
    brake_s: float = 0.10  # [s] time constant in which the body stops when no plan follows
    stand_s: float = 2.5  # [s] for standing up
    arc: Literal["flow", "sixth_order"] = "flow"  # path of swinging feet: Lotriet's flow, or Erasmus' polynomial for reference
    plan_age_s: float = 0.6  # [s] older plans are refused

    def __post_init__(self) -> None:
        if not 20.0 <= self.rate_hz <= 200.0:
            raise ValueError(f"rate_hz of 20 to 200 expected, found {self.rate_hz}")
        if not 0 < self.read_budget_ms < 1e3 / self.rate_hz:
            raise ValueError(
                f"read_budget_ms within a cycle of {1e3 / self.rate_hz:.1f} ms expected, found {self.read_budget_ms}"
            )
        if not (self.unload_s > 0 and self.load_s > 0 and self.unload_s + self.load_s < SHORTEST_STEP_S):
            raise ValueError(
                f"unload_s and load_s above 0, together below the shortest step of {SHORTEST_STEP_S} s expected, "
                f"found {self.unload_s} and {self.load_s}"
            )
        if min(self.brake_s, self.stand_s, self.plan_age_s) <= 0 or self.level_gain < 0:
            raise ValueError(
                f"brake_s, stand_s and plan_age_s above 0 and level_gain of 0 or more expected, "
                f"found {self.brake_s}, {self.stand_s}, {self.plan_age_s} and {self.level_gain}"
            )
