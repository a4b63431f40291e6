"""Wrong time stamps of a camera's images."""

from collections import deque
from collections.abc import Iterator

import numpy as np

from sextant.shared.wire.messages import ColorImage, DepthImage


class StampErrors:
    """Stamps the images of one camera, and holds an image back until it arrives.

    A camera or its driver stamps an image when it arrives, some time after its exposure. With a negative offset, the stamp is
    earlier than the exposure.
    """

    def __init__(self, offset_s: float, jitter_s: float, rng: np.random.Generator):
        """Begin without an image.

        Args:
            offset_s: [s] mean time from an exposure to its stamp.
            jitter_s: [s] standard deviation of that time.
            rng: Random generator.
        """
        self._offset_s, self._jitter_s, self._rng = offset_s, jitter_s, rng
        self._held: deque[tuple[int, DepthImage | ColorImage]] = deque()  # arrival [ns] and image
        self._newest_ns = -1

    def stamp(self, exposed_ns: int) -> int:
        """Return the stamp [ns] of an image that is exposed now; stamps rise."""
        late_s = self._offset_s + (self._rng.normal(0.0, self._jitter_s) if self._jitter_s else 0.0)
        self._newest_ns = max(self._newest_ns + 1, exposed_ns + round(late_s * 1e9))
        return self._newest_ns

    def hold(self, image: DepthImage | ColorImage, due_ns: int) -> None:
        """Add an image that arrives at `due_ns`, in the order of the exposures."""
        self._held.append((due_ns, image))

    def release(self, now_ns: int) -> Iterator[DepthImage | ColorImage]:
        """Yield the images that have arrived."""
        while self._held and self._held[0][0] <= now_ns:
            yield self._held.popleft()[1]
