"""Schema of a scenario: terrain, start, goal, robot, walk, camera and faults.

A scenario is read from TOML.

The services that control the robot never read a scenario. The simulator builds the world from it, the scorer evaluates the run
against it, and the launcher sends its goal and speed to the planner as an operator would.
"""

import re
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from sextant.shared.files import config
from sextant.shared.files.config import bounded, expect
from sextant.shared.plugins.loading import Plugins
from sextant.shared.scenario.mismatch import Deviation, Mismatch
from sextant.shared.scenario.mover import Mover
from sextant.shared.scenario.scale import scaled_table, suffix_of
from sextant.shared.scenario.terrain import HeightMap, Terrain
from sextant.shared.servo.bus_fault import BusFault
from sextant.shared.wire import topics
from sextant.shared.wire.messages import GaitRequest

_FAULT_STREAM = 0x5CE  # random stream of the run's seed for the times of faults
_MISMATCH_STREAM = 0x5CF  # random stream of the run's seed for the deviations from the profile
_MOST_WAYPOINTS = 32  # of a route, including its end


@dataclass(frozen=True, slots=True)
class Start:
    """Initial pose of the robot.

    The run's seed draws uniform offsets within +- the spreads.
    """

    xy: tuple[float, float] = (0.0, 0.0)  # [m] of the body
    yaw_deg: float = 0.0  # [deg] heading
    xy_spread: tuple[float, float] = (0.0, 0.0)  # [m] of xy
    yaw_spread_deg: float = 0.0  # [deg] of the heading

    lengths = "xy xy_spread"
    checks = (*bounded("xy xy_spread", 1000, "m"), *bounded("yaw_deg yaw_spread_deg", 360, "deg"))

    def __post_init__(self) -> None:
        least = min(*self.xy_spread, self.yaw_spread_deg)
        expect(least >= 0, "spreads of at least 0", least)


@dataclass(frozen=True, slots=True)
class Goal:
    """Goal line across the starting direction.

    The body's centre must pass it within the corridor.
    """

    distance: float  # [m] straight ahead from the start
    corridor: float = 0.25  # [m] maximum lateral distance from the starting direction
    route: bool = False  # True: the planner receives a goal and finds a path; False: the operator steers straight ahead
    waypoints: tuple[
        tuple[float, float], ...
    ] = ()  # [m] from the start, x ahead and y left; passed in order, within `corridor`, before the goal line counts
    passage: bool = False  # True: the route is ordered as a passage, straight from the start to the end
    # Correct result: to arrive, or to stop before an obstacle that cannot be crossed and report the reason. "either" applies
    # if this depends on the seed, unless the scorer is given the result for that seed.
    expect: Literal["arrival", "refusal", "either"] = "arrival"

    lengths = "distance corridor waypoints"
    checks = (
        *bounded("distance corridor", 1000, "m"),
        config.together("waypoints", lambda found: all(max(map(abs, one)) <= 1000 for one in found), "places within 1000 m"),
    )

    def __post_init__(self) -> None:
        expect(min(self.distance, self.corridor) > 0, "distance and corridor greater than 0 m", (self.distance, self.corridor))
        expect(self.route or not self.waypoints, "route = true with waypoints", "false")
        expect(self.route or not self.passage, "route = true with passage", "false")
        expect(len(self.waypoints) < _MOST_WAYPOINTS, f"fewer than {_MOST_WAYPOINTS} waypoints", len(self.waypoints))


@dataclass(frozen=True, slots=True)
class Walk:
    """Walking parameters that the operator sets."""

    gait: GaitRequest = "tripod"  # groups of legs that swing together: two, three or six; auto: the planner chooses
    speed: float = 0.11  # [m/s] commanded on level ground
    auto_speed: bool = False  # True: the planner chooses the speed and how high feet go, by what it sees; `speed` is not used
    body_height: float = 0.11  # [m] above the ground; a robot whose range does not reach it has that of its stance
    lift: float = 0.025  # [m] clearance of a swinging foot over start and touchdown; higher over obstacles in the map
    blind: bool = False  # True: baseline without a map, the planner walks as on flat ground
    footholds: Literal["score", "evaluation"] = "score"  # map layer for the footholds: Lotriet's or Masri's
    arc: Literal["flow", "sixth_order"] = "flow"  # swing trajectory: Lotriet's, or Erasmus' for reference
    by_touch: bool = False  # True: when the robot stops for lack of a map, it is commanded to continue by touch

    lengths = "speed body_height lift"
    checks = (*bounded("speed", 10, "m/s"), *bounded("body_height lift", 10, "m"))

    def __post_init__(self) -> None:
        expect(self.speed > 0, "a speed greater than 0 m/s", self.speed)
        expect(self.body_height > 0, "a body height greater than 0 m", self.body_height)
        expect(self.lift > 0, "a lift greater than 0 m", self.lift)


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """Errors of the simulated depth camera."""

    noise: bool = True  # whether depth has noise
    dropouts: bool = True  # pixels without return in shadows, at grazing angles, and at random
    loss: float = 0.05  # [1] share of random pixels without return, drawn for each frame; only with dropouts

    def __post_init__(self) -> None:
        expect(0.0 <= self.loss <= 1.0, "a loss from 0 to 1", self.loss)


@dataclass(frozen=True, slots=True)
class Floor:
    """Look of the ground in the grey images of a camera with colour."""

    # uniform: without texture; black: it returns almost no light to the eye; glossy: it mirrors the lamps of a ceiling
    look: Literal["textured", "uniform", "black", "glossy"] = "textured"
    contrast: float = 0.10  # [1] standard deviation of the texture's brightness, relative to its mean
    light: float = 0.15  # [1] relative change of the light over time, and over the ground
    light_period_s: float = 7.0  # [s] of the change over time
    exposure_s: float = 0.012  # [s] exposure time, during which motion blurs the image
    noise: float = 1.5  # [1/255] standard deviation of a pixel

    def __post_init__(self) -> None:
        expect(0.0 <= self.contrast <= 0.3, "a contrast from 0 to 0.3", self.contrast)
        expect(0.0 <= self.light <= 0.5, "a light from 0 to 0.5", self.light)
        expect(0.1 <= self.light_period_s <= 1e6, "a light_period_s from 0.1 to 1000000 s", self.light_period_s)
        expect(0.0 <= self.exposure_s <= 0.1, "an exposure_s from 0 to 0.1 s", self.exposure_s)
        expect(0.0 <= self.noise <= 50.0, "a noise from 0 to 50", self.noise)


@dataclass(frozen=True, slots=True)
class Variation:
    """Random deviation of a run's physics from the profile.

    The factors are uniform from 1/x to x.
    """

    armature: float = 1.5  # factor of the reflected inertia of the rotors
    friction: float = 1.15  # factor of the friction of joints and feet
    imu: bool = False  # whether the robot has an IMU even if its profile names none
    registration: Literal["projective", "kiss-icp"] = "projective"  # method that localizes the robot

    checks = (*bounded("armature friction", 100, "times"),)

    def __post_init__(self) -> None:
        expect(min(self.armature, self.friction) >= 1, "factors of at least 1", (self.armature, self.friction))


@dataclass(frozen=True, slots=True)
class MapOptions:
    """Size and resolution of the terrain map.

    Scans have the same cell size, but at least 5 mm.
    """

    cells: int = 256  # along x
    cells_y: int = 0  # along y; 0 for the same number as along x
    resolution: float = 0.01  # [m] edge of a cell

    lengths = "resolution"
    checks = (*bounded("cells cells_y", 2048, "cells"),)

    def __post_init__(self) -> None:
        expect(self.cells >= 8 and (self.cells_y == 0 or self.cells_y >= 8), "at least 8 cells", (self.cells, self.cells_y))
        expect(0.001 <= self.resolution <= 1.0, "a resolution of 0.001 to 1 m", self.resolution)
        cells, most = self.cells * (self.cells_y or self.cells), topics.cells_that_fit(topics.TERRAIN)
        expect(cells <= most, f"at most {most} cells in all, which a message of {topics.TERRAIN.key} has room for,", cells)

    @property
    def scan_resolution(self) -> float:
        """Cell size of scans [m]."""
        return max(self.resolution, 0.005)


CameraFaultKind = Literal[
    "absent", "frozen", "stale", "blind", "noise", "sun", "dark", "wet", "dropouts", "blobs", "dirt", "swapped", "zoomed",
    "late", "ahead", "backward", "jumping",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Fault:
    """Fault of a service or of the simulated camera at a given time."""

    at_s: float  # [s] simulated
    service: Literal["perception", "mapper", "planner", "actuator", "camera"]  # process or device that fails
    # How it fails: a process by "kill" or "hang", the simulated camera by the others; simulation.md explains them.
    kind: Literal["kill", "hang", CameraFaultKind] = "kill"
    # [s] duration. A live run restarts a killed process itself, and also one that hangs for too long.
    for_s: float = 2.0
    at_spread_s: float = 0.0  # [s] maximum random delay, added to at_s

    checks = (*bounded("at_s for_s at_spread_s", 1e6, "s"),)

    def __post_init__(self) -> None:
        expect(self.at_s >= 0, "a time of at least 0 s", self.at_s)
        expect(self.at_spread_s >= 0, "an at_spread_s of at least 0 s", self.at_spread_s)
        expect(self.for_s > 0, "an outage longer than 0 s", self.for_s)
        kinds = get_args(CameraFaultKind) if self.of_camera else ("kill", "hang")
        expect(self.kind in kinds, f"one of {', '.join(kinds)} for service = {self.service!r}", repr(self.kind))

    @property
    def of_camera(self) -> bool:
        """Whether the simulated camera fails, not a process."""
        return self.service == "camera"


@dataclass(frozen=True, slots=True)
class Link:
    """Radio link between the robot and the computer that maps and plans.

    It exists in lockstep runs only.

    With the default values both are one machine.
    """

    delay_ms: float = 0.0  # [ms] one way
    mbit: float = 0.0  # [Mbit/s] total of both directions; 0 for no limit
    loss: float = 0.0  # [1] share of lost packets

    def __post_init__(self) -> None:
        expect(0.0 <= self.delay_ms <= 1000.0, "delay_ms from 0 to 1000", self.delay_ms)
        expect(self.mbit == 0.0 or 0.1 <= self.mbit <= 1e5, "mbit of 0.1 or more, or 0 for no limit", self.mbit)
        expect(0.0 <= self.loss <= 0.5, "a loss from 0 to 0.5", self.loss)

    @property
    def exists(self) -> bool:
        """Whether there is a radio link."""
        return self != Link()


@dataclass(frozen=True, slots=True)
class Trouble:
    """Set of faults and deviations that can be added to any course."""

    faults: tuple[Fault, ...] = ()
    bus_faults: tuple[BusFault, ...] = ()
    movers: tuple[Mover, ...] = ()
    camera: CameraOptions | None = None  # replaces the course's camera options
    floor: Floor | None = None  # replaces the course's floor
    mismatch: Mismatch | None = None  # replaces the course's mismatch
    extra_time_s: float = 0.0  # [s] simulated, added to the course's time limit

    def __post_init__(self) -> None:
        expect(self.extra_time_s >= 0, "an extra_time_s of at least 0 s", self.extra_time_s)


@dataclass(frozen=True, slots=True)
class Scenario:
    """One course, with the parameters to walk it."""

    name: str  # letters, digits, spaces and . _ + @ -; also names the folder of a run
    terrain: tuple[Terrain, ...]
    goal: Goal
    start: Start = field(default_factory=Start)
    robot: str = "phantomx_mk2"  # profile, by name or by the path of a TOML file
    # Profile of the simulated robot, if it is not `robot`: the robot's services then work with a profile of another robot, such
    # as a calibrated one, or with a mistake. Reports name `robot`. The deviations of `mismatch` are relative to it.
    real_robot: str = ""
    walk: Walk = field(default_factory=Walk)
    camera: CameraOptions = field(default_factory=CameraOptions)
    floor: Floor = field(default_factory=Floor)
    variation: Variation = field(default_factory=Variation)
    mismatch: Mismatch = field(default_factory=Mismatch)
    pose_error: Literal["none", "rgbdslam", "orb_slam"] = "none"  # adds the recorded pose error of a visual SLAM system
    map: MapOptions = field(default_factory=MapOptions)
    battery_ah: float = 4.0  # [A h] capacity of the simulated battery; the default lasts for more than half an hour of walking
    bridge: bool = False  # True: a microcontroller drives the servo bus, and the actuator sends it the goal positions
    faults: tuple[Fault, ...] = ()
    bus_faults: tuple[BusFault, ...] = ()  # of the simulated servos and their bus
    movers: tuple[Mover, ...] = ()  # moving obstacles; the depth camera sees them, but they have no contacts
    link: Link = field(default_factory=Link)
    params: dict[str, object] = field(default_factory=dict, hash=False)  # service -> parameters that differ; docs/parameters.md
    time_limit_s: float = 90.0  # [s] simulated
    plugins: Plugins = field(default_factory=Plugins)  # of the command line; a file cannot name them, because they are code
    folder: str = "."  # folder of the files named in the scenario; set on loading

    checks = (
        *bounded("battery_ah", 1e6, "A h"),
        *bounded("time_limit_s", 86400, "s"),
        config.together("terrain", lambda parts: len(parts) <= 5000, "at most 5000 primitives"),
        config.together("movers", lambda movers: len(movers) <= 100, "at most 100 movers"),
    )

    def __post_init__(self) -> None:
        # The name is also the name of the run's folder.
        plain = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9 _.+@-]*", self.name) is not None and ".." not in self.name
        expect(len(self.name) <= 100, "a name of at most 100 characters", len(self.name))
        expect(plain, "a name of letters, digits, spaces, dots, dashes, plus signs, at signs and underscores", repr(self.name))
        if not self.terrain:
            raise ValueError('at least one terrain primitive expected, found none; add [[terrain]] with kind = "plane"')
        expect(self.time_limit_s > 0, "a time limit greater than 0 s", self.time_limit_s)
        expect(self.battery_ah > 0, "a battery_ah greater than 0 A h", self.battery_ah)

    def faults_at(self, seed: int) -> tuple[Fault, ...]:
        """Return the faults of the run with a seed, with their times drawn."""
        spread = np.random.default_rng([seed, _FAULT_STREAM]).random(len(self.faults))
        return tuple(
            replace(fault, at_s=fault.at_s + fault.at_spread_s * float(share), at_spread_s=0.0)
            for fault, share in zip(self.faults, spread, strict=True)
        )

    def deviation(self, seed: int) -> Deviation:
        """Return the deviations from the profile of the run with a seed."""
        return self.mismatch.draw(np.random.default_rng([seed, _MISMATCH_STREAM]))

    def with_trouble(self, trouble: Trouble, name: str) -> "Scenario":
        """Return this course under another name, with the faults of a trouble added."""
        return replace(
            self,
            name=name,
            faults=(*self.faults, *trouble.faults),
            bus_faults=(*self.bus_faults, *trouble.bus_faults),
            movers=(*self.movers, *trouble.movers),
            camera=trouble.camera or self.camera,
            floor=trouble.floor or self.floor,
            mismatch=trouble.mismatch or self.mismatch,
            time_limit_s=self.time_limit_s + trouble.extra_time_s,
        )

    def scaled(self, scale: float) -> "Scenario":
        """Return this course with its lengths and speeds times a scale, which its name then states; itself for a scale of 1.

        Raises:
            ConfigError: A length is then out of its range, or only a file states it.
        """
        if scale == 1.0:
            return self
        name = f"{self.name}{suffix_of(scale)}"
        try:
            ground = tuple(part.with_scale() if isinstance(part, HeightMap) else part for part in self.terrain)
        except ValueError as error:
            raise config.ConfigError(f"scenario {name}", [str(error)]) from None
        table = scaled_table(replace(self, terrain=ground), scale)
        return config.build(table | {"name": name}, Scenario, f"scenario {name}")
