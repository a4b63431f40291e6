"""Interface of a foothold rule, which replaces the mapper's score."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class ElevationMap:
    """Ground around the robot; cell (i, j) is centred at origin + resolution * (i, j). The arrays are read-only.

    Attributes:
        elevation: (nx, ny) [m] {world}, NaN where never seen.
        variance: (nx, ny) [m^2] of elevation, NaN where never seen.
        origin: (2,) [m] {world} centre of cell (0, 0).
        resolution: [m] cell edge.
        foot_radius: [m] of the robot.
    """

    elevation: NDArray[np.float32]
    variance: NDArray[np.float32]
    origin: NDArray[np.float64]
    resolution: float
    foot_radius: float


class FootholdRule(Protocol):
    """A function that scores every cell of a map as a foothold."""

    def __call__(self, ground: ElevationMap, /) -> NDArray[np.floating]:
        """Return the score (nx, ny): 0 is best, above 1 is no foothold, NaN is unknown.

        It is called for each published map, some 15 times a second, and should take less than 50 ms. No margin is added for
        the uncertainty of map and pose; the parameters of `mapper.footholds` apply to Sextant's own score alone.
        """
        ...


def checked_score(score: object, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return the score of a rule as the map needs it.

    Raises:
        ValueError: It is not an array of numbers with the shape of the map.
    """
    if not isinstance(score, np.ndarray) or score.shape != shape or score.dtype.kind not in "fiu":
        found = f"{score.dtype} {score.shape}" if isinstance(score, np.ndarray) else type(score).__name__
        raise ValueError(f"a score as a float array {shape} expected, found {found}")
    return np.ascontiguousarray(score, dtype=np.float32)
