"""Computing only while nobody else wants to, where Linux shares the processor among sessions first (autogroup in sched(7))."""

import os
import threading
from pathlib import Path

_TRIES, _AGAIN_S = 20, 0.11
_NICE = "10"  # a tenth of the usual weight, so that nobody starves for long


def is_idle() -> bool:
    """Whether this process computes only while no other of its session wants to."""
    return os.sched_getscheduler(0) == os.SCHED_IDLE


def weigh_little(pid: int) -> None:
    """Have the session of a process, the first one in it, go behind all other sessions."""
    for _ in range(_TRIES):
        try:
            Path(f"/proc/{pid}/autogroup").write_text(_NICE, encoding="ascii")
        except BlockingIOError:  # only root may do so more than ten times a second, all users together
            threading.Event().wait(_AGAIN_S)
        except OSError:
            return  # there are no such groups here
        else:
            return
