"""Compilation of inner loops with Numba: cached, without the GIL, single-threaded.

`parallel=True` is never used. Two Python threads that enter a parallel region abort on a machine without a threading layer, and
a service must not take the cores of other services. A compiled function must not call a compiled function of another file, or
use its constants, because the cache does not detect changes there.
"""

from collections.abc import Callable, Iterable
from typing import Any, TypeVar, cast

import numba
import numpy as np

F = TypeVar("F", bound=Callable[..., Any])
Group = TypeVar("Group", bound=tuple[Any, ...])


def compiled(function: F) -> F:
    """Compile a function of arrays and scalars on its first call, or load it."""
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def written_into(function: F) -> F:
    """Compile a function that is inlined into compiled loops.

    Calls with many arrays would be slow.
    """
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")(function))


def constants(values: Iterable[int]) -> tuple[int, ...]:
    """Return integers for compiled functions.

    Numba compiles a function once more for each Python integer that a call names, but only once for all of these.
    """
    return tuple(cast(int, np.int64(value)) for value in values)


def as_plain(group: Group) -> Group:
    """Return a named tuple as a plain tuple, for a compiled function that unpacks it.

    Each call of a compiled function determines the types of its arguments. This takes 1 us longer for a named tuple.
    """
    return cast(Group, tuple(group))
