"""How many functions the processes of a first start have compiled, as lines of their output."""

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_REPORT_EVERY_S = 0.5
COMPILED = "compiled"  # first word of a line of progress; then process, compiled functions, all functions


@contextmanager
def reported(after_s: float = 0.0) -> Iterator[None]:
    """Print the number of compiled functions while the block runs, whenever it changes.

    Args:
        after_s: [s] until the first line; a block that compiles nothing is over before.
    """
    ended = threading.Event()

    def report() -> None:
        told, pause_s = "", after_s or _REPORT_EVERY_S
        while not ended.wait(pause_s):
            known, pause_s = _compiled_functions(), _REPORT_EVERY_S
            line = f"{COMPILED} {os.getpid()} {len(_ready(known))} {len(known)}"
            if line != told:
                told = line
                sys.stdout.write(line + "\n")
                sys.stdout.flush()

    reporter = threading.Thread(target=report, name="report", daemon=True)
    reporter.start()
    try:
        yield
    finally:
        ended.set()
        reporter.join()


class CompiledFunctions:
    """Number of functions that processes have compiled, from their lines of progress."""

    def __init__(self) -> None:
        """Start without any line."""
        self._of_process: dict[str, tuple[int, int]] = {}

    def hear(self, _name: str, line: str) -> bool:
        """Read a line; return whether it is about progress."""
        match line.split():
            case [str(word), process, done, total] if word == COMPILED and done.isdecimal() and total.isdecimal():
                self._of_process[process] = int(done), int(total)
                return True
        return False

    def count(self) -> tuple[int, int]:
        """Return the number of compiled functions, and of all."""
        counts = list(self._of_process.values())
        return sum(done for done, _ in counts), sum(total for _, total in counts)


def _ready(functions: list[Any]) -> list[Any]:
    """Return the functions that are compiled, also those that a loaded function of their file contains."""
    loaded = {one.py_func.__module__ for one in functions if one.stats.cache_hits}
    return [one for one in functions if one.overloads or one.py_func.__module__ in loaded]


def _compiled_functions() -> list[Any]:
    """Return the functions that Numba compiles, except those that it inlines."""
    numba = sys.modules.get("numba.core.dispatcher")  # imported only by services that compile
    if numba is None:
        return []
    modules = [vars(module) for name, module in list(sys.modules.items()) if name.startswith("sextant.")]
    found = {id(one): one for names in modules for one in list(names.values()) if isinstance(one, numba.Dispatcher)}
    return [one for one in found.values() if one.targetoptions.get("inline") != "always"]
