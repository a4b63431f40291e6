"""The one way a hot loop is compiled: Numba, cached on disk, without the GIL, single-threaded.

`parallel=True` is never used: two Python threads that enter a parallel region abort on a machine without a threading
layer, and a service must not take the cores of its neighbours. Do not call a compiled function of another file from a
compiled function, nor use a constant of one: the cache does not notice when it changes.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile a function of arrays and scalars on its first call, or load it from the cache."""
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def written_into(function: F) -> F:
    """Compile a step of a hot loop that is written into the loop itself: no call, which where many arrays are passed costs."""
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")(function))
