"""Compilation of inner loops with Numba: cached, without the GIL, single-threaded.

`parallel=True` is never used. Two Python threads that enter a parallel region abort on a machine without a threading layer, and
a service must not take the cores of other services. A compiled function must not call a compiled function of another file, or
use its constants, because the cache does not detect changes there.

Functions are compiled for x86-64-v3, or for any arm64, not for the processor of this machine, so that a wheel can contain them.
They are as fast. The environment variable `NUMBA_CPU_NAME` selects another processor, by its name in LLVM.
"""

import os
import platform
import shutil
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from llvmlite import binding

F = TypeVar("F", bound=Callable[..., Any])
_REORDERED = {"reassoc", "nsz", "contract"}  # what LLVM may do with sums; infinities and NaN keep their meaning
Group = TypeVar("Group", bound=tuple[Any, ...])

_V3 = frozenset(("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"))  # what x86-64-v3 adds to x86-64


def baseline(machine: str, features: Mapping[str, bool]) -> str:
    """Return the processor to compile for, by its name in LLVM, or "" for that of this machine.

    Args:
        machine: Architecture, as `platform.machine()` returns it.
        features: Features of the processor, by LLVM's names.
    """
    if machine in ("aarch64", "arm64"):
        return "generic"
    return "x86-64-v3" if machine in ("x86_64", "AMD64") and all(features.get(name) for name in _V3) else ""


if "NUMBA_CPU_NAME" not in os.environ and (_name := baseline(platform.machine(), binding.get_host_cpu_features())):
    os.environ |= {"NUMBA_CPU_NAME": _name, "NUMBA_CPU_FEATURES": ""}  # the name implies the features
    numba.config.reload_config()  # type: ignore[no-untyped-call]


def processor() -> str:
    """Return the processor that functions are compiled for, by its name in LLVM."""
    return os.environ.get("NUMBA_CPU_NAME") or str(binding.get_host_cpu_name())


def compiled(function: F, reordered: bool = False) -> F:
    """Compile a function of arrays and scalars on its first call, or load it."""
    made = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_REORDERED if reordered else False)(function)
    _take_over(Path(function.__code__.co_filename), Path(str(made.stats.cache_path)))
    return cast(F, made)


def compiled_sums(function: F) -> F:
    """Compile a function whose sums may be computed in any order, so that their loops are vectorised."""
    return compiled(function, reordered=True)


@cache
def _take_over(source: Path, folder: Path) -> None:
    """Copy the compiled code that lies next to a source file to the folder in which Numba looks for it.

    The two differ if this user may not write next to the source, or has set `NUMBA_CACHE_DIR`.
    """
    delivered = source.parent / "__pycache__"
    if folder == delivered:
        return
    for path in sorted(delivered.glob(f"{source.stem}.*.nb[ci]")):  # the code of a function before its index
        copy = folder / path.name
        if not copy.exists() or copy.stat().st_mtime_ns < path.stat().st_mtime_ns:
            part = copy.with_name(f"{path.name}.{os.getpid()}")  # several processes may copy it at once
            shutil.copyfile(path, part)
            part.replace(copy)


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
