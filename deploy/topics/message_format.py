"""Messages as text and as JSON.

Small arrays are shown in full, large ones by dtype, shape and range.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.deploy.topics.passive_subscriber import ReceivedMessage, age_ns
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire.codec import DecodeError, decode, label
from sextant.shared.wire.messages import Message, schema

_ROUNDING = 1e-14  # smaller numbers are rounding errors, shown as 0
FEW = 36  # values of an array that is shown in full: a covariance, and all joints
_WIDTH = 110  # columns


def in_words(heard: ReceivedMessage) -> str:
    """Format a frame's message as lines of text.

    Raises:
        DecodeError: The frame does not match its topic, with what to do.
    """
    message, age = _decoded(heard)
    facts = [f"{len(heard.frame)} bytes", f"{age * 1e-6:.0f} ms old" if age is not None else "another machine's clock"]
    if heard.passed_over:
        facts.append(f"{heard.passed_over} skipped")
    lines = [f"{heard.topic.key}  {type(message).__name__}  {', '.join(facts)}"]
    names = [name for name, _, _ in schema(type(message))]
    width = max(map(len, names))
    for name in names:
        head = f"  {name:<{width}}  "
        first, *rest = _lines(getattr(message, name), _WIDTH - len(head))
        lines += [head + first, *(" " * len(head) + line for line in rest)]
    return "\n".join(lines)


def for_scripts(heard: ReceivedMessage) -> dict[str, Any]:
    """Return a frame's message as JSON values; NaN is null.

    Raises:
        DecodeError: The frame does not match its topic, with what to do.
    """
    message, age = _decoded(heard)
    return {
        "key": heard.topic.key,
        "type": type(message).__name__,
        "bytes": len(heard.frame),
        "age_ms": None if age is None else round(age * 1e-6, 3),
        "passed_over": heard.passed_over,
        "message": {name: _plain(getattr(message, name)) for name, _, _ in schema(type(message))},
    }


def refusal(topic: AnyTopic, error: DecodeError) -> str:
    """Return why a frame cannot be decoded, and what to do."""
    return f"{topic.key}: {error}; run `sextant topics` of the sender's version, or restart the older program"


def _decoded(heard: ReceivedMessage) -> tuple[Message, int | None]:
    message, _ = decode(heard.frame, heard.topic.type, heard.topic.max_bytes)
    return message, age_ns(label(heard.frame), heard.at_ns)


def _lines(value: Any, width: int) -> list[str]:
    if isinstance(value, np.ndarray):
        what = f"{value.dtype} {value.shape}"
        if value.size > FEW:
            return [f"{what}  {_digest_in_words(value)}"]
        text = np.array2string(value, max_line_width=width, formatter=_aligned(value))
        lines = text.splitlines()
        return [f"{what}  {text}"] if len(lines) == 1 and len(what) + len(text) + 2 <= width else [what, *lines]
    if isinstance(value, tuple):
        return list(value) or ["none"]
    if isinstance(value, float):
        return [f"{value:.6g}"]
    return [repr(value) if type(value) is str else str(value)]


def _aligned(array: NDArray[Any]) -> Any:
    """Return NumPy's formatter for the numbers of an array: five digits in equal widths; None without floats."""
    if array.dtype.kind != "f":
        return None

    def spelled(x: float) -> str:
        return f"{0.0 if abs(x) < _ROUNDING else x:.5g}"

    width = max(map(len, map(spelled, array.ravel().tolist())), default=0)
    return {"float_kind": lambda x: f"{spelled(x):>{width}}"}


def _digest(array: NDArray[Any]) -> dict[str, float]:
    """Return share of finite values, minimum and maximum of an array.

    For booleans it is the share of true values.
    """
    if array.dtype == np.bool_:
        return {"true": round(float(array.mean()), 4)}
    values = array[np.isfinite(array)] if array.dtype.kind == "f" else array.ravel()
    found = {"finite": round(values.size / array.size, 4)} if array.dtype.kind == "f" else {}
    return {**found, "min": values.min().item(), "max": values.max().item()} if values.size else found


def _digest_in_words(array: NDArray[Any]) -> str:
    digest = _digest(array)
    shares = [f"{100 * digest[name]:.3g} % {name}" for name in ("finite", "true") if name in digest]
    ends = [f"{digest['min']:.5g} to {digest['max']:.5g}"] if "min" in digest else []
    return ", ".join(shares + ends)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        if value.size > FEW:
            return {"dtype": str(value.dtype), "shape": list(value.shape), **_digest(value)}
        return _without_nan(value.tolist())
    return list(value) if isinstance(value, tuple) else value


def _without_nan(value: Any) -> Any:
    if isinstance(value, list):
        return [_without_nan(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
