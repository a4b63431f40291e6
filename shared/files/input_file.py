"""Reader of untrusted text, TOML and JSON files of bounded size.

These functions raise only `FileError`, for any path and any content. Reading never blocks: a pipe or a device is refused
before it is opened.
"""

import json
import os
import re
import stat
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

from sextant.shared.errors import SextantError

_MAX_TEXT_BYTES = 16_000_000
_MAX_TOML_BYTES = 2_000_000
_PIECE_BYTES = 1 << 20
_MAX_DEPTH = 32  # nesting depth of tables and lists
_INT64 = range(-(2**63), 2**63)
# Matches one dotted name more than allowed, because tomllib needs quadratic time and memory in their number.
_NAME = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_DOTTED = re.compile(rf"(?<![\w-])(?:{_NAME}[ \t]*+\.[ \t]*+){{{_MAX_DEPTH}}}")
_DECIMAL_COMMA = re.compile(r"[^=#\[]*=\s*([+-]?\d{1,15}),(\d{1,15})\s*(?:#|$)")
_UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")


class FileError(SextantError, ValueError):
    """A file cannot be used; the text gives path, line (if known) and cause."""

    def __init__(self, path: Path, cause: str, line: int | None = None):
        self.path, self.cause, self.line = path, cause, line
        self.place = f"{path}" if line is None else f"{path}:{line}"
        super().__init__(f"{self.place}: {cause}")


def read_bytes(path: Path, most: int) -> bytes:
    """Read a regular file of at most `most` bytes.

    Raises:
        FileError: The file does not exist, is not a regular file, cannot be read, or is larger.
    """
    try:
        _check_regular(path, path.stat())
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK), "rb") as file:
            _check_regular(path, os.fstat(file.fileno()))
            data = bytearray()
            while len(data) <= most and (piece := file.read(_PIECE_BYTES)):  # the reported size of a file may be wrong
                data += piece
    except OSError as error:
        raise FileError(path, os_cause(error)) from None
    except ValueError as error:
        if isinstance(error, FileError):
            raise
        raise FileError(Path(repr(str(path))), "a path without zero characters expected") from None
    if len(data) > most:
        raise FileError(path, f"at most {_size(most)} expected, found more")
    return bytes(data)


def read_text(path: Path, most: int = _MAX_TEXT_BYTES) -> str:
    """Read a UTF-8 text file, with or without a byte-order mark.

    Raises:
        FileError: As in `read_bytes`, or the file is not UTF-8.
    """
    return decode_text(path, read_bytes(path, most))


def decode_text(path: Path, data: bytes) -> str:
    """Decode the bytes of a UTF-8 file.

    Raises:
        FileError: The bytes are not UTF-8.
    """
    if data.startswith(_UTF16_MARKS) or b"\0" in data:
        found = "UTF-16" if data.startswith(_UTF16_MARKS) or _every_second_is_zero(data) else "zero bytes"
        raise FileError(path, f"UTF-8 text expected, found {found}")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        cause = f"UTF-8 text expected, found byte 0x{data[error.start]:02x}; save the file as UTF-8"
        raise FileError(path, cause, line) from None


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Integers have at most 64 bits, and tables and lists are at most 32 deep.

    Raises:
        FileError: As in `read_text`, or the file is not such a TOML file.
    """
    return parse_toml(path, read_bytes(path, _MAX_TOML_BYTES))


def parse_toml(path: Path, data: bytes) -> dict[str, Any]:
    """Parse the bytes of a TOML file; see `read_toml`."""
    text = decode_text(path, data)
    dotted = _DOTTED.search(text)
    if dotted is not None:
        line = text.count("\n", 0, dotted.start()) + 1
        raise FileError(path, f"TOML expected, found more than {_MAX_DEPTH} names joined by dots", line)
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise FileError(path, f"no valid TOML: {_uncapitalized(str(error))}{_decimal_comma(text, str(error))}") from None
    except RecursionError:
        raise FileError(path, f"TOML expected, found lists or tables more than {_MAX_DEPTH} deep") from None
    except ValueError:  # from Python's limit on the digits of an integer
        raise FileError(path, "whole numbers of at most 64 bits expected, found one of thousands of digits") from None
    _check_plain(path, table, None)
    return table


def _decimal_comma(text: str, error: str) -> str:
    """Return a hint if the line of a TOML error has a number with a decimal comma, else an empty text."""
    place, lines = re.search(r"at line (\d+)", error), text.splitlines()
    line = lines[int(place[1]) - 1] if place and int(place[1]) <= len(lines) else ""
    found = _DECIMAL_COMMA.match(line)
    return f"; a decimal point is needed: {found[1]}.{found[2]}" if found else ""


def read_json(path: Path, most: int = _MAX_TEXT_BYTES) -> Any:
    """Read a JSON file; see `parse_json`."""
    return parse_json(path, read_bytes(path, most))


def parse_json(path: Path, data: bytes, line: int | None = None) -> Any:
    """Parse the bytes of a JSON file, or of one line of it.

    NaN and infinity are refused.

    Raises:
        FileError: The bytes are not valid JSON.
    """
    text = decode_text(path, data)
    try:
        value = json.loads(text, parse_constant=_refuse)
    except json.JSONDecodeError as error:
        where = error.lineno if line is None else line
        raise FileError(path, f"JSON expected, found {_uncapitalized(error.msg)} at column {error.colno}", where) from None
    except RecursionError:
        raise FileError(path, f"JSON expected, found lists or tables more than {_MAX_DEPTH} deep", line) from None
    except ValueError as error:
        found = str(error) if isinstance(error, _ConstantError) else "a whole number of thousands of digits"
        raise FileError(path, f"finite numbers of at most 64 bits expected, found {found}", line) from None
    _check_plain(path, value, line)
    return value


def os_cause(error: OSError) -> str:
    """Why a file cannot be opened, read or written, in the words of the system."""
    if isinstance(error, FileNotFoundError):
        return "no such file"
    return f"cannot be read: {_uncapitalized(error.strerror or str(error))}"


def _check_regular(path: Path, status: os.stat_result) -> None:
    kinds = {
        stat.S_IFDIR: "folder", stat.S_IFIFO: "pipe", stat.S_IFSOCK: "socket", stat.S_IFCHR: "device", stat.S_IFBLK: "device",
    }  # fmt: skip
    kind = stat.S_IFMT(status.st_mode)
    if kind != stat.S_IFREG:
        raise FileError(path, f"a file expected, found a {kinds.get(kind, 'special file')}")


def _check_plain(path: Path, value: Any, line: int | None) -> None:
    """Refuse deep nesting, integers of more than 64 bits, and invalid Unicode."""
    level = [("", value)]
    for _ in range(_MAX_DEPTH + 1):
        if not level:
            return
        for where, entry in level:
            if isinstance(entry, int) and entry not in _INT64:
                cause = f"a whole number of at most 64 bits expected, found one of {entry.bit_length()} bits"
                raise FileError(path, f"{where}: {cause}" if where else cause, line)
            if isinstance(entry, str) and not entry.isascii() and any("\ud800" <= letter <= "\udfff" for letter in entry):
                cause = "Unicode text expected, found half of a surrogate pair"
                raise FileError(path, f"{where}: {cause}" if where else cause, line)
        level = [child for where, entry in level for child in _children(where, entry)]
    raise FileError(path, f"lists and tables at most {_MAX_DEPTH} deep expected, found deeper ones", line)


def _children(where: str, entry: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(entry, dict):
        for key, child in entry.items():
            yield f"{where}.{key[:40]}" if where else key[:40], child
            yield where, key
    elif isinstance(entry, list):
        for index, child in enumerate(entry):
            yield f"{where}[{index}]", child


class _ConstantError(ValueError):
    """The text contains a constant that JSON does not have."""


def _refuse(constant: str) -> NoReturn:
    raise _ConstantError(constant)


def _every_second_is_zero(data: bytes) -> bool:
    return len(data) > 3 and (not any(data[:64:2]) or not any(data[1:64:2]))


def _size(count: int) -> str:
    return f"{count // 1_000_000} MB" if count >= 1_000_000 else f"{count} bytes"


def _uncapitalized(text: str) -> str:
    return text[:1].lower() + text[1:]
