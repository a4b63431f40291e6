"""TOML -> frozen dataclasses: every key known, every type right, and all that is wrong said at once.

A dataclass is its own schema: field types say what is expected, defaults say what may be left out, `__post_init__` refuses
nonsense. Nothing is repaired. A union of dataclasses is told apart by the key `kind`, a Literal of each member.
"""

import dataclasses
import difflib
import math
import tomllib
import types
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

T = TypeVar("T")


class ConfigError(ValueError):
    """What is wrong in a configuration, one line each, with the place, what was expected and what was found."""

    def __init__(self, source: str, problems: list[str]):
        self.problems = tuple(problems)
        super().__init__(
            f"{source}: " + ("; ".join(problems) if len(problems) == 1 else "".join(f"\n  - {p}" for p in problems))
        )


def load(path: Path, schema: type[T]) -> T:
    """Read a TOML file as a frozen dataclass.

    Raises:
        ConfigError: The file is missing, is not TOML, or does not fit the schema; all misfits are listed.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(str(path), ["no such file"]) from None
    except OSError as error:
        raise ConfigError(str(path), [f"cannot be read: {error.strerror}"]) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(str(path), [f"not a TOML file: {error}"]) from None
    return build(table, schema, str(path))


def build(table: dict[str, Any], schema: type[T], source: str = "configuration") -> T:
    """Make a frozen dataclass from a table of plain values; raises ConfigError that lists every misfit."""
    problems: list[str] = []
    value = _build_dataclass(table, schema, "", problems)
    if problems:
        raise ConfigError(source, problems)
    return cast(T, value)


def as_table(value: object) -> Any:
    """The plain table that `build` would make the value from: tuples become lists, None fields are left out."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        pairs = ((f.name, getattr(value, f.name)) for f in dataclasses.fields(value))
        return {name: as_table(item) for name, item in pairs if item is not None}
    if isinstance(value, list | tuple):
        return [as_table(item) for item in value]
    if isinstance(value, dict):
        return {key: as_table(item) for key, item in value.items()}
    return value


_INVALID = object()


def _build_dataclass(table: object, schema: type[Any], where: str, problems: list[str]) -> object:
    if not isinstance(table, dict):
        problems.append(f"{where or 'top level'}: a table expected, found {_shown(table)}")
        return _INVALID
    hints = get_type_hints(schema)
    fields = {f.name: f for f in dataclasses.fields(schema) if f.init}
    before = len(problems)
    for key in sorted(table.keys() - fields.keys(), key=str):
        near = difflib.get_close_matches(str(key), fields, n=1)
        known = f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(sorted(fields))}"
        problems.append(f"{_join(where, str(key))}: unknown key; {known}")
    values: dict[str, object] = {}
    for name, field in fields.items():
        if name in table:
            values[name] = _build_value(table[name], hints[name], _join(where, name), problems)
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            problems.append(f"{_join(where, name)}: missing; {_wanted(hints[name], name)} is needed")
    if len(problems) > before:
        return _INVALID
    try:
        return schema(**values)
    except ValueError as error:
        problems.append(f"{where or 'top level'}: {error}")
        return _INVALID


def _build_value(value: object, hint: Any, where: str, problems: list[str]) -> object:
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _build_union(value, [a for a in args if a is not type(None)], where, problems)
    if dataclasses.is_dataclass(hint):
        return _build_dataclass(value, cast(type[Any], hint), where, problems)
    if origin is tuple:
        return _build_tuple(value, args, where, problems)
    if origin is dict and isinstance(value, dict):
        return {key: _build_value(item, args[1], _join(where, str(key)), problems) for key, item in value.items()}
    if origin is Literal:
        if value in args:
            return value
        problems.append(f"{where}: one of {', '.join(map(repr, args))} expected, found {_shown(value)}")
        return _INVALID
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            problems.append(f"{where}: a number that fits 64 bits expected, found one of {value.bit_length()} bits")
            return _INVALID
    if isinstance(hint, type) and isinstance(value, hint) and not (hint is int and isinstance(value, bool)):
        if isinstance(value, float) and not math.isfinite(value):
            problems.append(f"{where}: a finite number expected, found {value}")
        return value
    problems.append(f"{where}: {_type_words(hint)} expected, found {_shown(value)}")
    return _INVALID


def _build_union(value: object, members: list[Any], where: str, problems: list[str]) -> object:
    if len(members) == 1:
        return _build_value(value, members[0], where, problems)
    kinds: dict[object, Any] = {get_args(get_type_hints(m)["kind"])[0]: m for m in members}
    kind = value.get("kind") if isinstance(value, dict) else None
    if not isinstance(kind, str) or kind not in kinds:
        near = difflib.get_close_matches(str(kind), map(str, kinds), n=1)
        known = f"did you mean {near[0]!r}?" if near else f"known kinds: {', '.join(map(str, kinds))}"
        problems.append(f"{_join(where, 'kind')}: found {_shown(kind)}; {known}")
        return _INVALID
    return _build_dataclass(value, kinds[kind], where, problems)


def _build_tuple(value: object, args: tuple[Any, ...], where: str, problems: list[str]) -> object:
    if not isinstance(value, list | tuple):
        problems.append(f"{where}: a list expected, found {_shown(value)}")
        return _INVALID
    hints = [args[0]] * len(value) if len(args) == 2 and args[1] is Ellipsis else list(args)
    if len(hints) != len(value):
        problems.append(f"{where}: a list of {len(hints)} values expected, found {len(value)}")
        return _INVALID
    return tuple(_build_value(v, h, f"{where}[{i}]", problems) for i, (v, h) in enumerate(zip(value, hints, strict=True)))


def _join(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def _wanted(hint: Any, name: str) -> str:
    """What a missing key asks for, in words."""
    if dataclasses.is_dataclass(hint):
        return f"a table [{name}]"
    if get_origin(hint) is tuple and any(dataclasses.is_dataclass(member) for member in _members(hint)):
        return f"one table [[{name}]] or more"
    return f"a value of {_type_words(hint)}"


def _members(hint: Any) -> tuple[Any, ...]:
    """What the entries of a tuple's hint may be."""
    return tuple(member for entry in get_args(hint) for member in (get_args(entry) or (entry,)))


def _type_words(hint: Any) -> str:
    words: dict[Any, str] = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}
    return words.get(hint, getattr(hint, "__name__", str(hint)))


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
