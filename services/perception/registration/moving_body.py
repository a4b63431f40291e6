"""Detection of a single body that moves in front of a resting camera.

Such a body may be a person's leg or a trolley. Flat ground does not show motion along itself. There, a camera moving past one
object and an object moving in front of the camera look alike. The gain of a point is the decrease of its misfit from one pose
to the other. If all points with a gain lie within the size of one body, they are no evidence that the camera moves.
"""

import numpy as np
from numpy.typing import NDArray

_CELL_M = 0.15  # [m] edge of the squares that average the noise of points
_INSIDE_SHARE = 0.9  # share of the total gain that must lie within the body
_SIGMAS = 4.0  # times the noise of a square, above which its gain is significant
_MAX_VIEW_SHARE = 0.5  # largest radius of a body, relative to the radius of the visible area
_MIN_GAIN = 20.0  # total gain below which there is no motion


def is_one_body(xy: NDArray[np.float64], gains: NDArray[np.float64], radius: float) -> bool:
    """Return whether all points that support a motion lie within a radius.

    Args:
        xy: (n, 2) [m] points in the plane of the ground.
        gains: (n,) decrease of each point's misfit if the camera moved.
        radius: [m] of a body.
    """
    if not len(gains):
        return False
    squares = np.floor(xy / _CELL_M)
    first = squares.min(axis=0)
    columns = int(squares[:, 1].max() - first[1]) + 1
    index = ((squares[:, 0] - first[0]) * columns + squares[:, 1] - first[1]).astype(np.int64)
    net, count = np.bincount(index, gains).astype(np.float64), np.bincount(index)
    speaks = net > _SIGMAS * 1.5 * float(np.median(np.abs(gains))) * np.sqrt(count)
    if net[speaks].sum() < _MIN_GAIN:
        return False
    middles = (first + np.column_stack(np.divmod(np.flatnonzero(speaks), columns)) + 0.5) * _CELL_M
    seen = float(
        np.percentile(np.linalg.norm(xy - np.median(xy, axis=0), axis=1), 90)
    )  # at short range, the visible area itself may be this small
    radius = min(radius, _MAX_VIEW_SHARE * seen)
    return _is_within(np.asarray(middles, dtype=np.float64), net[speaks], radius)


def is_within_body(xy: NDArray[np.float64], radius: float) -> bool:
    """Return whether nearly all ground points (n, 2) [m] lie within a radius [m]."""
    return bool(len(xy)) and _is_within(xy, np.ones(len(xy)), radius)


def _is_within(xy: NDArray[np.float64], weights: NDArray[np.float64], radius: float) -> bool:
    middle = np.array([_weighted_median(along, weights) for along in xy.T])
    near = np.linalg.norm(xy - middle, axis=1) <= radius
    return bool(weights[near].sum() >= _INSIDE_SHARE * weights.sum())


def _weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, 0.5 * below[-1])])
