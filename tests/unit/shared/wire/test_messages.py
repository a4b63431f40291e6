"""Messages are validated when they are made.

An error names the field, the expected and the found value.
"""

import dataclasses
from enum import StrEnum
from typing import Any

import numpy as np
import pytest

from sextant.shared.wire import messages as m
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Message

KINDS = list(topics.OF_TYPE)


def example(kind: type[Message]) -> Message:
    """Return the simplest message of a type, from its declaration."""
    values: dict[str, Any] = {}
    for name, base, detail in m.schema(kind):
        if base is np.ndarray:
            dtype, dims = detail
            free = min(3, (dims.lengths or (0, 3))[1])
            values[name] = np.zeros([n if isinstance(n, int) else free for n in dims.shape], dtype)
        elif base is tuple:
            values[name] = ("text",)
        elif isinstance(base, type) and issubclass(base, StrEnum):
            values[name] = next(iter(base))
        elif isinstance(detail, tuple):
            values[name] = detail[0]
        else:
            values[name] = base()
    return kind(**values)


def fields_with(base: Any) -> list[tuple[type[Message], str, Any]]:
    return [(kind, name, detail) for kind in KINDS for name, found, detail in m.schema(kind) if found is base]


def refused(message: Message, name: str, value: object) -> str:
    with pytest.raises(ValueError, match=rf"^{type(message).__name__}\.{name}: .*expected") as caught:
        dataclasses.replace(message, **{name: value})  # type: ignore[arg-type]
    return str(caught.value)


@pytest.mark.parametrize("kind", KINDS)
def test_messages_are_immutable(kind: type[Message]) -> None:
    message = example(kind)
    with pytest.raises(dataclasses.FrozenInstanceError):
        message.stamp_ns = 1  # type: ignore[misc]
    assert m.schema(kind)[0] == ("stamp_ns", int, None)
    assert kind.__doc__
    assert "->" in kind.__doc__  # publishers and subscribers


@pytest.mark.parametrize(("kind", "name", "detail"), fields_with(np.ndarray))
def test_invalid_arrays_are_refused(kind: type[Message], name: str, detail: Any) -> None:
    dtype, dims = detail
    message = example(kind)
    good = getattr(message, name)
    assert "found list" in refused(message, name, good.tolist())
    assert "found " in refused(message, name, good.astype(np.complex128))
    if dtype.itemsize > 1:
        assert "found >" in refused(message, name, good.astype(dtype.newbyteorder(">")))
    assert "found (" in refused(message, name, good[None])
    for axis, length in enumerate(dims.shape):
        longer = np.concatenate([good, good], axis)
        if isinstance(length, int):
            assert "found (" in refused(message, name, longer)
        elif sum(length in d[1].shape for _, b, d in m.schema(kind) if b is np.ndarray) > 1:  # others share the name
            with pytest.raises(ValueError, match=rf"^{kind.__name__}\.\w+: .*expected with {length} = "):
                dataclasses.replace(message, **{name: longer})  # type: ignore[arg-type]
    if dtype.kind == "f":
        for wild in (np.nan, np.inf, -np.inf):
            broken = good.copy()
            broken.flat[-1] = wild
            if dims.finite:
                assert "NaN or infinity" in refused(message, name, broken)
            else:
                dataclasses.replace(message, **{name: broken})


@pytest.mark.parametrize(("kind", "name", "_"), fields_with(float))
@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1, "1", None, True])
def test_non_finite_or_non_float_numbers_are_refused(kind: type[Message], name: str, _: Any, value: object) -> None:
    refused(example(kind), name, value)


@pytest.mark.parametrize(("kind", "name", "_"), fields_with(int))
@pytest.mark.parametrize("value", [1.0, True, "1", None, 1 << 63, -(1 << 63), np.int64(1)])
def test_integers_must_fit_64_bits(kind: type[Message], name: str, _: Any, value: object) -> None:
    refused(example(kind), name, value)


@pytest.mark.parametrize(("kind", "name", "_"), fields_with(bool))
@pytest.mark.parametrize("value", [0, 1, None, "true", np.True_])
def test_non_boolean_values_are_refused(kind: type[Message], name: str, _: Any, value: object) -> None:
    refused(example(kind), name, value)


@pytest.mark.parametrize(("kind", "name", "_"), fields_with(str))
@pytest.mark.parametrize("value", [0, None, b"text"])
def test_non_text_values_are_refused(kind: type[Message], name: str, _: Any, value: object) -> None:
    refused(example(kind), name, value)


@pytest.mark.parametrize(("kind", "name", "_"), fields_with(tuple))
@pytest.mark.parametrize("value", [["text"], (1,), ("x", 1), "text"])
def test_lists_must_be_tuples_of_texts(kind: type[Message], name: str, _: Any, value: object) -> None:
    refused(example(kind), name, value)


def test_values_outside_choices_are_refused() -> None:
    refused(example(m.ModeCommand), "mode", "run")
    refused(example(m.ModeCommand), "mode", None)
    refused(example(m.PlannerStatus), "state", "")
    refused(example(m.ActuatorState), "mode", "walk")  # a text is not yet a Mode


def test_too_long_array_is_refused() -> None:
    huge = np.broadcast_to(np.zeros((1, 1), np.uint16), (m.MAX_LENGTH + 1, 1))  # takes no memory
    assert "expected" in refused(example(m.DepthImage), "depth", huge)


def test_empty_image_and_empty_scan_are_valid() -> None:
    m.ColorImage(stamp_ns=0, rgb=np.zeros((0, 0, 3), np.uint8))
    dataclasses.replace(
        example(m.Scan),
        points_mm=np.zeros((0, 3), np.int16),  # type: ignore[call-arg]
        pixel_count=np.zeros(0, np.uint8),
        height_range_mm=np.zeros(0, np.uint8),
        color=np.zeros((0, 3), np.uint8),
    )


def test_optional_color_is_given_for_all_points_or_none() -> None:
    scan = example(m.Scan)
    dataclasses.replace(scan, color=np.zeros((0, 3), np.uint8))  # type: ignore[call-arg]
    for bad in (np.zeros((1, 3), np.uint8), np.zeros((0, 4), np.uint8), np.zeros(0, np.uint8)):
        with pytest.raises(ValueError, match="color"):
            dataclasses.replace(scan, color=bad)  # type: ignore[call-arg]


_MOST = [(m.TerrainMap, "hazard", 3), (m.TerrainMap, "confidence", 100), (m.Scan, "color", 63)]


@pytest.mark.parametrize(("kind", "name", "most"), _MOST)
def test_undefined_codes_are_refused(kind: type[Message], name: str, most: int) -> None:
    message = example(kind)
    values = getattr(message, name).copy()
    values.flat[-1] = most
    dataclasses.replace(message, **{name: values})  # type: ignore[arg-type]
    values.flat[-1] = most + 1
    assert f"at most {most} expected, found {most + 1}" in refused(message, name, values)


def test_goal_needs_limited_number_of_waypoints() -> None:
    goal = example(m.Goal)
    for n in (0, m.MAX_WAYPOINTS + 1):
        assert f"found {n}" in refused(goal, "waypoints", np.zeros((n, 2)))
    dataclasses.replace(goal, waypoints=np.zeros((m.MAX_WAYPOINTS, 2)))  # type: ignore[call-arg]


def test_too_long_text_is_truncated_on_construction() -> None:
    """Truncate texts of others, so that they end no service."""
    status = m.PlannerStatus(0, "waiting", "x" * (m.MAX_TEXT + 1), 0, 0, -1)
    assert status.reason == "x" * (m.MAX_TEXT - 3) + "..."
    assert dataclasses.replace(status, reason="half a pair \ud800").reason == "half a pair ?"
    long = ("y" * (m.MAX_TEXT + 1), *("z",) * m.MAX_ITEMS)
    state = dataclasses.replace(example(m.ActuatorState), warnings=long)  # type: ignore[call-arg]
    assert len(state.warnings) == m.MAX_ITEMS
    assert max(map(len, state.warnings)) == m.MAX_TEXT
