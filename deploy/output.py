"""The two streams that a command speaks on, which may be closed, full, or unable to show a character."""

import contextlib
import io
import os
import sys
from collections.abc import Iterator

from sextant.shared.files.whole_files import cause


class OutputError(OSError):
    """Standard output that cannot be written, and why."""


def prepare_streams() -> None:
    """Replace characters that a stream cannot encode; let a stream that is closed go nowhere."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # its number is taken, so that no file which is opened later gets it
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115 - for the life of the process
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def say(text: str) -> None:
    """Print a line of the result.

    Raises:
        BrokenPipeError: The reader has closed the pipe.
        OutputError: It cannot be written.
    """
    with _explained():
        sys.stdout.write(text + "\n")
        sys.stdout.flush()


def complain(text: str) -> None:
    """Print a line of what went wrong, if that is possible."""
    with contextlib.suppress(OSError):
        sys.stderr.write(text + "\n")
        sys.stderr.flush()


@contextlib.contextmanager
def flushed_output() -> Iterator[None]:
    """Write at the end of the block what standard output holds back, also that of argparse.

    Raises:
        BrokenPipeError: The reader has closed the pipe.
        OutputError: It cannot be written.
    """
    try:
        yield
    finally:
        with _explained():
            sys.stdout.flush()


def discard_output() -> None:
    """Let what standard output still holds, and whatever follows, go nowhere."""
    with contextlib.suppress(io.UnsupportedOperation):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def _explained() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(f"standard output cannot be written: {cause(error)}") from error
