"""Giving way: a session of tests has a tenth of the usual weight while a file exists, and its own again once that is gone.

Where Linux shares the processor among sessions first (autogroup in sched(7)), a session is given less; elsewhere a process is.
"""

import contextlib
import os
import threading
from pathlib import Path

_TRIES, _AGAIN_S = 20, 0.11
_LITTLE, _USUAL = 10, 0  # nice values: a tenth of the usual weight, so that nothing starves

_to: Path | None = None


def give_way_to(file: Path) -> None:
    """Begin a session of this process, of little weight while a file exists."""
    global _to
    if file.exists():
        os.setsid()
        _to = file
        weigh_little(os.getpid())


def is_giving_way() -> bool:
    """Whether this process gives way, after a look at the file; it takes its usual weight back where that is gone."""
    global _to
    if _to is not None and not _to.exists():
        _to = None
        if not _weigh(os.getpid(), _USUAL):
            with contextlib.suppress(PermissionError):  # only root may be less nice than before
                os.setpriority(os.PRIO_PROCESS, 0, _USUAL)
    return _to is not None


def weigh_little(pid: int) -> None:
    """Have the session of a process, the first one in it, weigh a tenth."""
    if not _weigh(pid, _LITTLE):
        os.setpriority(os.PRIO_PROCESS, pid, _LITTLE)


def _weigh(pid: int, nice: int) -> bool:
    """Set the weight of a session; whether there is such a thing here."""
    for _ in range(_TRIES):
        try:
            Path(f"/proc/{pid}/autogroup").write_text(f"{nice}", encoding="ascii")
        except BlockingIOError:  # only root may do so more than ten times a second, all users together
            threading.Event().wait(_AGAIN_S)
        except OSError:
            return False
        else:
            return True
    return True
