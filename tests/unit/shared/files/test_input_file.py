"""Files from other programs: readers raise only `FileError`, and never block.

The error names the file.
"""

import contextlib
import errno
import os
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.shared.files.input_file import FileError, parse_json, parse_toml, read_bytes, read_json, read_text, read_toml

FILE = Path("some.file")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"\xff\xfea\0=\0001\0", "UTF-8 text expected, found UTF-16"),
        ("a = 1".encode("utf-16-le"), "UTF-8 text expected, found UTF-16"),
        ("a = 1\nb = 'é'".encode("latin-1"), r"some\.file:2: UTF-8 text expected, found byte 0xe9; save"),
        (b"a = " + b"[" * 100_000, "TOML expected, found"),
        (b"a = " + b"[" * 40 + b"]" * 40, "at most 32 deep expected"),
        (b"a = " + b"{a = " * 100_000, "TOML expected, found"),
        (b"a.b.c." * 40 + b"d = 1", r"some\.file:1: .*names joined by dots"),
        (b"a." * 100_000 + b"d = 1", "names joined by dots"),
        (b"a = " + b"9" * 5000, "whole numbers of at most 64 bits expected"),
        (b"a.b = [1, 0x" + b"f" * 500_000 + b"]", r"a\.b\[1\]: a whole number of at most 64 bits expected, found one of 20"),
        (b"a = 1\nb = -1,5  # [m]\n", "after a statement .at line 2, column 7.; a decimal point is needed: -1.5"),
        (b"a = 1\n= 3\n", "no valid TOML: invalid statement .at line 2"),
        (b"a = 1\0", "zero bytes"),
    ],
)
def test_invalid_toml_is_refused_with_reason(data: bytes, message: str) -> None:
    began = time.perf_counter()
    with pytest.raises(FileError, match=message) as caught:
        parse_toml(FILE, data)
    assert time.perf_counter() - began < 60.0
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("some.file")


def test_byte_order_mark_is_accepted() -> None:
    assert parse_toml(FILE, "\ufeffa = 1".encode()) == {"a": 1}
    assert parse_json(FILE, "\ufeff[1]".encode()) == [1]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"[" * 100_000, "JSON expected, found"),
        (b"[" * 40 + b"]" * 40, "at most 32 deep expected"),
        (b"[NaN]", "finite numbers of at most 64 bits expected, found NaN"),
        (b"[" + b"9" * 5000 + b"]", "finite numbers of at most 64 bits expected"),
        (b'{"a": 99999999999999999999}', "a: a whole number of at most 64 bits expected"),
        (b'{"a": "\\ud800"}', "a: Unicode text expected"),
        (b"[1,\n2", r"some\.file:2: JSON expected"),
        (b"", r"some\.file:1: JSON expected"),
    ],
)
def test_invalid_json_is_refused_with_reason(data: bytes, message: str) -> None:
    with pytest.raises(FileError, match=message):
        parse_json(FILE, data)
    with pytest.raises(FileError, match=r"some\.file:7: "):
        parse_json(FILE, data.replace(b"\n", b" "), line=7)


@settings(max_examples=300)
@given(st.one_of(st.binary(max_size=60), st.text(alphabet="[]{}a.=\"'\n#-0exn,_:TZ ", max_size=60).map(str.encode)))
def test_parsers_raise_only_file_errors(data: bytes) -> None:
    for parse in (parse_toml, parse_json):
        with contextlib.suppress(FileError):
            parse(FILE, data)


def test_unreadable_paths_are_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "large").write_bytes(bytes(11))
    for place, cause in (
        (tmp_path, "a file expected, found a folder"),
        (tmp_path / "pipe", "a file expected, found a pipe"),
        (Path("/dev/zero"), "a file expected, found a device"),
        (tmp_path / "none", "no such file"),
        (tmp_path / "large" / "below", "not a directory"),
        (tmp_path / "loop", "too many levels of symbolic links"),
        (tmp_path / ("x" * 300), "file name too long"),
        (tmp_path / "large", "at most 10 bytes expected"),
        (Path("a\0b"), "without zero characters"),
    ):
        with pytest.raises(FileError, match=cause):
            read_bytes(place, 10)


def test_file_without_permission_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> int:
        raise PermissionError(errno.EACCES, "Permission denied")

    (tmp_path / "secret").write_text("a = 1")
    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(FileError, match="cannot be read: permission denied"):
        read_toml(tmp_path / "secret")


def test_toml_text_and_json_files_are_read(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"\xef\xbb\xbfa = 'x'\r\nb = [1, 2.5]\r\n")
    assert read_toml(path) == {"a": "x", "b": [1, 2.5]}
    assert read_text(path).startswith("a = ")
    path.write_text('{"a": [1, null, true]}')
    assert read_json(path) == {"a": [1, None, True]}
