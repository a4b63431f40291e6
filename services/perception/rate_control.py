"""How many scans cross the link to the map, and how large: as much as it carries before they grow late.

The mapper says of every scan that it has come. What a scan takes beyond the shortest time that one has taken lately is spent
in a queue; when that grows, less is sent, and as long as there is none a little more. Every other scan goes first, since a map
is made of two; then points far from the camera; then more scans, down to what a fresh map needs.
"""

from collections import deque
from dataclasses import dataclass

_LATE_NS, _SOON_NS = 100_000_000, 50_000_000  # beyond the shortest time: a queue grows; none does
_IN_A_ROW = 3  # receipts of which the soonest counts: a mapper that is busy for a moment is no queue
_SILENT_NS = 300_000_000  # beyond the shortest time, without a receipt
_LESS, _MORE = 0.7, 1.07  # factors by which what is sent changes
_ANEW = 1.3  # likewise after a silence, until a queue grows
_CHANGE_NS = 250_000_000  # between two changes: what is on its way was sent before the last one
_WINDOW_NS = 60_000_000_000  # over which the shortest time is looked for, and up to twice that
_FEWER, _SMALLER, _LEAST = 0.5, 0.125, 0.067  # shares of all: down to these scans, points, and again scans are left out
_KEPT = 64  # scans whose receipt is waited for


@dataclass(frozen=True, slots=True)
class Allowance:
    """What may be sent."""

    scans: float  # share of the scans, 0 to 1
    points: float  # share of a scan's points, the nearest


class LinkCare:
    """Watches when scans arrive; all times are of one clock."""

    def __init__(self) -> None:
        """Begin with all that there is."""
        self.share = 1.0  # of all points of all scans
        self._sent: deque[tuple[int, int]] = deque(maxlen=_KEPT)  # stamp and time [ns] of scans without a receipt
        self._shortest_ns: list[int] = []  # of this window and the last
        self._window_ends_ns = 0
        self._took_ns: deque[int] = deque(maxlen=_IN_A_ROW)  # by the newest receipts
        self._changed_ns = 0
        self._anew = False  # whether it carries again after a silence
        self._credit = 1.0

    @property
    def allowance(self) -> Allowance:
        """What may be sent now."""
        scans = min(max(self.share, _FEWER), 1.0) * min(self.share / _SMALLER, 1.0)
        return Allowance(scans, min(max(self.share / _FEWER, _SMALLER / _FEWER), 1.0))

    def wants(self) -> bool:
        """Whether the next scan is to be sent; asked once for each."""
        self._credit += self.allowance.scans
        if self._credit < 1.0 - 1e-9:
            return False
        self._credit = min(self._credit - 1.0, 1.0)
        return True

    def sent(self, stamp_ns: int, now_ns: int) -> None:
        """A scan has been sent."""
        self._sent.append((stamp_ns, now_ns))

    def received(self, stamp_ns: int, now_ns: int) -> None:
        """The mapper has a scan, and needs no receipt of older ones."""
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

    def look(self, now_ns: int) -> None:
        """See whether a scan is late of which nothing has been heard."""
        if not (self._shortest_ns and self._sent):
            return
        waits_ns = now_ns - self._sent[0][1] - min(self._shortest_ns)
        if waits_ns > _SILENT_NS:
            self._judge(waits_ns, now_ns)
            self._anew = True  # it may have been cut, which says nothing of how much it carries

    def _judge(self, queued_ns: int, now_ns: int) -> None:
        since_ns = now_ns - self._changed_ns
        if queued_ns > _LATE_NS and since_ns >= _CHANGE_NS:
            self.share, self._changed_ns, self._anew = max(_LESS * self.share, _LEAST), now_ns, False
        elif queued_ns > _SOON_NS:
            return  # enough is sent
        elif self.share < 1.0 and since_ns >= _CHANGE_NS:
            self.share, self._changed_ns = min((_ANEW if self._anew else _MORE) * self.share, 1.0), now_ns
