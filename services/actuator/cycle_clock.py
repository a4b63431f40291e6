"""Time between two control cycles, and how long the computer was suspended."""

from collections.abc import Callable

from sextant.services.actuator.safety.health_monitor import GAP_S


class CycleClock:
    """Clock of the control cycle."""

    def __init__(self, now_ns: Callable[[], int], suspended_ns: Callable[[], int], period_ns: int):
        """Begin before the first cycle.

        Args:
            now_ns: [ns] clock of the servo port.
            suspended_ns: [ns] that this machine has spent suspended since it booted.
            period_ns: [ns] of a cycle.
        """
        self.now_ns = now_ns
        self.began_ns = -1  # [ns] stamp of the present cycle
        self.period_ns = period_ns  # [ns] of a cycle
        self._read_suspended_ns = suspended_ns
        self._suspended_ns = suspended_ns()

    def begin(self, stamp_ns: int) -> tuple[float, float]:
        """Begin a cycle; return the time [s] since the last one, and the share of it for leg motion."""
        elapsed = self.period_ns if self.began_ns < 0 else stamp_ns - self.began_ns
        self.began_ns = stamp_ns
        return elapsed * 1e-9, min(elapsed, 2 * self.period_ns) * 1e-9

    def suspended_s(self) -> float:
        """Return the time [s] suspended since the last call; 0 for a short time."""
        before, self._suspended_ns = self._suspended_ns, self._read_suspended_ns()
        suspended_s = (self._suspended_ns - before) * 1e-9
        return suspended_s if suspended_s > GAP_S else 0.0

    @property
    def is_current(self) -> bool:
        """Whether goals of the present cycle may still be sent.

        They are too old if this process was suspended within the cycle.
        """
        return self.now_ns() - self.began_ns < GAP_S * 1e9
