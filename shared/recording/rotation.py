"""Recording in complete files of one minute each.

It stops before the disk is full.
"""

import shutil
from collections.abc import Callable
from pathlib import Path

from sextant.shared.recording.writer import Recorder
from sextant.shared.runtime.service import AnyTopic

FILE_NS = 60_000_000_000  # [ns] length of a file
RESERVE_BYTES = 500_000_000  # disk space to leave free
_LOOK_NS = 1_000_000_000  # [ns] between two checks of the free space


class NoRoomError(OSError):
    """The disk is nearly full; the text gives the free space and what to do."""


class Rotation:
    """Writes frames to consecutive files.

    Like a `Recorder` it is not thread-safe, except for `sync`.
    """

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
            folder: Folder of the files; it exists.
            make: Function that opens a recorder for a path.
            file_ns: Length [ns] of a file.
            reserve_bytes: Disk space to leave free; recording stops before using it.
            free_bytes: Function that returns the free disk space of a folder.

        Raises:
            OSError: The file cannot be written, or the disk is nearly full.
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
        """Path of the current file."""
        return self._recorder.path

    @property
    def target(self) -> str:
        """Path of the current file as text."""
        return self._recorder.target

    @property
    def size(self) -> int:
        """Bytes written so far to all files."""
        return self._finished_size + self._recorder.size

    def write(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        """Append a frame with its arrival time [ns].

        Raises:
            OSError: The frame cannot be written.
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
        """Flush all written data to the operating system."""
        self._recorder.flush()

    def sync(self) -> None:
        """Wait until all flushed data is on the disk; callable from any thread."""
        self._recorder.sync()

    def close(self) -> None:
        """Finish the last file."""
        self._recorder.close()

    def abandon(self) -> None:
        """Close the last file without finishing it."""
        self._recorder.abandon()

    def _next(self) -> Recorder:
        self._files += 1
        return self._make(self.folder / f"recording-{self._files:04d}.mcap")

    def _look(self) -> None:
        free = self._free_bytes(self.folder)
        if free < self._reserve_bytes:
            raise NoRoomError(
                f"only {free // 1_000_000} MB are free on the disk of {self.folder}, "
                f"and {self._reserve_bytes // 1_000_000} MB must stay free; free some space, or record to another disk"
            )
