"""Detection of faulty depth images from the images alone."""

import numpy as np
from numpy.typing import NDArray

from sextant.shared.robot.camera import DepthSensor

EMPTY, POOR = 0.02, 0.25  # shares of measured pixels below which an image shows nothing, or almost nothing
_STEADY = 0.1  # weight of the newest image in the mean measured share
_SAMPLED = 8  # every n-th row and column is checked
_NOISE_SAMPLED = 16  # the same for pairs of horizontally adjacent pixels
_NOISE_STEP = 10  # neighbours count as different from 1/10 of their depth on, which is rare on real ground
_NOISE_SHARE = 0.5  # share of such neighbours, above which an image is noise
_PATIENCE_S = 2.0  # [s] for which a camera may see almost nothing, e.g. because of a near wall or a hand
_FROZEN_S = 1.0  # [s] without a changed pixel, after which an image is frozen


def measured_share(depth: NDArray[np.uint16], sensor: DepthSensor) -> float:
    """Estimate the share of a raw image (h, w) that is within the sensor's range."""
    sample = depth[::_SAMPLED, ::_SAMPLED]
    low: float = sensor.min_range * sensor.depth_scale
    high: float = sensor.max_range * sensor.depth_scale
    return float(np.count_nonzero((sample >= low) & (sample <= high))) / max(1, sample.size)


def is_noise(depth: NDArray[np.uint16]) -> bool:
    """Return whether most sampled neighbours in a raw image (h, w) differ widely."""
    left = depth[::_NOISE_SAMPLED, :-1:_NOISE_SAMPLED].astype(np.int32)
    right = depth[::_NOISE_SAMPLED, 1::_NOISE_SAMPLED].astype(np.int32)
    both = (left > 0) & (right > 0)
    jumps = both & (np.abs(left - right) * _NOISE_STEP > np.minimum(left, right))
    return int(np.count_nonzero(jumps)) > _NOISE_SHARE * max(1, int(np.count_nonzero(both)))


class ImageQualityCheck:
    """Check of a camera's images, which reports a fault after it has lasted a while."""

    def __init__(self, sensor: DepthSensor, size: tuple[int, int]):
        """Create a check without images.

        Args:
            sensor: Range of the camera.
            size: Expected height and width of the images.
        """
        self._sensor, self._size = sensor, size
        self._sample: NDArray[np.uint16] | None = None  # every `_SAMPLED`-th row and column of the last changed image
        self._since_ns = 0  # time since which the sample is unchanged
        self._share = 1.0  # mean measured share of an image
        self._poor_since_ns = -1  # time since which almost nothing is seen, or -1
        self.sound = True  # whether the device works according to its newest image; it may see almost nothing and still work

    def check(self, depth: NDArray[np.uint16], stamp_ns: int) -> str:
        """Return the fault of the camera after a new raw image (h, w), or an empty string.

        A wall nearer than the minimum range and the open sky are not device faults. `sound` is True in these cases.
        """
        self.sound = False
        if depth.shape != self._size or depth.dtype != np.uint16:
            expected = f"{self._size[0]}x{self._size[1]} uint16"
            return f"images of {expected} expected by the profile, found {'x'.join(map(str, depth.shape))} {depth.dtype}"
        share = measured_share(depth, self._sensor)
        frozen_s = self._unchanged_s(depth, stamp_ns)
        self._share += _STEADY * (share - self._share)
        if share >= POOR and is_noise(depth):
            return "its images are noise: neighbouring pixels are unrelated"
        if min(share, self._share) >= POOR or share >= 2.0 * POOR:  # a view that becomes free is accepted at once
            self._poor_since_ns = -1
        elif self._poor_since_ns < 0:
            self._poor_since_ns = stamp_ns
        if share >= EMPTY and frozen_s >= _FROZEN_S:
            return f"it has sent the same image for {frozen_s:.1f} s: frozen"
        self.sound = True
        poor_s = (stamp_ns - self._poor_since_ns) * 1e-9 if self._poor_since_ns >= 0 else 0.0
        if poor_s >= _PATIENCE_S:
            what = "nothing" if self._share < EMPTY else f"only {min(share, self._share):.0%} of its image"
            return f"it has measured {what} within its range for {poor_s:.1f} s"
        return ""

    def _unchanged_s(self, depth: NDArray[np.uint16], stamp_ns: int) -> float:
        sample = depth[::_SAMPLED, ::_SAMPLED]
        if self._sample is None or not np.array_equal(sample, self._sample):
            self._sample, self._since_ns = sample.copy(), stamp_ns
        return (stamp_ns - self._since_ns) * 1e-9
