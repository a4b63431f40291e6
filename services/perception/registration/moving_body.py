"""Whether a motion is seen by one body alone: a person's legs or a trolley may move before a camera that stands still.

Over ground that shows no motion along itself, a camera that moves past one thing and a thing that moves before a camera look
alike. Between two poses, each point tells by how much better it fits one of them. Points that speak for a motion and lie all
within the size of one body are no evidence that the camera moves.
"""

import numpy as np
from numpy.typing import NDArray

_CELL_M = 0.15  # [m] edge of the squares in which the noise of points averages out
_WITHIN = 0.9  # share of what speaks for the motion that must lie within the body
_SIGMAS = 4.0  # of the noise of a square, from which it speaks for the motion
_SHARE_OF_VIEW = 0.5  # of the radius of what is in view, that a body may have at most
_MIN_GAIN = 20.0  # misfit below which nothing speaks for the motion


def is_one_body(xy: NDArray[np.float64], gains: NDArray[np.float64], radius: float) -> bool:
    """Whether all points that gain by a motion lie within a radius.

    Args:
        xy: (n, 2) [m] points in the plane of the ground.
        gains: (n,) by how much the misfit of each falls if the camera moved.
        radius: [m] of a body.
    """
    cells, index = np.unique(np.floor(xy / _CELL_M).astype(np.int64), axis=0, return_inverse=True)
    net, count = np.bincount(index.ravel(), gains).astype(np.float64), np.bincount(index.ravel())
    noise = 1.5 * float(np.median(np.abs(gains))) if len(gains) else 0.0
    speaks = net > _SIGMAS * np.sqrt(count) * noise
    if net[speaks].sum() < _MIN_GAIN:
        return False
    seen = float(
        np.percentile(np.linalg.norm(xy - np.median(xy, axis=0), axis=1), 90)
    )  # near by, all in view may be that small
    radius = min(radius, _SHARE_OF_VIEW * seen)
    return _is_within(np.asarray((cells[speaks] + 0.5) * _CELL_M, dtype=np.float64), net[speaks], radius)


def is_within_body(xy: NDArray[np.float64], radius: float) -> bool:
    """Whether points (n, 2) [m] in the plane of the ground lie within the radius [m] of one body, but for a few."""
    return bool(len(xy)) and _is_within(xy, np.ones(len(xy)), radius)


def _is_within(xy: NDArray[np.float64], weights: NDArray[np.float64], radius: float) -> bool:
    middle = np.array([_weighted_median(along, weights) for along in xy.T])
    near = np.linalg.norm(xy - middle, axis=1) <= radius
    return bool(weights[near].sum() >= _WITHIN * weights.sum())


def _weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, 0.5 * below[-1])])
