"""Serve a page in a thread, so that the test can act as the browser."""

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self


class Serving:
    """A thread that calls a server's `wait` repeatedly; a context manager.

    Other callers of the server must hold `turn`.
    """

    def __init__(self, wait: Callable[[float], object]):
        """Use this `wait` [s]."""
        self.turn = threading.Lock()
        self._wait = wait
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="serving", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._over.set()
        self._thread.join(10.0)

    def _serve(self) -> None:
        while not self._over.wait(0.001):  # the test's turn
            with self.turn:
                self._wait(0.002)
