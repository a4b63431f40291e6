"""How long computing takes, for reports: the only clock of the machine that is read in lockstep.

Nothing decides by it. Times by which a service decides come from the clock that it is given.
"""

import time


def stopwatch_ns() -> int:
    """Read [ns] this machine's finest monotonic clock, counted from an arbitrary instant."""
    return time.perf_counter_ns()
