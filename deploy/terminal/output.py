"""Standard output and error of commands.

Either may be closed, full or limited in encoding.
"""

import contextlib
import io
import os
import sys
from collections.abc import Iterator

from sextant.shared.files.whole_files import cause


class OutputError(OSError):
    """Standard output cannot be written; the message says why."""


def prepare_streams() -> None:
    """Make the streams replace characters that they cannot encode.

    A closed stream is redirected to the null device.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # occupy its file number, so that no file opened later gets it
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115 - for the life of the process
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def say(text: str) -> None:
    """Print a line of the result.

    Raises:
        BrokenPipeError: The reader has closed the pipe.
        OutputError: It cannot be written.
    """
    with explained():
        sys.stdout.write(text + "\n")
        sys.stdout.flush()


def complain(text: str) -> None:
    """Print a line on stderr, ignoring write errors."""
    with contextlib.suppress(OSError):
        sys.stderr.write(text + "\n")
        sys.stderr.flush()


@contextlib.contextmanager
def flushed_output() -> Iterator[None]:
    """Flush standard output at the end of the block, including printed help.

    Raises:
        BrokenPipeError: The reader has closed the pipe.
        OutputError: It cannot be written.
    """
    try:
        yield
    finally:
        with explained():
            sys.stdout.flush()


def discard_output() -> None:
    """Redirect standard output, and what it still buffers, to the null device."""
    with contextlib.suppress(io.UnsupportedOperation):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def explained() -> Iterator[None]:
    """Turn an error of standard output into an OutputError with its cause."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(f"standard output cannot be written: {cause(error)}") from error
