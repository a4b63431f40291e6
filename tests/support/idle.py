"""Computing only while nobody else wants to, where Linux shares the processor among sessions first (autogroup in sched(7))."""

import contextlib
import os
from pathlib import Path


def is_idle() -> bool:
    """Whether this process computes only while no other of its session wants to."""
    return os.sched_getscheduler(0) == os.SCHED_IDLE


def weigh_little(pid: int) -> None:
    """Have the session of a process, the first one in it, go behind all other sessions."""
    with contextlib.suppress(OSError):  # there are no such groups here, or this user may not just now
        Path(f"/proc/{pid}/autogroup").write_text("19", encoding="ascii")
