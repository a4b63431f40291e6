"""Sensor model of a PrimeSense depth camera: noise, quantisation, range limits and missing pixels.

The camera triangulates between a projector and one sensor.
It measures the disparity d = fx * baseline / z, in which its noise is Gaussian and its quantisation uniform. Pixels are missing
where the projector's light does not reach or returns too weakly.

Each random number is a hash of the camera's key, the frame number and the pixel. A frame therefore depends neither on earlier
frames nor on the machine.
"""

from math import ceil
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.robot.camera import DepthSensor, Intrinsics
from sextant.shared.runtime.compiled import compiled

RANDOM_LOSS = 0.05  # [1] share of pixels that are missing at random
GRAZING = (0.03, 0.12)  # [1] cosines of incidence: below the first, all pixels are missing; above the second, none
_SHADOW_MARGIN = 0.5  # [px] disparity margin, so that rounding does not make a smooth surface shadow itself
_GAUSS_BITS = 12  # random bits of a noise value: logarithm of the table's length
_MAX_RAW = 65535  # [raw units] largest depth of a frame


class DepthCamera:
    """Depth camera that converts true inverse depth to raw frames."""

    def __init__(
        self,
        intrinsics: Intrinsics,
        sensor: DepthSensor,
        rng: np.random.Generator,
        noise: bool = True,
        dropouts: bool = True,
        loss: float = RANDOM_LOSS,
    ):
        """Create a camera.

        Args:
            intrinsics: Intrinsics of the image. The projector is `sensor.baseline` [m] to the right of the sensor.
            sensor: Range limits and noise parameters.
            rng: Generator of the camera's key. It is used once, and only here.
            noise: Whether to add disparity noise and quantisation; without them, depth is only rounded to raw units.
            dropouts: Whether to remove pixels in shadows, at grazing incidence and at random.
            loss: [1] share of pixels that are removed at random.
        """
        self.intrinsics, self.sensor = intrinsics, sensor
        self._key = np.uint32(rng.integers(1 << 32))
        self._frames = 0
        self._dropouts = dropouts
        self._loss = loss
        self._bf = intrinsics.fx * sensor.baseline  # [px m]
        quantised = noise and sensor.disparity_step > 0
        self._counts = 1.0 / sensor.disparity_step if quantised else 0.0  # [1/px] steps of disparity, 0 without quantisation
        self._sigma = sensor.disparity_sigma if noise else 0.0
        self._gauss = _gaussian_table()
        self._first_count, self._last_count = self._counts_in_range()
        self._camera = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])

    def measure(self, inverse_depth: NDArray[np.float32]) -> NDArray[np.uint16]:
        """Return the next raw frame (h, w) of true inverse depth (h, w) [1/m].

        In both, 0 means no surface or no measurement.

        Raises:
            ValueError: The inverse depth does not have the camera's size, or is not float32.
        """
        shape = (self.intrinsics.height, self.intrinsics.width)
        if inverse_depth.shape != shape or inverse_depth.dtype != np.float32:
            raise ValueError(f"float32 inverse depth {shape} expected, found {inverse_depth.dtype} {inverse_depth.shape}")
        raw = np.empty(shape, dtype=np.uint16)
        frame_key = _mix(np.uint32(self._key ^ np.uint32((self._frames * 0x9E3779B9) & 0xFFFFFFFF)))
        limits = np.array([self.sensor.min_range, self.sensor.max_range, self.sensor.depth_scale])
        _expose(
            inverse_depth,
            raw,
            frame_key,
            self._bf,
            self._sigma,
            self._counts,
            self._gauss,
            (self._first_count, self._last_count),
            limits,
            self._camera,
            self._dropouts,
            self._loss,
        )
        self._frames += 1
        return raw

    def skip_frame(self) -> None:
        """Skip a frame; later frames are the same as if it had been measured."""
        self._frames += 1

    def _counts_in_range(self) -> tuple[int, int]:
        """Return the lowest and the highest disparity [steps] whose depth is within range; (1, 0) if there is none."""
        if self._counts == 0.0:
            return 1, 0
        sensor = self.sensor
        count = np.arange(1, ceil(self._bf / sensor.min_range * self._counts) + 2)
        z = self._bf * self._counts / count
        seen = (z >= sensor.min_range) & (z <= sensor.max_range) & (np.rint(z * sensor.depth_scale) <= _MAX_RAW)
        within = count[seen]
        return (int(within[0]), int(within[-1])) if len(within) else (1, 0)


def _gaussian_table() -> NDArray[np.float32]:
    """Return equally likely values of a normal distribution, scaled to unit variance."""
    n = 1 << _GAUSS_BITS
    normal = NormalDist()
    values = np.array([normal.inv_cdf((i + 0.5) / n) for i in range(n)])
    return np.asarray(values / np.sqrt(np.mean(values**2)), dtype=np.float32)


@compiled
def _mix(x: np.uint32) -> np.uint32:
    """Hash 32 bits (Wellons 2018, `lowbias32`).

    The hash is a bijection with an avalanche bias of 0.17.
    """
    # Numba widens products of 32-bit numbers, so each step converts back to 32 bits.
    x = np.uint32((x ^ (x >> np.uint32(16))) * np.uint32(0x7FEB352D))
    x = np.uint32((x ^ (x >> np.uint32(15))) * np.uint32(0x846CA68B))
    return np.uint32(x ^ (x >> np.uint32(16)))


@compiled
def _expose(
    w: NDArray[np.float32],
    raw: NDArray[np.uint16],
    key: np.uint32,
    bf: float,
    sigma: float,
    counts: float,
    gauss: NDArray[np.float32],
    counted: tuple[int, int],
    limits: Array,
    camera: Array,
    dropouts: bool,
    loss: float,
) -> None:
    """Compute a raw frame: add noise to the disparity, quantise it, remove pixels.

    A pixel has 32 random bits: the upper bits select its noise, the lower bits its loss. Each step is a separate loop over a
    row, without branches if possible, so that it is vectorised.

    Args:
        w: (h, w) [1/m] true inverse depth.
        raw: (h, w) [raw units] the frame, written.
        key: Hash of camera and frame number.
        bf: [px m] focal length times baseline.
        sigma: [px] standard deviation of the disparity.
        counts: [1/px] steps of disparity, 0 without quantisation.
        gauss: Equally likely values of a normal distribution.
        counted: First and last disparity [steps] within range.
        limits: Shortest and longest range [m], and raw units per metre.
        camera: fx, fy, cx, cy [px].
        dropouts: Whether to remove pixels.
        loss: [1] share of pixels that are removed at random.
    """
    rows, columns = raw.shape
    nearest, farthest, scale = limits
    to_count, spread, half = np.float32(bf * counts), np.float32(sigma * counts), np.float32(0.5)
    first, last = np.int32(counted[0]), np.int32(counted[1])
    raw_by_count = np.float32(bf * counts * scale)
    # Limits outside which noise cannot move a pixel into range: the Gaussian table ends at 3.7 sigma, and quantisation moves a
    # pixel by half a count.
    reach = (4.0 * sigma + (1.0 / counts if counts > 0.0 else 0.0)) / bf + 1e-3
    darkest, brightest = np.float32(max(1.0 / farthest - reach, 1e-9)), np.float32(1.0 / nearest + reach)
    bits = np.zeros(columns, dtype=np.uint32)
    noise = np.zeros(columns, dtype=np.float32)
    seen_at = np.zeros(columns, dtype=np.float32)
    fold = np.zeros((columns + 7) // 8 * 8, dtype=np.bool_)
    folds = fold.view(np.uint64)  # tests eight columns at once, because folds are rare
    u = np.arange(columns).astype(np.float32)
    x = (np.arange(columns) - camera[2]).astype(np.float32)
    for row in range(rows):
        line, out = w[row], raw[row]
        # 1. Skip rows without a pixel near the range: half of the image of a walking robot that looks at the near ground.
        inside = np.uint32(0)
        for column in range(columns):
            inside |= np.uint32((line[column] >= darkest) & (line[column] <= brightest))
        if inside == 0:
            out[:] = 0
            continue
        # 2. Add noise and apply the range.
        seed = np.uint32(row * columns)
        for column in range(columns):
            h = np.uint32(np.uint32(np.uint32(seed + np.uint32(column)) * np.uint32(0x9E3779B1)) ^ key)
            h = np.uint32(np.uint32(h ^ (h >> np.uint32(16))) * np.uint32(0x7FEB352D))
            h = np.uint32(np.uint32(h ^ (h >> np.uint32(15))) * np.uint32(0x846CA68B))
            bits[column] = np.uint32(h ^ (h >> np.uint32(16)))
        if sigma > 0.0:
            for column in range(columns):
                noise[column] = gauss[bits[column] >> np.uint32(32 - _GAUSS_BITS)]
        if counts > 0.0:
            for column in range(columns):
                reachable = (line[column] >= darkest) & (line[column] <= brightest)
                disparity = line[column] * to_count + noise[column] * spread + half if reachable else np.float32(0.0)
                count = np.int32(disparity)
                value = np.int32(raw_by_count / np.float32(max(count, first)) + half)
                out[column] = np.uint16(value) * np.uint16((count >= first) & (count <= last))
        else:
            for column in range(columns):
                out[column] = 0
                if darkest <= line[column] <= brightest:
                    d = line[column] * bf + noise[column] * sigma
                    z = bf / d if d > 0.0 else np.inf
                    value = np.rint(z * scale)
                    if nearest <= z <= farthest and value <= 65535.0:
                        out[column] = np.uint16(value)
        if not dropouts:
            continue
        # 3. Remove shadows. A point lies at u - d in the projector's image. A pixel is in shadow if any pixel to its right lies
        # further left in the projector's image.
        for column in range(columns):
            seen_at[column] = u[column] - np.float32(bf) * line[column]
        for column in range(columns - 1):
            fold[column] = seen_at[column] > seen_at[column + 1]
        column = columns - 2
        while column >= 0:
            if column % 8 == 7 and folds[column // 8] == 0:
                column -= 8
                continue
            if fold[column]:
                leftmost = seen_at[column + 1]  # minimum over all pixels to the right, which are in order
                while column >= 0 and seen_at[column] > leftmost:
                    if seen_at[column] > leftmost + np.float32(_SHADOW_MARGIN):
                        out[column] = 0
                    column -= 1
            column -= 1
        # 4. Remove pixels at grazing incidence and at random.
        above, below = w[max(row - 1, 0)], w[min(row + 1, rows - 1)]
        y, fx, fy = np.float32(row - camera[3]), np.float32(camera[0]), np.float32(camera[1])
        _graze(line, above, below, bits, x, y, fx, fy, np.float32(loss), out)
        out[0] = out[columns - 1] = 0  # the border has no neighbour on one side


@compiled
def _graze(
    line: NDArray[np.float32],
    above: NDArray[np.float32],
    below: NDArray[np.float32],
    bits: NDArray[np.uint32],
    x: NDArray[np.float32],
    y: np.float32,
    fx: np.float32,
    fy: np.float32,
    loss: np.float32,
    out: NDArray[np.uint16],
) -> None:
    """Remove pixels of a row at grazing incidence and at random.

    `line`, `above` and `below` are rows of inverse depth [1/m]; x and y are [px] from the optical axis.
    """
    one = np.float32(1.0)
    per_fx, per_fy = one / fx, one / fy
    low, width = np.float32(GRAZING[0]), np.float32(GRAZING[1] - GRAZING[0]) / max(one - loss, np.float32(1e-6))
    likely, to_unit = one - loss, np.float32(2.0 ** (_GAUSS_BITS - 32))
    mask = np.uint32((1 << (32 - _GAUSS_BITS)) - 1)
    ry2 = one + (y * per_fy) * (y * per_fy)
    for k in range(1, len(line) - 1):
        here = line[k]
        # Use the neighbour that is nearer in depth, so that the edge of a level surface does not count as steep.
        one_side, other = here - line[k - 1], line[k + 1] - here
        wu = one_side if abs(one_side) < abs(other) else other
        one_side, other = here - above[k], below[k] - here
        wv = one_side if abs(one_side) < abs(other) else other
        # On a plane w = 1/z is linear in the pixel coordinates; its gradient gives the normal, and w = normal . ray.
        nx, ny, nz = fx * wu, fy * wv, here - wu * x[k] - wv * y
        rx = x[k] * per_fx
        chance = np.float32(np.int32(bits[k] & mask)) * to_unit
        # Keep a pixel with a probability that is linear in the cosine of incidence; the comparison uses squares.
        needed = low + width * chance
        squares = (nx * nx + ny * ny + nz * nz) * (ry2 + rx * rx)
        kept = (chance < likely) & (here * here > needed * needed * squares)
        out[k] = out[k] * np.uint16(kept)  # a conditional would prevent vectorisation
