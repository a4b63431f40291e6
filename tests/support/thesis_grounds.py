"""The grounds of the theses' tests as height maps, for the scenarios `lotriet_*`.

The figures are missing: sizes are chosen, the layout follows the text. The pictures are 16-bit grey with 0.1 mm per step, from
`BASE` up. Run as a script, this module writes them again.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array

STEP = 0.02  # [m] grid
ORIGIN = (-0.8, -1.2)  # [m] of grid point (0, 0)
SHAPE = (201, 121)
SCALE = 1e-4  # [m] per grey step
BASE = -0.1  # [m]

# Lotriet 2024, section 6.5: top is ahead, left is left.
PILLAR, PEDESTAL, HOLE = (2.2, 0.46), (1.6, -0.46), (1.0, 0.46)  # [m] centres
PILLAR_TOP, PEDESTAL_TOP, HOLE_BOTTOM = 0.08, 0.06, -0.05  # [m]
FLAT = 0.08  # [m] radius of the level surface of each
_SIDE = np.tan(np.radians(60.0))  # slope of the sides, steeper than either thesis stands on

# Section 4.6: the piggybank and the stone; boxes and the wedge are primitives of the scenario.
PIG = (1.0, 0.48)
STONE = (2.1, -0.50)


def _grid() -> tuple[Array, Array]:
    x, y = (ORIGIN[k] + STEP * np.arange(SHAPE[k]) for k in (0, 1))
    return tuple(np.meshgrid(x, y, indexing="ij"))  # type: ignore[return-value]


def scoring() -> Array:
    """Heights of a sloped pillar, a round pedestal and a sloped hole (201, 121) [m].

    They lie in level ground.
    """
    x, y = _grid()
    z = np.zeros(SHAPE)
    square = np.maximum(np.abs(x - PILLAR[0]), np.abs(y - PILLAR[1]))
    z = np.maximum(z, np.minimum(PILLAR_TOP, PILLAR_TOP - _SIDE * (square - FLAT)))
    z = np.maximum(z, np.minimum(PEDESTAL_TOP, PEDESTAL_TOP - _SIDE * (np.hypot(x - PEDESTAL[0], y - PEDESTAL[1]) - FLAT)))
    deep = HOLE_BOTTOM + np.maximum(0.0, _SIDE * (np.hypot(x - HOLE[0], y - HOLE[1]) - FLAT))
    return np.asarray(np.where(deep < 0, deep, z))


def walk_past() -> Array:
    """Heights of a nearly round piggybank and an irregular stone (201, 121) [m].

    They lie on level ground.
    """
    x, y = _grid()
    pig = 1.0 - ((x - PIG[0]) / 0.14) ** 2 - ((y - PIG[1]) / 0.11) ** 2
    u, v = x - STONE[0], y - STONE[1]
    bumps = 0.5 + 0.3 * np.cos(40 * u + 1.0) * np.cos(31 * v) + 0.2 * np.cos(57 * u - 23 * v)
    stone = 0.12 * bumps * np.clip(1.5 - np.hypot(u / 0.16, v / 0.12) * 1.5, 0.0, 1.0)
    return np.asarray(np.maximum(0.13 * np.sqrt(np.maximum(pig, 0.0)), stone))


GROUNDS: Mapping[str, Callable[[], Array]] = {"lotriet_scoring": scoring, "lotriet_walk_past": walk_past}


def grey(heights: Array) -> NDArray[np.uint16]:
    """Heights as a picture's grey values."""
    return np.rint((heights - BASE) / SCALE).astype(np.uint16)


if __name__ == "__main__":
    folder = Path(__file__).parents[2] / "shared/scenario/scenarios"
    for name, ground in GROUNDS.items():
        cv2.imwrite(str(folder / f"{name}.png"), grey(ground()))
