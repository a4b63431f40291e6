"""Shutdown of a process: with its parent or on request, in bounded time.

It avoids steps that may hang.
"""

import faulthandler
import logging
import os
import signal
import sys
import threading
from types import TracebackType
from typing import Any, NoReturn, Self

from sextant.shared.runtime.operating_system import signal_at_end_of

_STDERR = 2
_END_S = 10.0  # [s] time limit of the shutdown; launchers and systemd kill a process earlier


def end_with(parent: int) -> None:
    """End this process when its parent process, which has the id `parent`, ends."""
    if not signal_at_end_of(parent, signal.SIGTERM):
        raise SystemExit(1)


def bound_the_end() -> None:
    """End this process with status 1 if it still runs in ten seconds.

    The tracebacks of all threads are printed.
    """
    faulthandler.dump_traceback_later(_END_S, exit=True, file=_STDERR)  # from a thread that does not need the interpreter


class ShutdownRequested:
    """Context manager of the main thread that sets an event on SIGTERM or SIGINT.

    A separate thread waits for the signals. A signal handler would have to wait for the main thread, which may be blocked in a
    library call. After a signal the process has ten seconds to leave the block, see `bound_the_end`.
    """

    def __init__(self) -> None:
        self.event = threading.Event()
        self._at_once = True
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        self._reads, self._writes = os.pipe()
        os.set_blocking(self._writes, False)
        self._wakes_before = signal.set_wakeup_fd(self._writes, warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGINT):  # with a handler installed, Python writes the number to the pipe
            self._before[number] = signal.signal(number, lambda *_: None)
        self._thread = threading.Thread(target=self._listen, name="told to end", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        signal.set_wakeup_fd(self._wakes_before)
        for number, handler in self._before.items():
            signal.signal(number, handler)
        os.close(self._writes)  # ends the thread
        self._thread.join()
        os.close(self._reads)
        faulthandler.cancel_dump_traceback_later()  # of `bound_the_end`

    def open(self) -> None:
        """Set the event on signals from now on, for an orderly shutdown.

        Before this call a signal ends the process at once, with status 0.
        """
        self._at_once = False

    def _listen(self) -> None:
        while number := os.read(self._reads, 1):
            if number[0] not in self._before or self.event.is_set():
                continue
            if self._at_once:
                os._exit(0)
            self.event.set()
            bound_the_end()


def leave_at_errors() -> None:
    """Make an uncaught exception print its traceback and end the process with `leave`."""

    def told(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        sys.__excepthook__(kind, error, trace)
        leave(1)

    sys.excepthook = told


def leave_at_errors_of_threads() -> None:
    """Make an uncaught exception in any thread end the process.

    Use it for threads that depend on each other.
    """

    def told(failed: threading.ExceptHookArgs) -> None:
        threading.__excepthook__(failed)
        leave(1)

    threading.excepthook = told


def leave(status: int) -> NoReturn:
    """End this process without the interpreter's teardown, which may hang.

    The caller must have closed all files and connections.
    """
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
