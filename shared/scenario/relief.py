"""Relief: ground whose height follows a formula, as a height field."""

from dataclasses import dataclass
from typing import Literal

from sextant.shared.files import config

_MOST_POINTS = 1_000_000  # of a height field


@dataclass(frozen=True, slots=True)
class Relief:
    """Waves, ridges, random roughness or a cross-slope, in a region.

    The shape grows from level ground: from `begin` over a stretch of `blend`. The run's seed draws the phases of the waves, and
    all of the roughness. It may be lower than `base`: a plane in the scenario must then be lower still, or absent.
    """

    x: tuple[float, float]  # [m] region along x, lowest and highest
    y: tuple[float, float]  # [m] region along y, lowest and highest
    # level; washboard: a sine along x; sine: a sine along x times one along y; ridges: triangles along x, with sharp crests;
    # fractal: random, with a spectrum that falls by a power law
    shape: Literal["level", "washboard", "sine", "ridges", "fractal"] = "level"
    kind: Literal["relief"] = "relief"
    amplitude: float = 0.0  # [m] half of the height from valley to crest; of a fractal its standard deviation
    wavelength: float = 0.2  # [m] from crest to crest; of a fractal the longest
    hurst: float = 0.8  # [1] Hurst exponent of a fractal: near 0 for spiky ground, near 1 for smooth ground
    cross_slope_deg: float = 0.0  # [deg] inclination across the way, added to the shape: the left side is higher
    begin: float = 0.6  # [m] x at which the level ground ends
    blend: float = 0.3  # [m] length over which the shape grows to its full size
    resolution: float = 0.02  # [m] cell edge
    base: float = 0.0  # [m] height of the level ground
    color: tuple[int, int, int] | None = None  # R, G, B from 0 to 255; by default the ground's usual colour

    lengths = "x y amplitude wavelength begin blend resolution base"
    checks = (
        *config.each("x y begin blend", lambda one: abs(one) <= 1000, "-1000 to 1000 m"),
        *config.each("amplitude", lambda one: 0 <= one <= 10, "0 to 10 m"),
        *config.each("wavelength", lambda one: 0.01 <= one <= 1000, "0.01 to 1000 m"),
        *config.each("hurst", lambda one: 0 < one <= 1, "more than 0 and at most 1"),
        *config.each("cross_slope_deg", lambda one: abs(one) <= 60, "-60 to 60 deg"),
        *config.each("resolution", lambda one: 0.002 <= one <= 1, "0.002 to 1 m"),
        *config.each("base", lambda one: abs(one) <= 100, "-100 to 100 m"),
    )

    def __post_init__(self) -> None:
        for name, bounds in (("x", self.x), ("y", self.y)):
            if bounds[1] - bounds[0] < 2 * self.resolution:
                raise ValueError(f"{name} in rising order, two cells at least, expected, found {bounds}")
        points = (self.x[1] - self.x[0]) * (self.y[1] - self.y[0]) / self.resolution**2
        if points > _MOST_POINTS:
            raise ValueError(f"at most {_MOST_POINTS} points expected, found {points:.0f}; choose a larger resolution")
        if self.blend < 0:
            raise ValueError(f"a blend of at least 0 m expected, found {self.blend}")
