"""Operating system settings of a process: priority, open files and memory."""

import ctypes
import gc
import os
import resource
import sys

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # glibc's mallopt
_KEPT = 1 << 28  # [bytes]
_SWITCH_S = 0.0005
_OPEN_FILES = 16_384
_LOWEST = 19  # niceness
_REAL_TIME = 10  # real-time priority, 1 to 99: above normal processes, below the kernel's own threads


def go_first() -> str:
    """Give real-time priority to this thread and to those that it starts from now on.

    Returns:
        Why the system refuses it, or an empty text.
    """
    if not hasattr(os, "sched_setscheduler"):
        return "this system has no real-time priority, so busy processes may delay the cycles"
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(_REAL_TIME))
    except PermissionError:
        return "real-time priority is refused, so busy processes may delay the cycles; allow it with `ulimit -r` or LimitRTPRIO"
    return ""


def go_last() -> None:
    """Let this process run only on idle cores, where the system has such a priority; else with the lowest one."""
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    else:
        os.nice(_LOWEST)


def switch_often() -> None:
    """Set Python's switch interval to a tenth of the default 5 ms.

    Servo responses and network messages are handled in threads next to the one that computes.
    """
    sys.setswitchinterval(_SWITCH_S)


def allow_many_files() -> None:
    """Raise the limit of open files and connections as far as allowed.

    The default of 1024 is too low.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, _OPEN_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def spare_collector() -> None:
    """Run Python's cyclic garbage collector rarely.

    Messages and arrays have no reference cycles, and the collector takes a few per cent of the time.
    """
    gc.unfreeze()  # objects of an earlier run in this process can be collected
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 50, 50)


def keep_memory() -> None:
    """Allocate large arrays from memory that stays mapped.

    Mapping new pages takes longer than most stages compute.

    Four new arrays of 256 KiB took 0.56 ms without this setting and 0.03 ms with it. Without glibc the function does nothing.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _KEPT >> 2)
        mallopt(_M_TRIM_THRESHOLD, _KEPT)
