"""History of the quality of fit, against which a frame's fit is compared."""

import math

from sextant.services.perception.registration.acceptance import Acceptance, rejection_reason
from sextant.services.perception.registration.projective_matching import Match

_USUAL_SHARE = 0.05  # weight of each good frame in the average rmse
_RECENT_SHARE = 0.2  # weight of each good frame in the recent misfit and rmse
_SURPRISING, _FAR_APART = 1.25, 1.6  # times the recent misfit and the recent rmse, above which a fit is poor
_FAR_APART_FOUND = 2.0  # times the recent rmse, above which a place found by a search is wrong
_SPARSE = 0.5  # share of pixels on visible surfaces below which a failure message reports the missing pixels
_OVERLAP_WANTED = 0.6  # overlap below which a frame with a much higher misfit than recent ones is refused


class FitHistory:
    """Average fit of the good frames; infinite or the largest allowed before the first one."""

    def __init__(self, limits: Acceptance):
        """Start without frames."""
        self._limits = limits
        self.reset()

    def reset(self) -> None:
        """Forget all frames, because other ground may be rougher."""
        self._usual_rmse = self._limits.max_rmse  # [m]
        self._misfit = self._rmse = math.inf  # of recent frames; [m]

    def add(self, match: Match) -> None:
        """Add a good frame."""
        self._usual_rmse += _USUAL_SHARE * (match.rmse - self._usual_rmse)
        self._misfit, self._rmse = _recent(self._misfit, match.misfit), _recent(self._rmse, match.rmse)

    def is_poor(self, match: Match) -> bool:
        """Return whether a frame fits worse than recent ones."""
        return match.misfit > _SURPRISING * self._misfit or match.rmse > _FAR_APART * self._rmse

    def is_plausible(self, match: Match) -> bool:
        """Return whether a frame's surfaces are near enough at a place found by a search."""
        return match.rmse <= _FAR_APART_FOUND * self._rmse

    def rejection_reason(self, match: Match, usual_share: float) -> str:
        """Return why a match is rejected, or an empty string.

        The rmse limit follows the average rmse.

        Args:
            match: Of the frame.
            usual_share: Share of the usually measured pixels that the frame measures.
        """
        limits = self._limits
        usual = limits.rmse_factor * self._usual_rmse + limits.rmse_margin
        reason = rejection_reason(match, limits, min(limits.max_rmse, usual))
        if not reason or usual_share >= _SPARSE:
            return reason
        return f"{reason}; {1.0 - usual_share:.0%} of the pixels in view have no measurement"

    def worsening(self, match: Match, overlap: float = _OVERLAP_WANTED) -> str:
        """Return why a frame without legs is rejected for a poor fit, or an empty string.

        It is rejected if its misfit is far above the recent one and its overlap is at most `overlap`.
        """
        limits = self._limits
        if not limits.legless or match.overlap > overlap or match.misfit <= limits.max_worsening * self._misfit:
            return ""
        worse = match.misfit / self._misfit
        return f"{match.overlap:.0%} of the frame overlaps known ground and fits {worse:.1f} times worse than recent frames"


def _recent(mean: float, value: float) -> float:
    """Return the running mean updated with a value."""
    return mean + _RECENT_SHARE * (value - mean) if math.isfinite(mean) else value
