"""Conversion of TOML to frozen dataclasses, with all errors reported at once.

A dataclass is its own schema. The field types define the expected types, fields with defaults are optional, `checks` define
conditions of the values, and `__post_init__` refuses other invalid combinations. Unknown keys are errors, and nothing is
repaired. In a union of dataclasses the key `kind`, a Literal in each member, selects the member. A schema's `renamed` maps keys
of earlier versions to present ones; the error of an old key names the new one.
"""

import dataclasses
import math
import types
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from sextant.shared.errors import SextantError
from sextant.shared.files import input_file
from sextant.shared.spelling import hint, nearest

T = TypeVar("T")
N = TypeVar("N", int, float)
_RANGE = "range"  # key of a field's metadata
_MOST_SHOWN = 30  # problems shown per configuration


class ConfigError(SextantError, ValueError):
    """Errors in a configuration, one per line, with place, expected and found value."""

    def __init__(self, source: str, problems: list[str]):
        self.problems = tuple(problems)
        more = [f"and {len(problems) - _MOST_SHOWN} more"] if len(problems) > _MOST_SHOWN else []
        shown = [*problems[:_MOST_SHOWN], *more]
        listed = f" {shown[0]}" if len(shown) == 1 else "".join(f"\n  - {problem}" for problem in shown)
        super().__init__(f"{source}:{listed}")


@dataclass(frozen=True, slots=True)
class Misfit:
    """Invalid value in a configuration."""

    place: str  # key relative to the checked table, such as "limits[1]"
    expected: str  # description of the expected value
    found: str  # description of the found value


@dataclass(frozen=True, slots=True)
class Check:
    """Condition on some values of a table.

    All checks of a schema run on the values that could be read, so that all errors are reported at once. A check is skipped if
    one of its values could not be read, or failed an earlier check.
    """

    keys: tuple[str, ...]
    finds: Callable[..., Iterable[Misfit]]  # called with the values of the keys


def each(keys: str, holds: Callable[[Any], bool], expected: str) -> tuple[Check, ...]:
    """Return one check per key in `keys`, which are separated by spaces.

    A list is checked entry by entry.
    """

    def of(key: str) -> Check:
        def finds(value: Any) -> Iterator[Misfit]:
            entries = enumerate(value) if isinstance(value, tuple) else ((None, value),)
            for index, entry in entries:
                if _known(entry) and not holds(entry):
                    yield Misfit(key if index is None else f"{key}[{index}]", expected, _shown(entry))

        return Check((key,), finds)

    return tuple(map(of, keys.split()))


def bounded(keys: str, most: float, unit: str) -> tuple[Check, ...]:
    """Return one check per key in `keys`: numbers, or lists of them, within +- `most`."""
    return each(keys, lambda value: value is None or abs(value) <= most, f"at most {most:g} {unit} either way")


def ranged(default: N, low: float, high: float) -> N:
    """Declare a number of a dataclass with its default and its allowed range, ends included."""
    return dataclasses.field(default=default, metadata={_RANGE: (low, high)})


def range_of(field: dataclasses.Field[Any]) -> tuple[float, float] | None:
    """Return the range of a field that `ranged` declares, else None."""
    return cast("tuple[float, float] | None", field.metadata.get(_RANGE))


def together(keys: str, holds: Callable[..., bool], expected: str) -> Check:
    """Return a check on several values together; `keys` are separated by spaces.

    Errors name the first key.
    """
    names = keys.split()

    def finds(*values: Any) -> Iterator[Misfit]:
        if all(map(_known, values)) and not holds(*values):
            found = ", ".join(f"{name} = {_shown(value)}" for name, value in zip(names, values, strict=True))
            yield Misfit(names[0], expected, found)

    return Check(tuple(names), finds)


def expect(holds: bool, expected: str, found: object) -> None:
    """Raise a ValueError with what was expected and what was found, unless a condition holds."""
    if not holds:
        raise ValueError(f"{expected} expected, found {found}")


def verify(made: Any) -> None:
    """Run the `checks` of a dataclass; its `__post_init__` calls this.

    Raises:
        ValueError: A check failed; the text lists all errors.
    """
    values = {field.name: getattr(made, field.name) for field in dataclasses.fields(made)}
    misfits = _misfits(_checks_of(type(made)), values)
    if misfits:
        raise ValueError("; ".join(map(_words, misfits)))


def read(path: Path) -> dict[str, Any]:
    """Read a TOML file as a table of plain values; raises ConfigError if that fails."""
    try:
        return input_file.read_toml(path)
    except input_file.FileError as error:
        raise ConfigError(error.place, [error.cause]) from None


def load(path: Path, schema: type[T]) -> T:
    """Read a TOML file as a frozen dataclass.

    Raises:
        ConfigError: The file is missing, is not TOML, or does not match the schema; the text lists all errors.
    """
    return build(read(path), schema, str(path))


def build(table: dict[str, Any], schema: type[T], source: str = "configuration", also: tuple[Check, ...] = ()) -> T:
    """Make a frozen dataclass from a table of plain values.

    Args:
        table: Plain values, as from TOML.
        schema: Dataclass to make.
        source: Name of the table in errors.
        also: Additional checks of the top level.

    Raises:
        ConfigError: The table does not match the schema; the text lists all errors.
    """
    problems: list[str] = []
    value = _build_dataclass(table, schema, "", problems, also)
    if problems:
        raise ConfigError(source, problems)
    return cast(T, value)


def as_table(value: object) -> Any:
    """Return the plain table from which `build` makes the value.

    Tuples become lists, and None fields are omitted.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        pairs = ((f.name, getattr(value, f.name)) for f in dataclasses.fields(value))
        return {name: as_table(item) for name, item in pairs if item is not None}
    if isinstance(value, list | tuple):
        return [as_table(item) for item in value]
    if isinstance(value, dict):
        return {key: as_table(item) for key, item in value.items()}
    return value


def assign(table: dict[str, Any], assignments: Iterable[str]) -> None:
    """Set values of a table by `key=value` texts; the values are in TOML notation.

    A dotted key sets one value of a nested table, not the whole table. A word without quotes is a text.

    Raises:
        ConfigError: An assignment is malformed.
    """
    for assignment in assignments:
        key, equals, value = assignment.partition("=")
        parts = [part.strip() for part in key.split(".")]
        if not equals or not all(part.isidentifier() for part in parts):
            raise ConfigError("--set", [f"key=value expected, found {assignment!r}"])
        try:
            parsed = input_file.parse_toml(Path("--set"), f"value = {value}".encode(errors="replace"))
        except input_file.FileError:
            parsed = {}
        inner = table
        for part in parts[:-1]:
            inner = inner.setdefault(part, {})
            if not isinstance(inner, dict):
                raise ConfigError("--set", [f"{key}: {part} is not a table"])
        inner[parts[-1]] = parsed["value"] if len(parsed) == 1 else value


_INVALID = object()


class _Partial:
    """Valid values of a table that has errors."""

    def __init__(self, values: dict[str, object]):
        self._values = values

    def __getattr__(self, name: str) -> object:
        value = self._values.get(name, _INVALID)
        if not _known(value):
            raise AttributeError(name)
        return value


def _known(value: object) -> bool:
    """Return whether a value is valid, including all its entries."""
    if isinstance(value, tuple):
        return all(map(_known, value))
    return value is not _INVALID and not isinstance(value, _Partial)


def _checks_of(schema: type[Any]) -> tuple[Check, ...]:
    """Return the checks of a schema: the ranges of its numbers, then its `checks`."""
    found: list[Check] = []
    for field in dataclasses.fields(schema):
        if limits := range_of(field):
            found += _within(field.name, *limits)
    return (*found, *getattr(schema, "checks", ()))


def _within(key: str, low: float, high: float) -> tuple[Check, ...]:
    return each(key, lambda value: low <= value <= high, f"{low:g} to {high:g}")


def _misfits(checks: Iterable[Check], values: dict[str, object]) -> list[Misfit]:
    """Run checks on the known values and return the errors.

    Failed values are marked as invalid.
    """
    found: list[Misfit] = []
    for check in checks:
        if all(values.get(key, _INVALID) is not _INVALID for key in check.keys):
            misfits = list(check.finds(*(values[key] for key in check.keys)))
            for misfit in misfits:
                if "." not in misfit.place:  # otherwise the error is inside a table whose other values are valid
                    values[misfit.place.split("[")[0]] = _INVALID
            found += misfits
    return found


def _words(misfit: Misfit) -> str:
    return f"{misfit.place}: {misfit.expected} expected, found {misfit.found}"


def _build_dataclass(
    table: object, schema: type[Any], where: str, problems: list[str], also: tuple[Check, ...] = (), default: object = None
) -> object:
    """Return a dataclass made from a table; fields that it omits are those of `default`, an instance, if given."""
    if not isinstance(table, dict):
        problems.append(f"{where or 'top level'}: a table expected, found {_shown(table)}")
        return _INVALID
    hints = get_type_hints(schema)
    fields = {f.name: f for f in dataclasses.fields(schema) if f.init}
    before = len(problems)
    unknown = sorted(str(key) for key in table.keys() - fields.keys())
    problems += [f"{_join(where, key[:60])}: unknown key; {_instead(key, schema, fields)}" for key in unknown]
    misspelt = {nearest(key, sorted(fields)) for key in unknown}
    values: dict[str, object] = {}
    for name, field in fields.items():
        if name in table:
            values[name] = _build_value(table[name], hints[name], _join(where, name), problems, _default(field))
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING and name not in misspelt:
            problems.append(f"{_join(where, name)}: missing; {_wanted(hints[name], name)} is needed")
    given = dict(values)
    if default is None:  # checks of several fields see the defaults of those that the table omits
        values |= {name: f.default for name, f in fields.items() if name not in table and f.default is not dataclasses.MISSING}
    misfits = _misfits((*_checks_of(schema), *also), values)
    problems += [_join(where, _words(misfit)) for misfit in misfits]
    if len(problems) > before:
        return _Partial(values)
    try:
        return schema(**given) if default is None else dataclasses.replace(cast(Any, default), **given)
    except ValueError as error:
        problems.append(f"{where}: {error}" if where else str(error))  # at the top level, the error names its key
        return _INVALID


def _instead(key: str, schema: type[Any], known: Iterable[str]) -> str:
    """Return what to write in place of an unknown key."""
    new = getattr(schema, "renamed", {}).get(key)
    return f"it is now {new!r}" if new else hint(key, sorted(known), "known keys")


def _default(field: dataclasses.Field[Any]) -> object:
    """Return the default of a field that is a dataclass, else None."""
    factory = field.default_factory
    made = None if factory is dataclasses.MISSING else factory()
    return made if dataclasses.is_dataclass(made) else None


def _build_value(value: object, hint: Any, where: str, problems: list[str], default: object = None) -> object:
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _build_union(value, [a for a in args if a is not type(None)], where, problems)
    if dataclasses.is_dataclass(hint):
        return _build_dataclass(value, cast(type[Any], hint), where, problems, default=default)
    if origin is tuple:
        return _build_tuple(value, args, where, problems)
    if origin is dict and isinstance(value, dict):
        return {key: _build_value(item, args[1], _join(where, str(key)), problems) for key, item in value.items()}
    if origin is Literal:
        if value in args:
            return value
        near = nearest(value, map(str, args)) if isinstance(value, str) else ""
        guess = f"; did you mean {near!r}?" if near else ""
        problems.append(f"{where}: one of {', '.join(map(repr, args))} expected, found {_shown(value)}{guess}")
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
            return _INVALID
        return value
    problems.append(f"{where}: {_type_words(hint)} expected, found {_shown(value)}")
    return _INVALID


def _build_union(value: object, members: list[Any], where: str, problems: list[str]) -> object:
    if len(members) == 1:
        return _build_value(value, members[0], where, problems)
    kinds: dict[object, Any] = {get_args(get_type_hints(m)["kind"])[0]: m for m in members}
    kind = value.get("kind") if isinstance(value, dict) else None
    if not isinstance(kind, str) or kind not in kinds:
        problems.append(f"{_join(where, 'kind')}: found {_shown(kind)}; {hint(str(kind), map(str, kinds), 'known kinds')}")
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
    """Return the expected value of a missing key as text."""
    if dataclasses.is_dataclass(hint):
        return f"a table [{name}]"
    if get_origin(hint) is tuple and any(dataclasses.is_dataclass(member) for member in _members(hint)):
        return f"one table [[{name}]] or more"
    return _type_words(hint)


def _members(hint: Any) -> tuple[Any, ...]:
    """Return the possible entry types of a tuple's type hint."""
    return tuple(member for entry in get_args(hint) for member in (get_args(entry) or (entry,)))


def _type_words(hint: Any) -> str:
    if get_origin(hint) is tuple:
        return "a list"
    if get_origin(hint) is dict:
        return "a table"
    words: dict[Any, str] = {
        float: "a number", int: "a whole number", str: "a text", bool: "true or false", date: "a date as in 2026-07-30",
    }  # fmt: skip
    return words.get(hint, getattr(hint, "__name__", str(hint)))


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
