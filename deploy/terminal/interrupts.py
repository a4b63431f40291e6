"""Ctrl-C and termination signals as a state instead of an exception.

No exception can therefore interrupt a cleanup.
"""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, NoReturn, Self

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupts:
    """Counts Ctrl-C, SIGTERM and SIGHUP instead of raising, while entered.

    For the main thread only.
    """

    def __init__(self) -> None:
        self.count = 0
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        for number in _SIGNALS:
            self._before[number] = signal.signal(number, self._count)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def asked(self) -> bool:
        """Return whether an end was requested."""
        return self.count > 0

    def insisted(self) -> bool:
        """Return whether an end was requested twice, so that nothing waits any longer."""
        return self.count > 1

    def _count(self, _number: int, _frame: FrameType | None) -> None:
        self.count += 1  # nothing else, because the main thread may hold any lock here


@contextmanager
def explained_interrupts(kept: Callable[[], str]) -> Iterator[None]:
    """Raise a KeyboardInterrupt at SIGTERM and SIGHUP too, and give each interrupt a text while entered.

    For the main thread only.

    Args:
        kept: Returns what the interrupted command has kept, and how to go on.
    """

    def interrupt(_number: int, _frame: FrameType | None) -> NoReturn:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(kept()) from None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
