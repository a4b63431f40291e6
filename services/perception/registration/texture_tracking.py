"""Tracking of the ground's texture from keyframes into the grey image of a frame.

A keyframe keeps the points of its grey image that are distinct in both directions (Shi and Tomasi 1994), with the planes that
its depth shows there. A patch around such a point is warped by its plane into the view that the prior expects, and aligned with
the frame from coarse to fine (inverse compositional, Baker and Matthews 2004), with the brightness and the contrast of each
patch free. The positions found are terms of the registration's cost: light that changes moves none of them.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.params import TextureParams
from sextant.shared.geometry import inverse
from sextant.shared.robot.camera import Intrinsics
from sextant.shared.runtime.compiled import compiled

Array = NDArray[Any]  # argument of compiled functions, any numeric type
Pyramid = tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]  # a grey image, and it at 1/2 and 1/4 of its size

_CELL_PX = 16  # [px] edge of the cells of a keyframe, each of which gives one point
_HALF = 5  # [px] half of a patch's edge
_MARGIN_PX = 8  # [px] from the image's edge, within which there is no point
_MAX_STEPS = 8  # of the alignment at one size of the image
_CONVERGED_PX = 0.02  # [px] step that ends it
_SYSTEMATIC_PX = 0.1  # [px] error of a position that is due to the model
_CAUCHY = 2.5  # [sigma] at which the weight of a position is one half
_INFORMATION_SHARE = 0.1  # positions share calibration and keyframe errors, so ten count as one
_INLIER_PX = 1.0  # [px] up to which a position agrees with a pose


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Points of keyframes, and where a frame shows them."""

    points: NDArray[np.float64]  # (n, 3) [m] in the frame of the keyframes' poses
    pixels: NDArray[np.float64]  # (n, 2) x / z and y / z {camera}
    information: NDArray[np.float64]  # (n, 3) of these: xx, xy, yy
    slots: NDArray[np.int64]  # (n,) keyframe of each point
    expected: int  # number of points that the frame should show
    pixel: float  # [1] x / z of one pixel

    def equations(self, T: NDArray[np.float64], widen: float = 1.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return information (6, 6) and gradient (6,) of the camera pose's error twist, of all positions.

        Args:
            T: (4, 4) camera pose.
            widen: [1] factor of the deviation at which the weight of a position is one half; larger than 1 far from the
                solution.
        """
        H, g = np.zeros((6, 6)), np.zeros(6)
        _sum(self.points, self.pixels, self.information, T, widen * _CAUCHY, H, g)
        share = _INFORMATION_SHARE / max(1, len(np.unique(self.slots)))
        return share * H, share * g

    def agreeing(self, T: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which positions (n,) agree with a camera pose."""
        seen = (self.points - T[:3, 3]) @ T[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            off = seen[:, :2] / seen[:, 2:] - self.pixels
        return np.asarray((seen[:, 2] > 0.0) & (np.hypot(off[:, 0], off[:, 1]) < _INLIER_PX * self.pixel))


class TextureTracker:
    """Grey images of keyframes, and the tracking of their points into the loaded frame."""

    def __init__(self, lens: Intrinsics, x: NDArray[np.floating], y: NDArray[np.floating], stored: int, params: TextureParams):
        """Create empty storage.

        Args:
            lens: Intrinsics of the grey image.
            x: (columns,) x / z {camera} of the centres of the depth image's blocks.
            y: (rows,) the same for y / z.
            stored: Number of keyframes.
            params: Parameters.
        """
        self._lens = np.array([lens.fx, lens.fy, lens.cx, lens.cy])
        self._shape = (lens.height, lens.width)
        self._x, self._y, self._params = x, y, params
        self._frame: Pyramid | None = None
        self._keyframes: list[tuple[Pyramid, NDArray[np.float64]] | None] = [None] * stored

    def load(self, gray: NDArray[np.uint8]) -> bool:
        """Load the grey image of a frame; return whether it has the expected size."""
        fits = gray.shape == self._shape
        self._frame = _pyramid(gray) if fits else None
        return fits

    def store(self, slot: int, planes: NDArray[np.float32]) -> None:
        """Store the loaded frame as a keyframe with its planes (rows, columns, 4), see `BlockFrame.fit_planes`."""
        self._keyframes[slot] = None if self._frame is None else (self._frame, self._points(self._frame[0], planes))

    def keep_only(self, slots: Collection[int]) -> None:
        """Forget all keyframes but some."""
        self._keyframes = [keyframe if slot in slots else None for slot, keyframe in enumerate(self._keyframes)]

    def track(self, T: NDArray[np.float64], chosen: NDArray[np.int64], poses: NDArray[np.float64]) -> Tracks | None:
        """Find the points of keyframes in the loaded frame.

        Args:
            T: (4, 4) expected camera pose.
            chosen: (k,) keyframes, of which the first ones with grey images are tracked.
            poses: (n, 4, 4) camera poses of all keyframes.
        """
        if self._frame is None:
            return None
        found, expected = [], 0
        for slot in chosen:
            keyframe = self._keyframes[slot]
            if keyframe is None or len(keyframe[1]) == 0:
                continue
            T_frame_key = inverse(T) @ poses[slot]
            out = np.zeros((len(keyframe[1]), 9))
            limits = self._params.search_px, self._params.min_correlation
            expected += _track(keyframe[0], self._frame, keyframe[1], T_frame_key, self._lens, *limits, out)
            good = out[out[:, 8] > 0.0]
            good[:, :3] = good[:, :3] @ poses[slot][:3, :3].T + poses[slot][:3, 3]
            found.append((good, np.full(len(good), slot)))
            if len(found) == self._params.keyframes:
                break
        if not found:
            return None
        rows = np.concatenate([good for good, _ in found])
        slots = np.concatenate([slot for _, slot in found])
        fx, fy, cx, cy = self._lens
        pixels = (rows[:, 3:5] - (cx, cy)) / (fx, fy)
        return Tracks(rows[:, :3].copy(), pixels, rows[:, 5:8] * (fx * fx, fx * fy, fy * fy), slots, expected, 1.0 / fx)

    def _points(self, gray: NDArray[np.uint8], planes: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the points (n, 5) of a keyframe: u, v [px], and their planes A, B, C; see `BlockFrame`."""
        smooth = cv2.GaussianBlur(gray, (3, 3), 0.8)
        distinct = cv2.cornerMinEigenVal(smooth, 7, ksize=3)
        return _select(distinct, planes, self._x, self._y, self._lens, self._params.min_texture**2)


def _pyramid(gray: NDArray[np.uint8]) -> Pyramid:
    half = cv2.pyrDown(gray)
    return gray.copy(), np.asarray(half, dtype=np.uint8), np.asarray(cv2.pyrDown(half), dtype=np.uint8)


@compiled
def _select(distinct: Array, planes: Array, x: Array, y: Array, lens: Array, least: float) -> Array:
    """Return u, v, A, B, C of the most distinct point with a plane of each cell.

    `distinct` (h, w) is the smaller eigenvalue of the structure tensor as OpenCV scales it.
    """
    height, width = distinct.shape
    rows, columns = planes.shape[0], planes.shape[1]
    out = np.empty(((height // _CELL_PX + 1) * (width // _CELL_PX + 1), 5))
    n = 0
    scale = 255.0 * 255.0 / 4.0  # OpenCV uses twice the gradients, of a brightness from 0 to 1
    for top in range(_MARGIN_PX, height - _MARGIN_PX, _CELL_PX):
        for left in range(_MARGIN_PX, width - _MARGIN_PX, _CELL_PX):
            best, u, v = least / scale, -1, -1
            for i in range(top, min(top + _CELL_PX, height - _MARGIN_PX)):
                for j in range(left, min(left + _CELL_PX, width - _MARGIN_PX)):
                    if distinct[i, j] > best:
                        best, u, v = distinct[i, j], j, i
            if u < 0:
                continue
            row = int(np.floor(((v - lens[3]) / lens[1] - y[0]) / (y[1] - y[0]) + 0.5))
            column = int(np.floor(((u - lens[2]) / lens[0] - x[0]) / (x[1] - x[0]) + 0.5))
            if row < 0 or column < 0 or row >= rows or column >= columns or planes[row, column, 3] <= 0.0:
                continue
            out[n, 0], out[n, 1] = u, v
            for k in range(3):
                out[n, 2 + k] = planes[row, column, k]
            n += 1
    return out[:n].copy()


@compiled
def _bilinear(image: Array, u: float, v: float) -> float:
    """Return the brightness at a point, which is inside the image."""
    j, i = int(u), int(v)
    a, b = u - j, v - i
    top = (1.0 - a) * image[i, j] + a * image[i, j + 1]
    bottom = (1.0 - a) * image[i + 1, j] + a * image[i + 1, j + 1]
    return float((1.0 - b) * top + b * bottom)


@compiled
def _prepare_patch(
    key: Array, u_key: float, v_key: float, warp: Array, template: Array, patch: Array
) -> tuple[float, float, float, float]:
    """Fill a patch with its template, its gradients, both without mean, and the gradients without the template's share.

    Arguments as of `_align_patch`. Return the squares of the template and of the gradients in x and y, and the gradients'
    product; the first is 0 if the patch is not inside the image or has no texture in both directions.
    """
    edge = 2 * _HALF + 1
    n = edge * edge
    reach_u = (abs(warp[0, 0]) + abs(warp[0, 1])) * (_HALF + 1)
    reach_v = (abs(warp[1, 0]) + abs(warp[1, 1])) * (_HALF + 1)
    if not (
        u_key - reach_u >= 0.0
        and v_key - reach_v >= 0.0
        and u_key + reach_u < key.shape[1] - 1
        and v_key + reach_v < key.shape[0] - 1
    ):
        return 0.0, 0.0, 0.0, 0.0
    for i in range(edge + 2):
        for j in range(edge + 2):
            dx, dy = j - _HALF - 1.0, i - _HALF - 1.0
            template[i, j] = _bilinear(
                key, u_key + warp[0, 0] * dx + warp[0, 1] * dy, v_key + warp[1, 0] * dx + warp[1, 1] * dy
            )
    st = sx = sy = 0.0
    for i in range(edge):
        for j in range(edge):
            k = i * edge + j
            patch[0, k] = template[i + 1, j + 1]
            patch[1, k] = 0.5 * (template[i + 1, j + 2] - template[i + 1, j])
            patch[2, k] = 0.5 * (template[i + 2, j + 1] - template[i, j + 1])
            st += patch[0, k]
            sx += patch[1, k]
            sy += patch[2, k]
    tt = tx = ty = 0.0
    for k in range(n):
        patch[0, k] -= st / n
        patch[1, k] -= sx / n
        patch[2, k] -= sy / n
        tt += patch[0, k] * patch[0, k]
        tx += patch[0, k] * patch[1, k]
        ty += patch[0, k] * patch[2, k]
    if tt < 1e-6 * n:
        return 0.0, 0.0, 0.0, 0.0
    xx = xy = yy = 0.0
    for k in range(n):
        patch[1, k] -= tx / tt * patch[0, k]
        patch[2, k] -= ty / tt * patch[0, k]
        xx += patch[1, k] * patch[1, k]
        xy += patch[1, k] * patch[2, k]
        yy += patch[2, k] * patch[2, k]
    if xx * yy - xy * xy <= 1e-3 * (xx + yy) * (xx + yy):
        return 0.0, 0.0, 0.0, 0.0
    return tt, xx, yy, xy


@compiled
def _align_patch(
    key: Array, frame: Array, u_key: float, v_key: float, warp: Array, start: Array, template: Array, patch: Array, found: Array
) -> bool:
    """Align a patch of a keyframe with a frame, both at the same size of the image, and return whether it succeeds.

    Args:
        key: Image of the keyframe.
        frame: Image of the frame.
        u_key: Point of the keyframe.
        v_key: Point of the keyframe.
        warp: (2, 2) pixels of the keyframe per pixel of the frame.
        start: (2,) expected point in the frame.
        template: (2 h + 3, 2 h + 3) workspace.
        patch: (4, n) workspace.
        found: (6,) point in the frame, its information xx, xy, yy [1/px^2], and the correlation; written.
    """
    edge = 2 * _HALF + 1
    n = edge * edge
    tt, xx, yy, xy = _prepare_patch(key, u_key, v_key, warp, template, patch)
    if tt == 0.0:
        return False
    det = xx * yy - xy * xy
    # Gauss-Newton over the position; brightness and contrast follow from the patch.
    u, v = start[0], start[1]
    ti = ii = contrast = 0.0
    for _ in range(_MAX_STEPS):
        if not (u - _HALF >= 0.0 and v - _HALF >= 0.0 and u + _HALF < frame.shape[1] - 1 and v + _HALF < frame.shape[0] - 1):
            return False
        j0, i0 = int(u), int(v)
        a, b = u - j0, v - i0
        w00, w01, w10, w11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
        total = 0.0
        for i in range(edge):
            for j in range(edge):
                p, q = i0 + i - _HALF, j0 + j - _HALF
                value = w00 * frame[p, q] + w01 * frame[p, q + 1] + w10 * frame[p + 1, q] + w11 * frame[p + 1, q + 1]
                patch[3, i * edge + j] = value
                total += value
        ti = ii = gx = gy = 0.0
        for k in range(n):
            value = patch[3, k] - total / n
            ti += patch[0, k] * value
            ii += value * value
            gx += patch[1, k] * value
            gy += patch[2, k] * value
        contrast = ti / tt
        if contrast < 0.1:
            return False
        du, dv = (yy * gx - xy * gy) / (det * contrast), (xx * gy - xy * gx) / (det * contrast)
        u -= du
        v -= dv
        if du * du + dv * dv < _CONVERGED_PX * _CONVERGED_PX:
            break
    found[0], found[1] = u, v
    variance = max((ii - ti * ti / tt) / ((n - 4) * contrast * contrast), 1e-6)
    # Covariance of the position, and its inverse
    cxx, cxy, cyy = variance * yy / det, -variance * xy / det, variance * xx / det
    cxx, cyy = cxx + _SYSTEMATIC_PX * _SYSTEMATIC_PX, cyy + _SYSTEMATIC_PX * _SYSTEMATIC_PX
    whole = cxx * cyy - cxy * cxy
    found[2], found[3], found[4] = cyy / whole, -cxy / whole, cxx / whole
    found[5] = ti / np.sqrt(max(tt * ii, 1e-12))
    return True


@compiled
def _track(
    key: Pyramid,
    frame: Pyramid,
    points: Array,
    T: Array,
    lens: Array,
    search_px: float,
    min_correlation: float,
    out: Array,
) -> int:
    """Track the points (n, 5) of a keyframe, and return how many the frame should show.

    T is T_frame_keyframe (4, 4) as expected. `out` (n, 9): x, y, z {keyframe}, u, v in the frame, information xx, xy, yy, and 1
    for success.
    """
    fx, fy, cx, cy = lens
    edge = 2 * _HALF + 1
    template, patch, found = np.empty((edge + 2, edge + 2)), np.empty((4, edge * edge)), np.empty(6)
    warp, start, homography = np.empty((2, 2)), np.empty(2), np.empty((3, 3))
    height, width = frame[0].shape
    inside = 0
    for n in range(len(points)):
        # 1. Where the prior expects the point, and how its plane warps the patch there.
        u_key, v_key = points[n, 0], points[n, 1]
        x, y = (u_key - cx) / fx, (v_key - cy) / fy
        w = points[n, 2] * x + points[n, 3] * y + points[n, 4]
        if w <= 0.05:
            continue
        for i in range(3):
            for j in range(3):
                homography[i, j] = T[i, j] + T[i, 3] * points[n, 2 + j]
        px = homography[0, 0] * x + homography[0, 1] * y + homography[0, 2]
        py = homography[1, 0] * x + homography[1, 1] * y + homography[1, 2]
        pz = homography[2, 0] * x + homography[2, 1] * y + homography[2, 2]
        if pz <= 0.05:
            continue
        u, v = fx * px / pz + cx, fy * py / pz + cy
        if not (_MARGIN_PX <= u < width - _MARGIN_PX and _MARGIN_PX <= v < height - _MARGIN_PX):
            continue
        inside += 1
        a = (homography[0, 0] - px / pz * homography[2, 0]) / pz
        b = (homography[0, 1] - px / pz * homography[2, 1]) / pz * fx / fy
        c = (homography[1, 0] - py / pz * homography[2, 0]) / pz * fy / fx
        d = (homography[1, 1] - py / pz * homography[2, 1]) / pz
        det = a * d - b * c
        if not 0.1 < det < 10.0:
            continue
        warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1] = d / det, -b / det, -c / det, a / det
        # 2. From coarse to fine; a coarse image without texture is skipped.
        at_u, at_v = u, v
        good = False
        for level in range(2, -1, -1):
            scale = 0.5**level
            start[0], start[1] = at_u * scale, at_v * scale
            good = _align_patch(key[level], frame[level], u_key * scale, v_key * scale, warp, start, template, patch, found)
            good = good and found[5] >= min_correlation
            good = good and (found[0] / scale - u) ** 2 + (found[1] / scale - v) ** 2 < search_px * search_px
            if good:
                at_u, at_v = found[0] / scale, found[1] / scale
        if good:
            out[n, 0], out[n, 1], out[n, 2] = x / w, y / w, 1.0 / w
            out[n, 3], out[n, 4] = at_u, at_v
            out[n, 5], out[n, 6], out[n, 7], out[n, 8] = found[2], found[3], found[4], 1.0
    return inside


@compiled
def _sum(points: Array, pixels: Array, information: Array, T: Array, cauchy: float, H: Array, g: Array) -> None:
    """Sum the normal equations of positions with Cauchy's weight."""
    J = np.empty((2, 6))
    for n in range(len(points)):
        rx, ry, rz = points[n, 0] - T[0, 3], points[n, 1] - T[1, 3], points[n, 2] - T[2, 3]
        px = T[0, 0] * rx + T[1, 0] * ry + T[2, 0] * rz
        py = T[0, 1] * rx + T[1, 1] * ry + T[2, 1] * rz
        pz = T[0, 2] * rx + T[1, 2] * ry + T[2, 2] * rz
        if pz < 0.05:
            continue
        w = 1.0 / pz
        ex, ey = px * w - pixels[n, 0], py * w - pixels[n, 1]
        # Derivative of the position with respect to the twist: of the point {camera}, R^T (r x w - v).
        for k in range(2):
            c, other = (px, 0) if k == 0 else (py, 1)
            ax = w * (T[0, other] - c * w * T[0, 2])
            ay = w * (T[1, other] - c * w * T[1, 2])
            az = w * (T[2, other] - c * w * T[2, 2])
            J[k, 0], J[k, 1], J[k, 2] = -ax, -ay, -az
            J[k, 3], J[k, 4], J[k, 5] = rz * ay - ry * az, rx * az - rz * ax, ry * ax - rx * ay
        xx, xy, yy = information[n, 0], information[n, 1], information[n, 2]
        weight = 1.0 / (1.0 + (xx * ex * ex + 2.0 * xy * ex * ey + yy * ey * ey) / (cauchy * cauchy))
        for p in range(6):
            ix, iy = weight * (J[0, p] * xx + J[1, p] * xy), weight * (J[0, p] * xy + J[1, p] * yy)
            g[p] += ix * ex + iy * ey
            for q in range(6):
                H[p, q] += ix * J[0, q] + iy * J[1, q]
