"""Rotations and rigid transforms as plain arrays, batched over leading axes.

`T_world_body` is a (4, 4) matrix that transforms body coordinates to world coordinates, so adjacent names cancel:
`T_world_body @ T_body_camera`. A twist is (6,): linear part first, then angular part.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_IDENTITY = np.eye(4)
_FEW = 64  # points up to which one loop over rows is faster than three over columns
_NEWTON_STEPS, _NEWTON_END = 50, 1e-15  # most steps for an eigenvalue, and the relative step that ends them
_WELL_DETERMINED = 1e-3  # [1] smallest relative size of the cofactors that yield an eigenvector
_SMALL_DEVIATION = 1e-8  # [1] of a rotation times its transpose from one: its square is below the rounding error
_SMALL_ANGLE = 1e-8  # [rad] below this angle a series replaces sin(x)/x


def skew(v: ArrayLike) -> Array:
    """Return the matrix (..., 3, 3) of the cross product with v (..., 3).

    Its product with w is v x w.
    """
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def rotation_z(angle: ArrayLike) -> Array:
    """Return the rotation (..., 3, 3) by a finite angle (...,) [rad] about z."""
    if isinstance(angle, float):
        return rotation_from_rpy((0.0, 0.0, angle))
    angle = np.asarray(angle, dtype=np.float64)
    out = np.zeros((*angle.shape, 3, 3))
    c, s = np.cos(angle), np.sin(angle)
    out[..., 0, 0], out[..., 0, 1] = c, -s
    out[..., 1, 0], out[..., 1, 1] = s, c
    out[..., 2, 2] = 1.0
    return out


def rotation_from_rpy(rpy: ArrayLike) -> Array:
    """Return the rotation (..., 3, 3) of roll, pitch, yaw (..., 3) [rad].

    It is Rz(yaw) Ry(pitch) Rx(roll).
    """
    rpy = np.asarray(rpy, dtype=np.float64)
    if rpy.ndim == 1:  # fast path for the control loop, where arrays of one element would dominate the cost
        angles = rpy.tolist()
        (cr, cp, cy), (sr, sp, sy) = map(math.cos, angles), map(math.sin, angles)
        return np.array(
            [
                [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                [-sp, cp * sr, cp * cr],
            ]
        )
    cr, cp, cy = (np.cos(rpy[..., i]) for i in range(3))
    sr, sp, sy = (np.sin(rpy[..., i]) for i in range(3))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rpy_from_rotation(R: Array) -> Array:
    """Return roll, pitch, yaw (..., 3) [rad] of rotations (..., 3, 3).

    The pitch is in [-pi/2, pi/2].
    """
    if R.ndim == 2:
        (ax, _, _), (ay, _, _), (az, bz, cz) = R.tolist()
        return np.array([math.atan2(bz, cz), -math.asin(min(max(az, -1.0), 1.0)), math.atan2(ay, ax)])
    pitch = -np.arcsin(np.clip(R[..., 2, 0], -1.0, 1.0))
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    yaw = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    return np.stack([roll, pitch, yaw], axis=-1)


def exp_so3(rotvec: ArrayLike) -> Array:
    """Return the rotation (..., 3, 3) of a rotation vector (..., 3) [rad] (Rodrigues)."""
    rotvec = np.asarray(rotvec, dtype=np.float64)
    if rotvec.ndim == 1:
        return _exp_of_one(*rotvec.tolist())
    angle = np.linalg.norm(rotvec, axis=-1)[..., None, None]
    K = skew(rotvec)
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0, np.sin(safe) / safe)
    b = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    return np.eye(3) + a * K + b * (K @ K)


def log_so3(R: Array) -> Array:
    """Return the rotation vector (..., 3) [rad] of rotations (..., 3, 3).

    Its length is at most pi.
    """
    if R.ndim == 2:
        rows = R.tolist()
        if rows[0][0] + rows[1][1] + rows[2][2] > 0.0:  # turned by less than 120 deg
            return _log_of_one(rows)
    q = quaternion_from_rotation(R)
    norm = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(norm, q[..., :1])
    small = norm < _SMALL_ANGLE
    scale = np.where(small, 2.0, angle / np.where(small, 1.0, norm))
    return np.asarray(scale * q[..., 1:])


def _exp_of_one(x: float, y: float, z: float) -> Array:
    """Compute `exp_so3` of one vector with plain numbers, without array overhead."""
    angle = math.sqrt(x * x + y * y + z * z)
    # The half angle keeps the precision of small angles.
    a = math.sin(angle) / angle if angle > 0.0 else 1.0
    b = 2.0 * (math.sin(angle / 2.0) / angle) ** 2 if angle > 0.0 else 0.5
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + a * K + b * (K @ K))


def _log_of_one(rows: list[list[float]]) -> Array:
    """Compute `log_so3` of the rows of one rotation by less than 120 deg."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rows
    x, y, z = 0.5 * (zy - yz), 0.5 * (xz - zx), 0.5 * (yx - xy)
    sine = math.sqrt(x * x + y * y + z * z)
    angle = math.atan2(sine, 0.5 * (xx + yy + zz - 1.0))
    scale = angle / sine if sine > _SMALL_ANGLE else 1.0
    return np.array([scale * x, scale * y, scale * z])


def rotation_from_quaternion(wxyz: ArrayLike) -> Array:
    """Return the rotation (..., 3, 3) of a quaternion (..., 4), scalar first.

    The quaternion may have any length except zero.
    """
    q = np.asarray(wxyz, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    K = skew(q[..., 1:])
    return np.asarray(np.eye(3) + 2.0 * (q[..., :1, None] * K + K @ K))


def quaternion_from_rotation(R: Array) -> Array:
    """Return the unit quaternion (..., 4) of rotations (..., 3, 3).

    The scalar is first and not negative.
    """
    if R.ndim == 2:
        return np.array(quaternion_of_rows(R.tolist()))
    trace = np.trace(R, axis1=-2, axis2=-1)
    # The four closed forms are cheaper than an eigenvector, and the one with the largest pivot is always well scaled.
    squares = np.stack([trace, R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]], axis=-1)
    pivot = np.argmax(squares, axis=-1)
    m = R
    candidates = np.stack(
        [
            np.stack([1 + trace, m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1),
            np.stack(
                [
                    m[..., 2, 1] - m[..., 1, 2],
                    1 + 2 * m[..., 0, 0] - trace,
                    m[..., 0, 1] + m[..., 1, 0],
                    m[..., 0, 2] + m[..., 2, 0],
                ],
                -1,
            ),
            np.stack(
                [
                    m[..., 0, 2] - m[..., 2, 0],
                    m[..., 0, 1] + m[..., 1, 0],
                    1 + 2 * m[..., 1, 1] - trace,
                    m[..., 1, 2] + m[..., 2, 1],
                ],
                -1,
            ),
            np.stack(
                [
                    m[..., 1, 0] - m[..., 0, 1],
                    m[..., 0, 2] + m[..., 2, 0],
                    m[..., 1, 2] + m[..., 2, 1],
                    1 + 2 * m[..., 2, 2] - trace,
                ],
                -1,
            ),
        ],
        axis=-2,
    )
    q = np.take_along_axis(candidates, pivot[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., :1] < 0, -q, q))


def quaternion_of_rows(rows: Sequence[Sequence[float]]) -> tuple[float, float, float, float]:
    """Return the unit quaternion of one rotation, as `quaternion_from_rotation` does, in plain numbers.

    The rows are those of a rotation or of a transform. This takes a tenth of the time that arrays take.
    """
    (a, b, c, *_), (d, e, f, *_), (g, h, i, *_) = rows[:3]
    trace = a + e + i
    pivot = max(trace, a, e, i)
    if pivot == trace:
        q = (1 + trace, h - f, c - g, d - b)
    elif pivot == a:
        q = (h - f, 1 + 2 * a - trace, b + d, c + g)
    elif pivot == e:
        q = (c - g, b + d, 1 + 2 * e - trace, f + h)
    else:
        q = (d - b, c + g, f + h, 1 + 2 * i - trace)
    w, x, y, z = q
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0:
        length = -length
    return w / length, x / length, y / length, z / length


def transform(R: ArrayLike, p: ArrayLike) -> Array:
    """Return the rigid transform (..., 4, 4) of a rotation and a translation.

    The rotation is (..., 3, 3), the translation (..., 3) [m].
    """
    R, p = np.asarray(R, dtype=np.float64), np.asarray(p, dtype=np.float64)
    if R.ndim == 2 and p.ndim == 1:
        one = _IDENTITY.copy()
        one[:3, :3], one[:3, 3] = R, p
        return one
    out = np.zeros((*np.broadcast_shapes(R.shape[:-2], p.shape[:-1]), 4, 4))
    out[..., :3, :3] = R
    out[..., :3, 3] = p
    out[..., 3, 3] = 1.0
    return out


def from_xyz_rpy(xyz: ArrayLike, rpy: ArrayLike) -> Array:
    """Return the rigid transform of a position [m] and roll, pitch, yaw [rad]."""
    return transform(rotation_from_rpy(rpy), xyz)


def is_rigid(T: Array, tolerance: float = 1e-6) -> bool:
    """Return whether a (4, 4) matrix is a rigid transform."""
    *rows, last = T.tolist()
    if last != [0.0, 0.0, 0.0, 1.0] or not all(abs(part) <= 1.0 + tolerance for row in rows for part in row[:3]):
        return False
    (ax, ay, az, _), (bx, by, bz, _), (cx, cy, cz, _) = rows
    off = (
        *(ax * ax + ay * ay + az * az - 1.0, bx * bx + by * by + bz * bz - 1.0, cx * cx + cy * cy + cz * cz - 1.0),
        *(ax * bx + ay * by + az * bz, bx * cx + by * cy + bz * cz, cx * ax + cy * ay + cz * az),
    )
    determinant = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    return all(abs(part) <= tolerance for part in off) and determinant > 0.0


def inverse(T: Array) -> Array:
    """Return the inverse of rigid transforms (..., 4, 4), by transposing the rotation."""
    if T.ndim == 2:
        one, Rt = _IDENTITY.copy(), T[:3, :3].T
        one[:3, :3], one[:3, 3] = Rt, -(Rt @ T[:3, 3])
        return one
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(Rt, -(Rt @ T[..., :3, 3, None])[..., 0])


def on_twists(R: Array) -> Array:
    """Return the matrix (6, 6) that turns twists, linear then angular, by a rotation (3, 3)."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    return out


def apply(T: Array, points: ArrayLike) -> Array:
    """Transform points (..., 3) [m] with a (4, 4) transform, or points (..., n, 3) with transforms (..., 4, 4)."""
    points = np.asarray(points, dtype=np.float64)
    if T.ndim > 2:
        return np.asarray(points @ T[..., :3, :3].mT + T[..., None, :3, 3])
    return _offset(points @ T[:3, :3].T, T[:3, 3])


def from_millimetres(points_mm: NDArray[np.integer], origin: Array) -> Array:
    """Convert integer millimetres (n, 3) from an origin (3,) [m] to points (n, 3) [m]."""
    points: Array = np.multiply(points_mm, 1e-3, dtype=np.float64)
    return _offset(points, origin)


def to_millimetres(points: Array, origin: Array) -> NDArray[np.int16]:
    """Convert points (n, 3) [m] to integer millimetres (n, 3) from an origin (3,) [m].

    The values are clipped to 32.767 m per axis.
    """
    return np.clip(np.rint(1e3 * _offset(points.copy(), -origin)), -32767, 32767).astype(np.int16)


def _offset(points: Array, by: Array) -> Array:
    """Translate points (..., 3) in place.

    It works column by column, because NumPy's loops over rows of three are too short for vector instructions.
    """
    if points.size <= 3 * _FEW:
        points += by
        return points
    for axis in range(3):
        points[..., axis] += by[axis]
    return points


def exp_se3(twist: ArrayLike) -> Array:
    """Return the rigid transform (..., 4, 4) of a twist (..., 6).

    The twist has the linear part [m] and the rotation vector [rad] of a screw motion.
    """
    twist = np.asarray(twist, dtype=np.float64)
    return transform(exp_so3(twist[..., 3:]), (_left_jacobian(twist[..., 3:]) @ twist[..., :3, None])[..., 0])


def log_se3(T: Array) -> Array:
    """Return the twist (..., 6) whose exponential is the transform (..., 4, 4)."""
    rotvec = log_so3(T[..., :3, :3])
    v = np.linalg.solve(_left_jacobian(rotvec), T[..., :3, 3, None])[..., 0]
    return np.concatenate([v, rotvec], axis=-1)


def interpolate(T0: Array, T1: Array, s: float) -> Array:
    """Interpolate between transforms, from T0 (s = 0) to T1 (s = 1).

    The position is linear, and the rotation takes the shortest path.
    """
    R0, R1 = T0[:3, :3], T1[:3, :3]
    return transform(R0 @ exp_so3(s * log_so3(R0.T @ R1)), (1.0 - s) * T0[:3, 3] + s * T1[:3, 3])


def yaw_of(T: Array) -> float:
    """Return the heading [rad] of a (4, 4) transform."""
    return math.atan2(T[1, 0], T[0, 0])


def orthonormal(T: Array) -> Array:
    """Return the nearest rigid transform to a (4, 4) matrix with rounding errors."""
    (a, b, c), (d, e, f), (g, h, i) = T[:3, :3].tolist()
    # Small deviations of R R^T from one are halved by a Newton step, which leaves their squares.
    xx, yy, zz = a * a + b * b + c * c - 1.0, d * d + e * e + f * f - 1.0, g * g + h * h + i * i - 1.0
    xy, xz, yz = a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i
    det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if det > 0.0 and max(abs(xx), abs(yy), abs(zz), abs(xy), abs(xz), abs(yz)) < _SMALL_DEVIATION:
        out = T.copy()
        out[:3, :3] -= 0.5 * np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ T[:3, :3]
        return out
    u, _, vt = np.linalg.svd(T[:3, :3])
    return transform(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, T[:3, 3])


def align_rigid(source: Array, target: Array, weights: Array | None = None) -> Array:
    """Compute the rigid transform from source points (n, 3) to target points (n, 3).

    It minimizes the weighted squared distances (Horn; Kabsch where the quaternion is not well determined).

    Raises:
        ValueError: There are fewer than three points, or the shapes differ.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3 or len(source) < 3:
        raise ValueError(f"two (n, 3) point sets with n >= 3 expected, found {source.shape} and {target.shape}")
    w = np.full(len(source), 1.0 / len(source)) if weights is None else weights / weights.sum()
    source_mean, target_mean = w @ source, w @ target
    H = (source - source_mean).T @ (w[:, None] * (target - target_mean))
    R = _aligning_rotation(H)
    if R is None:
        u, _, vt = np.linalg.svd(H)
        R = vt.T @ u.T
        if np.linalg.det(R) < 0.0:  # flip the direction with the smallest singular value
            R = (vt.T * [1.0, 1.0, -1.0]) @ u.T
    return transform(R, target_mean - R @ source_mean)


def _aligning_rotation(H: Array) -> Array | None:
    """Return the rotation that maximizes trace(R H), from its quaternion; None where that is not well determined.

    Source: Horn 1987, with the largest eigenvalue by Newton's method on the characteristic polynomial (Theobald 2005). It is
    faster than a singular value decomposition, and is not well determined near half a turn and for points on one line.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = H.tolist()
    n00, n11, n22, n33 = xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy
    side = (yz - zy, zx - xz, xy - yx)
    rest = (xy + yx, zx + xz, yz + zy)
    squares = sum(part * part for row in ((xx, xy, xz), (yx, yy, yz), (zx, zy, zz)) for part in row)
    if not 0.0 < squares < math.inf:
        return None
    c2 = -2.0 * squares
    c1 = -8.0 * (xx * (yy * zz - yz * zy) - xy * (yx * zz - yz * zx) + xz * (yx * zy - yy * zx))
    q0, q1, q2, q3 = _first_cofactors((n11, n22, n33), side, rest)
    c0 = n00 * q0 + side[0] * q1 + side[1] * q2 + side[2] * q3
    largest = math.sqrt(3.0 * squares)  # not below the largest eigenvalue
    for _ in range(_NEWTON_STEPS):
        square = largest * largest
        slope = 4.0 * largest * square + 2.0 * c2 * largest + c1
        if slope <= 0.0:
            return None
        step = (square * square + c2 * square + c1 * largest + c0) / slope
        largest -= step
        if step <= _NEWTON_END * largest:
            break
    q0, q1, q2, q3 = _first_cofactors((n11 - largest, n22 - largest, n33 - largest), side, rest)
    norm = math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    if norm < _WELL_DETERMINED * largest**3:
        return None
    w, x, y, z = q0 / norm, q1 / norm, q2 / norm, q3 / norm
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def _first_cofactors(
    diagonal: tuple[float, float, float], side: tuple[float, float, float], rest: tuple[float, float, float]
) -> tuple[float, float, float, float]:
    """Return the cofactors of the first row of a symmetric (4, 4) matrix.

    Args:
        diagonal: Its diagonal without the first element, which does not matter.
        side: Its first row without that element.
        rest: Its elements (1, 2), (1, 3) and (2, 3).
    """
    (b, c, d), (ab, ac, ad), (bc, bd, cd) = diagonal, side, rest
    p01, p02, p03 = ac * bd - bc * ad, ac * cd - c * ad, ac * d - cd * ad
    p12, p13, p23 = bc * cd - c * bd, bc * d - cd * bd, c * d - cd * cd
    return (
        b * p23 - bc * p13 + bd * p12,
        bc * p03 - ab * p23 - bd * p02,
        ab * p13 - b * p03 + bd * p01,
        b * p02 - ab * p12 - bc * p01,
    )


def _left_jacobian(rotvec: Array) -> Array:
    angle = np.linalg.norm(rotvec, axis=-1)[..., None, None]
    K = skew(rotvec)
    small = angle < 1e-4  # the closed form loses precision long before it divides by zero
    safe = np.where(small, 1.0, angle)
    b = np.where(small, 0.5 - angle**2 / 24, (1.0 - np.cos(safe)) / safe**2)
    c = np.where(small, 1.0 / 6.0 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    return np.asarray(np.eye(3) + b * K + c * (K @ K))
