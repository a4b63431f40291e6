"""Memory of refused crossings, so that the robot does not try again at once at the same place."""

import numpy as np

from sextant.services.planner.gap_crossing.params import GapApproachParams
from sextant.shared.geometry import Array


class RefusalMemory:
    """The last refusal with its place, and the last place where nothing was found to cross."""

    def __init__(self, params: GapApproachParams):
        """Start without refusals."""
        self._params = params
        self._reason = self._straight_refusal = ""
        self._refused_at: Array | None = None  # (2,) [m] {world}
        self._refused_ns, self._lifetime_ns = 0, self._first_lifetime_ns
        self._nothing_at: Array | None = None  # (2,) [m] {world} place of a look that found nothing to cross

    def forget(self) -> None:
        """Forget both places, because the robot has another goal."""
        self._reason, self._straight_refusal, self._refused_at, self._nothing_at = "", "", None, None

    def reason_at(self, xy: Array, now_ns: int) -> str:
        """Return why a crossing at a place (2,) [m] {world} was refused lately, or ""."""
        if not (now_ns - self._refused_ns < self._lifetime_ns and self._is_near(xy, self._refused_at)):
            self._reason = ""
        return self._reason

    def straight_refusal_at(self, xy: Array) -> str:
        """Return why no section led straight on in the last crossing near a place (2,) [m] {world}, or ""."""
        return self._straight_refusal if self._is_near(xy, self._refused_at) else ""

    def refuse(self, reason: str, xy: Array, now_ns: int, straight_refusal: str = "") -> None:
        """Add a refusal at a place (2,) [m] {world}; its lifetime doubles if the place was refused before.

        `straight_refusal` is why no section led straight on, or "" if the body did not turn.
        """
        again = self._is_near(xy, self._refused_at)
        self._lifetime_ns = 2 * self._lifetime_ns if again else self._first_lifetime_ns
        self._straight_refusal = straight_refusal or self.straight_refusal_at(xy)
        self._reason, self._refused_at, self._refused_ns = reason, xy.copy(), now_ns

    def complete(self, nothing_at: Array | None) -> None:
        """Note that a crossing is complete, and the place (2,) [m] {world} if there was nothing to cross."""
        self._nothing_at = None if nothing_at is None else nothing_at.copy()

    def found_nothing_at(self, xy: Array) -> bool:
        """Return whether a look near a place (2,) [m] {world} found nothing to cross."""
        return self._is_near(xy, self._nothing_at)

    @property
    def _first_lifetime_ns(self) -> int:
        return round(self._params.refusal_s * 1e9)

    def _is_near(self, xy: Array, place: Array | None) -> bool:
        return place is not None and float(np.linalg.norm(xy - place)) < self._params.retry_distance_m
