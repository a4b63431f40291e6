"""Recent rate of requests without a usable answer."""

from collections import deque


class LossRate:
    """Share of requests lost within a time window."""

    def __init__(self, window_ns: int) -> None:
        """Begin without requests."""
        self._window_ns = window_ns
        self._asked: deque[tuple[int, bool]] = deque()  # time, and whether it was lost
        self._lost = 0
        self._lost_ns: int | None = None  # when the last one was lost

    def note(self, now_ns: int, lost: bool) -> None:
        """Record whether a request was answered or lost."""
        self._asked.append((now_ns, lost))
        self._lost += lost
        self._lost_ns = now_ns if lost else self._lost_ns
        self._forget(now_ns)

    def share(self, now_ns: int) -> float:
        """Return the share lost in the window that ends now.

        Without requests in it, it is that of the last request, or 0 before the first.
        """
        self._forget(now_ns)
        return self._lost / len(self._asked) if self._asked else 0.0

    def within(self, now_ns: int, window_ns: int) -> bool:
        """Return whether a request was lost within another window that ends now."""
        return self._lost_ns is not None and now_ns - self._lost_ns < window_ns

    def _forget(self, now_ns: int) -> None:
        while len(self._asked) > 1 and self._asked[0][0] <= now_ns - self._window_ns:
            self._lost -= self._asked.popleft()[1]
