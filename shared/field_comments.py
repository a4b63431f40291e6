"""Comments of the fields of dataclasses, from which the reference pages are made."""

import ast
import dataclasses
import inspect
import io
import re
import sys
import tokenize
from collections.abc import Mapping
from typing import Any, NamedTuple

_COMMENT = re.compile(r"(?:\((?:[\d, ]+)\) )?(?:\[(?P<unit>[^\]]+)\] ?)?(?:\{(?P<frame>\w+)\} ?)?(?P<what>.*)", re.DOTALL)


class Meaning(NamedTuple):
    """Parts of a field's comment."""

    unit: str
    frame: str
    what: str


def parse(comment: str) -> Meaning:
    """Parse a field's comment: `[unit] {frame} text`."""
    found = _COMMENT.fullmatch(comment)
    assert found is not None
    return Meaning(found["unit"] or "", found["frame"] or "", found["what"].lstrip(", ").rstrip("."))


def comments_of(kind: type[Any]) -> dict[str, str]:
    """Return field -> comment of a dataclass and of its bases."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if dataclasses.is_dataclass(base):
            said = comments(inspect.getsource(sys.modules[base.__module__]))
            found |= {name: words for (owner, name), words in said.items() if owner == base.__name__}
    return found


def comments(source: str) -> dict[tuple[str, str], str]:
    """Return (class, field) -> comments above and behind its declaration."""
    lines = source.splitlines()
    found = {
        token.start[0]: (token.string.lstrip("# "), not lines[token.start[0] - 1][: token.start[1]].strip())
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    said: dict[tuple[str, str], str] = {}
    for kind in ast.parse(source).body:
        if isinstance(kind, ast.ClassDef):
            for node in kind.body:
                match node:
                    case ast.AnnAssign(target=ast.Name(name)) | ast.Assign(targets=[ast.Name(name)]):
                        said[kind.name, name] = _comment(node, found)
    return said


def _comment(node: ast.stmt, found: Mapping[int, tuple[str, bool]]) -> str:
    above: list[str] = []
    line = node.lineno - 1
    while line in found and found[line][1]:
        above.insert(0, found[line][0])
        line -= 1
    within = range(node.lineno, (node.end_lineno or node.lineno) + 1)
    behind = [found[line][0] for line in within if line in found]
    if not above or not behind:
        return " ".join(above or behind)
    return f"{' '.join(behind)}; {above[0][:1].lower()}{' '.join(above)[1:]}"
