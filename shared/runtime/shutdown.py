"""How a process ends: with the one that started it, when it is told to, in bounded time, and without what may hang."""

import ctypes
import faulthandler
import logging
import os
import signal
import sys
import threading
from types import TracebackType
from typing import Any, NoReturn, Self

_PR_SET_PDEATHSIG = 1  # Linux: a signal for this process when the thread that started it ends
_STDERR = 2
_END_S = 10.0  # [s] by which a process has closed what it had open, or never will; launchers and systemd kill sooner


def end_with(parent: int) -> None:
    """End this process when the one with an id, which must have started it, has ended; nothing is orphaned."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:  # it died before the call above
        raise SystemExit(1)


def bound_the_end() -> None:
    """Have this process end in ten seconds, with status 1 and word of where each thread was, if it has not ended by then."""
    faulthandler.dump_traceback_later(_END_S, exit=True, file=_STDERR)  # by a thread that needs nothing of Python's


class ToldToEnd:
    """SIGTERM and SIGINT as an event, for as long as a block of the main thread runs; a context manager.

    A thread waits for them, because a signal's handler has to wait for the main thread, which may be caught in a call into a
    library that lets other threads run meanwhile. Who is told has ten seconds to leave the block, see `bound_the_end`.
    """

    def __init__(self) -> None:
        self.event = threading.Event()
        self._at_once = True
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        self._reads, self._writes = os.pipe()
        os.set_blocking(self._writes, False)
        self._wakes_before = signal.set_wakeup_fd(self._writes, warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGINT):  # a handler has it written to the pipe, and need not do anything
            self._before[number] = signal.signal(number, lambda *_: None)
        self._thread = threading.Thread(target=self._listen, name="told to end", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        signal.set_wakeup_fd(self._wakes_before)
        for number, handler in self._before.items():
            signal.signal(number, handler)
        os.close(self._writes)  # at which the thread ends
        self._thread.join()
        os.close(self._reads)
        faulthandler.cancel_dump_traceback_later()  # of `bound_the_end`

    def open(self) -> None:
        """Have the process close what it opens from now on; before, it ends at once when it is told, with status 0."""
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
    """Have whatever this process raises in the end be told as usual, and the process left as by `leave`."""

    def told(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        sys.__excepthook__(kind, error, trace)
        leave(1)

    sys.excepthook = told


def leave_at_errors_of_threads() -> None:
    """End this process when one of its threads fails, for one whose threads are of no use without each other."""

    def told(failed: threading.ExceptHookArgs) -> None:
        threading.__excepthook__(failed)
        leave(1)

    threading.excepthook = told


def leave(status: int) -> NoReturn:
    """End this process, which has closed what it had open, without the interpreter's teardown, in which libraries may hang."""
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
