"""Atomic writing of files.

A file is written under a temporary name in its own folder, and renamed when it is complete. A reader therefore never sees an
incomplete file, and a crash leaves the old file. Errors of writing are raised as WriteError, with one sentence.
"""

import contextlib
import errno
import fcntl
import os
from collections.abc import Callable, Iterator
from io import BufferedWriter
from pathlib import Path
from typing import BinaryIO

from sextant.shared.errors import SextantError

_USUAL_MODE = 0o666  # before the user's umask
_CAUSES = {
    errno.ENOSPC: "the disk is full; free some space",
    errno.EDQUOT: "the disk quota of this user is exceeded; free some space",
    errno.EFBIG: "a file of this size is not allowed here; raise the limit (`ulimit -f`)",
    errno.EROFS: "the disk is read-only; write to another folder",
    errno.EACCES: "this user may not write there; write to another folder",
    errno.EPERM: "this user may not write there; write to another folder",
    errno.ENOENT: "its folder does not exist; create it, or write to another folder",
    errno.ENOTDIR: "its folder is a file; write to another folder",
    errno.EISDIR: "a folder has this name; choose another name",
    errno.EIO: "the disk reports an I/O error; write to another disk",
}

OUT_OF_ROOM = frozenset((errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS))


class WriteError(SextantError, OSError):
    """A file cannot be written; the text gives the file, the cause and what to do."""

    exit_status = 1

    def __init__(self, path: Path, error: OSError, kept: str = ""):
        self._of = path, OSError(error.errno, error.strerror or str(error)), kept
        super().__init__(error.errno, cause(error))
        self._sentence = f"{path} cannot be written: {cause(error)}" + (f"; {kept}" if kept else "")

    def __str__(self) -> str:
        return self._sentence

    def __reduce__(self) -> tuple[type["WriteError"], tuple[Path, OSError, str]]:
        return WriteError, self._of


def cause(error: OSError) -> str:
    """Return why a file cannot be written, and what to do."""
    return _CAUSES.get(error.errno or 0) or error.strerror or str(error)


@contextlib.contextmanager
def explained(path: Path) -> Iterator[None]:
    """Convert an OSError in the block to a WriteError."""
    try:
        yield
    except WriteError:
        raise
    except OSError as error:
        raise WriteError(path, error) from error


@contextlib.contextmanager
def reported(tell: Callable[[str], object]) -> Iterator[None]:
    """Report a WriteError in the block as a warning.

    Use it where work can continue without the file.
    """
    try:
        yield
    except WriteError as error:
        tell(f"warning: {error}")


@contextlib.contextmanager
def replacing(path: Path, durable: bool = False, mode: int = _USUAL_MODE) -> Iterator[BinaryIO]:
    """Open a temporary file that replaces `path` when the block ends.

    If the block fails, the temporary file is removed.

    Args:
        path: Path of the file; its folder exists.
        durable: Wait until the file is on the disk, so that a power cut does not lose it: for evidence and settings.
        mode: Permissions of a new file, before the user's umask.

    Raises:
        WriteError: The file cannot be written, or another process is writing it.
    """
    part = partial(path)
    with explained(path), _locked(part, mode) as file:
        try:
            yield file
            file.flush()
            if durable:
                os.fsync(file.fileno())
            part.replace(path)
            if durable:
                sync_folder(path.parent)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


def write_bytes(path: Path, data: bytes, durable: bool = False, mode: int = _USUAL_MODE) -> None:
    """Write a file atomically.

    Raises:
        WriteError: The file cannot be written.
    """
    with replacing(path, durable, mode) as file:
        file.write(data)


def write_text(path: Path, text: str, durable: bool = False, mode: int = _USUAL_MODE) -> None:
    """Write a UTF-8 text file atomically.

    Raises:
        WriteError: The file cannot be written.
    """
    write_bytes(path, text.encode(), durable, mode)


def write_by_name(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file atomically with a library function that takes a path.

    The temporary name has the same suffix.

    The file is renamed when it is complete.

    Raises:
        WriteError: The file cannot be written.
    """
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    with explained(path):
        try:
            write(part)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Make a folder and its parents if they are missing.

    Raises:
        WriteError: The folder cannot be made.
    """
    with explained(path):
        path.mkdir(parents=True, exist_ok=True)


def append_text(path: Path, text: str, durable: bool = False) -> None:
    """Append UTF-8 text to a file.

    A missing file is made, and an error leaves the file unchanged.

    Raises:
        WriteError: The file cannot be written.
    """
    with explained(path), path.open("ab", buffering=0) as file:
        before = file.seek(0, os.SEEK_END)
        try:
            rest = memoryview(text.encode())
            while rest:
                rest = rest[file.write(rest) :]
            if durable:
                os.fsync(file.fileno())
        except OSError:
            with contextlib.suppress(OSError):
                file.truncate(before)
            raise


def partial(path: Path) -> Path:
    """Return the temporary name of a file."""
    return path.with_name(f".{path.name}.part")


def sync_folder(folder: Path) -> None:
    """Wait until the directory entries of a folder are on the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def _locked(part: Path, mode: int) -> Iterator[BufferedWriter]:
    """Open an empty partial file and lock it for this process.

    A file left by a killed process is reused.
    """
    while True:
        descriptor = os.open(part, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, mode)
        with open(descriptor, "wb") as file:  # noqa: PTH123 - of a descriptor
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise OSError(errno.EBUSY, "another process is writing it; wait for it to end") from None
            if not _is(part, descriptor):
                continue  # another process just renamed or removed it
            os.ftruncate(descriptor, 0)
            if mode != _USUAL_MODE:
                os.fchmod(descriptor, mode)  # also if a killed process made the file
            yield file
            return


def _is(path: Path, descriptor: int) -> bool:
    """Return whether a path still refers to an open file."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
