"""What differs between operating systems: the end of a process with its parent, and the usable cores."""

import ctypes
import os
import signal
import threading

_PR_SET_PDEATHSIG = 1  # Linux: sends a signal to this process when the thread that started it ends
_LOOK_S = 0.2  # [s] between two looks at the parent where the system does not report its end


def signal_at_end_of(parent: int, number: signal.Signals) -> bool:
    """Send this process a signal when its parent process ends.

    Linux sends it at once. Elsewhere a thread looks for the parent several times a second.

    Args:
        parent: Process id of the parent.
        number: The signal.

    Returns:
        Whether the parent still lives.
    """
    prctl = getattr(ctypes.CDLL(None), "prctl", None)
    if prctl is not None:
        prctl(_PR_SET_PDEATHSIG, number)
    else:
        threading.Thread(target=_watch, args=(parent, number), name="watches the parent", daemon=True).start()
    return os.getppid() == parent  # False if it died before the call above


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _watch(parent: int, number: signal.Signals) -> None:
    pause = threading.Event()
    while os.getppid() == parent:
        pause.wait(_LOOK_S)
    os.kill(os.getpid(), number)
