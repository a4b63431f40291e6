"""Settings of the simulator."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Settings:
    """Scenario, random seed and ports of the servo bus."""

    scenario: str = "steps"  # name of a scenario, or path of a TOML file
    seed: int = 0
    bridge: bool = False  # simulate a bridge board with the firmware between the port and the servo bus
    bus_port: int = 0  # TCP port on 127.0.0.1 on which the servo bus listens, 0 for any
    other_bus_port: int = 0  # TCP port of the bus after a fault that changes its device name, 0 for any
    viewer: bool = False  # open MuJoCo's viewer, in which the mouse pushes the robot
    frames_per_picture: int = 1  # render only every n-th depth frame, if perception ignores the others

    def __post_init__(self) -> None:
        for port in (self.bus_port, self.other_bus_port):
            if not 0 <= port <= 65535:
                raise ValueError(f"a TCP port of 0 to 65535 expected, found {port}")
        if self.seed < 0:
            raise ValueError(f"a seed of 0 or more expected, found {self.seed}")
        if self.frames_per_picture < 1:
            raise ValueError(f"1 frame or more per picture expected, found {self.frames_per_picture}")
