"""Fields of a message as a table: type, shape, unit, frame and meaning, from the declaration and its comments."""

import inspect
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, Literal

import numpy as np

from sextant.shared.field_comments import Meaning, comments, parse
from sextant.shared.wire import messages
from sextant.shared.wire.codec import schema_id
from sextant.shared.wire.messages import Dims, Message
from sextant.shared.wire.topics import Topic

_FRAMES = ("world", "odom", "body")
_NAMES = {float: "float", int: "int", bool: "bool", str: "text", tuple: "texts"}


@dataclass(frozen=True, slots=True)
class FieldRow:
    """One field of a message."""

    name: str
    type: str  # float, int, bool, text, texts, or the dtype of an array
    shape: tuple[int | str, ...]  # of an array: lengths, or names of free lengths
    unit: str
    frame: str
    what: str
    choices: tuple[str, ...]  # all values of a text; empty for any text


def field_rows(kind: type[Message]) -> list[FieldRow]:
    """Return the fields of a message class in the order of its frame."""
    said = comments(inspect.getsource(messages))
    rows = []
    for name, base, detail in messages.schema(kind):
        declared_in = next(one.__name__ for one in kind.__mro__ if name in inspect.get_annotations(one))
        meaning = _meaning(name, said.get((declared_in, name), ""))
        type_, shape, limits = _NAMES.get(base, "text"), (), f"at most {messages.MAX_ITEMS}" if base is tuple else ""
        if base is np.ndarray:
            dtype, dims = detail
            type_, shape, limits = str(dtype), dims.shape, _limits(dtype, dims)
        what = "; ".join(filter(None, (meaning.what, limits)))
        rows.append(FieldRow(name, type_, shape, meaning.unit, meaning.frame, what, _choices(base, detail)))
    return rows


def table_of(topic: Topic[Any]) -> dict[str, Any]:
    """Return a topic, the schema of its message and the fields as JSON values."""
    return {
        "key": topic.key,
        "type": topic.type.__name__,
        "schema": schema_id(topic.type),
        "rate_hz": topic.rate_hz,
        "rate": topic.rate,
        "delivery": topic.delivery.value,
        "lane": topic.lane.value,
        "max_bytes": topic.max_bytes,
        "fields": [asdict(row) for row in field_rows(topic.type)],
    }


def _choices(base: Any, detail: Any) -> tuple[str, ...]:
    if base is Literal:
        return tuple(detail)
    return tuple(base) if isinstance(base, type) and issubclass(base, StrEnum) else ()


def _meaning(name: str, comment: str) -> Meaning:
    """Parse a field's comment; a transform T_to_from has its frames in its name."""
    unit, frame, what = parse(comment)
    match name.split("_"):
        case ["T", to, source] if to in _FRAMES and source in _FRAMES:
            takes = f"takes {source} coordinates to {to}"
            return Meaning(unit or "m", frame or to, f"{takes}; {what}" if what else takes)
    return Meaning(unit, frame, what)


def _limits(dtype: np.dtype[Any], dims: Dims) -> str:
    low, high = dims.lengths or (0, 0)
    words = (
        "may hold NaN" if dtype.kind == "f" and not dims.finite else "",
        f"at most {dims.most}" if dims.most is not None else "",
        f"{low} to {high} of them" if dims.lengths else "",
        "may be empty" if dims.optional else "",
        "packed" if dims.packed else "",
    )
    return ", ".join(filter(None, words))
