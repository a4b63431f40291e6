"""What a result depends on: code of the project and versions of the libraries, compared between two commits."""

import ast
import fnmatch
import hashlib
import importlib.metadata
import importlib.util
import re
import subprocess
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import grimp

from benchmarks.campaign.part import ROOT

_ROOTS = ("sextant", "benchmarks")
_PINS = "constraints.txt"
_DATA = (".toml", ".png", ".xml")  # files that modules of the same folder read
_CATALOGUES = ("shared/scenario/", "shared/robot/profiles/")  # of these folders only the files that a part names


@dataclass(frozen=True, slots=True)
class Dependencies:
    """Files of the checkout and libraries that a result depends on."""

    files: tuple[str, ...]  # paths from the root of the checkout, in alphabetical order
    libraries: tuple[str, ...]  # as pinned, in alphabetical order

    @staticmethod
    def of(modules: Iterable[str], reads: Iterable[str] = ()) -> "Dependencies":
        """Collect all that some modules import, and the data files in the folders of these.

        Args:
            modules: Names of modules.
            reads: Scenarios, troubles, families and profiles, as paths from the root of the checkout; may be patterns.

        Raises:
            ValueError: There is no module of a name, or no file of a pattern.
        """
        graph, found = _graph(), set[str]()
        for module in modules:
            if module not in graph.modules:
                raise ValueError(f"a module of this checkout expected, found {module!r}")
            found |= {module} | graph.find_upstream_modules(module)
        own = {_file(name) for name in found if name.partition(".")[0] in _ROOTS}
        folders = {Path(path).parent for path in own}
        data = {path for path in _tracked("HEAD") if path.endswith(_DATA) and Path(path).parent in folders}
        data = {path for path in data if not path.startswith(_CATALOGUES)}
        for pattern in reads:
            named = fnmatch.filter(_tracked("HEAD"), pattern)
            if not named:
                raise ValueError(f"a file of this checkout expected, found {pattern!r}")
            data.update(named)
        external = {name for name in found if name.partition(".")[0] not in _ROOTS}
        return Dependencies(tuple(sorted(own | data)), tuple(sorted(_libraries(external))))

    def digest(self, commit: str = "HEAD") -> str:
        """Return a digest of the files and pinned versions at a commit."""
        at, pins = _tracked(commit), _pins(commit)
        lines = [f"{path} {at.get(path, '')}" for path in self.files] + [
            f"{name} {pins.get(name, '')}" for name in self.libraries
        ]
        return hashlib.blake2s("\n".join(lines).encode(), digest_size=6).hexdigest()

    def changed(self, since: str, until: str = "HEAD") -> list[str]:
        """Return the files and libraries that differ between two commits, apart from comments and docstrings."""
        old, new = _tracked(since), _tracked(until)
        differ = [path for path in self.files if old.get(path) != new.get(path)]
        files = [
            path for path in differ if path not in old or path not in new or _code(old[path], path) != _code(new[path], path)
        ]
        before, after = _pins(since), _pins(until)
        return files + [name for name in self.libraries if before.get(name) != after.get(name)]


def known(commit: str) -> bool:
    """Return whether the checkout has a commit."""
    words = ["git", "-C", str(ROOT), "cat-file", "-e", f"{commit}^{{commit}}"]
    return bool(re.fullmatch("[0-9a-f]{7,40}|HEAD", commit)) and not subprocess.run(words, capture_output=True).returncode


@cache
def _graph() -> grimp.ImportGraph:
    return grimp.build_graph(*_ROOTS, include_external_packages=True, cache_dir=None)


def _file(module: str) -> str:
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise ValueError(f"a module with a file expected, found {module!r}")
    return Path(spec.origin).resolve().relative_to(ROOT).as_posix()


def _libraries(modules: Iterable[str]) -> set[str]:
    """Return the names of the distributions that hold some modules, as constraints.txt writes them."""
    owners = importlib.metadata.packages_distributions()
    return {_plain(owner) for module in modules for owner in owners.get(module.partition(".")[0], [])}


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


@cache
def _tracked(commit: str) -> dict[str, str]:
    """Return the digest of each file at a commit."""
    lines = _git("ls-tree", "-r", "-z", commit).decode().split("\0")
    return {path: line.split()[2] for line, _, path in (entry.partition("\t") for entry in lines) if path}


@cache
def _pins(commit: str) -> dict[str, str]:
    """Return the pinned version of each library at a commit."""
    if _PINS not in _tracked(commit):
        return {}
    lines = _git("show", f"{commit}:{_PINS}").decode().splitlines()
    return {_plain(found[1]): found[2] for line in lines if (found := re.match(r"([\w.-]+)(?:\[.*?\])?==(\S+)", line))}


@cache
def _code(blob: str, path: str) -> str | bytes:
    """Return the content of a file, without the comments and docstrings of Python and TOML."""
    content = _git("cat-file", "blob", blob)
    if path.endswith(".toml"):
        return repr(tomllib.loads(content.decode()))
    if not path.endswith(".py"):
        return content
    tree = ast.parse(content)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str):
                del node.body[0]
    return ast.dump(tree)


def _git(*words: str) -> bytes:
    return subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, check=True).stdout
