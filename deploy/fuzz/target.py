"""What a fuzzer gives messages to."""

import shutil
import tempfile
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

_MEMORY_DISK = Path("/dev/shm")  # where waiting for the disk takes no time; elsewhere a usual folder serves


@dataclass(frozen=True, slots=True)
class Target:
    """Something that takes in what others have made."""

    name: str
    examples: tuple[bytes, ...]
    twisted: Callable[[bytes, Random], bytes]  # an example whose structure is whole, and in it something odd
    take: Callable[[bytes], bool]  # whether it took it for good; raises only what is a fault


class Folder:
    """A temporary folder that is removed with the last target that uses it."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="sextant-fuzz-", dir=_MEMORY_DISK if _MEMORY_DISK.is_dir() else None))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)
