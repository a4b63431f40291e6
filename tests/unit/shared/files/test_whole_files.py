import errno
import os
import pickle
import re
import resource
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from sextant.shared.files import whole_files
from sextant.shared.files.whole_files import WriteError

OLD, NEW = "the old text", "the new text"


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("durable", [False, True])
def test_file_is_replaced_when_complete(tmp_path: Path, durable: bool) -> None:
    path = tmp_path / "a.txt"
    whole_files.write_text(path, OLD, durable)
    with whole_files.replacing(path, durable) as file:
        file.write(NEW.encode())
        assert path.read_text() == OLD
    assert path.read_text() == NEW
    assert names(tmp_path) == ["a.txt"]


def test_failed_write_leaves_only_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    whole_files.write_text(path, OLD)

    def fail() -> None:
        with whole_files.replacing(path) as file:
            file.write(b"half")
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert path.read_text() == OLD
    assert names(tmp_path) == ["a.txt"]


def test_concurrent_writers_do_not_mix(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with whole_files.replacing(path) as file:
        file.write(NEW.encode())
        with pytest.raises(WriteError, match="another process is writing it"):
            whole_files.write_text(path, OLD)
    assert path.read_text() == NEW


def test_partial_file_of_killed_process_is_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    code = (
        "import os, pathlib, sys; from sextant.shared.files import whole_files\n"
        "with whole_files.replacing(pathlib.Path(sys.argv[1])) as file:\n"
        "    file.write(b'x' * 100_000); file.flush(); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code, str(path)], check=False)
    assert names(tmp_path) == [whole_files.partial(path).name]
    whole_files.write_text(path, NEW)
    assert path.read_text() == NEW
    assert names(tmp_path) == ["a.txt"]


def test_secret_file_is_never_readable_by_others(tmp_path: Path) -> None:
    path = tmp_path / "key.pem"
    whole_files.partial(path).touch(0o666)  # as a killed process leaves it
    with whole_files.replacing(path, mode=0o600) as file:
        assert stat.S_IMODE(whole_files.partial(path).stat().st_mode) == 0o600
        file.write(b"secret")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def limited(code: str, path: Path) -> subprocess.CompletedProcess[str]:
    """Run code that writes a file, with a limit of 1000 bytes per file."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))

    begin = "import pathlib, sys; sys.dont_write_bytecode = True; path = pathlib.Path(sys.argv[1])\n"
    begin += "from sextant.shared.files import whole_files\n"
    return subprocess.run(
        [sys.executable, "-c", begin + code, str(path)], preexec_fn=limit, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize(
    "code",
    [
        "whole_files.write_bytes(path, bytes(5000))",
        "whole_files.write_bytes(path, bytes(5000), durable=True)",
        "whole_files.write_by_name(path, lambda part: part.write_bytes(bytes(5000)))",
        "whole_files.append_text(path, 'x' * 5000)",
    ],
)
def test_full_disk_is_reported_and_old_file_kept(tmp_path: Path, code: str) -> None:
    path = tmp_path / "a.txt"
    whole_files.write_text(path, OLD)
    ended = limited(code, path)
    assert ended.returncode == 1
    assert f"WriteError: {path} cannot be written: a file of this size is not allowed here" in ended.stderr
    assert path.read_text() == OLD
    assert names(tmp_path) == ["a.txt"]


def test_appended_data_follows_existing_data(tmp_path: Path) -> None:
    path = tmp_path / "lines.txt"
    whole_files.append_text(path, "one\n")
    whole_files.append_text(path, "two\n", durable=True)
    assert path.read_text() == "one\ntwo\n"


@pytest.mark.parametrize("name", ["gone/a.txt", "file/a.txt", "folder"])
def test_unwritable_path_is_reported_with_advice(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    with pytest.raises(WriteError, match=r"cannot be written: .*; .*"):
        whole_files.write_text(tmp_path / name, NEW)
    assert sorted(names(tmp_path)) == ["file", "folder"]


def test_partial_file_keeps_suffix_for_libraries(tmp_path: Path) -> None:
    seen: list[Path] = []

    def write(part: Path) -> None:
        seen.append(part)
        part.write_text(NEW)

    whole_files.write_by_name(tmp_path / "a.svg", write)
    assert seen[0].suffix == ".svg"
    assert seen[0].parent == tmp_path
    assert names(tmp_path) == ["a.svg"]


def test_folder_that_cannot_be_created_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(WriteError, match="cannot be written"):
        whole_files.make_folder(tmp_path / "file" / "folder")


@pytest.mark.parametrize("number", sorted(whole_files.OUT_OF_ROOM))
def test_each_cause_has_advice(number: int) -> None:
    assert "; " in whole_files.cause(OSError(number, os.strerror(number)))
    assert whole_files.cause(OSError(errno.ETXTBSY, "text file busy")) == "text file busy"


def test_write_error_survives_pickling_between_processes() -> None:
    error = WriteError(Path("a.txt"), OSError(errno.ENOSPC, "No space left on device"), "its first 2 MB are kept")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    assert str(error) == "a.txt cannot be written: the disk is full; free some space; its first 2 MB are kept"


def test_optional_write_failure_is_a_warning() -> None:
    told: list[str] = []
    with whole_files.reported(told.append):
        whole_files.write_text(Path("/dev/null/a.txt"), NEW)
    assert told == ["warning: /dev/null/a.txt cannot be written: its folder is a file; write to another folder"]


# Files that are not written with `sextant.shared.files.whole_files`, and the reasons.
APART = {
    "benchmarks/net_testbed/namespace.py": "the kernel's own files",
    "benchmarks/robot/link.py": "a folder that is removed at the end",
    "benchmarks/robot/slow_core.py": "the kernel's own files, and a log, line by line",
    "benchmarks/robot/soak.py": "a folder that is removed at the end",
    "benchmarks/fuzz/file_targets.py": "a folder that is removed at the end",
    "benchmarks/fuzz/fuzzing.py": "the newest message, for when it ends the process",
    "benchmarks/fuzz/recording_mutators.py": "a folder that is removed at the end",
    "deploy/terminal/output.py": "nowhere",
    "deploy/live/live_run.py": "a log, line by line",
    "evaluation/viewers/file_export.py": "by the name that `write_by_name` gives",
    "evaluation/video/video_writer.py": "by the name that `write_by_name` gives",
    "shared/robot/profile_file.py": "whole, once it has been read as a robot",
    "services/actuator/safety/torque_off_latch.py": "whole, or as an empty file, by the stop path",
    "services/actuator/safety/walk_authorization.py": "whole, in memory",
    "services/actuator/servo_bus/usb_adapter.py": "the kernel's own files",
    "shared/recording/writer.py": "as it comes; readable as far as it goes",
    "shared/files/whole_files.py": "this is where",
    "shared/runtime/simulated_time.py": "memory that processes share",
}
WRITES = re.compile(
    r"""\bopen\([^)\n]*["'][wax]b?\+?["']|["']w\+b["']|fdopen\([^)\n]*["']w|(?<!files)\.write_(?:text|bytes)\(|savefig\(|imwrite\(|np\.save"""
)


def test_all_files_are_written_through_whole_files() -> None:
    root = Path(__file__).parents[4]
    found = {
        path.relative_to(root).as_posix()
        for package in ("benchmarks", "deploy", "docs", "evaluation", "services", "shared")
        for path in (root / package).rglob("*.py")
        if WRITES.search(path.read_text(encoding="utf-8"))
    }
    assert found == set(APART)
