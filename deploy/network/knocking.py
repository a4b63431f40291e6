"""Why a router is not let in by another machine's: Zenoh tries again and again in silence, so it is found out beside it."""

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

_PAUSE_S = 3.0


class Knocking:
    """Asks now and then, while there is no connection, and tells each answer once; a context manager with a thread."""

    def __init__(
        self, ask: Callable[[], str], connected: Callable[[], bool], tell: Callable[[str], None], pause_s: float = _PAUSE_S
    ):
        """Prepare.

        Args:
            ask: Why nobody lets us in, in words, or nothing; may take seconds.
            connected: Whether somebody has.
            tell: Is told why, from the thread.
            pause_s: [s] between two times.
        """
        self._ask, self._connected, self._tell, self._pause_s = ask, connected, tell, pause_s
        self._end = threading.Event()
        self._told = ""
        self._thread = threading.Thread(target=self._run, name="knocking", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._end.set()  # not waited for: it may be asking a machine that does not answer

    def look(self) -> None:
        """Ask once, and tell what is new."""
        why = "" if self._connected() else self._ask()
        if why and why != self._told:
            self._tell(why)
        self._told = why

    def _run(self) -> None:
        while not self._end.is_set():
            self.look()
            self._end.wait(self._pause_s)
