"""Doubt about the pose, which starts searches of the map."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.error_twist import error_twist
from sextant.shared.geometry import inverse

_SAME_AWAY = np.array([0.04, 0.04, 0.04, 0.05, 0.05, 0.05])  # [m] and [rad] within which two searches agree


class PoseDoubt:
    """Consecutive doubtful frames, and what the last search for a better pose found."""

    def __init__(self, frames_before_search: int, search_every: int):
        """Start without doubt.

        Args:
            frames_before_search: Number of consecutive doubtful or failed frames that start a search.
            search_every: [frames] between searches while the doubt lasts.
        """
        self._before_search, self._every = frames_before_search, search_every
        self.reset()

    def reset(self) -> None:
        """Forget all frames and searches, because the map starts again."""
        self._doubtful = 0  # consecutive frames, including failed ones
        self._correction: NDArray[np.float64] | None = None  # (4, 4) of expected poses, by the last search for a doubtful frame
        self._suspended = 0  # frames for which the doubt is suspended, because the ground changed and not the pose

    def is_suspended(self) -> bool:
        """Return whether contradictions to the map are believed; call once per frame."""
        self._suspended = max(0, self._suspended - 1)
        return self._suspended > 0

    def suspend(self) -> None:
        """Believe contradictions for a while, because the scene has changed and not the pose."""
        self._suspended = self._every

    def update(self, doubted: bool) -> None:
        """Count a frame."""
        self._doubtful = self._doubtful + 1 if doubted else 0
        self._correction = self._correction if doubted else None

    def clear(self) -> None:
        """End the doubt: a better pose was found, from which the next search starts."""
        self._doubtful, self._correction = 0, None

    @property
    def lasts(self) -> bool:
        """Whether enough consecutive frames contradict the map for a search, or the last search found the scene changed."""
        return self._doubtful >= self._before_search or self._suspended > 0

    def is_search_due(self) -> bool:
        """Return whether to search for a better pose now."""
        since = self._doubtful - self._before_search
        return since >= 0 and since % self._every == 0

    def is_confirmed(self, T_found: NDArray[np.float64], T_expected: NDArray[np.float64]) -> bool:
        """Return whether two consecutive searches correct the expected poses (4, 4) equally.

        The correction is in {world}, because there it stays the same while the robot walks.
        """
        before, self._correction = self._correction, T_found @ inverse(T_expected)
        return before is not None and bool((np.abs(error_twist(T_found, before @ T_expected)) < _SAME_AWAY).all())
