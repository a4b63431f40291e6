"""Find out why another machine's router does not accept this one.

Zenoh retries without reporting the reason.
"""

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

_PAUSE_S = 3.0


class ConnectProbe:
    """Periodic check while there is no connection; a context manager with a thread."""

    def __init__(
        self, ask: Callable[[], str], connected: Callable[[], bool], tell: Callable[[str], None], pause_s: float = _PAUSE_S
    ):
        """Prepare.

        Args:
            ask: Returns why the connection is refused, or an empty string; may take seconds.
            connected: Returns whether there is a connection.
            tell: Called with each new reason, from the thread.
            pause_s: [s] between two checks.
        """
        self._ask, self._connected, self._tell, self._pause_s = ask, connected, tell, pause_s
        self._end = threading.Event()
        self._told = ""
        self._thread = threading.Thread(target=self._run, name="knocking", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._end.set()  # the thread is not joined: it may be waiting for a machine that does not answer

    def look(self) -> None:
        """Check once, and report a new reason."""
        why = "" if self._connected() else self._ask()
        if why and why != self._told:
            self._tell(why)
        self._told = why

    def _run(self) -> None:
        while not self._end.is_set():
            self.look()
            self._end.wait(self._pause_s)
