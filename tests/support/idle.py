"""Give way: run tests at a tenth of the usual CPU weight while a file exists.

The usual weight returns when the file is gone. Where Linux shares the processor among sessions first (autogroup in sched(7)),
the session's weight is reduced; elsewhere the process's weight is.
"""

import contextlib
import os
import threading
from pathlib import Path

_TRIES, _AGAIN_S = 20, 0.11
_LITTLE, _USUAL = 10, 0  # nice values: a tenth of the usual weight still lets every process run

_to: Path | None = None


def give_way_to(file: Path) -> None:
    """Start a session of this process with little weight while a file exists."""
    global _to
    if file.exists():
        os.setsid()
        _to = file
        weigh_little(os.getpid())


def is_giving_way() -> bool:
    """Return whether this process gives way; check the file.

    The process takes its usual weight back if the file is gone.
    """
    global _to
    if _to is not None and not _to.exists():
        _to = None
        if not _weigh(os.getpid(), _USUAL):
            with contextlib.suppress(PermissionError):  # only root may lower a nice value
                os.setpriority(os.PRIO_PROCESS, 0, _USUAL)
    return _to is not None


def weigh_little(pid: int) -> None:
    """Reduce the weight of a session to a tenth; `pid` is its leader."""
    if not _weigh(pid, _LITTLE):
        os.setpriority(os.PRIO_PROCESS, pid, _LITTLE)


def _weigh(pid: int, nice: int) -> bool:
    """Set the weight of a session; return whether sessions have weights here."""
    for _ in range(_TRIES):
        try:
            Path(f"/proc/{pid}/autogroup").write_text(f"{nice}", encoding="ascii")
        except BlockingIOError:  # all users together may do so ten times a second, except root
            threading.Event().wait(_AGAIN_S)
        except OSError:
            return False
        else:
            return True
    return True
