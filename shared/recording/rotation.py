"""A recording in files of a minute, each whole in itself, which leave the disk some room."""

import shutil
from collections.abc import Callable
from pathlib import Path

from sextant.shared.recording.writer import Recorder
from sextant.shared.runtime.service import AnyTopic

FILE_NS = 60_000_000_000  # [ns] of a file
RESERVE_BYTES = 500 << 20  # that others keep of the disk
_LOOK_NS = 1_000_000_000  # [ns] between two looks at how much is left


class NoRoomError(OSError):
    """The disk is all but full; says how full, and what to do."""


class Rotation:
    """Writes frames into one file after the other; used by one thread at a time but for `sync`, as a `Recorder`."""

    def __init__(
        self,
        folder: Path,
        make: Callable[[Path], Recorder],
        file_ns: int = FILE_NS,
        reserve_bytes: int = RESERVE_BYTES,
        free_bytes: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
    ):
        """Open the first file.

        Args:
            folder: Where the files go; it exists.
            make: Opens a file.
            file_ns: Length [ns] of a file.
            reserve_bytes: That are left free; what would go into them is not written.
            free_bytes: How much is free where a folder is.

        Raises:
            OSError: The file cannot be written, or there is no room for it.
        """
        self.folder = folder
        self._make, self._file_ns = make, file_ns
        self._reserve_bytes, self._free_bytes = reserve_bytes, free_bytes
        self._files = self._finished_size = 0
        self._began_ns = self._looked_ns = -1
        self._look()
        self._recorder = self._next()
        self.skipped = self._recorder.skipped

    @property
    def path(self) -> Path:
        """The file that is being written."""
        return self._recorder.path

    @property
    def target(self) -> str:
        """The same, in words."""
        return self._recorder.target

    @property
    def size(self) -> int:
        """Written so far, into all files."""
        return self._finished_size + self._recorder.size

    def write(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        """Append a frame with the time [ns] at which it came.

        Raises:
            OSError: It could not be written.
        """
        if self._began_ns < 0:
            self._began_ns = self._looked_ns = at_ns
        if at_ns - self._looked_ns >= _LOOK_NS:
            self._looked_ns = at_ns
            self._look()
        if at_ns - self._began_ns >= self._file_ns:
            self._recorder.close()
            self._finished_size += self._recorder.size
            self._recorder, self._began_ns = self._next(), at_ns
        self._recorder.write(topic, frame, at_ns)

    def flush(self) -> None:
        """Hand all that was written over to the system."""
        self._recorder.flush()

    def sync(self) -> None:
        """Wait until what was flushed is on the disk; from any thread."""
        self._recorder.sync()

    def close(self) -> None:
        """Finish the last file."""
        self._recorder.close()

    def abandon(self) -> None:
        """Close the last file as it is."""
        self._recorder.abandon()

    def _next(self) -> Recorder:
        self._files += 1
        return self._make(self.folder / f"recording-{self._files:04d}.mcap")

    def _look(self) -> None:
        free = self._free_bytes(self.folder)
        if free < self._reserve_bytes:
            raise NoRoomError(
                f"{free >> 20} MB are free where {self.folder} is, and {self._reserve_bytes >> 20} MB are to stay so; "
                "make room, or record to another disk"
            )
