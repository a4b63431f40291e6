"""Configuration: valid tables are built, and all errors are reported at once."""

import contextlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.shared.files import config
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario, scenario_names
from sextant.shared.scenario.scenario import Scenario


@dataclass(frozen=True, slots=True)
class Round:
    """A member of a union."""

    radius: float
    kind: Literal["round"] = "round"


@dataclass(frozen=True, slots=True)
class Square:
    """The other member of the union."""

    edge: float
    kind: Literal["square"] = "square"


@dataclass(frozen=True, slots=True)
class Inner:
    """A nested table."""

    speed: float = 0.1
    gait: Literal["tripod", "wave"] = "tripod"

    def __post_init__(self) -> None:
        if self.speed < 0:
            raise ValueError(f"a speed of at least 0 expected, found {self.speed}")


@dataclass(frozen=True, slots=True)
class Settings:
    """A table with every kind of field."""

    count: int
    name: str = "x"
    blind: bool = False
    ratio: float = 1.0
    inner: Inner = field(default_factory=Inner)
    pair: tuple[float, float] = (0.0, 1.0)
    items: tuple[int, ...] = ()
    shapes: tuple[Round | Square, ...] = ()
    table: dict[str, float] = field(default_factory=dict)
    maybe: float | None = None


FULL: dict[str, Any] = {
    "count": 3,
    "name": "robot",
    "blind": True,
    "ratio": 2,
    "inner": {"speed": 0.2, "gait": "wave"},
    "pair": [1, 2.5],
    "items": [1, 2, 3],
    "shapes": [{"kind": "round", "radius": 1}, {"kind": "square", "edge": 2}],
    "table": {"a": 1.0},
    "maybe": 4.0,
}


def problems(table: dict[str, Any], schema: type[Any] = Settings) -> tuple[str, ...]:
    with pytest.raises(config.ConfigError) as caught:
        config.build(table, schema)
    return caught.value.problems


def test_dataclass_is_built_from_table() -> None:
    built = config.build(FULL, Settings)
    assert built == Settings(
        3, "robot", True, 2.0, Inner(0.2, "wave"), (1.0, 2.5), (1, 2, 3), (Round(1.0), Square(2.0)), {"a": 1.0}, 4.0
    )
    assert isinstance(built.ratio, float)  # an integer is a valid number
    assert isinstance(built.pair[0], float)


def test_missing_values_take_defaults() -> None:
    assert config.build({"count": 1}, Settings) == Settings(1)


def test_table_of_dataclass_builds_it_again() -> None:
    built = config.build(FULL, Settings)
    assert config.build(config.as_table(built), Settings) == built
    assert "maybe" not in config.as_table(Settings(1))  # TOML has no null


numbers = st.floats(allow_nan=False, allow_infinity=False)


@pytest.mark.slow
@settings(max_examples=50)
@given(
    st.builds(
        Settings,
        count=st.integers(),
        name=st.text(),
        blind=st.booleans(),
        ratio=numbers,
        inner=st.builds(Inner, st.floats(0, 9), st.sampled_from(["tripod", "wave"])),
        pair=st.tuples(numbers, numbers),
        items=st.lists(st.integers()).map(tuple),
        shapes=st.lists(st.builds(Round, st.floats(0, 9)) | st.builds(Square, st.floats(0, 9))).map(tuple),
        table=st.dictionaries(st.text(), st.floats(0, 9)),
        maybe=st.none() | st.floats(0, 9),
    )
)
def test_any_settings_survive_round_trip(made: Settings) -> None:
    assert config.build(config.as_table(made), Settings) == made


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"cuont": 1}, "cuont: unknown key; did you mean 'count'?"),
        ({"inner": {"sped": 1.0}}, "inner.sped: unknown key; did you mean 'speed'?"),
        ({"zzz": 1}, "zzz: unknown key; known keys: blind, count"),
        ({"count": "three"}, "count: a whole number expected, found 'three'"),
        ({"count": 3.5}, "count: a whole number expected, found 3.5"),
        ({"count": True}, "count: a whole number expected, found True"),
        ({"ratio": False}, "ratio: a number expected, found False"),
        ({"ratio": float("nan")}, "ratio: a finite number expected, found nan"),
        ({"ratio": float("inf")}, "ratio: a finite number expected, found inf"),
        ({"ratio": 10**400}, "ratio: a number that fits 64 bits expected, found one of 1329 bits"),
        ({"blind": 1}, "blind: true or false expected, found 1"),
        ({"name": 7}, "name: a text expected, found 7"),
        ({"inner": 7}, "inner: a table expected, found 7"),
        ({"inner": {"gait": "trot"}}, "inner.gait: one of 'tripod', 'wave' expected, found 'trot'"),
        ({"inner": {"speed": -1.0}}, "inner: a speed of at least 0 expected, found -1.0"),
        ({"pair": [1.0]}, "pair: a list of 2 values expected, found 1"),
        ({"pair": 1.0}, "pair: a list expected, found 1.0"),
        ({"items": [1, "b"]}, "items[1]: a whole number expected, found 'b'"),
        ({"shapes": [{"kind": "rond", "radius": 1.0}]}, "shapes[0].kind: found 'rond'; did you mean 'round'?"),
        ({"shapes": [{"radius": 1.0}]}, "shapes[0].kind: found None; known kinds: round, square"),
        ({"shapes": [{"kind": "round"}]}, "shapes[0].radius: missing; a number is needed"),
        ({"shapes": [3]}, "shapes[0].kind: found None"),
        ({"shapes": [{"kind": ["round"]}]}, "shapes[0].kind: found ['round']"),
        ({"shapes": [{"kind": {}}]}, "shapes[0].kind: found {}"),
        ({"table": {"a": "b"}}, "table.a: a number expected, found 'b'"),
        ({"table": []}, "table: "),
    ],
)
def test_each_invalid_value_is_named_with_its_key(change: dict[str, Any], words: str) -> None:
    (problem,) = problems(FULL | change)
    assert problem.startswith(words)


def test_missing_value_is_named() -> None:
    assert problems({}) == ("count: missing; a whole number is needed",)
    wanted = r"(?s)terrain: missing; one table \[\[terrain\]\] or more is needed.*goal: missing; a table \[goal\] is needed"
    with pytest.raises(config.ConfigError, match=wanted):
        config.build({"name": "short"}, Scenario)


def test_all_errors_are_reported_together() -> None:
    found = problems({"total": 1, "name": 7, "inner": {"sped": 1, "gait": 2}, "pair": [0]})
    assert sorted(p.partition(":")[0] for p in found) == ["count", "inner.gait", "inner.sped", "name", "pair", "total"]
    error = config.ConfigError("robot.toml", list(found))
    assert str(error).startswith("robot.toml:\n  - ")
    assert all(p in str(error) for p in found)


def test_misspelt_key_is_not_reported_as_missing() -> None:
    assert problems({"cuont": 1}) == ("cuont: unknown key; did you mean 'count'?",)


def test_unknown_keys_are_reported_in_order() -> None:
    found = problems({"count": 1} | {f"{letter}{letter}{letter}": 1 for letter in "zxwkjyq"})
    assert list(found) == sorted(found)


def test_long_value_is_shortened() -> None:
    (problem,) = problems({"count": "x" * 1000})
    assert len(problem) < 120


plain: st.SearchStrategy[Any] = st.recursive(
    st.booleans()
    | st.integers(-(10**6), 10**6)
    | st.sampled_from([10**400, -(10**400)])
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["round", "square", "tripod", ""]),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["kind", "radius", "edge", "speed", "count", "name", "x"]), inner, max_size=4)
    ),
    max_leaves=8,
)
names = st.sampled_from(["count", "name", "blind", "ratio", "inner", "pair", "items", "shapes", "table", "maybe", "cuont", ""])


@settings(max_examples=70)
@given(st.dictionaries(names, plain, max_size=8))
def test_any_table_is_built_or_refused_with_reason(table: dict[str, Any]) -> None:
    with contextlib.suppress(config.ConfigError):
        assert isinstance(config.build(table, Settings), Settings)


@pytest.mark.slow
@pytest.mark.parametrize("schema", [Scenario, RobotProfile])
@settings(max_examples=50)
@given(st.dictionaries(st.sampled_from(["name", "terrain", "goal", "walk", "links", "legs", "camera", "servo"]), plain))
def test_any_table_for_scenario_and_profile_is_built_or_refused(schema: type[Any], table: dict[str, Any]) -> None:
    with contextlib.suppress(config.ConfigError):
        assert isinstance(config.build(table, schema), schema)


@pytest.mark.parametrize("text", ["count = ", "count = 1\ncount = 2", "\x00", "[inner", "= 3"])
def test_invalid_toml_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "settings.toml"
    path.write_text(text)
    with pytest.raises(config.ConfigError, match=r"no valid TOML: |expected, found") as caught:
        config.load(path, Settings)
    assert str(path) in str(caught.value)


def test_unreadable_paths_and_non_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(config.ConfigError, match="expected, found"):
        config.load(path, Settings)
    with pytest.raises(config.ConfigError, match="no such file"):
        config.load(tmp_path / "none.toml", Settings)
    with pytest.raises(config.ConfigError, match="a file expected, found a folder"):
        config.load(tmp_path, Settings)


def test_toml_file_is_loaded(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text('count = 2\nname = "Ü"\n[inner]\ngait = "wave"\n', encoding="utf-8")
    assert config.load(path, Settings) == Settings(2, "Ü", inner=Inner(gait="wave"))


def test_packaged_profile_and_scenarios_survive_round_trip() -> None:
    profile = load_profile("phantomx_mk2")
    assert config.build(config.as_table(profile), RobotProfile) == profile
    for name in scenario_names():
        scenario = load_scenario(name)
        assert config.build(config.as_table(scenario), Scenario) == scenario
