"""Matching of a depth frame against keyframes: projective association, weights and normal equations.

Each point of the frame is projected into a keyframe, and compared with the plane of the block where it lands.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.block_frame import BlockFrame
from sextant.shared.runtime.compiled import compiled, compiled_sums

Array = NDArray[Any]  # argument of compiled functions, any numeric type

_MODEL_SIGMA = 0.0005  # [m] deviation of a real surface from its plane
_NEAR = 0.05  # [m] from a plane, within which a keyframe has seen a point
_AT_A_TIME = 256  # points per pass; their intermediate values fit into the fastest cache
_CAUCHY = 2.5  # [sigma] at which the weight of a match is one half


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Normal equations of a frame against keyframes, and the quality of the match.

    H, g and N refer to the error twist in world axes at the camera.
    """

    H: NDArray[np.float64]  # (6, 6) information
    g: NDArray[np.float64]  # (6,) gradient
    N: NDArray[np.float64]  # (6, 6) part of H that the noise of the planes alone would give
    keyframes: int  # number of matched keyframes
    overlap: float  # 0..1 share of the frame's points with a plane in the best keyframe, except on rough blocks
    agreement: float  # 0..1 share of the points facing a plane that lie on it, over all keyframes
    rmse: float  # [m] point-to-plane distance of the matches, NaN when there are none
    misfit: float = 0.0  # mean of k^2 / (1 + scale k^2) over points facing a plane, k sigma off it


def match_frame(
    frame: BlockFrame,
    planes: NDArray[np.float32],
    poses: NDArray[np.float64],
    chosen: NDArray[np.int64],
    T_world_camera: NDArray[np.float64],
    gate: float,
    stride: int = 1,
    robust: bool = True,
) -> Match:
    """Match a frame at a pose with some keyframes.

    Args:
        frame: The loaded frame.
        planes: (n, rows, columns, 4) plane images of the keyframes, see `BlockFrame.fit_planes`.
        poses: (n, 4, 4) {world} their camera poses.
        chosen: (k,) indices of the keyframes to match with.
        T_world_camera: (4, 4) pose at which the normal equations are linearised.
        gate: [m] largest point-to-plane distance of a match.
        stride: Use every stride-th point.
        robust: Whether the weight of a match falls with its distance.
    """
    H, g, N, tally = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6)), np.zeros(5)
    scale = 1.0 / _CAUCHY**2 if robust else 0.0
    samples = frame.samples(stride, min(stride, len(chosen)))
    x, y, sigma = frame.x, frame.y, frame.sigma
    _match(samples, frame.valid, stride, x, y, planes, poses, chosen, T_world_camera, sigma, gate, scale, H, g, N, tally)
    matched, facing, squares, best, off = tally.tolist()
    rmse = math.sqrt(squares / matched) if matched else math.nan
    return Match(H, g, N, len(chosen), best, matched / max(facing, 1.0), rmse, off / max(facing, 1.0))


def point_misfits(
    frame: BlockFrame,
    planes: NDArray[np.float32],
    poses: NDArray[np.float64],
    chosen: NDArray[np.int64],
    T_world_camera: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the misfit of each point (n,) of a frame at a pose, averaged over the chosen keyframes.

    The misfit is k^2 / (1 + scale k^2), as in `Match`, or NaN for a point that faces no plane. Arguments are those of
    `match_frame`.
    """
    out = np.empty(len(frame.points))
    _misfits(frame.points, frame.x, frame.y, planes, poses, chosen, T_world_camera, frame.sigma, out)
    return out


def shared_surface(
    frame: BlockFrame, planes: NDArray[np.float32], poses: NDArray[np.float64], T_world_camera: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the share (n,) [1] of a frame's points that each keyframe has seen.

    Arguments are those of `match_frame`.
    """
    return np.asarray(_shares_seen(frame.points, frame.x, frame.y, planes, poses, T_world_camera))


@compiled
def _relative(T_world_a: Array, T_world_b: Array, out: Array) -> None:
    """Compute T_a_b (4, 4) of two poses; the last row of `out` is not written."""
    for i in range(3):
        for j in range(4):
            out[i, j] = 0.0
            for k in range(3):
                out[i, j] += T_world_a[k, i] * (T_world_b[k, j] - (T_world_a[k, 3] if j == 3 else 0.0))


@compiled
def _shares_seen(points: Array, x: Array, y: Array, planes: Array, poses: Array, T_world_camera: Array) -> Array:
    """Return the share of about 200 frame points near a plane of each keyframe."""
    shares = np.zeros(len(poses))
    T = np.empty((4, 4))
    step = max(1, len(points) // 200)
    rows, columns = planes.shape[1], planes.shape[2]
    to_column, to_row = 1.0 / (x[1] - x[0]), 1.0 / (y[1] - y[0])
    for k in range(len(poses)):
        _relative(poses[k], T_world_camera, T)
        count, seen = 0, 0
        for n in range(0, len(points), step):
            qx, qy, qz = points[n, 0], points[n, 1], points[n, 2]
            count += 1
            px = T[0, 0] * qx + T[0, 1] * qy + T[0, 2] * qz + T[0, 3]
            py = T[1, 0] * qx + T[1, 1] * qy + T[1, 2] * qz + T[1, 3]
            pz = T[2, 0] * qx + T[2, 1] * qy + T[2, 2] * qz + T[2, 3]
            if pz < 0.05:
                continue
            u = (px / pz - x[0]) * to_column + 0.5
            v = (py / pz - y[0]) * to_row + 0.5
            if not (u >= 0.0 and v >= 0.0 and u < columns and v < rows):
                continue
            A, B, C = planes[k, int(v), int(u), 0], planes[k, int(v), int(u), 1], planes[k, int(v), int(u), 2]
            f = A * px + B * py + C * pz - 1.0
            if f * f < _NEAR * _NEAR * (A * A + B * B + C * C):
                seen += 1
        shares[k] = seen / max(count, 1)
    return shares


@compiled
def _misfits(
    points: Array,
    x: Array,
    y: Array,
    planes: Array,
    poses: Array,
    chosen: Array,
    T_world_camera: Array,
    sigma: float,
    out: Array,
) -> None:
    """Write the misfit of each point, averaged over the keyframes it faces."""
    rows, columns = planes.shape[1], planes.shape[2]
    to_column, to_row = 1.0 / (x[1] - x[0]), 1.0 / (y[1] - y[0])
    T, faced = np.empty((4, 4)), np.zeros(len(points))
    out[:] = 0.0
    for phase in range(len(chosen)):
        _relative(poses[chosen[phase]], T_world_camera, T)
        for n in range(len(points)):
            qx, qy, qz = points[n, 0], points[n, 1], points[n, 2]
            px = T[0, 0] * qx + T[0, 1] * qy + T[0, 2] * qz + T[0, 3]
            py = T[1, 0] * qx + T[1, 1] * qy + T[1, 2] * qz + T[1, 3]
            pz = T[2, 0] * qx + T[2, 1] * qy + T[2, 2] * qz + T[2, 3]
            if pz < 0.05:
                continue
            u, v = (px / pz - x[0]) * to_column + 0.5, (py / pz - y[0]) * to_row + 0.5
            if not (u >= 0.0 and v >= 0.0 and u < columns and v < rows):
                continue
            plane = planes[chosen[phase], int(v), int(u)]
            length2 = plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2]
            if length2 == 0.0:
                continue
            f = plane[0] * px + plane[1] * py + plane[2] * pz - 1.0
            square = f * f / (sigma * sigma * pz * pz + _MODEL_SIGMA * _MODEL_SIGMA * length2)
            out[n] += square / (1.0 + square / (_CAUCHY * _CAUCHY))
            faced[n] += 1.0
    for n in range(len(points)):
        out[n] = out[n] / faced[n] if faced[n] > 0.0 else np.nan


@compiled_sums
def _accumulate(
    points: Array,
    tried: int,
    x: Array,
    y: Array,
    planes: Array,
    T: Array,
    sigma: float,
    gate: float,
    scale: float,
    sums: Array,
) -> None:
    """Match a frame with one keyframe by projection and sum the normal equations.

    The Jacobian with respect to the twist at the keyframe is [pi, p x pi]. A match that is off by k sigma has Cauchy's
    weight 1 / (1 + scale k^2). Loops have no branches and 32-bit numbers, so that the compiler can vectorise them; the sums of
    each pass are added in 64 bits.

    points: (3, m) of which the first `tried` are matched.
    sums: H (36), N (36), g (6), matched points, points facing a plane, squared distances, points that could match, and
    misfit. All points but those facing a block without a plane could match, and at least half of the points count.
    """
    rows, columns = planes.shape[0], planes.shape[1]
    zero, one = np.float32(0.0), np.float32(1.0)
    to_column, to_row = np.float32(1.0 / (x[1] - x[0])), np.float32(1.0 / (y[1] - y[0]))
    column0, row0 = np.float32(0.5 - x[0] / (x[1] - x[0])), np.float32(0.5 - y[0] / (y[1] - y[0]))
    width, height = np.float32(columns), np.float32(rows)
    T00, T01, T02, T03 = np.float32(T[0, 0]), np.float32(T[0, 1]), np.float32(T[0, 2]), np.float32(T[0, 3])
    T10, T11, T12, T13 = np.float32(T[1, 0]), np.float32(T[1, 1]), np.float32(T[1, 2]), np.float32(T[1, 3])
    T20, T21, T22, T23 = np.float32(T[2, 0]), np.float32(T[2, 1]), np.float32(T[2, 2]), np.float32(T[2, 3])
    gate2, sigma2, scale32 = np.float32(gate * gate), np.float32(sigma * sigma), np.float32(scale)
    model2, least = np.float32(_MODEL_SIGMA * _MODEL_SIGMA), np.float32(0.05)
    blocks = planes.reshape((rows * columns, 4))
    px, py, pz = np.empty(_AT_A_TIME, np.float32), np.empty(_AT_A_TIME, np.float32), np.empty(_AT_A_TIME, np.float32)
    A, B, C = np.empty(_AT_A_TIME, np.float32), np.empty(_AT_A_TIME, np.float32), np.empty(_AT_A_TIME, np.float32)
    spread, offs, weights = np.empty(_AT_A_TIME, np.float32), np.empty(_AT_A_TIME, np.float32), np.empty(_AT_A_TIME, np.float32)
    at = np.empty(_AT_A_TIME, np.int32)
    sums[:] = 0.0
    for begin in range(0, tried, _AT_A_TIME):
        # 1. The block that each point projects to, -1 for none.
        some = min(_AT_A_TIME, tried - begin)
        qx, qy, qz = points[0, begin : begin + some], points[1, begin : begin + some], points[2, begin : begin + some]
        for k in range(some):
            px[k] = T00 * qx[k] + T01 * qy[k] + T02 * qz[k] + T03
            py[k] = T10 * qx[k] + T11 * qy[k] + T12 * qz[k] + T13
            pz[k] = T20 * qx[k] + T21 * qy[k] + T22 * qz[k] + T23
        for k in range(some):
            along = one / pz[k]
            u = px[k] * along * to_column + column0
            v = py[k] * along * to_row + row0
            inside = (pz[k] >= least) & (u >= zero) & (v >= zero) & (u < width) & (v < height)
            u, v = u if inside else zero, v if inside else zero
            at[k] = np.int32(v) * np.int32(columns) + np.int32(u) if inside else np.int32(-1)
        # 2. The plane there: zero where there is none, with a spread of -1 on a rough block.
        for k in range(some):
            plane = blocks[np.uint64(max(at[k], 0))]
            there = np.float32(at[k] >= 0)
            A[k], B[k], C[k], spread[k] = there * plane[0], there * plane[1], there * plane[2], there * plane[3]
        # 3. The distance of the point from it, and the weight.
        matched = facing = rough = squares = misfit = zero
        for k in range(some):
            length2 = A[k] * A[k] + B[k] * B[k] + C[k] * C[k]
            f = A[k] * px[k] + B[k] * py[k] + C[k] * pz[k] - one
            f2 = f * f
            there = one if length2 > zero else zero
            near = there if f2 <= gate2 * length2 else zero
            weight = one / (sigma2 * pz[k] * pz[k] + model2 * length2 + f2 * scale32)  # Cauchy's
            weights[k], offs[k] = near * weight, f
            matched += near
            facing += there
            rough += one if spread[k] < zero else zero
            squares += near * f2 / (length2 if length2 > zero else one)
            misfit += there * f2 * weight
        # 4. Sum.
        h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = zero
        h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = zero
        g0 = g1 = g2 = g3 = g4 = g5 = zero
        for k in range(some):
            a, b, c, weight = A[k], B[k], C[k], weights[k]
            j3, j4, j5 = py[k] * c - pz[k] * b, pz[k] * a - px[k] * c, px[k] * b - py[k] * a
            a0, a1, a2 = weight * a, weight * b, weight * c
            h00 += a0 * a
            h01 += a0 * b
            h02 += a0 * c
            h03 += a0 * j3
            h04 += a0 * j4
            h05 += a0 * j5
            h11 += a1 * b
            h12 += a1 * c
            h13 += a1 * j3
            h14 += a1 * j4
            h15 += a1 * j5
            h22 += a2 * c
        for k in range(some):
            a, b, c, f, weight = A[k], B[k], C[k], offs[k], weights[k]
            j3, j4, j5 = py[k] * c - pz[k] * b, pz[k] * a - px[k] * c, px[k] * b - py[k] * a
            a3, a4, a5, a6 = weight * j3, weight * j4, weight * j5, weight * f
            h23 += a3 * c
            h24 += a4 * c
            h25 += a5 * c
            h33 += a3 * j3
            h34 += a3 * j4
            h35 += a3 * j5
            h44 += a4 * j4
            h45 += a4 * j5
            h55 += a5 * j5
            g0 += a6 * a
            g1 += a6 * b
            g2 += a6 * c
            g3 += a6 * j3
            g4 += a6 * j4
            g5 += a6 * j5
        upper = (
            (h00, h01, h02, h03, h04, h05),
            (h01, h11, h12, h13, h14, h15),
            (h02, h12, h22, h23, h24, h25),
            (h03, h13, h23, h33, h34, h35),
            (h04, h14, h24, h34, h44, h45),
            (h05, h15, h25, h35, h45, h55),
        )
        for p in range(6):
            for q in range(6):
                sums[6 * p + q] += upper[p][q]
        for p, g in enumerate((g0, g1, g2, g3, g4, g5, matched, facing, squares, -rough, misfit)):
            sums[72 + p] += g
        # Gradient noise turns pi by e = (1, 0, -x) and (0, 1, -y): add its part of H from every 16th point.
        for k in range(0, some, 16):
            noise = 16.0 * weights[k] * spread[k]
            if noise <= 0.0:
                continue
            row, column = at[k] // columns, at[k] % columns
            for axis in range(2):
                ex, ey, ez = 1.0 - axis, float(axis), -(y[row] if axis else x[column])
                jacobian = (ex, ey, ez, py[k] * ez - pz[k] * ey, pz[k] * ex - px[k] * ez, px[k] * ey - py[k] * ex)
                for p in range(6):
                    along = noise * jacobian[p]
                    for q in range(p, 6):
                        sums[36 + 6 * p + q] += along * jacobian[q]
    for p in range(1, 6):
        for q in range(p):
            sums[36 + 6 * p + q] = sums[36 + 6 * q + p]
    sums[81] = max(sums[81] + tried, tried / 2)


@compiled
def _match(
    samples: Array,
    valid: int,
    stride: int,
    x: Array,
    y: Array,
    planes: Array,
    poses: Array,
    chosen: Array,
    T_world_camera: Array,
    sigma: float,
    gate: float,
    scale: float,
    H: Array,
    g: Array,
    N: Array,
    tally: Array,
) -> None:
    """Sum the matches with some keyframes.

    tally: matched, facing, squares, best overlap, misfit, as in `Match`.
    """
    T, sums, M, half = np.empty((4, 4)), np.empty(83), np.zeros((6, 6)), np.empty((6, 6))
    for phase in range(len(chosen)):
        pose = poses[chosen[phase]]
        _relative(pose, T_world_camera, T)
        # Each keyframe is matched with different points, so that together they use most of the points.
        sample = phase % len(samples)
        _accumulate(
            samples[sample], (valid - sample + stride - 1) // stride, x, y, planes[chosen[phase]], T, sigma, gate, scale, sums
        )
        # From the keyframe's axes and origin to world axes at the camera: M = [[R, 0], [-skew(t) R, R]].
        tx, ty = T_world_camera[0, 3] - pose[0, 3], T_world_camera[1, 3] - pose[1, 3]
        tz = T_world_camera[2, 3] - pose[2, 3]
        for j in range(3):
            for i in range(3):
                M[i, j] = M[3 + i, 3 + j] = pose[i, j]
            M[3, j] = tz * pose[1, j] - ty * pose[2, j]
            M[4, j] = tx * pose[2, j] - tz * pose[0, j]
            M[5, j] = ty * pose[0, j] - tx * pose[1, j]
        for block in range(2):
            out = H if block == 0 else N
            for i in range(6):
                for j in range(6):
                    half[i, j] = 0.0
                    for k in range(6):
                        half[i, j] += M[i, k] * sums[36 * block + 6 * k + j]
            for i in range(6):
                for j in range(6):
                    for k in range(6):
                        out[i, j] += half[i, k] * M[j, k]
        for i in range(6):
            for k in range(6):
                g[i] += M[i, k] * sums[72 + k]
        tally[0] += sums[78]
        tally[1] += sums[79]
        tally[2] += sums[80]
        tally[3] = max(tally[3], sums[78] / max(sums[81], 1.0))
        tally[4] += sums[82]
