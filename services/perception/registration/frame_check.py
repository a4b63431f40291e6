"""Checks of a depth frame before it is registered: order, size, noise, frozen image."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.cameras.image_quality import is_noise
from sextant.services.perception.registration.motion_prior import Motion
from sextant.shared.wire.messages import DepthImage

OUT_OF_ORDER_NS = 1_000_000_000  # [ns] a frame older than the newest by less than this is late; by more, the clock has changed
_LATE_FRAMES = 3  # consecutive late frames from which the stamps are wrong, and not the order of the messages
_AHEAD_NS, _OLD_NS = 500_000_000, 1_500_000_000  # [ns] from the robot's clock; odometry is kept for 2 s
_SPACING_PX = 8  # [px] row and column spacing of the pixels compared to detect a frozen image
_MOVED = 0.01  # [m] or [rad] body motion after which two identical images show a frozen camera


class FrameCheck:
    """Checks frames of one camera in the order of their arrival."""

    def __init__(self, size: tuple[int, int]):
        """Start without frames; `size` is the expected (rows, columns)."""
        self._size = size
        self._newest_ns = -OUT_OF_ORDER_NS  # stamp of the newest frame
        self._late = 0  # consecutive late frames
        self._picture: tuple[NDArray[np.uint16], int, Motion | None] | None = None  # pixel sample, first stamp, and motion then

    def has_expected_size(self, image: DepthImage) -> bool:
        """Return whether an image has the profile's size."""
        return image.depth.shape == self._size

    def is_late(self, stamp_ns: int) -> bool:
        """Return whether a newer frame has come before; call once per frame."""
        if 0 <= self._newest_ns - stamp_ns < OUT_OF_ORDER_NS:  # an older stamp is from another clock
            self._late += 1
            return True
        self._newest_ns, self._late = stamp_ns, 0
        return False

    def stamp_fault(self, stamp_ns: int, clock_ns: int | None) -> str:
        """Return why a stamp is wrong, or an empty string; call it for each frame, before `is_late`.

        Args:
            stamp_ns: [ns] stamp of the frame.
            clock_ns: [ns] time by the robot's clock, None if unknown.
        """
        if clock_ns is not None and stamp_ns > clock_ns + _AHEAD_NS:
            return f"the camera stamps its images {(stamp_ns - clock_ns) * 1e-9:.1f} s in the future"
        if clock_ns is not None and stamp_ns < clock_ns - _OLD_NS:
            return f"the camera's images are {(clock_ns - stamp_ns) * 1e-9:.1f} s old by their stamps"
        before_s = (self._newest_ns - stamp_ns) * 1e-9
        same_clock = before_s < OUT_OF_ORDER_NS * 1e-9 or (clock_ns is not None and self._newest_ns <= clock_ns + _AHEAD_NS)
        if self._late >= _LATE_FRAMES and before_s >= 0.0 and same_clock:
            return f"the camera's stamps do not rise: the newest image is stamped {before_s:.1f} s before an earlier one"
        return ""

    def fault(self, image: DepthImage, motion: Motion | None) -> str:
        """Return why a frame is useless, or an empty string; call once per frame.

        Args:
            image: The frame.
            motion: Motion of the body at the stamp of the frame, None if unknown.
        """
        if not self.has_expected_size(image):
            found = image.depth.shape
            return f"a frame of {self._size} expected by the profile, found {found}: check the camera's intrinsics"
        if is_noise(image.depth):
            return "the camera sends noise: neighbouring pixels are unrelated"
        return self._frozen(image, motion)

    def _frozen(self, image: DepthImage, motion: Motion | None) -> str:
        """Return why an image is frozen, or an empty string.

        A frozen image stays the same although the body has moved.
        """
        sample = image.depth[::_SPACING_PX, ::_SPACING_PX]
        if self._picture is None or not np.array_equal(sample, self._picture[0]):
            self._picture = (sample.copy(), image.stamp_ns, motion)
            return ""
        first, since_ns, before = self._picture
        if before is None:  # no odometry since the first of these images
            self._picture = (first, since_ns, motion)
        if motion is None or before is None or not sample.any():
            return ""
        if np.abs(motion.T_odom_body - before.T_odom_body).max() <= _MOVED:
            return ""
        return f"the camera has sent the same image for {(image.stamp_ns - since_ns) * 1e-9:.1f} s while the legs moved: frozen"
