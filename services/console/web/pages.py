"""Outgoing messages of one open page.

A slow page receives fewer frames instead of a growing queue. Each kind of message has one slot, and a newer message replaces
the older one. Log lines are kept until they are sent. A map or a picture is sent after the page has drawn the previous one.
Only the web server's thread may use these objects.
"""

from collections import deque
from collections.abc import Sequence

_SLOTS = ("hello", "state", "glance", "calibration", "health", "passage", "refused")  # in sending order
_FRAMES = ("map", "picture")
_MAX_LINES = 64  # maximum number of waiting log messages; the oldest are dropped


class Page:
    """Outgoing messages of one open page."""

    def __init__(self, number: int):
        """Create the empty slots of a page with a number."""
        self.number = number
        self.press = -1  # number of the newest press of its pad
        self._slots: dict[str, str] = {}
        self._frames: dict[str, bytes] = {}
        self._drawing: set[str] = set()  # kinds of frames that were sent and are not drawn yet
        self._lines: deque[str] = deque(maxlen=_MAX_LINES)

    def post(self, kind: str, text: str) -> None:
        """Queue a text, which replaces the waiting text of its kind; log lines accumulate."""
        if kind == "log":
            self._lines.append(text)
        else:
            self._slots[kind] = text

    def show(self, kind: str, frame: bytes) -> None:
        """Queue a frame, which replaces the waiting frame of its kind."""
        self._frames[kind] = frame

    def seen(self, kind: str) -> None:
        """Record that the page has drawn the last frame of a kind."""
        self._drawing.discard(kind)

    def take(self) -> Sequence[str | bytes]:
        """Remove and return the messages that are ready to send."""
        out: list[str | bytes] = [self._slots.pop(kind) for kind in _SLOTS if kind in self._slots]
        out += self._lines
        self._lines.clear()
        for kind in _FRAMES:
            if kind in self._frames and kind not in self._drawing:
                self._drawing.add(kind)
                out.append(self._frames.pop(kind))
        return out
