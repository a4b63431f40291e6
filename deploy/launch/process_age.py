"""Age of this process, from the command that started it."""

import os
import time
from pathlib import Path

_LOADED_S = time.monotonic()


def process_age_s() -> float:
    """Return the time [s] since this process was started; on systems without /proc, since it has loaded this module."""
    try:
        began_ticks = int(Path("/proc/self/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()[19])
        return time.clock_gettime(time.CLOCK_BOOTTIME) - began_ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError):
        return time.monotonic() - _LOADED_S
