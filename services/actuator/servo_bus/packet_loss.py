"""How many questions stay without a usable answer, lately."""

from collections import deque


class LossRate:
    """The share of questions lost within a window of time."""

    def __init__(self, window_ns: int) -> None:
        """Begin with nothing asked."""
        self._window_ns = window_ns
        self._asked: deque[tuple[int, bool]] = deque()  # when, and whether it was lost
        self._lost = 0
        self._lost_ns: int | None = None  # when one was lost last

    def note(self, now_ns: int, lost: bool) -> None:
        """A question has got its answer, or has been given up."""
        self._asked.append((now_ns, lost))
        self._lost += lost
        self._lost_ns = now_ns if lost else self._lost_ns
        self._forget(now_ns)

    def share(self, now_ns: int) -> float:
        """Share of the questions in the window ending now; of the last question where there is none, 0 before the first."""
        self._forget(now_ns)
        return self._lost / len(self._asked) if self._asked else 0.0

    def within(self, now_ns: int, window_ns: int) -> bool:
        """Whether a question was lost within another window ending now."""
        return self._lost_ns is not None and now_ns - self._lost_ns < window_ns

    def _forget(self, now_ns: int) -> None:
        while len(self._asked) > 1 and self._asked[0][0] <= now_ns - self._window_ns:
            self._lost -= self._asked.popleft()[1]
