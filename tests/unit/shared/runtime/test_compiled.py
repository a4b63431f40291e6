"""Compiled functions use no names from other files, and take named tuples as plain ones.

Their cache is invalidated only by the date of their own file.
"""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from sextant.shared.runtime.compiled import as_plain, compiled

ROOT = Path(__file__).parents[4]
OURS = ("services", "shared", "evaluation", "deploy")
COMPILED = ("compiled", "written_into")


def borrowed(source: str) -> Iterator[str]:
    """Yield the names from other files of this project that compiled functions use."""
    module = ast.parse(source)
    imported = {
        alias.asname or alias.name
        for node in ast.walk(module)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sextant.")
        for alias in node.names
    }
    for function in module.body:
        if isinstance(function, ast.FunctionDef) and any(ast.unparse(d) in COMPILED for d in function.decorator_list):
            names = {node.id for part in function.body for node in ast.walk(part) if isinstance(node, ast.Name)}
            yield from (f"{function.name} uses {name}" for name in sorted(names & imported))


def test_names_used_from_other_files_are_found() -> None:
    source = "from sextant.shared.a import B, c\nD = 1\n@compiled\ndef f(x):\n    return c(x) + B + D\ndef g():\n    return B\n"
    assert list(borrowed(source)) == ["f uses B", "f uses c"]
    assert list(borrowed(source.replace("@compiled", "@written_into"))) == ["f uses B", "f uses c"]


@pytest.mark.slow
def test_compiled_functions_use_no_names_of_other_files() -> None:
    files = [file for folder in OURS for file in (ROOT / folder).rglob("*.py")]
    assert sum("@compiled" in file.read_text() for file in files) > 10
    found = {str(file.relative_to(ROOT)): list(borrowed(file.read_text())) for file in files}
    assert not {file: names for file, names in found.items() if names}


class Line(NamedTuple):
    """A line to evaluate."""

    slope: float
    offset: float


@compiled
def height_on(line: Line, x: float) -> float:
    """Return the height of a line."""
    slope, offset = line
    return slope * x + offset


def test_compiled_function_takes_named_tuple_as_plain_one() -> None:
    line = Line(2.0, 1.0)
    assert type(as_plain(line)) is tuple
    assert height_on(as_plain(line), 3.0) == height_on(line, 3.0) == 7.0
