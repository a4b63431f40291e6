"""Height map of worn stairs, for the scenario `worn_stairs`. Run as a script, this module writes it again.

Three stone steps, skewed to the course. The nosings are chipped and rounded, the treads are worn where people walk, and the
stone is rough. The picture is 16-bit grey.
"""

from pathlib import Path

import cv2
import numpy as np

from sextant.shared.geometry import Array

STEP = 0.02  # [m] grid
ORIGIN = (0.70, -0.60)  # [m] of grid point (0, 0); rows run along x
SHAPE = (45, 61)
SCALE, BASE = 1e-4, -0.02  # [m] per grey step, and of grey 0
FILE = Path(__file__).parents[2] / "shared/scenario/scenarios/worn_stairs.png"

NOSINGS = (0.86, 1.15, 1.44)  # [m] along x, in the middle
RISES = (0.044, 0.048, 0.046)  # [m]
SKEW = 0.09  # [1] offset of a nosing along x per metre along y
_ROUND = 0.012  # [m] half of the length over which a nosing is rounded
_WEAR = 0.004  # [m] at a nosing in the middle, less towards the back and the sides
_WORN = 0.22  # [m] half width of the worn strip
_CHIP = 0.006  # [m] standard deviation of a nosing's line
_ROUGH = 0.0008  # [m] standard deviation of the stone's height


def heights() -> Array:
    """Return the heights (45, 61) [m]; the same at each call."""
    rng = np.random.default_rng(5)
    x, y = (ORIGIN[k] + STEP * np.arange(SHAPE[k]) for k in (0, 1))
    z = _ROUGH * _smooth(rng.standard_normal(SHAPE), 2.0)
    for nosing, rise in zip(NOSINGS, RISES, strict=True):
        line = nosing + SKEW * y + _CHIP * _smooth(rng.standard_normal((1, SHAPE[1])), 2.0)[0]
        beyond = x[:, None] - line
        edge = np.clip((beyond + _ROUND) / (2 * _ROUND), 0.0, 1.0)
        worn = _WEAR * np.exp(-((y / _WORN) ** 2)) * np.clip(1.0 - beyond / 0.25, 0.0, 1.0)
        z += edge * edge * (3.0 - 2.0 * edge) * (rise - worn * (beyond < 0.25))
    return np.asarray(z)


def _smooth(noise: Array, cells: float) -> Array:
    """Return smoothed noise of standard deviation 1."""
    smooth = cv2.GaussianBlur(noise, (0, 0), cells)
    return np.asarray(smooth / smooth.std())


def picture() -> Array:
    """Return the heights as grey values (45, 61)."""
    return np.asarray(np.rint((heights() - BASE) / SCALE).astype(np.uint16))


if __name__ == "__main__":
    cv2.imwrite(str(FILE), picture())
