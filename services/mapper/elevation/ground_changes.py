"""Changes of the mapped ground by corrections of the camera."""

import numpy as np

from sextant.shared.geometry import Array

_LARGEST = np.array([0.02, 0.02, 0.1])  # [1, 1, m] between two scans; more is no slow correction


class GroundChanges:
    """Follows the changes that scans state; see `Scan.ground_change`."""

    def __init__(self) -> None:
        """Start without changes."""
        self._total: Array | None = None  # (3,) of the newest scan, None before the first one

    def next(self, total: Array) -> Array | None:
        """Return how heights have changed since the last scan, as (3,) like `total`; None if they have not.

        Args:
            total: (3,) change since perception started.
        """
        last, self._total = self._total, total.copy()
        if not total.any():  # perception has started again, with the mount of the profile
            return None
        if last is None or (total == last).all() or not (np.abs(total - last) <= _LARGEST).all():
            return None
        return np.asarray(total - last)
