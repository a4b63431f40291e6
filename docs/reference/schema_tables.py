"""Tables of the fields of nested dataclasses, which are the schema of a file.

The meaning of a field is its comment in the source, the meaning of a table is the docstring of its class.
"""

import dataclasses
import inspect
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import date
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from docs.reference.parts import anchor
from sextant.shared.field_comments import comments_of, parse
from sextant.shared.files import config
from sextant.shared.runtime.process import toml_value

_TYPES = {float: "number", int: "whole number", str: "text", bool: "true, false", date: "date", Any: "any"}
_PLURALS = {"number": "numbers", "whole number": "whole numbers", "text": "texts", "table": "tables"}


@dataclass(frozen=True, slots=True)
class Layout:
    """Format of a schema's page, and what it leaves out."""

    toml: bool  # a TOML file with defaults, else JSON
    leave_out: frozenset[str] = frozenset()  # fields of the top level that a file does not have
    before: Mapping[str, str] = field(default_factory=dict)  # path of a table, or path.kind -> text before its fields


def tables(schema: type[Any], layout: Layout) -> Iterator[str]:
    """Yield the lines of a schema's tables: its own fields, then its nested tables."""
    yield from _fields(schema, layout, "", layout.leave_out)
    yield from _nested(schema, layout, "", 2, layout.leave_out)


def _nested(schema: type[Any], layout: Layout, path: str, level: int, leave_out: frozenset[str] = frozenset()) -> Iterator[str]:
    for name, hint in get_type_hints(schema).items():
        inner, many = tables_of(hint)
        if not inner or name in leave_out or name not in _own(schema):
            continue
        place = f"{path}.{name}" if path else name
        title = f"[[{place}]]" if many and layout.toml else f"[{place}]" if layout.toml else place
        yield from ("#" * level + f" `{title}`", "")
        if place in layout.before:
            yield from (layout.before[place], "")
        if len(inner) == 1:
            yield from _table(inner[0], layout, place, level)
            continue
        yield from (f"The key `kind` selects one of {len(inner)} kinds.", "")
        for kind in inner:
            word = kind_of(kind)
            yield from ("#" * (level + 1) + f" `{word}`", "")
            yield from _table(kind, layout, place, level + 1, layout.before.get(f"{place}.{word}", ""), of_union=True)


def _table(kind: type[Any], layout: Layout, place: str, level: int, before: str = "", of_union: bool = False) -> Iterator[str]:
    yield from (inspect.getdoc(kind) or "", "")
    if before:
        yield from (before, "")
    yield from _fields(kind, layout, place, frozenset(["kind"] if of_union else []))
    yield from _nested(kind, layout, place, level + 1)


def _fields(schema: type[Any], layout: Layout, place: str, leave_out: frozenset[str]) -> Iterator[str]:
    said, hints = comments_of(schema), get_type_hints(schema)
    columns = ("key", "type", *(["default"] if layout.toml else []), "unit", "meaning")
    yield f"| {' | '.join(columns)} |"
    yield "|" + "---|" * len(columns)
    for one in dataclasses.fields(schema):
        if one.name in leave_out or one.name not in _own(schema):
            continue
        unit, frame, what = parse(said.get(one.name, ""))
        meaning = ", ".join(filter(None, (what, f"in {{{frame}}}" if frame else "")))
        key = f"[`{one.name}`](#{anchor(place + one.name)})" if tables_of(hints[one.name])[0] else f"`{one.name}`"
        cells = (key, _type(hints[one.name]), *([_default(one)] if layout.toml else []), unit, meaning)
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
    yield ""


def _own(schema: type[Any]) -> set[str]:
    """Return the fields of a dataclass that none of its bases has, whose table lists them."""
    inherited = {one.name for base in schema.__mro__[1:] if dataclasses.is_dataclass(base) for one in dataclasses.fields(base)}
    return {one.name for one in dataclasses.fields(schema)} - inherited


def _default(one: dataclasses.Field[Any]) -> str:
    if one.default is dataclasses.MISSING and one.default_factory is dataclasses.MISSING:
        return "*required*"
    default = one.default if one.default is not dataclasses.MISSING else None
    if default is None or default == () or dataclasses.is_dataclass(default):
        return ""
    return f"`{toml_value(config.as_table(default))}`"


def _type(hint: Any) -> str:
    """Return the type of a field as a file has it."""
    origin, args = get_origin(hint), tuple(arg for arg in get_args(hint) if arg is not type(None))
    if origin in (Union, types.UnionType):
        return _type(args[0])
    if origin is Literal:
        return ", ".join(f"`{word}`" for word in args)
    if origin is tuple:
        count = "" if args[-1] is Ellipsis else f"{len(args)} "
        one = _type(args[0])
        return f"{count}{_PLURALS.get(one, f'lists of {one}')}" if count else f"list of {_PLURALS.get(one, one)}"
    if origin is dict or dataclasses.is_dataclass(hint):
        return "table"
    return _TYPES[hint]


def kind_of(schema: type[Any]) -> str:
    """Return the value of `kind` that selects a table."""
    return str(get_args(get_type_hints(schema)["kind"])[0])


def tables_of(hint: Any) -> tuple[tuple[type[Any], ...], bool]:
    """Return the dataclasses that a field may hold, and whether it holds several."""
    origin, args = get_origin(hint), get_args(hint)
    if dataclasses.is_dataclass(hint):
        return (hint,), False  # type: ignore[return-value]
    if origin in (Union, types.UnionType):
        return tuple(kind for arg in args for kind in tables_of(arg)[0]), False
    if origin is tuple:
        return tables_of(args[0])[0], True
    if origin is dict:
        return tables_of(args[1])[0], True
    return (), False
