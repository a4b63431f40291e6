"""Results as JSON: written by a benchmark, and read again and checked, to make the tables of the documentation."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.peers.timing import machine
from sextant.shared.files import config
from sextant.shared.files.input_file import FileError, parse_json

T = TypeVar("T")
_MACHINE, _ROWS = "machine", "rows"
_SOURCE = Path("kept JSON")  # in errors


def to_json(found: object) -> str:
    """Return a dataclass as JSON, with the machine that measured it; fields that are None are left out."""
    return _text(config.as_table(found))


def from_json(text: str, schema: type[T]) -> T:
    """Read a dataclass written by `to_json`.

    Raises:
        ConfigError: The text does not match the dataclass; it lists all errors.
    """
    return config.build(_table(text), schema, str(_SOURCE))


def rows_to_json(rows: Sequence[object]) -> str:
    """Return dataclasses of one kind as JSON, with the machine that measured them."""
    return _text({_ROWS: config.as_table(rows)})


def rows_from_json(text: str, schema: type[T]) -> list[T]:
    """Read dataclasses written by `rows_to_json`.

    Raises:
        ConfigError: The text has no rows, or one does not match the dataclass; it lists all errors of the first that does not.
    """
    rows = _table(text).get(_ROWS)
    if not isinstance(rows, list) or not rows:
        raise config.ConfigError(str(_SOURCE), [f"{_ROWS}: a list of rows expected, found {rows!r}"])
    return [config.build(row, schema, f"{_SOURCE}, row {number}") for number, row in enumerate(rows)]


def origin(text: str) -> str:
    """Return the machine that made a result and its load of the minute before, or "" if the result does not state them."""
    table = parse_json(_SOURCE, text.encode())
    made = table.get(_MACHINE, {}) if isinstance(table, dict) else {}
    if "load" not in made:
        return ""
    return f"on {made['processor']}, {made['cores']} cores, Python {made['python']}, at a load of {made['load']}"


def about() -> dict[str, str]:
    """Return a description of this machine, with its load: how many processes wanted a core, mean of the last minute."""
    return {**machine(), "load": f"{os.getloadavg()[0]:.1f}"}


def _text(table: dict[str, Any]) -> str:
    return json.dumps({_MACHINE: about(), **table}, indent=1, allow_nan=False) + "\n"


def _table(text: str) -> dict[str, Any]:
    try:
        found = parse_json(_SOURCE, text.encode())
    except FileError as error:
        raise config.ConfigError(str(_SOURCE), [error.cause]) from None
    if not isinstance(found, dict):
        raise config.ConfigError(str(_SOURCE), [f"a table expected, found {type(found).__name__}"])
    return {name: value for name, value in found.items() if name != _MACHINE}
