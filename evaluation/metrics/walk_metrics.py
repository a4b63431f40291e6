"""Metrics of a walk from ground truth: touchdowns, slip, stability, footholds.

Functions take and return arrays with one row per sample.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array

Flags = NDArray[np.bool_]
HeightAt = Callable[[Array], Array]  # (n, 2) [m] -> (n,) [m]

_DISC_RADIUS = 0.010  # [m] radius around the foot's centre in which it may come to stand
_DISC_RANGE = 0.008  # [m] maximum height range in that disc
_PLANE_MISFIT = 0.002  # [m] or the maximum distance of its heights from a plane,
_HIGHER = 0.065  # [m] above a foot's underside: higher ground next to it is an obstacle and not a step
_TOUCHING = 0.003  # [m] distance between a foot and an obstacle at which they touch
_LOWER = 0.08  # [m] below the other feet, a foot hangs in a hole,
_DEEP = 0.20  # [m] if the ground under it is also this far below them: stairs and pillars carry feet lower than _LOWER
_MAX_SLOPE = np.tan(np.radians(35.0))  # which is no steeper than this


def runs(flags: Flags) -> NDArray[np.intp]:
    """Return first and one past the last sample (k, 2) of each run of True (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2)


def debounced(contact: Flags, samples: int) -> Flags:
    """Remove gaps, then touches, of at most `samples` samples from contact (n, k)."""
    out = contact.copy()
    for column in out.T:
        for begin, end in runs(~column):
            if end - begin <= samples and begin > 0 and end < len(column):
                column[begin:end] = True
        for begin, end in runs(column):
            if end - begin <= samples and begin > 0 and end < len(column):
                column[begin:end] = False
    return out


def touchdowns(contact: Flags, swing: Flags) -> NDArray[np.intp]:
    """Return sample and leg (k, 2) of each touchdown, in order of time.

    A swing has one touchdown: the start of the contact that lasts beyond the swing's planned end. A foot that touches during
    the swing has not landed yet, and one that never lifted off does not land.

    Args:
        contact: (n, legs) debounced contact.
        swing: (n, legs) legs in the air by plan.
    """
    found: list[tuple[int, int]] = []
    for leg in range(contact.shape[1]):
        touches = runs(contact[:, leg])
        swings = runs(swing[:, leg])
        following = np.append(swings[1:, 0], len(contact))[: len(swings)]
        for (begin, end), next_begin in zip(swings, following, strict=True):
            after = touches[touches[:, 1] > end]
            if len(after) and begin < after[0, 0] < next_begin:
                found.append((int(after[0, 0]), leg))
    return np.array(sorted(found), dtype=np.intp).reshape(-1, 2)


def stability_margin(feet: Array, carrying: Flags, centre: Array) -> Array:
    """Return the stability margin (n,) [m], negative outside the support polygon.

    It is the distance of the projected centre of mass to the nearest edge of the polygon. With two feet it is minus the
    distance to the line through them, with one foot minus the distance to it; NaN without feet.

    Args:
        feet: (n, legs, 2) [m] foot centres on the ground plane.
        carrying: (n, legs) feet that span the polygon.
        centre: (n, 2) [m] centre of mass on the same plane.
    """
    legs = feet.shape[1]
    first, second = np.nonzero(~np.eye(legs, dtype=bool))
    edge = feet[:, second] - feet[:, first]  # (n, pairs, 2)
    length = np.linalg.norm(edge, axis=-1)
    normal = np.stack([-edge[..., 1], edge[..., 0]], axis=-1) / np.maximum(length, 1e-12)[..., None]  # to the left
    of_body = np.einsum("npk,npk->np", normal, centre[:, None] - feet[:, first])
    is_edge = carrying[:, first] & carrying[:, second] & (length > 1e-9)
    for leg in range(legs):  # all carrying feet are to the left of an edge of the hull
        of_foot = np.einsum("npk,npk->np", normal, feet[:, None, leg] - feet[:, first])
        is_edge &= ~carrying[:, None, leg] | (of_foot > -1e-9)
    margin = np.where(is_edge, of_body, np.inf).min(axis=1)
    count = carrying.sum(axis=1)
    alone = -np.linalg.norm(np.where(carrying[..., None], feet - centre[:, None], 0.0), axis=-1).sum(axis=1)
    return np.where(count >= 2, margin, np.where(count == 1, alone, np.nan))


def rubbing(feet: Array, shanks: Array, radius: float) -> Array:
    """Return the path (n, legs, 2) [m] of spherical feet without their rolling.

    Standing feet that only roll stay in place.

    Args:
        feet: (n, legs, 2) [m] centres of the feet.
        shanks: (n, legs, 3) unit vectors from there up the shanks, which turn little between samples.
        radius: [m] of the feet.
    """
    before, after = shanks[:-1], shanks[1:]
    # The cross product is the rotation vector of a small turn, without spin about the shank; turn x up is the displacement.
    rolled = radius * (before[..., 2:] * after[..., :2] - before[..., :2] * after[..., 2:])
    return np.asarray(feet - np.concatenate([np.zeros_like(feet[:1]), np.cumsum(rolled, axis=0)]))


def slip_per_step(feet: Array, planted: Flags, step: NDArray[np.int64]) -> Array:
    """Return how far (m,) [m] feet moved over the ground while planted.

    There is one value for each leg and step in which it was planted.

    Args:
        feet: (n, legs, 2) [m] foot centres, without their rolling.
        planted: (n, legs) in contact and in stance by plan.
        step: (n,) number of the current step.
    """
    if len(feet) < 2:
        return np.zeros(0)
    both = planted[1:] & planted[:-1] & (step[1:] == step[:-1])[:, None]
    motion = np.where(both[..., None], feet[1:] - feet[:-1], 0.0)
    numbers, of_step = np.unique(step[1:], return_inverse=True)
    total = np.zeros((len(numbers), feet.shape[1], 2))
    samples = np.zeros((len(numbers), feet.shape[1]), dtype=np.int64)
    np.add.at(total, of_step, motion)
    np.add.at(samples, of_step, both)
    return np.asarray(np.linalg.norm(total, axis=-1)[samples > 0])


def in_the_way(height_at: HeightAt, feet: Array, bodies: Array, radius: float, size: tuple[float, float, float]) -> Flags:
    """Return the feet, then the body, (n, 7) in collision.

    A foot collides with an obstacle higher than a step next to it, or hangs in a hole. The body collides where it
    intersects the ground.

    Args:
        height_at: The true ground.
        feet: (n, 6, 3) [m] foot centres.
        bodies: (n, 4, 4) poses of the body.
        radius: [m] of the feet.
        size: [m] of the body.
    """
    angle = np.arange(8) * np.pi / 4
    ring = (radius + _TOUCHING) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    around = feet[..., None, :2] + ring
    ground = height_at(around.reshape(-1, 2)).reshape(around.shape[:-1])
    underside = feet[..., 2] - radius
    beside = np.asarray(ground > underside[..., None] + _HIGHER).any(axis=2)
    others = np.median(underside, axis=1, keepdims=True)
    under_foot = height_at(feet[..., :2].reshape(-1, 2)).reshape(underside.shape)
    hangs = (underside < others - _LOWER) & (under_foot < others - _DEEP)
    half = np.array(size) / 2
    edge = np.array([(x, y, -1.0) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]) * half
    corners = edge @ bodies[:, :3, :3].transpose(0, 2, 1) + bodies[:, None, :3, 3]
    under = height_at(corners[..., :2].reshape(-1, 2)).reshape(corners.shape[:2])
    bumped = np.asarray(under > corners[..., 2]).any(axis=1)
    return np.column_stack([beside | hangs, bumped])


def angle_between(a: Array, b: Array) -> Array:
    """Return the angle (n,) [rad] between unit vectors (n, 3)."""
    return np.asarray(2.0 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=-1) / 2.0, 0.0, 1.0)))


def is_foothold(height_at: HeightAt, xy: Array) -> Flags:
    """Return whether the true ground supports a foot at each of (n, 2) [m]: (n,).

    The heights within 1 cm differ by at most 8 mm, or lie on a plane no steeper than 35 deg.
    """
    disc = _disc()
    points = xy[:, None] + disc
    z = height_at(points.reshape(-1, 2)).reshape(len(xy), len(disc))
    ground = np.asarray(np.isfinite(z).all(axis=1))
    z = np.where(ground[:, None], z, 0.0)
    z = z - z.mean(axis=1, keepdims=True)
    slope = z @ np.linalg.pinv(disc).T  # the disc's mean is zero, so the fit needs no constant
    misfit = np.abs(z - slope @ disc.T).max(axis=1)
    planar = (misfit <= _PLANE_MISFIT) & (np.hypot(slope[:, 0], slope[:, 1]) <= _MAX_SLOPE)
    return np.asarray(ground & ((np.ptp(z, axis=1) <= _DISC_RANGE) | planar))


def _disc() -> Array:
    """Return points (25, 2) [m] that cover the disc: its centre and three rings."""
    rings = [(0.0, 1), (1.0 / 3.0, 4), (2.0 / 3.0, 8), (1.0, 12)]
    polar = [(r * _DISC_RADIUS, 2.0 * np.pi * k / n) for r, n in rings for k in range(n)]
    return np.array([(r * np.cos(a), r * np.sin(a)) for r, a in polar])
