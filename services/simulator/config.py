"""Settings of the simulator."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Settings:
    """Which course is simulated, and where its servo bus is found."""

    scenario: str = "steps"  # by name, or the path of a TOML file
    seed: int = 0
    bridge: bool = False  # a board with the reference firmware stands between the port and the servo bus
    bus_port: int = 0  # TCP port on 127.0.0.1 on which the servo bus listens, 0 for any
    other_bus_port: int = 0  # likewise, on which it is found when a fault has it come back under another name
    frames_per_picture: int = 1  # of so many depth frames the last is made: others would be looked at by nobody

    def __post_init__(self) -> None:
        for port in (self.bus_port, self.other_bus_port):
            if not 0 <= port <= 65535:
                raise ValueError(f"a TCP port of 0 to 65535 expected, found {port}")
        if self.seed < 0:
            raise ValueError(f"a seed of 0 or more expected, found {self.seed}")
        if self.frames_per_picture < 1:
            raise ValueError(f"1 frame or more per picture expected, found {self.frames_per_picture}")
