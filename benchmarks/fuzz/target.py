"""Interface of fuzz targets."""

import shutil
import tempfile
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

_MEMORY_DISK = Path("/dev/shm")  # a RAM disk has no disk latency; elsewhere, the default folder is used


@dataclass(frozen=True, slots=True)
class Target:
    """A parser of external data."""

    name: str
    examples: tuple[bytes, ...]
    twisted: Callable[[bytes, Random], bytes]  # mutate an example with a valid structure
    take: Callable[[bytes], bool]  # return whether the data was accepted; any exception is a finding


class Folder:
    """Temporary folder, deleted with the last target that uses it."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="sextant-fuzz-", dir=_MEMORY_DISK if _MEMORY_DISK.is_dir() else None))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)
