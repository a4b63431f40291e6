"""What a run is about, read from TOML: terrain, start, goal, robot, walk, camera, faults.

Services that steer the robot never see a scenario; the simulator builds the world from it, the scorer judges by it, and the
launcher hands its goal and speed to the planner as an operator would.
"""

import difflib
import os
import re
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np

from sextant.shared.files import config
from sextant.shared.scenario.mover import Mover
from sextant.shared.servo.bus_fault import BusFault
from sextant.shared.spelling import hint
from sextant.shared.wire import topics
from sextant.shared.wire.messages import GaitName

Color = tuple[int, int, int]  # R, G, B from 0 to 255
MAX_BLOCKS = 500  # of a kind that the seed places: each keeps clear of all the others, which takes time
_FAULT_STREAM = 0x5CE  # of the run's seed, from which times of faults are drawn
_MOST_WAYPOINTS = 32  # of a route, its end included


def _bounded(keys: str, most: float, unit: str) -> tuple[config.Check, ...]:
    """Checks that numbers are no larger than a world that can be simulated."""
    return config.each(keys, lambda value: value is None or abs(value) <= most, f"at most {most:g} {unit} either way")


_BLOCK_COUNT = config.each("count", lambda count: 1 <= count <= MAX_BLOCKS, f"a count from 1 to {MAX_BLOCKS}")
_STEP_COUNT = config.each("count", lambda count: 1 <= count <= 1000, "a count from 1 to 1000")


@dataclass(frozen=True, slots=True)
class Plane:
    """Level ground everywhere."""

    kind: Literal["plane"] = "plane"
    height: float = 0.0  # [m]
    color: Color | None = None

    checks = (*_bounded("height", 100, "m"),)


@dataclass(frozen=True, slots=True)
class Box:
    """A block standing on the ground, its top level.

    With spreads its place, size and height are drawn by the run's seed, evenly up to the spread more or less.
    """

    xy: tuple[float, float]  # [m] centre
    size: tuple[float, float]  # [m] along its own x and y
    top: float  # [m] height of its top
    kind: Literal["box"] = "box"
    yaw_deg: float = 0.0  # [deg]
    depth: float = 0.5  # [m] how far it reaches down from its top
    color: Color | None = None
    xy_spread: tuple[float, float] = (0.0, 0.0)  # [m]
    size_spread: tuple[float, float] = (0.0, 0.0)  # [m]
    top_spread: float = 0.0  # [m]

    checks = (*_bounded("xy size xy_spread size_spread", 1000, "m"), *_bounded("top depth top_spread", 100, "m"))

    def __post_init__(self) -> None:
        least = min(*self.xy_spread, *self.size_spread, self.top_spread)
        _expect(least >= 0, "spreads of at least 0 m", least)
        for size, spread in zip(self.size, self.size_spread, strict=True):
            _expect(spread == 0 or spread < size, "a size_spread smaller than the size", spread)


@dataclass(frozen=True, slots=True)
class Hole:
    """A rectangle of the level ground, along its axes, that is deeper and looks so; by the run's seed as a box is."""

    xy: tuple[float, float]  # [m] centre
    size: tuple[float, float]  # [m] along x and y
    depth: float  # [m] of its bottom below the level ground
    kind: Literal["hole"] = "hole"
    xy_spread: tuple[float, float] = (0.0, 0.0)  # [m]
    size_spread: tuple[float, float] = (0.0, 0.0)  # [m]
    color: Color | None = None

    checks = (*_bounded("xy size xy_spread size_spread", 1000, "m"), *_bounded("depth", 100, "m"))

    def __post_init__(self) -> None:
        least = min(*self.xy_spread, *self.size_spread)
        _expect(least >= 0, "spreads of at least 0 m", least)
        _expect(min(*self.size, self.depth) > 0, "size and depth greater than 0 m", (*self.size, self.depth))
        for size, spread in zip(self.size, self.size_spread, strict=True):
            _expect(spread < size, "a size_spread smaller than the size", spread)


@dataclass(frozen=True, slots=True)
class Stairs:
    """Steps that rise along their own x (or fall, for a negative riser), the last tread as long as `landing`.

    Risers and treads are alike within a staircase; a spread lets the run's seed say how high and how long they are.
    """

    xy: tuple[float, float]  # [m] middle of the first riser's edge
    riser: float  # [m]
    tread: float  # [m]
    count: int
    width: float  # [m]
    kind: Literal["stairs"] = "stairs"
    landing: float = 1.0  # [m]
    yaw_deg: float = 0.0
    base: float = 0.0  # [m] height of the ground before the first riser
    depth: float = 0.5  # [m] how far they reach below their lowest tread
    riser_spread: float = 0.0  # [m] at most this much, of either sign, is added to the risers
    tread_spread: float = 0.0  # [m] and to the treads
    color: Color | None = None

    checks = (
        *_STEP_COUNT,
        *_bounded("xy width landing", 1000, "m"),
        *_bounded("riser tread base depth riser_spread tread_spread", 100, "m"),
    )

    def __post_init__(self) -> None:
        _expect(self.count >= 1, "a count of at least one step", self.count)
        _expect(min(self.tread, self.width, self.landing) > 0, "tread, width and landing greater than 0 m", self)
        _expect(0 <= self.riser_spread < abs(self.riser), "a riser_spread from 0 to less than the riser", self.riser_spread)
        _expect(0 <= self.tread_spread < self.tread, "a tread_spread from 0 to less than the tread", self.tread_spread)


@dataclass(frozen=True, slots=True)
class Pillars:
    """Pillars, the only places that carry a foot where there is no other ground."""

    xy: tuple[tuple[float, float], ...]  # [m] centres
    size: float  # [m] edge of the square tops
    top: float  # [m]
    kind: Literal["pillars"] = "pillars"
    length: float = 0.0  # [m] along x, of tops that are not square; 0 for as long as wide
    depth: float = 0.5  # [m]
    color: Color | None = None
    jitter: float = 0.0  # [m] by which the run's seed moves each pillar, at most and along either axis
    top_spread: float = 0.0  # [m] at most this much, of either sign, is added to the top of each
    weak: int = (
        0  # of them, chosen by the seed, look like the others and give way: each sinks once it is pressed, and stays down
    )
    bears: float = 3.0  # [N] the most that a weak one does
    sinks: float = 0.06  # [m] it sinks by

    checks = (
        config.together("xy", lambda xy: len(xy) <= 5000, "at most 5000 pillars"),
        config.together("xy", lambda xy: all(max(map(abs, one)) <= 1000 for one in xy), "places within 1000 m"),
        *_bounded("size length jitter", 1000, "m"),
        *_bounded("top depth top_spread sinks", 100, "m"),
        *_bounded("bears", 1e6, "N"),
    )

    def __post_init__(self) -> None:
        _expect(self.size > 0 and self.length >= 0, "a size greater than 0 m and a length", (self.size, self.length))
        least = min(self.jitter, self.top_spread)
        _expect(least >= 0, "a jitter and a top_spread of at least 0 m", least)
        _expect(0 <= self.weak <= len(self.xy), f"0 to {len(self.xy)} weak ones, for there are no more", self.weak)
        found = (self.bears, self.sinks)
        _expect(self.bears >= 0 and 0 < self.sinks < self.depth, "bears of at least 0 N and sinks between 0 m and depth", found)


@dataclass(frozen=True, slots=True)
class PillarField:
    """Square pillars along the axes, placed by the run's seed within a region, `gap` apart, as densely as the seed says."""

    x: tuple[float, float]  # [m] region
    y: tuple[float, float]  # [m]
    density: tuple[float, float]  # [1] lowest and highest share of the region that is pillars' tops
    size: float  # [m] edge of the square tops
    top: float  # [m]
    kind: Literal["pillar_field"] = "pillar_field"
    gap: float = 0.02  # [m]
    depth: float = 0.5  # [m]
    color: Color | None = None

    checks = (*_bounded("x y size gap", 1000, "m"), *_bounded("top depth", 100, "m"))

    def __post_init__(self) -> None:
        low, high = self.density
        _expect(0 <= low <= high <= 0.5, "densities in rising order from 0 to 0.5", self.density)
        _expect(self.size > 0, "a size greater than 0 m", self.size)


@dataclass(frozen=True, slots=True)
class Slope:
    """A ramp that rises along its own x to a level landing."""

    xy: tuple[float, float]  # [m] middle of its lower edge
    angle_deg: float
    length: float  # [m] horizontal
    width: float  # [m]
    kind: Literal["slope"] = "slope"
    yaw_deg: float = 0.0
    landing: float = 1.0  # [m]
    base: float = 0.0  # [m] height of its lower edge, or of its upper one where it falls
    depth: float = 0.5  # [m] how far it reaches below its lower end
    color: Color | None = None

    checks = (*_bounded("xy length width landing", 1000, "m"), *_bounded("base depth", 100, "m"))


@dataclass(frozen=True, slots=True)
class Rubble:
    """Blocks of random size, height and heading, placed by the run's seed, `gap` apart and none overlapping."""

    x: tuple[float, float]  # [m] region
    y: tuple[float, float]  # [m]
    count: int
    size: tuple[float, float]  # [m] shortest and longest edge
    top: tuple[float, float]  # [m] lowest and highest
    kind: Literal["rubble"] = "rubble"
    gap: float = 0.02  # [m]
    yaw_deg: float = 180.0  # [deg] headings are uniform within +- this
    base: float = 0.0  # [m] ground they stand on
    color: Color | None = None

    checks = (
        *_BLOCK_COUNT,
        *_bounded("x y size gap", 1000, "m"),
        *_bounded("top base", 100, "m"),
        *config.each("yaw_deg", lambda yaw: 0 <= yaw <= 180, "0 to 180 deg"),
    )


@dataclass(frozen=True, slots=True)
class HeightMap:
    """Measured ground from a .npy file (metres, NaN unknown, filled with the lowest) or a .png (grey value times `scale`).

    Of a larger map a part can be taken, and then be turned.
    """

    file: str  # beside the scenario file, absolute, or in a folder that an environment variable names: "$FOLDER/map.npy"
    resolution: float  # [m] cell edge
    xy: tuple[float, float]  # [m] where cell (0, 0) of what is taken and turned lies; rows run along x
    kind: Literal["height_map"] = "height_map"
    scale: float | None = None  # heights are multiplied by it; None for 1, and a .png needs it: [m] of one grey value
    color: Color | None = None
    base: float = 0.0  # [m] and this is added: a .png has no negative heights
    rows: tuple[int, int] | None = None  # first and one past the last that is taken, None for all
    columns: tuple[int, int] | None = None
    quarter_turns: int = 0  # of what is taken, counterclockwise as seen from above

    checks = (
        *_bounded("xy", 1000, "m"),
        *_bounded("base", 100, "m"),
        *config.each("resolution", lambda edge: 0.001 <= edge <= 10, "0.001 to 10 m"),
        *config.each("scale", lambda scale: scale is None or 0 < scale <= 1000, "more than 0 and at most 1000"),
    )

    def __post_init__(self) -> None:
        for name, taken in (("rows", self.rows), ("columns", self.columns)):
            _expect(taken is None or 0 <= taken[0] < taken[1] - 1, f"{name} from 0 on, two at least", taken)

    def path(self, folder: Path) -> Path:
        """Where the file is looked for.

        Args:
            folder: Of the scenario.

        Raises:
            ConfigError: The environment variable that is to name its folder is not set.
        """
        variable = re.match(r"\$(\w+)/", self.file)
        if variable is None:
            return folder / self.file
        root, rest = os.environ.get(variable[1], ""), self.file[variable.end() :]
        if not root:
            wanted = f"the environment variable {variable[1]} expected to name the folder that holds {rest}, it is not set"
            raise config.ConfigError(f"height map {self.file}", [wanted])
        return Path(root) / rest


@dataclass(frozen=True, slots=True)
class Puddle:
    """A rectangle of the level ground that gives way: seen level with it, but a foot goes through to the bed.

    Of another colour, and shallower, it is loose ground.
    """

    xy: tuple[float, float]  # [m] centre
    size: tuple[float, float]  # [m] along x and y
    kind: Literal["puddle"] = "puddle"
    depth: float = 0.05  # [m] from what is seen to the bed
    color: Color = (74, 94, 118)

    checks = (*_bounded("xy size", 1000, "m"), *_bounded("depth", 100, "m"))


@dataclass(frozen=True, slots=True)
class Puddles:
    """Puddles of random size, placed by the run's seed, `gap` apart and none overlapping."""

    x: tuple[float, float]  # [m] region
    y: tuple[float, float]  # [m]
    count: int
    size: tuple[float, float]  # [m] shortest and longest edge
    kind: Literal["puddles"] = "puddles"
    gap: float = 0.10  # [m]
    depth: float = 0.05  # [m]
    color: Color = (74, 94, 118)

    checks = (*_BLOCK_COUNT, *_bounded("x y size gap", 1000, "m"), *_bounded("depth", 100, "m"))


@dataclass(frozen=True, slots=True)
class Level:
    """A stretch of level ground."""

    length: float  # [m]
    kind: Literal["level"] = "level"

    checks = (*_bounded("length", 1000, "m"),)

    def __post_init__(self) -> None:
        _expect(self.length > 0, "a length greater than 0 m", self.length)


@dataclass(frozen=True, slots=True)
class Ramp:
    """A stretch that rises evenly, or falls for a negative angle."""

    length: float  # [m] horizontal
    angle_deg: float
    kind: Literal["ramp"] = "ramp"
    angle_spread_deg: float = 0.0  # at most this much, of either sign, is added by the run's seed

    checks = (*_bounded("length", 1000, "m"),)

    def __post_init__(self) -> None:
        _expect(self.length > 0, "a length greater than 0 m", self.length)
        spread, angle = self.angle_spread_deg, abs(self.angle_deg)
        _expect(0 <= spread < angle, "an angle_spread_deg from 0 to less than the angle", spread)
        _expect(angle + spread < 80, "an angle of less than 80 deg", self.angle_deg)


@dataclass(frozen=True, slots=True)
class Flight:
    """Steps up, or down for a negative riser; spreads as those of `Stairs`."""

    riser: float  # [m]
    tread: float  # [m]
    count: int
    kind: Literal["flight"] = "flight"
    riser_spread: float = 0.0  # [m]
    tread_spread: float = 0.0  # [m]

    checks = (*_STEP_COUNT, *_bounded("riser tread riser_spread tread_spread", 100, "m"))

    def __post_init__(self) -> None:
        _expect(self.count >= 1, "a count of at least one step", self.count)
        _expect(self.tread > 0, "a tread greater than 0 m", self.tread)
        _expect(0 <= self.riser_spread < abs(self.riser), "a riser_spread from 0 to less than the riser", self.riser_spread)
        _expect(0 <= self.tread_spread < self.tread, "a tread_spread from 0 to less than the tread", self.tread_spread)


@dataclass(frozen=True, slots=True)
class Blocks:
    """Level ground with rubble on it, placed as `Rubble` is."""

    length: float  # [m]
    count: int
    size: tuple[float, float]  # [m] shortest and longest edge
    top: tuple[float, float]  # [m] lowest and highest over the level ground
    kind: Literal["blocks"] = "blocks"
    gap: float = 0.02  # [m]
    yaw_deg: float = 180.0  # [deg]

    checks = (
        *_BLOCK_COUNT,
        *_bounded("length size gap", 1000, "m"),
        *_bounded("top", 100, "m"),
        *config.each("yaw_deg", lambda yaw: 0 <= yaw <= 180, "0 to 180 deg"),
    )

    def __post_init__(self) -> None:
        _expect(self.length > 0, "a length greater than 0 m", self.length)


@dataclass(frozen=True, slots=True)
class Stones:
    """Square stepping stones in rows across the way; between them, before and behind there is nothing to stand on."""

    length: float  # [m] at most; as many rows as find room, and the gaps around them
    size: float  # [m] edge of a stone
    gap: float  # [m] from stone to stone
    kind: Literal["stones"] = "stones"
    jitter: float = 0.0  # [m] by which the run's seed moves each stone, at most and along either axis
    top: tuple[float, float] = (0.0, 0.0)  # [m] lowest and highest over the ground before them, by the run's seed

    checks = (*_bounded("length size gap jitter", 1000, "m"), *_bounded("top", 100, "m"))

    def __post_init__(self) -> None:
        _expect(self.size > 0, "a size greater than 0 m", self.size)
        _expect(0 <= 2 * self.jitter <= self.gap, "a jitter of at most half the gap", self.jitter)
        _expect(self.top[0] <= self.top[1], "a top in rising order", self.top)
        _expect(self.rows >= 1, f"a length of at least {self.size + 2 * self.gap:g} m, for one row", self.length)

    @property
    def rows(self) -> int:
        """How many rows of stones there are."""
        return int((self.length - self.gap + 1e-9) // (self.size + self.gap))


@dataclass(frozen=True, slots=True)
class Gap:
    """A ditch right across the way."""

    length: float  # [m] along the way
    kind: Literal["gap"] = "gap"
    spread: float = 0.0  # [m] at most this much, of either sign, is added by the run's seed

    checks = (*_bounded("length spread", 1000, "m"),)

    def __post_init__(self) -> None:
        _expect(0 <= self.spread < self.length, "a spread from 0 to less than the length", self.spread)


Stretch = Level | Ramp | Flight | Blocks | Stones | Gap


@dataclass(frozen=True, slots=True)
class Course:
    """Stretches of ground laid end to end along x, each as high as the last one ended, over whatever lies below."""

    stretches: tuple[Stretch, ...]
    width: float  # [m] the middle at y = 0
    kind: Literal["course"] = "course"
    x: float = -0.6  # [m] where the first one begins
    bottom: float = -0.5  # [m] {world} how far down its solids reach
    shuffled: bool = False  # the stretches between the first and the last follow each other in an order of the run's seed
    rest: float = 0.0  # [m] of level ground put between any two of those
    color: Color | None = None

    checks = (*_bounded("width x rest", 1000, "m"), *_bounded("bottom", 100, "m"))

    def __post_init__(self) -> None:
        _expect(self.width > 0, "a width greater than 0 m", self.width)
        _expect(self.rest >= 0, "a rest of at least 0 m", self.rest)
        if not self.stretches:
            raise ValueError('at least one stretch expected, found none; add [[terrain.stretches]] with kind = "level"')


Terrain = Plane | Box | Hole | Stairs | Pillars | PillarField | Slope | Rubble | HeightMap | Puddle | Puddles | Course


def _expect(holds: bool, expected: str, found: object) -> None:
    if not holds:
        raise ValueError(f"{expected} expected, found {found}")


@dataclass(frozen=True, slots=True)
class Start:
    """Where the robot stands at the beginning; by the run's seed, evenly up to the spreads more or less."""

    xy: tuple[float, float] = (0.0, 0.0)  # [m]
    yaw_deg: float = 0.0
    xy_spread: tuple[float, float] = (0.0, 0.0)  # [m]
    yaw_spread_deg: float = 0.0

    checks = (*_bounded("xy xy_spread", 1000, "m"), *_bounded("yaw_deg yaw_spread_deg", 360, "deg"))

    def __post_init__(self) -> None:
        least = min(*self.xy_spread, self.yaw_spread_deg)
        _expect(least >= 0, "spreads of at least 0", least)


@dataclass(frozen=True, slots=True)
class Goal:
    """Where it shall arrive, along its starting direction: the body's centre past this line, within the corridor."""

    distance: float  # [m] straight ahead from the start
    corridor: float = 0.25  # [m] how far to the side it may be
    route: bool = False  # the planner is told where to go and finds the way; else the operator steers straight ahead
    waypoints: tuple[tuple[float, float], ...] = ()  # [m] from the start, x ahead and y left: of the route, before its end
    passage: bool = False  # of a route: a deliberate crossing is ordered, from the start straight to the end
    # What is right to do: to arrive, or to stand before what cannot be crossed and to say why; either where the seed decides
    # whether it can be crossed, unless somebody has found that out and tells the scorer.
    expect: Literal["arrival", "refusal", "either"] = "arrival"

    checks = (
        *_bounded("distance corridor", 1000, "m"),
        config.together("waypoints", lambda found: all(max(map(abs, one)) <= 1000 for one in found), "places within 1000 m"),
    )

    def __post_init__(self) -> None:
        _expect(min(self.distance, self.corridor) > 0, "distance and corridor greater than 0 m", (self.distance, self.corridor))
        _expect(self.route or not self.waypoints, "route = true with waypoints", "false")
        _expect(self.route or not self.passage, "route = true with passage", "false")
        _expect(len(self.waypoints) < _MOST_WAYPOINTS, f"fewer than {_MOST_WAYPOINTS} waypoints", len(self.waypoints))


@dataclass(frozen=True, slots=True)
class Walk:
    """What the operator asks for."""

    gait: GaitName = "tripod"
    speed: float = 0.11  # [m/s]
    body_height: float = 0.11  # [m]
    lift: float = 0.025  # [m] clearance of a swinging foot over start and touchdown; more over what the map shows
    blind: bool = False  # the baseline: the planner gets no map and walks as on flat ground
    footholds: Literal["score", "evaluation"] = "score"  # the layer of the map that says where: Lotriet's or Masri's
    arc: Literal["flow", "sixth_order"] = "flow"  # of swinging feet: Lotriet's, or Erasmus' for reference
    by_touch: bool = False  # when the robot stands for want of sight, it is asked to go on by touch alone

    checks = (*_bounded("speed", 10, "m/s"), *_bounded("body_height lift", 10, "m"))

    def __post_init__(self) -> None:
        _expect(self.speed > 0, "a speed greater than 0 m/s", self.speed)
        _expect(self.body_height > 0, "a body height greater than 0 m", self.body_height)
        _expect(self.lift > 0, "a lift greater than 0 m", self.lift)


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """How the simulated depth camera behaves."""

    noise: bool = True
    dropouts: bool = True  # pixels without return in shadows, on grazed surfaces, and at random
    loss: float = 0.05  # share of the pixels that are without return at random, each frame others; not without dropouts

    def __post_init__(self) -> None:
        _expect(0.0 <= self.loss <= 1.0, "a loss from 0 to 1", self.loss)


@dataclass(frozen=True, slots=True)
class Variation:
    """How far the physics of a run strays from the profile by its seed: factors are uniform in 1/x to x."""

    armature: float = 1.5
    friction: float = 1.15
    imu: bool = False  # whether the robot has an inertial sensor
    registration: Literal["projective", "kiss-icp"] = "projective"

    checks = (*_bounded("armature friction", 100, "times"),)

    def __post_init__(self) -> None:
        _expect(min(self.armature, self.friction) >= 1, "factors of at least 1", (self.armature, self.friction))


@dataclass(frozen=True, slots=True)
class MapOptions:
    """How large and how fine the terrain map is; scans are reduced to cells as fine, down to 5 mm."""

    cells: int = 256  # along x
    cells_y: int = 0  # along y, 0 for as many
    resolution: float = 0.01  # [m]

    checks = (*_bounded("cells cells_y", 2048, "cells"),)

    def __post_init__(self) -> None:
        _expect(self.cells >= 8 and (self.cells_y == 0 or self.cells_y >= 8), "at least 8 cells", (self.cells, self.cells_y))
        _expect(0.001 <= self.resolution <= 1.0, "a resolution of 0.001 to 1 m", self.resolution)
        cells, most = self.cells * (self.cells_y or self.cells), topics.cells_that_fit(topics.TERRAIN)
        _expect(cells <= most, f"at most {most} cells in all, which a message of {topics.TERRAIN.key} has room for,", cells)

    @property
    def scan_resolution(self) -> float:
        """[m] of the cells that scans are reduced to."""
        return max(self.resolution, 0.005)


@dataclass(frozen=True, slots=True)
class Fault:
    """Something that goes wrong at a time."""

    at_s: float  # [s] simulated
    service: Literal["perception", "mapper", "planner", "actuator", "camera"]
    # A camera is absent (unplugged), or sends the same picture, nothing in range, or noise; it is the simulator's.
    kind: Literal["kill", "hang", "absent", "frozen", "blind", "noise"] = "kill"
    # [s] until it is back. A live run starts a killed process again by itself, and one that hangs for longer than it may.
    for_s: float = 2.0
    at_spread_s: float = 0.0  # [s] at most this much, drawn by the run's seed, is added to at_s

    checks = (*_bounded("at_s for_s at_spread_s", 1e6, "s"),)

    def __post_init__(self) -> None:
        _expect(self.at_s >= 0, "a time of at least 0 s", self.at_s)
        _expect(self.at_spread_s >= 0, "an at_spread_s of at least 0 s", self.at_spread_s)
        _expect(self.for_s > 0, "an outage longer than 0 s", self.for_s)
        kinds = ("absent", "frozen", "blind", "noise") if self.of_camera else ("kill", "hang")
        _expect(self.kind in kinds, f"a kind out of {', '.join(kinds)} for service = {self.service!r}", repr(self.kind))

    @property
    def of_camera(self) -> bool:
        """Whether it is the simulated camera that fails, not a process."""
        return self.service == "camera"


@dataclass(frozen=True, slots=True)
class Link:
    """The radio between the robot and the computer that maps and plans; without numbers both are one machine. In lockstep."""

    delay_ms: float = 0.0  # [ms] one way
    mbit: float = 0.0  # [Mbit/s] both ways together; 0: no limit
    loss: float = 0.0  # share of the packets

    def __post_init__(self) -> None:
        _expect(0.0 <= self.delay_ms <= 1000.0, "delay_ms from 0 to 1000", self.delay_ms)
        _expect(self.mbit == 0.0 or 0.1 <= self.mbit <= 1e5, "mbit of 0.1 or more, or 0 for no limit", self.mbit)
        _expect(0.0 <= self.loss <= 0.5, "a loss from 0 to 0.5", self.loss)

    @property
    def exists(self) -> bool:
        """Whether there is one."""
        return self != Link()


@dataclass(frozen=True, slots=True)
class Trouble:
    """What goes wrong on whatever course."""

    faults: tuple[Fault, ...] = ()
    bus_faults: tuple[BusFault, ...] = ()
    movers: tuple[Mover, ...] = ()
    camera: CameraOptions | None = None  # in place of the course's
    extra_time_s: float = 0.0  # [s] simulated, added to the course's time limit

    def __post_init__(self) -> None:
        _expect(self.extra_time_s >= 0, "an extra_time_s of at least 0 s", self.extra_time_s)


@dataclass(frozen=True, slots=True)
class Scenario:
    """One course and the way to walk it."""

    name: str
    terrain: tuple[Terrain, ...]
    goal: Goal
    start: Start = field(default_factory=Start)
    robot: str = "phantomx_mk2"
    walk: Walk = field(default_factory=Walk)
    camera: CameraOptions = field(default_factory=CameraOptions)
    variation: Variation = field(default_factory=Variation)
    pose_error: Literal["none", "rgbdslam", "orb_slam"] = "none"  # perception is off as a recorded visual SLAM was
    map: MapOptions = field(default_factory=MapOptions)
    battery_ah: float = 4.0  # [A h] that the simulated battery holds: it walks for half an hour and more with that
    bridge: bool = False  # the servo bus is spoken by a microcontroller, to which the actuator sends its goals
    faults: tuple[Fault, ...] = ()
    bus_faults: tuple[BusFault, ...] = ()  # of the simulated servos and their bus
    movers: tuple[Mover, ...] = ()  # what moves over the course; the depth camera sees it, nothing touches it
    link: Link = field(default_factory=Link)
    time_limit_s: float = 90.0  # [s] simulated
    folder: str = "."  # where files named in the scenario are looked for; set on loading

    checks = (
        *_bounded("battery_ah", 1e6, "A h"),
        *_bounded("time_limit_s", 86400, "s"),
        config.together("terrain", lambda parts: len(parts) <= 5000, "at most 5000 primitives"),
        config.together("movers", lambda movers: len(movers) <= 100, "at most 100 movers"),
    )

    def __post_init__(self) -> None:
        # Folders of runs are named by it.
        plain = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9 _.+-]*", self.name) is not None and ".." not in self.name
        _expect(len(self.name) <= 100, "a name of at most 100 characters", len(self.name))
        _expect(plain, "a name of letters, digits, spaces, dots, dashes, plus signs and underscores", repr(self.name))
        if not self.terrain:
            raise ValueError('at least one terrain primitive expected, found none; add [[terrain]] with kind = "plane"')
        _expect(self.time_limit_s > 0, "a time limit greater than 0 s", self.time_limit_s)
        _expect(self.battery_ah > 0, "a battery_ah greater than 0 A h", self.battery_ah)

    def faults_at(self, seed: int) -> tuple[Fault, ...]:
        """The faults of the run with a seed, their times drawn."""
        spread = np.random.default_rng([seed, _FAULT_STREAM]).random(len(self.faults))
        return tuple(
            replace(fault, at_s=fault.at_s + fault.at_spread_s * float(share), at_spread_s=0.0)
            for fault, share in zip(self.faults, spread, strict=True)
        )

    def with_trouble(self, trouble: Trouble, name: str) -> "Scenario":
        """This course with something more that goes wrong, by another name."""
        return replace(
            self,
            name=name,
            faults=(*self.faults, *trouble.faults),
            bus_faults=(*self.bus_faults, *trouble.bus_faults),
            movers=(*self.movers, *trouble.movers),
            camera=trouble.camera or self.camera,
            time_limit_s=self.time_limit_s + trouble.extra_time_s,
        )


def load_scenario(name_or_path: str) -> Scenario:
    """Read a scenario that comes with Sextant by its name, or any other by the path of its TOML file.

    The name of a trouble may follow: `steps+sun` is `steps` with what the trouble `sun` adds to it.

    Raises:
        ConfigError: No such scenario, or what is wrong in it, all at once.
    """
    course, plus, trouble = name_or_path.rpartition("+")
    if plus and course and "/" not in trouble:
        scenario = load_scenario(course)
        return scenario.with_trouble(load_trouble(trouble), f"{scenario.name}+{trouble}")
    if name_or_path.endswith(".toml"):
        return _with_folder(config.load(Path(name_or_path), Scenario), Path(name_or_path).parent)
    known = scenario_names()
    if name_or_path not in known:
        ways = f"{hint(name_or_path, known)}; or give a path that ends in .toml"
        raise config.ConfigError("scenario", [f"no scenario {name_or_path[:60]!r}; {ways}"])
    with resources.as_file(resources.files("sextant.shared.scenario.scenarios") / f"{name_or_path}.toml") as path:
        return _with_folder(config.load(path, Scenario), path.parent)


def scenario_names() -> list[str]:
    """Names of the scenarios that come with Sextant."""
    return _names("sextant.shared.scenario.scenarios")


def trouble_names() -> list[str]:
    """Names of the troubles that come with Sextant."""
    return _names("sextant.shared.scenario.troubles")


def load_trouble(name: str) -> Trouble:
    """Read a trouble that comes with Sextant by its name.

    Raises:
        ConfigError: No such trouble, or what is wrong in it, all at once.
    """
    known = trouble_names()
    if name not in known:
        near = difflib.get_close_matches(name, known, 1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise config.ConfigError("trouble", [f"no trouble {name!r}; {hint}known: {', '.join(known)}"])
    with resources.as_file(resources.files("sextant.shared.scenario.troubles") / f"{name}.toml") as path:
        return config.load(path, Trouble)


def _names(package: str) -> list[str]:
    files = resources.files(package).iterdir()
    return sorted(p.name.removesuffix(".toml") for p in files if p.name.endswith(".toml"))


def _with_folder(scenario: Scenario, folder: Path) -> Scenario:
    return replace(scenario, folder=str(folder.resolve()))
