"""Output of commands to closed or full streams, or with unsupported characters."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.writer import Writer

from sextant.deploy.terminal.progress import Lines, Terminal
from sextant.evaluation.observers.monitor import View


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "r.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/körper/位姿", "json", 0)
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()
    return path


def info(recording: Path, stdout: int, env: dict[str, str] | None = None, closed: bool = False) -> tuple[int, str]:
    """Return the exit status and stderr of `sextant recording info`."""
    words = [sys.executable, "-m", "sextant.deploy.cli", "recording", "info", str(recording)]
    if closed:
        words = ["sh", "-c", 'exec "$@" >&-', "sh", *words]
    ended = subprocess.run(
        words, stdout=stdout, stderr=subprocess.PIPE, text=True, check=False, env={**os.environ, **(env or {})}
    )
    return ended.returncode, ended.stderr


def test_full_output_device_is_reported_in_one_sentence(recording: Path) -> None:
    with Path("/dev/full").open("w") as full:
        status, said = info(recording, full.fileno())
    assert (status, said) == (
        1,
        "sextant recording info: standard output cannot be written: the disk is full; free some space\n",
    )


@pytest.mark.parametrize("words", [("--help",), ("trials", "--help")])
def test_unwritable_help_exits_with_failure(words: tuple[str, ...]) -> None:
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "sextant.deploy.cli", *words]
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr.endswith("standard output cannot be written: the disk is full; free some space\n")
    assert ended.stderr.count("\n") == 1


def test_closed_pipe_ends_command_without_message(recording: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    assert info(recording, write) == (1, "")
    os.close(write)


def test_closed_stdout_is_ignored(recording: Path) -> None:
    assert info(recording, subprocess.DEVNULL, closed=True) == (0, "")


def test_unsupported_characters_are_replaced(recording: Path, tmp_path: Path) -> None:
    with (tmp_path / "out").open("wb") as out:
        assert info(recording, out.fileno(), {"PYTHONIOENCODING": "latin-1"}) == (0, "")
    assert "/körper/??" in (tmp_path / "out").read_bytes().decode("latin-1")


class Full(io.StringIO):
    def flush(self) -> None:
        raise OSError(28, "No space left on device")


def test_unwritable_progress_does_not_end_run() -> None:
    for progress in (Lines(Full()), Terminal(Full())):
        progress.update(View(up=True))
        progress.say("something")
        progress.finish()
