"""Rate control of the scans, limited to what the link to the mapper carries.

The mapper confirms every scan. A delay above the shortest recent one is time spent in a queue. If the queue grows, perception
sends less; if there is none, it sends slightly more. It first drops every other scan, because two scans make a map. Then it
drops points far from the camera, and finally more scans, down to the minimum for a current map.
"""

from collections import deque
from dataclasses import dataclass

_LATE_NS, _SOON_NS = 100_000_000, 50_000_000  # [ns] above the shortest delay: a queue grows; no queue
_IN_A_ROW = 3  # receipts whose shortest delay counts, because a mapper that is busy for a moment is not a queue
_SILENT_NS = 300_000_000  # [ns] above the shortest delay, after which a receipt is overdue
_LESS, _MORE = 0.7, 1.07  # factors that reduce and increase the share
_RECOVERY_FACTOR = 1.3  # factor that increases it after a silence, until a queue grows
_CHANGE_NS = 250_000_000  # [ns] between two changes, because scans in transit were sent before the last one
_WINDOW_NS = 60_000_000_000  # [ns] window of the shortest delay, which is the minimum over this window and the previous one
_FEWER, _SMALLER, _LEAST = 0.5, 0.125, 0.067  # shares of all points at which scans, points, and again scans stop to be reduced
_KEPT = 64  # scans kept until their receipt arrives


@dataclass(frozen=True, slots=True)
class SendBudget:
    """Share of the scans and points that may be sent."""

    scans: float  # share of the scans, 0 to 1
    points: float  # share of a scan's points, the nearest ones


class RateControl:
    """Rate control based on scan receipts; all times are from the same clock."""

    def __init__(self) -> None:
        """Start with the full rate."""
        self.share = 1.0  # of all points of all scans
        self._sent: deque[tuple[int, int]] = deque(maxlen=_KEPT)  # stamp and time [ns] of scans without a receipt
        self._shortest_ns: list[int] = []  # of this window and the previous one
        self._window_ends_ns = 0
        self._took_ns: deque[int] = deque(maxlen=_IN_A_ROW)  # delays of the newest receipts
        self._changed_ns = 0
        self._anew = False  # whether the link recovers from a silence
        self._credit = 1.0

    @property
    def budget(self) -> SendBudget:
        """Share of scans and points that may be sent now."""
        scans = min(max(self.share, _FEWER), 1.0) * min(self.share / _SMALLER, 1.0)
        return SendBudget(scans, min(max(self.share / _FEWER, _SMALLER / _FEWER), 1.0))

    def should_send(self) -> bool:
        """Return whether to send the next scan; call once per scan."""
        self._credit += self.budget.scans
        if self._credit < 1.0 - 1e-9:
            return False
        self._credit = min(self._credit - 1.0, 1.0)
        return True

    def sent(self, stamp_ns: int, now_ns: int) -> None:
        """Register a scan that was sent."""
        self._sent.append((stamp_ns, now_ns))

    def record_receipt(self, stamp_ns: int, now_ns: int) -> None:
        """Register the receipt of a scan, which also covers all older ones."""
        took_ns = next((now_ns - at_ns for stamp, at_ns in self._sent if stamp == stamp_ns), -1)
        while self._sent and self._sent[0][0] <= stamp_ns:
            self._sent.popleft()
        if took_ns < 0:
            return
        if not self._shortest_ns:
            self._shortest_ns, self._window_ends_ns = [took_ns], now_ns + _WINDOW_NS
        elif now_ns >= self._window_ends_ns:
            self._shortest_ns, self._window_ends_ns = [took_ns, self._shortest_ns[0]], now_ns + _WINDOW_NS
        else:
            self._shortest_ns[0] = min(self._shortest_ns[0], took_ns)
        self._took_ns.append(took_ns)
        self._judge(min(self._took_ns) - min(self._shortest_ns), now_ns)

    def check_overdue(self, now_ns: int) -> None:
        """Reduce the rate if the receipt of a scan is overdue."""
        if not (self._shortest_ns and self._sent):
            return
        waits_ns = now_ns - self._sent[0][1] - min(self._shortest_ns)
        if waits_ns > _SILENT_NS:
            self._judge(waits_ns, now_ns)
            self._anew = True  # the link may have been down, which does not show its capacity

    def _judge(self, queued_ns: int, now_ns: int) -> None:
        since_ns = now_ns - self._changed_ns
        if queued_ns > _LATE_NS and since_ns >= _CHANGE_NS:
            self.share, self._changed_ns, self._anew = max(_LESS * self.share, _LEAST), now_ns, False
        elif queued_ns > _SOON_NS:
            return  # keep the current rate
        elif self.share < 1.0 and since_ns >= _CHANGE_NS:
            self.share, self._changed_ns = min((_RECOVERY_FACTOR if self._anew else _MORE) * self.share, 1.0), now_ns
