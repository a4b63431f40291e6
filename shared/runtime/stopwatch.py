"""Stopwatch for computing times in reports.

It is the only machine clock that is read in lockstep.

No decision depends on it. A service takes the time for its decisions from its own clock argument.
"""

import time


def stopwatch_ns() -> int:
    """Return the time [ns] of this machine's finest monotonic clock.

    The origin is arbitrary.
    """
    return time.perf_counter_ns()
