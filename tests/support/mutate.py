"""Mutation tests of a module.

python -m tests.support.mutate services/actuator/safety/guard.py

The tests of guard.py are test_guard_*.py, then test_guard.py; they must use the module by its classes. Comparisons, Boolean
operators, numbers, strings, members of enumerations, arithmetic, branches, statements and returns are changed one at a time in
the module's syntax tree. The tests run against each changed module until one fails. The survivors are printed: each is a rule
without a test, or a change that makes no difference.
"""

import ast
import copy
import enum
import importlib
import os
import resource
import signal
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import FunctionType, ModuleType
from typing import NamedTuple

import pytest
from _pytest.runner import runtestprotocol
from hypothesis import Phase, settings

_COMPARED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_COMPUTED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.BitOr: ast.BitAnd,
    ast.BitAnd: ast.BitOr,
}
_LEAST_S = 5.0  # [s] least processor time of a mutant
_TIMES = 3.0  # limit as a multiple of the unchanged module's time; a mutant that takes longer hangs
_MOST = 255  # largest exit code
_QUIETLY = ("-q", "--no-header", "-s", "-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning")
_UNTOUCHED = ("annotation", "returns", "decorator_list", "bases")  # type annotations, and the definition of a class
_Way = tuple[tuple[str, int | None], ...]  # path from the root of a tree to a node


class Mutant(NamedTuple):
    """A changed module; valid until the next one is requested."""

    line: int
    was: str
    change: str
    tree: ast.Module


def mutants(module: ModuleType, source: str) -> Iterator[Mutant]:
    """Yield every change of a module's functions and numbers, one at a time."""
    root = ast.parse(source)
    for way, node in list(_nodes(root)):
        within = [type(step) for step in _along(root, way)]
        if ast.ClassDef in within and ast.FunctionDef not in within:
            continue  # fields, and strings of enumerations
        for change, other in _changes(node, module, ast.FunctionDef in within):
            was = ast.unparse(node).splitlines()[0]
            _put(root, way, copy.deepcopy(other))
            yield Mutant(getattr(node, "lineno", 0), was, change, ast.fix_missing_locations(root))
            _put(root, way, node)


def _changes(node: ast.AST, module: ModuleType, inside: bool) -> Iterator[tuple[str, ast.AST]]:
    """Yield the replacements of a node.

    Statements are removed only inside functions; outside them their absence is noticed at once.
    """
    match node:
        case ast.Compare(left, ops, comparators):
            for i, op in enumerate(ops):
                for other in _COMPARED[type(op)]:
                    changed = [*ops[:i], other(), *ops[i + 1 :]]
                    yield f"{type(op).__name__} -> {other.__name__}", ast.Compare(left, changed, comparators)
        case ast.BoolOp(op, values):
            yield "and <-> or", ast.BoolOp(ast.And() if isinstance(op, ast.Or) else ast.Or(), values)
            for i, value in enumerate(values):
                rest = [*values[:i], *values[i + 1 :]]
                yield f"without {ast.unparse(value)}", ast.BoolOp(op, rest) if len(rest) > 1 else rest[0]
        case ast.UnaryOp(ast.Not() | ast.USub(), operand):
            yield "without its sign", operand
        case ast.BinOp(left, op, right) | ast.AugAssign(left, op, right) if type(op) in _COMPUTED:
            yield "the other operator", type(node)(left, _COMPUTED[type(op)](), right)  # type: ignore[arg-type]
            if isinstance(node, ast.AugAssign):
                yield "no statement", ast.Pass()
        case ast.IfExp(_, body, orelse):
            yield "always the first", body
            yield "always the second", orelse
        case ast.If(_, body, orelse):
            yield "always", ast.If(ast.Constant(True), body, orelse)
            yield "never", ast.If(ast.Constant(False), body, orelse)
        case ast.Constant(bool(value)):
            yield f"{not value}", ast.Constant(not value)
        case ast.Constant(int(value) | float(value)):
            yield f"{value + 1}", ast.Constant(value + 1)
        case ast.Constant(str(value)):
            yield "other words", ast.Constant(f"{value}XX")
        case ast.Assign() | ast.Expr(ast.Call()) | ast.Return(ast.Tuple([])) if inside:
            yield "no statement", ast.Pass()
        case ast.Return(ast.expr() as value) if not isinstance(value, ast.Constant):
            yield "returns nothing", ast.Return(ast.Tuple([], ast.Load()))
        case ast.Attribute(ast.Name(name), member) if inside and isinstance(of := getattr(module, name, None), enum.EnumMeta):
            members = list(of.__members__)
            yield "another member", ast.Attribute(node.value, members[(members.index(member) + 1) % len(members)], ast.Load())


def _nodes(node: ast.AST, way: _Way = ()) -> Iterator[tuple[_Way, ast.AST]]:
    """Yield every node that may be changed, with its path."""
    for name, value in ast.iter_fields(node):
        if name in _UNTOUCHED or (isinstance(node, ast.Expr) and isinstance(value, ast.Constant)):  # a docstring
            continue
        for i, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if isinstance(child, ast.AST) and not isinstance(child, ast.Import | ast.ImportFrom | ast.expr_context):
                there = (*way, (name, i))
                yield there, child
                yield from _nodes(child, there)


def _along(node: ast.AST, way: _Way) -> Iterator[ast.AST]:
    for name, i in way:
        node = getattr(node, name) if i is None else getattr(node, name)[i]
        yield node


def _put(tree: ast.AST, way: _Way, other: ast.AST) -> None:
    *_, parent = (tree, *_along(tree, way[:-1]))
    name, i = way[-1]
    if i is None:
        setattr(parent, name, other)
    else:
        getattr(parent, name)[i] = other


class Hunt:
    """A pytest plugin that runs the collected tests against each mutant.

    Each mutant runs in a separate process.
    """

    def __init__(self, path: str):
        self._path, self._source = path, Path(path).read_text(encoding="utf-8")
        self._module = importlib.import_module(".".join(Path(path).with_suffix("").parts))
        self._tests: list[pytest.Item] = []  # the latest killer comes first: neighbouring mutants often fail the same test
        self._patience_s = 60.0

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Run the hunt instead of the tests."""
        self._tests, made, left = list(session.items), 0, 0
        if not self._survives(ast.parse(self._source)):
            raise pytest.UsageError("the tests fail as the module is: mend that first")
        self._patience_s = max(_LEAST_S, _TIMES * resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime)
        for mutant in mutants(self._module, self._source):
            made += 1
            if self._survives(mutant.tree):
                left += 1
                print(f"\n{self._path}:{mutant.line}: `{mutant.was}`: {mutant.change}", end="", flush=True)
        print(f"\n{made} mutants, {made - left} killed, {1 - left / made:.1%}")
        return True

    def _survives(self, tree: ast.Module) -> bool:
        child = os.fork()
        if child == 0:
            signal.setitimer(signal.ITIMER_VIRTUAL, self._patience_s)  # a mutant that never ends counts as noticed
            try:
                os._exit(self._run(tree))
            finally:
                os._exit(_MOST)  # the child must not return to pytest
        failed = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if 0 < failed <= len(self._tests):
            self._tests.insert(0, self._tests.pop(failed - 1))
        return failed == 0

    def _run(self, tree: ast.Module) -> int:
        """Return the number of the failing test from 1, or 0.

        The classes that the tests know get the changed functions.
        """
        changed: dict[str, object] = {"__name__": self._module.__name__}
        try:
            exec(compile(tree, self._path, "exec"), changed)
        except Exception:  # noqa: BLE001  (any exception of a changed module counts as noticed)
            return _MOST
        for name, known in [(n, k) for n, k in vars(self._module).items() if isinstance(k, type)]:
            if known.__module__ == self._module.__name__ and not issubclass(known, enum.Enum):
                for part, value in vars(changed[name]).items():
                    if isinstance(value, FunctionType | property):
                        setattr(known, part, value)
            changed[name] = known
        for i, (test, following) in enumerate(pairwise([*self._tests, None]), 1):
            assert test is not None
            if any(report.failed for report in runtestprotocol(test, nextitem=following, log=False)):
                return min(i, _MOST)
        return 0


def main(path: str) -> int:
    """Apply every change to a module, and print the changes that its tests miss."""
    settings.register_profile("once", phases=[Phase.explicit, Phase.generate])  # any failure will do; no shrinking
    settings.load_profile("once")
    folder, stem = Path("tests/unit", *Path(path).parts[1:-1]), Path(path).stem
    tests = [*sorted(folder.glob(f"test_{stem}_*.py")), folder / f"test_{stem}.py"]
    return int(pytest.main([*_QUIETLY, *map(str, tests)], plugins=[Hunt(path)]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
