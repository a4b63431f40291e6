"""Path of a swinging foot as Erasmus' sixth-order polynomial, as a reference.

The flow function replaced it.

Source: Lotriet 2024, section 5.4.1, eq. (5.21)-(5.22), after Erasmus et al. 2023. Each coordinate is the polynomial in time
that starts and ends at rest with zero speed and acceleration, and passes the midpoint q_m (printed as q_1 in (5.22)) at half
time. The coefficients are right as printed. With s = t / t_f and D = q_f - q_i they are

    q(s) = q_i + D (10 s^3 - 15 s^4 + 6 s^5) + (q_m - q_i - D/2) 64 s^3 (1 - s)^3

In the thesis the arc restarts at the foot when its target moves, and the foot rises a second time (figure 5.12). Here a target
moves slightly in every cycle, with the pose estimate. The arc is recomputed from the start of the swing, and the foot's offset
from the arc fades with the remaining distance. Thus the foot arrives without a leap. It keeps the height over the higher end
that the newest target requires, but does not rise early before a riser.
"""

import numpy as np

from sextant.shared.geometry import Array


def arc_coefficients(q_i: Array, q_m: Array, q_f: Array, t_f: float) -> Array:
    """Return coefficients a_0 to a_6 (7, ...) of q(t), as printed in (5.22).

    Args:
        q_i: (...) [m] at time 0.
        q_m: (...) [m] at half time.
        q_f: (...) [m] at the end.
        t_f: [s] the end.
    """
    middle, end = q_m - q_i, q_f - q_i
    a_3 = 2.0 / t_f**3 * (32.0 * middle - 11.0 * end)
    a_4 = -3.0 / t_f**4 * (64.0 * middle - 27.0 * end)
    a_5 = 3.0 / t_f**5 * (64.0 * middle - 30.0 * end)
    a_6 = -32.0 / t_f**6 * (2.0 * middle - end)
    zero = np.zeros_like(middle)
    return np.array([q_i, zero, zero, a_3, a_4, a_5, a_6])


def on_arc(q_i: Array, q_m: Array, q_f: Array, share: float) -> Array:
    """Return the position (...) [m] at a share of the arc's time, 0 to 1.

    The other arguments are those of `arc_coefficients`.
    """
    return np.asarray(np.polynomial.polynomial.polyval(share, arc_coefficients(q_i, q_m, q_f, 1.0)))


class SixthOrderArc:
    """Feet in the air, each on its arc to a moving target; alternative to `Swing`."""

    def __init__(self, foot: Array, target: Array, clearance: Array):
        """Begin a swing.

        Args:
            foot: (n, 3) [m] {odom} present feet.
            target: (n, 3) [m] {odom} footholds.
            clearance: (n,) [m] over the higher end, at half time.
        """
        self.foot = foot.copy()
        self._start, self._clearance = foot.copy(), clearance.copy()

    def update(self, target: Array, progress: float, step: float) -> Array:
        """Advance by a fraction of the swing's duration.

        Args:
            target: (n, 3) [m] {odom} present footholds.
            progress: Finished share of the swing, 0 to 1.
            step: Share to advance by.

        Returns:
            (n, 3) [m] {odom} the feet.
        """
        begin, end = min(progress, 1.0), min(progress + step, 1.0)
        if end >= 1.0:
            self.foot[:] = target
            return self.foot
        middle = (self._start + target) / 2
        middle[:, 2] = np.maximum(self._start[:, 2], target[:, 2]) + self._clearance
        off = self.foot - on_arc(self._start, middle, target, begin)
        self.foot[:] = on_arc(self._start, middle, target, end) + off * _left(end) / _left(begin)
        return self.foot


def _left(share: float) -> float:
    """Return the remaining share of the horizontal path at a share of the time."""
    return 1.0 - share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
