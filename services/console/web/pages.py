"""The pages that are open: what each is to be sent next. Slow ones get fewer frames, never a queue.

State, health and pictures are slots that the newest fills; log lines are kept until they are sent. A map or a picture is sent
once the page has drawn the one before. Everything in here belongs to one thread, the web server's.
"""

from collections import deque
from collections.abc import Sequence

_SLOTS = ("hello", "state", "glance", "health", "passage", "refused")  # in the order in which they are sent
_FRAMES = ("map", "picture")
_LINES = 64  # of the log that may wait: texts of entries, the oldest go


class Page:
    """One open page."""

    def __init__(self, number: int):
        """Nothing waits yet."""
        self.number = number
        self.press = -1  # of its pad, the newest
        self._slots: dict[str, str] = {}
        self._frames: dict[str, bytes] = {}
        self._drawing: set[str] = set()  # kinds of frames that it has been sent and has not drawn yet
        self._lines: deque[str] = deque(maxlen=_LINES)

    def post(self, kind: str, text: str) -> None:
        """Have a text sent; a newer one of its kind takes its place, but for lines of the log."""
        if kind == "log":
            self._lines.append(text)
        else:
            self._slots[kind] = text

    def show(self, kind: str, frame: bytes) -> None:
        """Have a frame sent, once the one before is drawn; a newer one takes its place."""
        self._frames[kind] = frame

    def seen(self, kind: str) -> None:
        """The page has drawn a frame."""
        self._drawing.discard(kind)

    def take(self) -> Sequence[str | bytes]:
        """What is to be sent now."""
        out: list[str | bytes] = [self._slots.pop(kind) for kind in _SLOTS if kind in self._slots]
        out += self._lines
        self._lines.clear()
        for kind in _FRAMES:
            if kind in self._frames and kind not in self._drawing:
                self._drawing.add(kind)
                out.append(self._frames.pop(kind))
        return out
