"""Compiled functions use no names from other files, and take named tuples as plain ones.

Their cache is invalidated only by the date of their own file.
"""

import ast
import importlib.util
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from sextant.shared.runtime.compiled import as_plain, baseline, compiled, processor

ROOT = Path(__file__).parents[4]
OURS = ("services", "shared", "evaluation", "deploy")
COMPILED = ("compiled", "compiled_sums", "written_into")


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


@pytest.mark.parametrize(
    ("machine", "missing", "name"),
    [("x86_64", (), "x86-64-v3"), ("x86_64", ("avx2",), ""), ("aarch64", ("avx2",), "generic"), ("riscv64", (), "")],
)
def test_processor_to_compile_for_is_the_common_one_where_there_is_one(
    machine: str, missing: tuple[str, ...], name: str
) -> None:
    features = dict.fromkeys(("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "sse4.2"), True)
    assert baseline(machine, features | dict.fromkeys(missing, False)) == name


def test_installed_code_is_loaded_where_the_user_may_not_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile a file as the build of a wheel does, install it elsewhere, and let Numba write to another folder."""
    built, installed = tmp_path / "built", tmp_path / "installed"
    built.mkdir()
    (built / "loops.py").write_text(
        "from sextant.shared.runtime.compiled import compiled\n\n\n@compiled\ndef twice(x):\n    return 2.0 * x\n"
    )

    def first_call(folder: Path) -> Any:
        spec = importlib.util.spec_from_file_location("loops", folder / "loops.py")
        assert spec
        assert spec.loader
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        assert module.twice(1.5) == 3.0
        return module.twice.stats

    assert first_call(built).cache_misses
    shutil.copytree(built, installed)
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "of the user"))
    stats = first_call(installed)
    assert Path(stats.cache_path).is_relative_to(tmp_path / "of the user")
    assert sum(stats.cache_hits.values()) == 1
    assert not stats.cache_misses
    (index,) = Path(stats.cache_path).glob("loops.twice-*.nbi")
    assert processor().encode() in index.read_bytes()
