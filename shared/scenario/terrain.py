"""Schema of a scenario's terrain: solids on the ground, measured ground, and ground of another kind."""

import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from sextant.shared.files import config
from sextant.shared.files.config import bounded, expect
from sextant.shared.scenario.counts import BLOCK_COUNT, STEP_COUNT
from sextant.shared.scenario.course import Course
from sextant.shared.scenario.relief import Relief

Color = tuple[int, int, int]  # R, G, B from 0 to 255


@dataclass(frozen=True, slots=True)
class Plane:
    """Level ground everywhere."""

    kind: Literal["plane"] = "plane"
    height: float = 0.0  # [m] of the ground
    color: Color | None = None  # R, G, B from 0 to 255; by default the ground's usual colour

    lengths = "height"
    checks = (*bounded("height", 100, "m"),)


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

    lengths = "xy size top depth xy_spread size_spread top_spread"
    checks = (*bounded("xy size xy_spread size_spread", 1000, "m"), *bounded("top depth top_spread", 100, "m"))

    def __post_init__(self) -> None:
        least = min(*self.xy_spread, *self.size_spread, self.top_spread)
        expect(least >= 0, "spreads of at least 0 m", least)
        for size, spread in zip(self.size, self.size_spread, strict=True):
            expect(spread == 0 or spread < size, "a size_spread smaller than the size", spread)


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

    lengths = "xy size depth xy_spread size_spread"
    checks = (*bounded("xy size xy_spread size_spread", 1000, "m"), *bounded("depth", 100, "m"))

    def __post_init__(self) -> None:
        least = min(*self.xy_spread, *self.size_spread)
        expect(least >= 0, "spreads of at least 0 m", least)
        expect(min(*self.size, self.depth) > 0, "size and depth greater than 0 m", (*self.size, self.depth))
        for size, spread in zip(self.size, self.size_spread, strict=True):
            expect(spread < size, "a size_spread smaller than the size", spread)


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

    lengths = "xy riser tread width landing base depth riser_spread tread_spread"
    checks = (
        *STEP_COUNT,
        *bounded("xy width landing", 1000, "m"),
        *bounded("riser tread base depth riser_spread tread_spread", 100, "m"),
    )

    def __post_init__(self) -> None:
        expect(self.count >= 1, "a count of at least one step", self.count)
        expect(
            min(self.tread, self.width, self.landing) > 0,
            "tread, width and landing greater than 0 m",
            (self.tread, self.width, self.landing),
        )
        expect(0 <= self.riser_spread < abs(self.riser), "a riser_spread from 0 to less than the riser", self.riser_spread)
        expect(0 <= self.tread_spread < self.tread, "a tread_spread from 0 to less than the tread", self.tread_spread)


@dataclass(frozen=True, slots=True)
class Pillars:
    """Pillars at given positions, the only footholds where there is no other ground."""

    xy: tuple[tuple[float, float], ...]  # [m] centres
    size: float  # [m] edge of the square tops
    top: float  # [m] height of the tops
    kind: Literal["pillars"] = "pillars"
    length: float = 0.0  # [m] edge of the tops along x, before the turn; 0 for square tops
    depth: float = 0.5  # [m] extent downward from the top
    turn_deg: float = 0.0  # [deg] turn of all pillars together about the pivot, to the left
    pivot: tuple[float, float] = (0.0, 0.0)  # [m] point about which they turn
    color: Color | None = None  # R, G, B from 0 to 255; by default the ground's usual colour
    jitter: float = 0.0  # [m] maximum random displacement of each pillar along each axis, before the turn
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

    lengths = "xy size top length depth pivot jitter top_spread sinks bears_within tip_height"
    checks = (
        config.together("xy", lambda xy: len(xy) <= 5000, "at most 5000 pillars"),
        config.together("xy", lambda xy: all(max(map(abs, one)) <= 1000 for one in xy), "places within 1000 m"),
        config.together("pivot", lambda pivot: max(map(abs, pivot)) <= 1000, "a place within 1000 m"),
        *bounded("turn_deg", 360, "deg"),
        *bounded("size length jitter", 1000, "m"),
        *bounded("top depth top_spread sinks", 100, "m"),
        *bounded("bears", 1e6, "N"),
        *config.each("tip_mass", lambda mass: 0 < mass <= 1000, "more than 0 and at most 1000 kg"),
        *config.each("tip_deg", lambda angle: 0 < angle <= 90, "more than 0 and at most 90 deg"),
    )

    def __post_init__(self) -> None:
        expect(self.size > 0 and self.length >= 0, "a size greater than 0 m and a length", (self.size, self.length))
        least = min(self.jitter, self.top_spread)
        expect(least >= 0, "a jitter and a top_spread of at least 0 m", least)
        expect(0 <= self.weak <= len(self.xy), f"0 to {len(self.xy)} weak pillars, the number of pillars", self.weak)
        found = (self.bears, self.sinks)
        expect(self.bears >= 0 and 0 < self.sinks < self.depth, "bears of at least 0 N and sinks between 0 m and depth", found)
        rest = len(self.xy) - self.weak
        expect(0 <= self.tipping <= rest, f"0 to {rest} tipping pillars, the number of pillars that are not weak", self.tipping)
        if self.tipping:
            half = min(self.size, self.length or self.size) / 2
            expect(0 < self.bears_within < half, f"bears_within between 0 m and half the edge, {half:g} m", self.bears_within)
            expect(0 < self.tip_height < self.depth, "a tip_height between 0 m and depth", self.tip_height)


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

    lengths = "x y size top gap depth"
    checks = (*bounded("x y size gap", 1000, "m"), *bounded("top depth", 100, "m"))

    def __post_init__(self) -> None:
        low, high = self.density
        expect(0 <= low <= high <= 0.5, "densities in rising order from 0 to 0.5", self.density)
        expect(self.size > 0, "a size greater than 0 m", self.size)


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

    lengths = "xy length width landing base depth"
    checks = (*bounded("xy length width landing", 1000, "m"), *bounded("base depth", 100, "m"))


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

    lengths = "x y size top gap base"
    checks = (
        *BLOCK_COUNT,
        *bounded("x y size gap", 1000, "m"),
        *bounded("top base", 100, "m"),
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

    lengths = "resolution xy scale base"
    checks = (
        *config.each("xy", lambda one: one is None or abs(one) <= 1000, "-1000 to 1000 m"),
        *bounded("base", 100, "m"),
        *config.each("resolution", lambda edge: edge is None or 0.001 <= edge <= 10, "0.001 to 10 m"),
        *config.each("scale", lambda scale: scale is None or 0 < scale <= 1000, "more than 0 and at most 1000"),
    )

    def __post_init__(self) -> None:
        for name, taken in (("rows", self.rows), ("columns", self.columns)):
            expect(taken is None or 0 <= taken[0] < taken[1] - 1, f"{name} from 0 on, two at least", taken)
        for name in ("resolution", "xy"):
            if not self.is_grid_map:
                expect(getattr(self, name) is not None, f"{name} of the map", "none")
        if self.is_grid_map and self.xy is None:
            moved = self.rows is not None or self.columns is not None or self.quarter_turns % 4 != 0
            expect(not moved, "xy of the cropped or rotated map", "none")

    @property
    def is_grid_map(self) -> bool:
        """Whether the file is a recording with a grid map."""
        return self.file.lower().endswith(".mcap")

    def with_scale(self) -> "HeightMap":
        """Return the map with its default scale stated.

        Raises:
            ValueError: The file states resolution or place, so they are not known here.
        """
        expect(self.resolution is not None and self.xy is not None, f"resolution and xy of the map in {self.file}", "none")
        return self if self.scale is not None or self.file.lower().endswith(".png") else replace(self, scale=1.0)

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

    lengths = "xy size depth"
    checks = (*bounded("xy size", 1000, "m"), *bounded("depth", 100, "m"))


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

    lengths = "x y size gap depth"
    checks = (*BLOCK_COUNT, *bounded("x y size gap", 1000, "m"), *bounded("depth", 100, "m"))


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

    lengths = "x y size"
    checks = (
        *BLOCK_COUNT,
        *bounded("x y size", 1000, "m"),
        *config.each("frictions", lambda friction: 0.05 <= friction <= 2, "0.05 to 2"),
    )

    def __post_init__(self) -> None:
        expect(len(self.frictions) > 0, "at least one friction", "none")
        for name in ("x", "y", "size"):
            low, high = getattr(self, name)
            expect(low <= high, f"{name} in rising order", (low, high))
        expect(self.size[0] > 0, "a size greater than 0 m", self.size)


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
# Kinds that stand on the ground or are sunk into it: the report tells touchdowns on them from those on the ground.
ON_GROUND = (Box, Hole, Rubble, Pillars, PillarField, Puddle, Puddles)
