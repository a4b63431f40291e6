"""Schema of a scenario: terrain, start, goal, robot, walk, camera and faults.

A scenario is read from TOML.

The services that control the robot never read a scenario. The simulator builds the world from it, the scorer evaluates the run
against it, and the launcher sends its goal and speed to the planner as an operator would.
"""

import difflib
import os
import re
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from sextant.shared.files import config
from sextant.shared.plugins.loading import Plugins
from sextant.shared.scenario.mismatch import Deviation, Mismatch
from sextant.shared.scenario.mover import Mover
from sextant.shared.scenario.relief import Relief
from sextant.shared.servo.bus_fault import BusFault
from sextant.shared.spelling import hint
from sextant.shared.wire import topics
from sextant.shared.wire.messages import GaitRequest

Color = tuple[int, int, int]  # R, G, B from 0 to 255
MAX_BLOCKS = 500  # randomly placed blocks of one primitive; each is tested against all others, which takes time
_FAULT_STREAM = 0x5CE  # random stream of the run's seed for the times of faults
_MISMATCH_STREAM = 0x5CF  # random stream of the run's seed for the deviations from the profile
_MOST_WAYPOINTS = 32  # of a route, including its end


def _bounded(keys: str, most: float, unit: str) -> tuple[config.Check, ...]:
    """Return checks that the absolute values of fields are at most `most`."""
    return config.each(keys, lambda value: value is None or abs(value) <= most, f"at most {most:g} {unit} either way")


_BLOCK_COUNT = config.each("count", lambda count: 1 <= count <= MAX_BLOCKS, f"a count from 1 to {MAX_BLOCKS}")
_STEP_COUNT = config.each("count", lambda count: 1 <= count <= 1000, "a count from 1 to 1000")


@dataclass(frozen=True, slots=True)
class Plane:
    """Level ground everywhere."""

    kind: Literal["plane"] = "plane"
    height: float = 0.0  # [m] of the ground
    color: Color | None = None  # R, G, B from 0 to 255; by default the ground's usual colour

    checks = (*_bounded("height", 100, "m"),)


@dataclass(frozen=True, slots=True)
class Box:
    """Block on the ground with a level top.

    The spreads vary its position, size and height: the run's seed draws uniform offsets within +- the spread.
    """

    xy: tuple[float, float]  # [m] centre
    size: tuple[float, float]  # [m] along its own x and y
    top: float  # [m] height of its top
    kind: Literal["box"] = "box"
    yaw_deg: float = 0.0  # [deg] of its x axis
    depth: float = 0.5  # [m] extent downward from its top
    color: Color | None = None  # R, G, B from 0 to 255; by default the ground's usual colour
    xy_spread: tuple[float, float] = (0.0, 0.0)  # [m] of its centre along x and y of {world}
    size_spread: tuple[float, float] = (0.0, 0.0)  # [m] of its size
    top_spread: float = 0.0  # [m] of its top

    checks = (*_bounded("xy size xy_spread size_spread", 1000, "m"), *_bounded("top depth top_spread", 100, "m"))

    def __post_init__(self) -> None:
        least = min(*self.xy_spread, *self.size_spread, self.top_spread)
        _expect(least >= 0, "spreads of at least 0 m", least)
        for size, spread in zip(self.size, self.size_spread, strict=True):
            _expect(spread == 0 or spread < size, "a size_spread smaller than the size", spread)


@dataclass(frozen=True, slots=True)
class Hole:
    """Rectangular, axis-aligned hole in the level ground, visible to the camera.

    The spreads vary it as those of a `box` do.
    """

    xy: tuple[float, float]  # [m] centre
    size: tuple[float, float]  # [m] along x and y
    depth: float  # [m] of the bottom below the level ground
    kind: Literal["hole"] = "hole"
    xy_spread: tuple[float, float] = (0.0, 0.0)  # [m] of its centre
    size_spread: tuple[float, float] = (0.0, 0.0)  # [m] of its size
    color: Color | None = None  # R, G, B from 0 to 255; by default that of the plane

    checks = (*_bounded("xy size xy_spread size_spread", 1000, "m"), *_bounded("depth", 100, "m"))

    def __post_init__(self) -> None:
        least = min(*self.xy_spread, *self.size_spread)
        _expect(least >= 0, "spreads of at least 0 m", least)
        _expect(min(*self.size, self.depth) > 0, "size and depth greater than 0 m", (*self.size, self.depth))
        for size, spread in zip(self.size, self.size_spread, strict=True):
            _expect(spread < size, "a size_spread smaller than the size", spread)


@dataclass(frozen=True, slots=True)
class Stairs:
    """Stairs that rise along their own x axis, or fall for a negative riser.

    The length of the last tread is `landing`.

    All risers and treads of one staircase are equal. With spreads, the run's seed draws their height and length.
    """

    xy: tuple[float, float]  # [m] middle of the first riser's edge
    riser: float  # [m] height of a step
    tread: float  # [m] length of a step
    count: int  # number of steps
    width: float  # [m] across
    kind: Literal["stairs"] = "stairs"
    landing: float = 1.0  # [m] length of the last tread
    yaw_deg: float = 0.0  # [deg] of its x axis
    base: float = 0.0  # [m] height of the ground before the first riser
    depth: float = 0.5  # [m] extent below the lowest tread
    riser_spread: float = 0.0  # [m] maximum random offset of the risers, of either sign
    tread_spread: float = 0.0  # [m] maximum random offset of the treads, of either sign
    color: Color | None = None  # R, G, B from 0 to 255; by default the ground's usual colour

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
    """Pillars at given positions, the only footholds where there is no other ground."""

    xy: tuple[tuple[float, float], ...]  # [m] centres
    size: float  # [m] edge of the square tops
    top: float  # [m] height of the tops
    kind: Literal["pillars"] = "pillars"
    length: float = 0.0  # [m] edge of the tops along x; 0 for square tops
    depth: float = 0.5  # [m] extent downward from the top
    color: Color | None = None  # R, G, B from 0 to 255; by default the ground's usual colour
    jitter: float = 0.0  # [m] maximum random displacement of each pillar along each axis
    top_spread: float = 0.0  # [m] maximum random offset of the top of each pillar, of either sign
    # Number of weak pillars, chosen by the seed. They look like the others, but sink when loaded and stay down.
    weak: int = 0
    bears: float = 3.0  # [N] maximum load of a weak pillar
    sinks: float = 0.06  # [m] depth by which a weak pillar sinks
    # Number of tipping pillars, chosen by the seed. They look like the others from above, but consist of a box on a smaller
    # base. A load over the base is borne; a load beyond it tips the box, unless the weight of the box holds it.
    tipping: int = 0
    bears_within: float = 0.03  # [m] from the middle of a tipping pillar to the edges of its base
    tip_height: float = 0.04  # [m] height of its box
    tip_mass: float = 0.2  # [kg] of its box
    tip_deg: float = 80.0  # [deg] largest angle of its box; where it has overturned, it stays

    checks = (
        config.together("xy", lambda xy: len(xy) <= 5000, "at most 5000 pillars"),
        config.together("xy", lambda xy: all(max(map(abs, one)) <= 1000 for one in xy), "places within 1000 m"),
        *_bounded("size length jitter", 1000, "m"),
        *_bounded("top depth top_spread sinks", 100, "m"),
        *_bounded("bears", 1e6, "N"),
        *config.each("tip_mass", lambda mass: 0 < mass <= 1000, "more than 0 and at most 1000 kg"),
        *config.each("tip_deg", lambda angle: 0 < angle <= 90, "more than 0 and at most 90 deg"),
    )

    def __post_init__(self) -> None:
        _expect(self.size > 0 and self.length >= 0, "a size greater than 0 m and a length", (self.size, self.length))
        least = min(self.jitter, self.top_spread)
        _expect(least >= 0, "a jitter and a top_spread of at least 0 m", least)
        _expect(0 <= self.weak <= len(self.xy), f"0 to {len(self.xy)} weak pillars, the number of pillars", self.weak)
        found = (self.bears, self.sinks)
        _expect(self.bears >= 0 and 0 < self.sinks < self.depth, "bears of at least 0 N and sinks between 0 m and depth", found)
        rest = len(self.xy) - self.weak
        _expect(
            0 <= self.tipping <= rest, f"0 to {rest} tipping pillars, the number of pillars that are not weak", self.tipping
        )
        if self.tipping:
            half = min(self.size, self.length or self.size) / 2
            _expect(0 < self.bears_within < half, f"bears_within between 0 m and half the edge, {half:g} m", self.bears_within)
            _expect(0 < self.tip_height < self.depth, "a tip_height between 0 m and depth", self.tip_height)


@dataclass(frozen=True, slots=True)
class PillarField:
    """Square, axis-aligned pillars in a region, at least `gap` apart.

    The run's seed draws positions and density.
    """

    x: tuple[float, float]  # [m] region along x, lowest and highest
    y: tuple[float, float]  # [m] region along y, lowest and highest
    density: tuple[float, float]  # [1] lowest and highest share of the region covered by pillar tops
    size: float  # [m] edge of the square tops
    top: float  # [m] height of the tops
    kind: Literal["pillar_field"] = "pillar_field"
    gap: float = 0.02  # [m] minimum distance between pillars
    depth: float = 0.5  # [m] extent downward from the top
    color: Color | None = None  # R, G, B from 0 to 255; by default the ground's usual colour

    checks = (*_bounded("x y size gap", 1000, "m"), *_bounded("top depth", 100, "m"))

    def __post_init__(self) -> None:
        low, high = self.density
        _expect(0 <= low <= high <= 0.5, "densities in rising order from 0 to 0.5", self.density)
        _expect(self.size > 0, "a size greater than 0 m", self.size)


@dataclass(frozen=True, slots=True)
class Slope:
    """Ramp that rises along its own x to a level landing."""

    xy: tuple[float, float]  # [m] middle of its lower edge
    angle_deg: float  # [deg] above the horizontal
    length: float  # [m] horizontal
    width: float  # [m] across
    kind: Literal["slope"] = "slope"
    yaw_deg: float = 0.0  # [deg] of its x axis
    landing: float = 1.0  # [m] length of the level ground behind it; 0 for none
    base: float = 0.0  # [m] height of its first edge, the upper one for a negative angle
    depth: float = 0.5  # [m] extent below its lower end
    color: Color | None = None  # R, G, B from 0 to 255; by default the ground's usual colour

    checks = (*_bounded("xy length width landing", 1000, "m"), *_bounded("base depth", 100, "m"))


@dataclass(frozen=True, slots=True)
class Rubble:
    """Blocks of random size, height, heading and position, at least `gap` apart.

    The run's seed draws them. In a region that they nearly fill, the blocks of some seeds find no room; `run` and `trials` then
    refuse the seed before the first walk.
    """

    x: tuple[float, float]  # [m] region along x, lowest and highest
    y: tuple[float, float]  # [m] region along y, lowest and highest
    count: int  # number of blocks
    size: tuple[float, float]  # [m] shortest and longest edge
    top: tuple[float, float]  # [m] lowest and highest
    kind: Literal["rubble"] = "rubble"
    gap: float = 0.02  # [m] minimum distance between blocks
    yaw_deg: float = 180.0  # [deg] headings are uniform within +- this angle
    base: float = 0.0  # [m] height of the ground under the blocks
    color: Color | None = None  # R, G, B from 0 to 255; by default the ground's usual colour

    checks = (
        *_BLOCK_COUNT,
        *_bounded("x y size gap", 1000, "m"),
        *_bounded("top base", 100, "m"),
        *config.each("yaw_deg", lambda yaw: 0 <= yaw <= 180, "0 to 180 deg"),
    )


@dataclass(frozen=True, slots=True)
class HeightMap:
    """Measured ground from a .npy, .png or .mcap file.

    A .npy file has heights in metres; NaN (unknown) is filled with the lowest height. The heights of a .png file are grey
    values times `scale`. A .mcap file is a recording of ROS 2 with a grid_map_msgs/GridMap, of which the newest is taken; it
    brings its resolution and position. `rows`, `columns` and `quarter_turns` crop the map and then rotate it.
    """

    file: str  # relative to the scenario file, absolute, or in the folder of an environment variable: "$FOLDER/map.npy"
    resolution: float | None = None  # [m] cell edge; required, but for .mcap
    # [m] position of cell (0, 0) of the cropped and rotated map; required, but for .mcap; rows run along x
    xy: tuple[float, float] | None = None
    layer: str = "elevation"  # layer of the grid map in a .mcap file
    topic: str = ""  # topic of the grid map in a .mcap file; needed if there are several
    kind: Literal["height_map"] = "height_map"
    scale: float | None = None  # factor of the heights, by default 1; required for .png: [m] per grey value
    color: Color | None = None  # R, G, B from 0 to 255; by default the ground's usual colour
    base: float = 0.0  # [m] added to the heights, because a .png has no negative values
    rows: tuple[int, int] | None = None  # first row and one past the last row of the crop, by default all
    columns: tuple[int, int] | None = None  # first column and one past the last column of the crop, by default all
    quarter_turns: int = 0  # of the cropped map, counterclockwise as seen from above

    checks = (
        *config.each("xy", lambda one: one is None or abs(one) <= 1000, "-1000 to 1000 m"),
        *_bounded("base", 100, "m"),
        *config.each("resolution", lambda edge: edge is None or 0.001 <= edge <= 10, "0.001 to 10 m"),
        *config.each("scale", lambda scale: scale is None or 0 < scale <= 1000, "more than 0 and at most 1000"),
    )

    def __post_init__(self) -> None:
        for name, taken in (("rows", self.rows), ("columns", self.columns)):
            _expect(taken is None or 0 <= taken[0] < taken[1] - 1, f"{name} from 0 on, two at least", taken)
        for name in ("resolution", "xy"):
            if not self.is_grid_map:
                _expect(getattr(self, name) is not None, f"{name} of the map", "none")
        if self.is_grid_map and self.xy is None:
            moved = self.rows is not None or self.columns is not None or self.quarter_turns % 4 != 0
            _expect(not moved, "xy of the cropped or rotated map", "none")

    @property
    def is_grid_map(self) -> bool:
        """Whether the file is a recording with a grid map."""
        return self.file.lower().endswith(".mcap")

    def path(self, folder: Path) -> Path:
        """Return the path of the file.

        Args:
            folder: Folder of the scenario.

        Raises:
            ConfigError: The environment variable that names the folder is not set.
        """
        variable = re.match(r"\$(\w+)/", self.file)
        if variable is None:
            return folder / self.file
        root, rest = os.environ.get(variable[1], ""), self.file[variable.end() :]
        if not root:
            wanted = f"the environment variable {variable[1]} is not set; set it to the folder that contains {rest}"
            raise config.ConfigError(f"height map {self.file}", [wanted])
        return Path(root) / rest


@dataclass(frozen=True, slots=True)
class Puddle:
    """Rectangular puddle.

    The camera sees level ground, but a foot sinks through to the bed.

    With another colour and less depth it represents loose ground.
    """

    xy: tuple[float, float]  # [m] centre
    size: tuple[float, float]  # [m] along x and y
    kind: Literal["puddle"] = "puddle"
    depth: float = 0.05  # [m] from the visible surface to the bed
    color: Color = (74, 94, 118)  # R, G, B from 0 to 255 of the surface

    checks = (*_bounded("xy size", 1000, "m"), *_bounded("depth", 100, "m"))


@dataclass(frozen=True, slots=True)
class Puddles:
    """Puddles of random size and position, at least `gap` apart.

    The run's seed draws them.
    """

    x: tuple[float, float]  # [m] region along x, lowest and highest
    y: tuple[float, float]  # [m] region along y, lowest and highest
    count: int  # number of puddles
    size: tuple[float, float]  # [m] shortest and longest edge
    kind: Literal["puddles"] = "puddles"
    gap: float = 0.10  # [m] minimum distance between puddles
    depth: float = 0.05  # [m] from the visible surface to the bed
    color: Color = (74, 94, 118)  # R, G, B from 0 to 255 of the surface

    checks = (*_BLOCK_COUNT, *_bounded("x y size gap", 1000, "m"), *_bounded("depth", 100, "m"))


@dataclass(frozen=True, slots=True)
class Patches:
    """Patches of the ground with other friction, of random size, position and friction; no sensor shows them.

    The run's seed draws them. Patches may overlap; the last one counts. The friction of a foot is that of the patch under it,
    times the deviation of that foot.
    """

    x: tuple[float, float]  # [m] region along x, lowest and highest
    y: tuple[float, float]  # [m] region along y, lowest and highest
    count: int  # number of patches
    size: tuple[float, float]  # [m] shortest and longest edge
    frictions: tuple[float, ...]  # [1] coefficients of sliding friction, of which each patch has one; elsewhere it is 0.8
    kind: Literal["patches"] = "patches"

    checks = (
        *_BLOCK_COUNT,
        *_bounded("x y size", 1000, "m"),
        *config.each("frictions", lambda friction: 0.05 <= friction <= 2, "0.05 to 2"),
    )

    def __post_init__(self) -> None:
        _expect(len(self.frictions) > 0, "at least one friction", "none")
        for name in ("x", "y", "size"):
            low, high = getattr(self, name)
            _expect(low <= high, f"{name} in rising order", (low, high))
        _expect(self.size[0] > 0, "a size greater than 0 m", self.size)


@dataclass(frozen=True, slots=True)
class Level:
    """Stretch of level ground."""

    length: float  # [m] along the course
    kind: Literal["level"] = "level"

    checks = (*_bounded("length", 1000, "m"),)

    def __post_init__(self) -> None:
        _expect(self.length > 0, "a length greater than 0 m", self.length)


@dataclass(frozen=True, slots=True)
class Ramp:
    """Stretch with a constant slope, downward for a negative angle."""

    length: float  # [m] horizontal
    angle_deg: float  # [deg] above the horizontal
    kind: Literal["ramp"] = "ramp"
    angle_spread_deg: float = 0.0  # [deg] maximum random offset of the angle, of either sign

    checks = (*_bounded("length", 1000, "m"),)

    def __post_init__(self) -> None:
        _expect(self.length > 0, "a length greater than 0 m", self.length)
        spread, angle = self.angle_spread_deg, abs(self.angle_deg)
        _expect(0 <= spread < angle, "an angle_spread_deg from 0 to less than the angle", spread)
        _expect(angle + spread < 80, "an angle of less than 80 deg", self.angle_deg)


@dataclass(frozen=True, slots=True)
class Flight:
    """Stretch of stairs, downward for a negative riser.

    The spreads are those of `stairs`.
    """

    riser: float  # [m] height of a step
    tread: float  # [m] length of a step
    count: int  # number of steps
    kind: Literal["flight"] = "flight"
    riser_spread: float = 0.0  # [m] maximum random offset of the risers, of either sign
    tread_spread: float = 0.0  # [m] maximum random offset of the treads, of either sign

    checks = (*_STEP_COUNT, *_bounded("riser tread riser_spread tread_spread", 100, "m"))

    def __post_init__(self) -> None:
        _expect(self.count >= 1, "a count of at least one step", self.count)
        _expect(self.tread > 0, "a tread greater than 0 m", self.tread)
        _expect(0 <= self.riser_spread < abs(self.riser), "a riser_spread from 0 to less than the riser", self.riser_spread)
        _expect(0 <= self.tread_spread < self.tread, "a tread_spread from 0 to less than the tread", self.tread_spread)


@dataclass(frozen=True, slots=True)
class Blocks:
    """Stretch of level ground with blocks on it, placed as in `rubble`."""

    length: float  # [m] along the course
    count: int  # number of blocks
    size: tuple[float, float]  # [m] shortest and longest edge
    top: tuple[float, float]  # [m] lowest and highest top above the level ground
    kind: Literal["blocks"] = "blocks"
    gap: float = 0.02  # [m] minimum distance between blocks
    yaw_deg: float = 180.0  # [deg] headings are uniform within +- this angle

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
    """Stretch of square stepping stones in rows across the path.

    There is no ground between or around them.
    """

    length: float  # [m] maximum; it holds as many rows, with gaps around them, as fit
    size: float  # [m] edge of a stone
    gap: float  # [m] from stone to stone
    kind: Literal["stones"] = "stones"
    jitter: float = 0.0  # [m] maximum random displacement of each stone along each axis
    top: tuple[float, float] = (0.0, 0.0)  # [m] lowest and highest random top, relative to the ground before the stones

    checks = (*_bounded("length size gap jitter", 1000, "m"), *_bounded("top", 100, "m"))

    def __post_init__(self) -> None:
        _expect(self.size > 0, "a size greater than 0 m", self.size)
        _expect(0 <= 2 * self.jitter <= self.gap, "a jitter of at most half the gap", self.jitter)
        _expect(self.top[0] <= self.top[1], "a top in rising order", self.top)
        _expect(self.rows >= 1, f"a length of at least {self.size + 2 * self.gap:g} m, for one row", self.length)

    @property
    def rows(self) -> int:
        """Number of rows of stones."""
        return int((self.length - self.gap + 1e-9) // (self.size + self.gap))


@dataclass(frozen=True, slots=True)
class Gap:
    """Stretch without ground, across the whole path."""

    length: float  # [m] along the path
    kind: Literal["gap"] = "gap"
    spread: float = 0.0  # [m] maximum random offset of the length, of either sign

    checks = (*_bounded("length spread", 1000, "m"),)

    def __post_init__(self) -> None:
        _expect(0 <= self.spread < self.length, "a spread from 0 to less than the length", self.spread)


Stretch = Level | Ramp | Flight | Blocks | Stones | Gap


@dataclass(frozen=True, slots=True)
class Course:
    """Stretches of ground end to end along x, above any other terrain.

    Each stretch starts at the height at which the previous one ends.
    """

    stretches: tuple[Stretch, ...]
    width: float  # [m] centred at y = 0
    kind: Literal["course"] = "course"
    x: float = -0.6  # [m] start of the first stretch
    bottom: float = -0.5  # [m] {world} lowest height of the solids
    shuffled: bool = False  # True: random order of the stretches between the first and the last
    rest: float = 0.0  # [m] level ground inserted between any two of these
    color: Color | None = None  # R, G, B from 0 to 255; by default the ground's usual colour

    checks = (*_bounded("width x rest", 1000, "m"), *_bounded("bottom", 100, "m"))

    def __post_init__(self) -> None:
        _expect(self.width > 0, "a width greater than 0 m", self.width)
        _expect(self.rest >= 0, "a rest of at least 0 m", self.rest)
        if not self.stretches:
            raise ValueError('at least one stretch expected, found none; add [[terrain.stretches]] with kind = "level"')


Terrain = (
    Plane
    | Box
    | Hole
    | Stairs
    | Pillars
    | PillarField
    | Slope
    | Rubble
    | HeightMap
    | Relief
    | Puddle
    | Puddles
    | Patches
    | Course
)


def _expect(holds: bool, expected: str, found: object) -> None:
    if not holds:
        raise ValueError(f"{expected} expected, found {found}")


@dataclass(frozen=True, slots=True)
class Start:
    """Initial pose of the robot.

    The run's seed draws uniform offsets within +- the spreads.
    """

    xy: tuple[float, float] = (0.0, 0.0)  # [m] of the body
    yaw_deg: float = 0.0  # [deg] heading
    xy_spread: tuple[float, float] = (0.0, 0.0)  # [m] of xy
    yaw_spread_deg: float = 0.0  # [deg] of the heading

    checks = (*_bounded("xy xy_spread", 1000, "m"), *_bounded("yaw_deg yaw_spread_deg", 360, "deg"))

    def __post_init__(self) -> None:
        least = min(*self.xy_spread, self.yaw_spread_deg)
        _expect(least >= 0, "spreads of at least 0", least)


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

    checks = (*_bounded("speed", 10, "m/s"), *_bounded("body_height lift", 10, "m"))

    def __post_init__(self) -> None:
        _expect(self.speed > 0, "a speed greater than 0 m/s", self.speed)
        _expect(self.body_height > 0, "a body height greater than 0 m", self.body_height)
        _expect(self.lift > 0, "a lift greater than 0 m", self.lift)


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """Errors of the simulated depth camera."""

    noise: bool = True  # whether depth has noise
    dropouts: bool = True  # pixels without return in shadows, at grazing angles, and at random
    loss: float = 0.05  # [1] share of random pixels without return, drawn for each frame; only with dropouts

    def __post_init__(self) -> None:
        _expect(0.0 <= self.loss <= 1.0, "a loss from 0 to 1", self.loss)


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
        _expect(0.0 <= self.contrast <= 0.3, "a contrast from 0 to 0.3", self.contrast)
        _expect(0.0 <= self.light <= 0.5, "a light from 0 to 0.5", self.light)
        _expect(0.1 <= self.light_period_s <= 1e6, "a light_period_s from 0.1 to 1000000 s", self.light_period_s)
        _expect(0.0 <= self.exposure_s <= 0.1, "an exposure_s from 0 to 0.1 s", self.exposure_s)
        _expect(0.0 <= self.noise <= 50.0, "a noise from 0 to 50", self.noise)


@dataclass(frozen=True, slots=True)
class Variation:
    """Random deviation of a run's physics from the profile.

    The factors are uniform from 1/x to x.
    """

    armature: float = 1.5  # factor of the reflected inertia of the rotors
    friction: float = 1.15  # factor of the friction of joints and feet
    imu: bool = False  # whether the robot has an IMU
    registration: Literal["projective", "kiss-icp"] = "projective"  # method that localizes the robot

    checks = (*_bounded("armature friction", 100, "times"),)

    def __post_init__(self) -> None:
        _expect(min(self.armature, self.friction) >= 1, "factors of at least 1", (self.armature, self.friction))


@dataclass(frozen=True, slots=True)
class MapOptions:
    """Size and resolution of the terrain map.

    Scans have the same cell size, but at least 5 mm.
    """

    cells: int = 256  # along x
    cells_y: int = 0  # along y; 0 for the same number as along x
    resolution: float = 0.01  # [m] edge of a cell

    checks = (*_bounded("cells cells_y", 2048, "cells"),)

    def __post_init__(self) -> None:
        _expect(self.cells >= 8 and (self.cells_y == 0 or self.cells_y >= 8), "at least 8 cells", (self.cells, self.cells_y))
        _expect(0.001 <= self.resolution <= 1.0, "a resolution of 0.001 to 1 m", self.resolution)
        cells, most = self.cells * (self.cells_y or self.cells), topics.cells_that_fit(topics.TERRAIN)
        _expect(cells <= most, f"at most {most} cells in all, which a message of {topics.TERRAIN.key} has room for,", cells)

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

    checks = (*_bounded("at_s for_s at_spread_s", 1e6, "s"),)

    def __post_init__(self) -> None:
        _expect(self.at_s >= 0, "a time of at least 0 s", self.at_s)
        _expect(self.at_spread_s >= 0, "an at_spread_s of at least 0 s", self.at_spread_s)
        _expect(self.for_s > 0, "an outage longer than 0 s", self.for_s)
        kinds = get_args(CameraFaultKind) if self.of_camera else ("kill", "hang")
        _expect(self.kind in kinds, f"one of {', '.join(kinds)} for service = {self.service!r}", repr(self.kind))

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
        _expect(0.0 <= self.delay_ms <= 1000.0, "delay_ms from 0 to 1000", self.delay_ms)
        _expect(self.mbit == 0.0 or 0.1 <= self.mbit <= 1e5, "mbit of 0.1 or more, or 0 for no limit", self.mbit)
        _expect(0.0 <= self.loss <= 0.5, "a loss from 0 to 0.5", self.loss)

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
        _expect(self.extra_time_s >= 0, "an extra_time_s of at least 0 s", self.extra_time_s)


@dataclass(frozen=True, slots=True)
class Scenario:
    """One course, with the parameters to walk it."""

    name: str  # letters, digits, spaces and . _ + -; also names the folder of a run
    terrain: tuple[Terrain, ...]
    goal: Goal
    start: Start = field(default_factory=Start)
    robot: str = "phantomx_mk2"  # profile, by name or by the path of a TOML file
    # Profile of the simulated robot, if it is not `robot`: the robot's services then work with a profile of another robot, such
    # as a calibrated one. The deviations of `mismatch` are relative to it.
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
        *_bounded("battery_ah", 1e6, "A h"),
        *_bounded("time_limit_s", 86400, "s"),
        config.together("terrain", lambda parts: len(parts) <= 5000, "at most 5000 primitives"),
        config.together("movers", lambda movers: len(movers) <= 100, "at most 100 movers"),
    )

    def __post_init__(self) -> None:
        # The name is also the name of the run's folder.
        plain = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9 _.+-]*", self.name) is not None and ".." not in self.name
        _expect(len(self.name) <= 100, "a name of at most 100 characters", len(self.name))
        _expect(plain, "a name of letters, digits, spaces, dots, dashes, plus signs and underscores", repr(self.name))
        if not self.terrain:
            raise ValueError('at least one terrain primitive expected, found none; add [[terrain]] with kind = "plane"')
        _expect(self.time_limit_s > 0, "a time limit greater than 0 s", self.time_limit_s)
        _expect(self.battery_ah > 0, "a battery_ah greater than 0 A h", self.battery_ah)

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


def load_scenario(name_or_path: str) -> Scenario:
    """Read a bundled scenario by name, or another one by the path of its TOML file.

    The name of a trouble may follow: `steps+sun` is the scenario `steps` with the trouble `sun` added.

    Raises:
        ConfigError: The scenario does not exist, or is invalid; the text lists all errors.
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
    """Return the names of the bundled scenarios."""
    return _names("sextant.shared.scenario.scenarios")


def trouble_names() -> list[str]:
    """Return the names of the bundled troubles."""
    return _names("sextant.shared.scenario.troubles")


def load_trouble(name: str) -> Trouble:
    """Read a bundled trouble by its name.

    Raises:
        ConfigError: The trouble does not exist, or is invalid; the text lists all errors.
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
    if scenario.plugins != Plugins():
        words = "no [plugins] expected, because a scenario is data and a plug-in is code; name plug-ins on the command line"
        raise config.ConfigError(scenario.name, [words])
    return replace(scenario, folder=str(folder.resolve()))
