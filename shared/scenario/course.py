"""Schema of a course: stretches of ground end to end."""

from dataclasses import dataclass
from typing import Literal

from sextant.shared.files import config
from sextant.shared.files.config import bounded, expect
from sextant.shared.scenario.counts import BLOCK_COUNT, STEP_COUNT


@dataclass(frozen=True, slots=True)
class Level:
    """Stretch of level ground."""

    length: float  # [m] along the course
    kind: Literal["level"] = "level"

    lengths = "length"
    checks = (*bounded("length", 1000, "m"),)

    def __post_init__(self) -> None:
        expect(self.length > 0, "a length greater than 0 m", self.length)


@dataclass(frozen=True, slots=True)
class Ramp:
    """Stretch with a constant slope, downward for a negative angle."""

    length: float  # [m] horizontal
    angle_deg: float  # [deg] above the horizontal
    kind: Literal["ramp"] = "ramp"
    angle_spread_deg: float = 0.0  # [deg] maximum random offset of the angle, of either sign

    lengths = "length"
    checks = (*bounded("length", 1000, "m"),)

    def __post_init__(self) -> None:
        expect(self.length > 0, "a length greater than 0 m", self.length)
        spread, angle = self.angle_spread_deg, abs(self.angle_deg)
        expect(0 <= spread < angle, "an angle_spread_deg from 0 to less than the angle", spread)
        expect(angle + spread < 80, "an angle of less than 80 deg", self.angle_deg)


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

    lengths = "riser tread riser_spread tread_spread"
    checks = (*STEP_COUNT, *bounded("riser tread riser_spread tread_spread", 100, "m"))

    def __post_init__(self) -> None:
        expect(self.count >= 1, "a count of at least one step", self.count)
        expect(self.tread > 0, "a tread greater than 0 m", self.tread)
        expect(0 <= self.riser_spread < abs(self.riser), "a riser_spread from 0 to less than the riser", self.riser_spread)
        expect(0 <= self.tread_spread < self.tread, "a tread_spread from 0 to less than the tread", self.tread_spread)


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

    lengths = "length size top gap"
    checks = (
        *BLOCK_COUNT,
        *bounded("length size gap", 1000, "m"),
        *bounded("top", 100, "m"),
        *config.each("yaw_deg", lambda yaw: 0 <= yaw <= 180, "0 to 180 deg"),
    )

    def __post_init__(self) -> None:
        expect(self.length > 0, "a length greater than 0 m", self.length)


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

    lengths = "length size gap jitter top"
    checks = (*bounded("length size gap jitter", 1000, "m"), *bounded("top", 100, "m"))

    def __post_init__(self) -> None:
        expect(self.size > 0, "a size greater than 0 m", self.size)
        expect(0 <= 2 * self.jitter <= self.gap, "a jitter of at most half the gap", self.jitter)
        expect(self.top[0] <= self.top[1], "a top in rising order", self.top)
        expect(self.rows >= 1, f"a length of at least {self.size + 2 * self.gap:g} m, for one row", self.length)

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

    lengths = "length spread"
    checks = (*bounded("length spread", 1000, "m"),)

    def __post_init__(self) -> None:
        expect(0 <= self.spread < self.length, "a spread from 0 to less than the length", self.spread)


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
    color: tuple[int, int, int] | None = None  # R, G, B from 0 to 255; by default the ground's usual colour

    lengths = "width x bottom rest"
    checks = (*bounded("width x rest", 1000, "m"), *bounded("bottom", 100, "m"))

    def __post_init__(self) -> None:
        expect(self.width > 0, "a width greater than 0 m", self.width)
        expect(self.rest >= 0, "a rest of at least 0 m", self.rest)
        if not self.stretches:
            raise ValueError('at least one stretch expected, found none; add [[terrain.stretches]] with kind = "level"')
