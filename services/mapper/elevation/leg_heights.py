"""How much higher each leg measures the ground than the camera does.

Camera mount, link lengths and horns are never exactly those of the profile. The map follows the camera. A foot whose leg
measures the ground lower than the map shows it hangs in the air when its joints say that it stands, so each leg needs the
ground's height in its own measure. Source: the kinematic residual of Bloesch et al. (ICRA 2013), reduced to the height of each
foot and filtered on line.
"""

import numpy as np

from sextant.shared.geometry import Array
from sextant.shared.robot.profile import LEGS

_START_SIGMA_M = 0.006  # [m] of the difference before the first touchdown: a femur that is off by 2 deg
_DRIFT_SIGMA_M = 0.001  # [m] of its change from touchdown to touchdown, because the pose drifts, too
_TOUCH_SIGMA_M = 0.005  # [m] of one measurement: joint resolution, sag, and the map under one foot
_OUTLIER_M = 0.03  # [m] a larger difference is an edge, not the leg
_WORTH_TELLING_M = 0.004  # [m] difference from which the status names the leg


class LegHeights:
    """Filters the height difference of each leg at its touchdowns (a Kalman filter for each leg)."""

    def __init__(self, largest: float):
        """Start without differences.

        Args:
            largest: [m] bound of the differences either way; 0 keeps them at zero.
        """
        self._largest = largest
        self.differences: Array = np.zeros(6)  # (6,) [m] height of the ground by each leg, minus that by the camera
        self._variances: Array = np.full(6, _START_SIGMA_M**2)  # (6,) [m^2] of the differences

    def update(self, leg: int, by_touch: float, by_sight: float) -> None:
        """Take in the height [m] {world} at which a foot touched the ground, and that of the map there."""
        found = by_touch - by_sight
        if not abs(found - self.differences[leg]) <= _OUTLIER_M:  # or NaN
            return
        variance = self._variances[leg] + _DRIFT_SIGMA_M**2
        gain = variance / (variance + _TOUCH_SIGMA_M**2)
        moved = self.differences[leg] + gain * (found - self.differences[leg])
        self.differences[leg] = np.clip(moved, -self._largest, self._largest)
        self._variances[leg] = (1.0 - gain) * variance

    @property
    def measured(self) -> Array:
        """The differences (6,) [m] without the assumption that they are small; NaN before a leg's first touchdown."""
        learned = _START_SIGMA_M**2 - self._variances
        known = (learned > 0.0) & (self._largest > 0.0)
        return np.where(known, self.differences * _START_SIGMA_M**2 / np.where(known, learned, 1.0), np.nan)

    def change_ground(self, changes: Array) -> None:
        """Follow a map whose heights at the feet changed by (6,) [m]."""
        touched = self._variances < _START_SIGMA_M**2
        moved = self.differences - np.where(touched, changes, 0.0)
        self.differences = np.clip(moved, -self._largest, self._largest)

    def describe(self) -> str:
        """Return which leg differs most from the camera, as text for the operator; "" if none differs much."""
        leg = int(np.argmax(np.abs(self.differences)))
        difference = float(self.differences[leg])
        if abs(difference) < _WORTH_TELLING_M:
            return ""
        where = "lower" if difference < 0.0 else "higher"
        return (
            f"the {LEGS[leg]} leg measures the ground {abs(difference) * 1e3:.0f} mm {where} than the camera: check its horns "
            "with `sextant servos calibrate`, and the camera's mount in the profile"
        )
