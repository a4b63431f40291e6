"""What a process asks of its host: to go before others, and to keep the memory it has."""

import ctypes
import gc
import os
import resource
import sys

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # glibc's mallopt
_KEPT = 1 << 28  # [bytes]
_SWITCH_S = 0.0005
_OPEN_FILES = 16_384
_REAL_TIME = 10  # priority, of 1 to 99: before all that has none, behind what the machine itself needs


def go_first() -> str:
    """Have this thread, and those it starts from now on, computed before all others that are not of real time too.

    Returns:
        Why it may not, in words, or nothing.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(_REAL_TIME))
    except PermissionError:
        return (
            "real-time priority is refused; allow it with `ulimit -r` or LimitRTPRIO, or busy neighbours may delay its cycles"
        )
    return ""


def switch_often() -> None:
    """Have threads of this process wait for one that computes for a tenth as long as Python's usual 5 ms.

    The servos' answers and what comes from the network are handled in threads beside the one that computes.
    """
    sys.setswitchinterval(_SWITCH_S)


def allow_many_files() -> None:
    """Raise this process's limit of open files and connections, as far as the user may: the usual 1024 is soon reached."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, _OPEN_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def spare_collector() -> None:
    """Have Python look for reference cycles rarely: messages and arrays make none, and looking costs some per cent."""
    gc.unfreeze()  # what an earlier run of this process left behind goes
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 50, 50)


def keep_memory() -> None:
    """Have large arrays come from memory that stays mapped: fresh pages cost more than what most stages compute.

    Four new arrays of 256 KiB took 0.56 ms without and 0.03 ms with it. Where there is no glibc it does nothing.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _KEPT >> 2)
        mallopt(_M_TRIM_THRESHOLD, _KEPT)
