"""What is wrong with a depth camera's pictures, as far as the pictures themselves tell."""

import numpy as np
from numpy.typing import NDArray

from sextant.shared.robot.camera import DepthSensor

EMPTY, POOR = 0.02, 0.25  # shares of the picture that are measured, below which it shows nothing, or hardly anything
_STEADY = 0.1  # share of the newest picture in the mean by which it is told whether they show hardly anything
_SAMPLED = 8  # every how many rows and columns are looked at
_NOISE_SAMPLED = 16  # likewise for pairs of neighbours
_NOISE_STEP = 10  # the share of the depth by which neighbouring pixels differ on no ground, save for few: a tenth
_NOISE_SHARE = 0.5  # of the neighbours, from which a picture is noise
_PATIENCE_S = 2.0  # [s] for which a camera may see next to nothing: a wall right before it, a hand
_FROZEN_S = 1.0  # [s] after which a picture that does not change in a single pixel is an old one


def measured_share(depth: NDArray[np.uint16], sensor: DepthSensor) -> float:
    """Share of a raw picture (h, w) that lies within the sensor's range, by a sample."""
    sample = depth[::_SAMPLED, ::_SAMPLED]
    low: float = sensor.min_range * sensor.depth_scale
    high: float = sensor.max_range * sensor.depth_scale
    return float(np.count_nonzero((sample >= low) & (sample <= high))) / max(1, sample.size)


def is_noise(depth: NDArray[np.uint16]) -> bool:
    """Whether most neighbouring pixels of a raw picture (h, w) have nothing to do with each other, by a sample."""
    left = depth[::_NOISE_SAMPLED, :-1:_NOISE_SAMPLED].astype(np.int32)
    right = depth[::_NOISE_SAMPLED, 1::_NOISE_SAMPLED].astype(np.int32)
    both = (left > 0) & (right > 0)
    jumps = both & (np.abs(left - right) * _NOISE_STEP > np.minimum(left, right))
    return int(np.count_nonzero(jumps)) > _NOISE_SHARE * max(1, int(np.count_nonzero(both)))


class Watch:
    """Looks at every picture of a camera and says what is wrong with them, once it has been wrong for a while."""

    def __init__(self, sensor: DepthSensor, size: tuple[int, int]):
        """Begin.

        Args:
            sensor: The camera's range.
            size: Height and width that its pictures have.
        """
        self._sensor, self._size = sensor, size
        self._sample: NDArray[np.uint16] | None = None
        self._since_ns = 0  # since when the sample has been the same
        self._share = 1.0  # of a picture that is measured, in the mean
        self._poor_since_ns = -1  # since when next to nothing is seen, -1 while all is well
        self.sound = True  # whether the device works by its newest picture: one that sees next to nothing may work

    def look(self, depth: NDArray[np.uint16], stamp_ns: int) -> str:
        """What is wrong with the camera, in words, by its newest raw picture (h, w); nothing while all is well.

        A wall nearer than it measures and the open sky are no fault of the device: `sound` tells the two apart.
        """
        self.sound = False
        if depth.shape != self._size or depth.dtype != np.uint16:
            expected = f"{self._size[0]}x{self._size[1]} uint16"
            return f"pictures of {expected} expected by the profile, found {'x'.join(map(str, depth.shape))} {depth.dtype}"
        share = measured_share(depth, self._sensor)
        frozen_s = self._unchanged_s(depth, stamp_ns)
        self._share += _STEADY * (share - self._share)
        if share >= POOR and is_noise(depth):
            return "its pictures are noise: neighbouring pixels have nothing to do with each other"
        if min(share, self._share) >= POOR or share >= 2.0 * POOR:  # a camera whose view is free again is so at once
            self._poor_since_ns = -1
        elif self._poor_since_ns < 0:
            self._poor_since_ns = stamp_ns
        if share >= EMPTY and frozen_s >= _FROZEN_S:
            return f"it has sent the same picture for {frozen_s:.1f} s: frozen"
        self.sound = True
        poor_s = (stamp_ns - self._poor_since_ns) * 1e-9 if self._poor_since_ns >= 0 else 0.0
        if poor_s >= _PATIENCE_S:
            what = "nothing" if self._share < EMPTY else f"only {min(share, self._share):.0%} of its picture"
            return f"it has measured {what} within its range for {poor_s:.1f} s"
        return ""

    def _unchanged_s(self, depth: NDArray[np.uint16], stamp_ns: int) -> float:
        sample = depth[::_SAMPLED, ::_SAMPLED]
        if self._sample is None or not np.array_equal(sample, self._sample):
            self._sample, self._since_ns = sample.copy(), stamp_ns
        return (stamp_ns - self._since_ns) * 1e-9
