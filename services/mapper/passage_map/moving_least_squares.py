"""Moving least squares: project each point onto the plane of its neighbours.

The plane also gives the normal. Masri 2016 (section 4.3) applies it to the voxels of the merged cloud, against camera noise.
A plane is enough instead of a paraboloid, because a foot stands on a patch no wider than the neighbourhood. The neighbours lie
within a ball, so a surface that is farther away than its radius, such as the ground below a pillar, has no effect.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sextant.services.mapper.elevation.validated_scan import MAX_COORDINATE_M
from sextant.shared.geometry import Array
from sextant.shared.runtime.compiled import compiled

_FEWEST = 5  # minimum number of neighbours for a plane, including the point
_FLAT = 1e-3  # [1] of the largest spread; points whose second spread is smaller form a line
_EVEN = 0.2  # times `edge`; if points deviate less than this from their plane, all belong to one surface
_ROOT, _ROOT_STEPS = 1e-15, 40  # tolerance and maximum steps of the search for the least spread


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Points projected onto the surface that they sample."""

    points: Array  # (n, 3) [m] on the surface; unchanged where there is no normal
    normals: Array  # (n, 3) unit, upward; NaN if there are too few neighbours, or all are on a line
    roughness: Array  # (n,) [m] root mean square distance of the neighbours from the plane, NaN without a normal


def smooth(points: ArrayLike, weight: ArrayLike, radius: float = 0.025, *, edge: float = 0.006, passes: int = 2) -> Surface:
    """Fit a plane around every point and project the point onto it.

    1. Neighbours are the points within `radius`. A neighbour at distance d has its own weight times
       exp(-(2 d / radius)^2).
    2. The plane contains their weighted mean, and its normal is the direction of their least spread.
    3. Unless the neighbours are even, the fit is repeated. A neighbour at distance e from the plane then has its weight
       multiplied by 1 / (1 + (e / edge)^2)^2 (Geman and McClure). At the border of two surfaces, the point's own one prevails.

    Args:
        points: (n, 3) [m].
        weight: (n,) weights of the points, positive.
        radius: [m] of the neighbourhood.
        edge: [m] distance from the plane, from which a neighbour belongs to another surface.
        passes: Number of fits, of which the first is not robust.

    Raises:
        ValueError: A shape is wrong, or a value is not finite or out of its range.

    Source: Masri 2016, section 4.3; Alexa et al. 2003, "Computing and rendering point set surfaces". The plane is given by
    the neighbours' principal axes, as in the Point Cloud Library.
    """
    p = np.ascontiguousarray(points, dtype=np.float64)
    w = np.ascontiguousarray(weight, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 3 or w.shape != (len(p),):
        raise ValueError(f"points (n, 3) and weights (n,) expected, found {p.shape} and {w.shape}")
    if not (np.abs(p) < MAX_COORDINATE_M).all() or not ((w > 0) & (w < math.inf)).all():
        raise ValueError(f"points within {MAX_COORDINATE_M:g} m and positive weights expected, found some that are not")
    if not (1e-3 <= radius < math.inf and edge > 0 and passes >= 1):
        raise ValueError(
            f"a radius of at least 1 mm, a positive edge and one pass or more expected, found {radius}, {edge}, {passes}"
        )
    if not len(p):
        return Surface(p.copy(), np.empty((0, 3)), np.empty(0))
    # With points sorted by columns of one radius, the nine columns around a point are three runs of the list.
    cell = np.floor(p[:, :2] / radius).astype(np.int64)
    cell -= cell.min(axis=0) - 1
    across = int(cell[:, 1].max()) + 2
    key = cell[:, 0] * across + cell[:, 1]
    order = np.argsort(key, kind="stable")
    sorted_key = key[order]
    columns, first = np.unique(sorted_key, return_index=True)
    runs = np.empty((len(columns), 3, 2), dtype=np.int64)
    for k in range(3):
        middle = columns + (k - 1) * across
        runs[:, k, 0] = np.searchsorted(sorted_key, middle - 1, side="left")
        runs[:, k, 1] = np.searchsorted(sorted_key, middle + 1, side="right")
    p, w = p[order], w[order]
    n = len(p)
    out, normals, roughness = np.empty((n, 3)), np.empty((n, 3)), np.empty(n)
    _fit(p, w, np.append(first, n), runs, radius, edge, passes, out, normals, roughness)
    back = np.empty(n, dtype=np.int64)
    back[order] = np.arange(n)
    return Surface(out[back], normals[back], roughness[back])


@compiled
def _fit(
    p: Array,
    w: Array,
    first: NDArray[np.int64],
    runs: NDArray[np.int64],
    radius: float,
    edge: float,
    passes: int,
    out: Array,
    normals: Array,
    roughness: Array,
) -> None:
    """Fit planes around points sorted by column.

    Column c contains points first[c] to first[c + 1].
    """
    near, share = np.empty(len(p), dtype=np.int64), np.empty(len(p))
    gauss = 4.0 / (radius * radius)
    for column in range(len(first) - 1):
        for q in range(first[column], first[column + 1]):
            out[q, 0], out[q, 1], out[q, 2] = p[q, 0], p[q, 1], p[q, 2]
            normals[q, 0] = normals[q, 1] = normals[q, 2] = roughness[q] = np.nan
            # 1. Neighbours with weights by distance; mean and spread relative to the point, to avoid cancellation.
            m = 0
            total = sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
            for run in range(3):
                for k in range(runs[column, run, 0], runs[column, run, 1]):
                    dx, dy, dz = p[k, 0] - p[q, 0], p[k, 1] - p[q, 1], p[k, 2] - p[q, 2]
                    d2 = dx * dx + dy * dy + dz * dz
                    if d2 > radius * radius:
                        continue
                    s = w[k] * math.exp(-gauss * d2)
                    near[m], share[m] = k, s
                    m += 1
                    total += s
                    sx, sy, sz = sx + s * dx, sy + s * dy, sz + s * dz
                    xx, xy, xz = xx + s * dx * dx, xy + s * dx * dy, xz + s * dx * dz
                    yy, yz, zz = yy + s * dy * dy, yz + s * dy * dz, zz + s * dz * dz
            if m < _FEWEST:
                continue
            # 2. The plane.
            cx, cy, cz = sx / total, sy / total, sz / total
            nx, ny, nz, off2 = _least_spread(
                xx / total - cx * cx, xy / total - cx * cy, xz / total - cx * cz,
                yy / total - cy * cy, yz / total - cy * cz, zz / total - cz * cz,
            )  # fmt: skip
            if math.isnan(nx):
                continue
            # 3. Repeat the fit if points deviate from the plane.
            if off2 > _EVEN * _EVEN * edge * edge:
                for _ in range(1, passes):
                    total = sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
                    for a in range(m):
                        k = near[a]
                        dx, dy, dz = p[k, 0] - p[q, 0], p[k, 1] - p[q, 1], p[k, 2] - p[q, 2]
                        e = (nx * (dx - cx) + ny * (dy - cy) + nz * (dz - cz)) / edge
                        e = 1.0 + e * e
                        s = share[a] / (e * e)
                        total += s
                        sx, sy, sz = sx + s * dx, sy + s * dy, sz + s * dz
                        xx, xy, xz = xx + s * dx * dx, xy + s * dx * dy, xz + s * dx * dz
                        yy, yz, zz = yy + s * dy * dy, yz + s * dy * dz, zz + s * dz * dz
                    mx, my, mz = sx / total, sy / total, sz / total
                    ux, uy, uz, _ = _least_spread(
                        xx / total - mx * mx, xy / total - mx * my, xz / total - mx * mz,
                        yy / total - my * my, yz / total - my * mz, zz / total - mz * mz,
                    )  # fmt: skip
                    if math.isnan(ux):
                        break
                    cx, cy, cz, nx, ny, nz = mx, my, mz, ux, uy, uz
                total = off2 = 0.0
                for a in range(m):
                    k = near[a]
                    e = nx * (p[k, 0] - p[q, 0] - cx) + ny * (p[k, 1] - p[q, 1] - cy) + nz * (p[k, 2] - p[q, 2] - cz)
                    total += share[a]
                    off2 += share[a] * e * e
                off2 /= total
            up = 1.0 if nz >= 0.0 else -1.0
            nx, ny, nz = up * nx, up * ny, up * nz
            off = nx * cx + ny * cy + nz * cz
            out[q, 0] += off * nx
            out[q, 1] += off * ny
            out[q, 2] += off * nz
            normals[q, 0], normals[q, 1], normals[q, 2] = nx, ny, nz
            roughness[q] = math.sqrt(off2)


@compiled
def _least_spread(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> tuple[float, float, float, float]:
    """Return the least eigenvalue's unit eigenvector of a covariance, and the value.

    They are NaN if the points form a line or a single place.
    """
    trace = xx + yy + zz
    minors = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    if not minors > _FLAT * trace * trace:
        return np.nan, np.nan, np.nan, np.nan
    # Newton's method from below the least root of the characteristic polynomial. It is convex there, so there is no overshoot.
    least = 0.0
    for _ in range(_ROOT_STEPS):
        value = determinant - least * (minors - least * (trace - least))
        slope = minors - least * (2.0 * trace - 3.0 * least)
        if not (value > _ROOT * trace * minors and slope > 0.0):
            break
        least += value / slope
    # The rows of the remaining matrix are directions in the plane: their cross products are normal to it.
    a, d, f = xx - least, yy - least, zz - least
    px, py, pz = xy * yz - xz * d, xz * xy - a * yz, a * d - xy * xy
    qx, qy, qz = xy * f - xz * yz, xz * xz - a * f, a * yz - xy * xz
    rx, ry, rz = d * f - yz * yz, yz * xz - xy * f, xy * yz - d * xz
    p, q, r = px * px + py * py + pz * pz, qx * qx + qy * qy + qz * qz, rx * rx + ry * ry + rz * rz
    if q > p and q >= r:
        px, py, pz, p = qx, qy, qz, q
    elif r > p:
        px, py, pz, p = rx, ry, rz, r
    if not p > 0.0:
        return np.nan, np.nan, np.nan, np.nan
    length = math.sqrt(p)
    return px / length, py / length, pz / length, max(least, 0.0)
