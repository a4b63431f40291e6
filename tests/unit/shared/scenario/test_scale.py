"""Scaled courses: the same ground for a robot of another size, and wrong scales are refused."""

import dataclasses
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest

from docs.reference.schema_tables import tables_of
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.shared.field_comments import comments_of, parse
from sextant.shared.files import config
from sextant.shared.robot.profile import LegLinks
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario, scenario_names
from sextant.shared.scenario.mismatch import Mismatch
from sextant.shared.scenario.scale import leg_scale, unscaled_name
from sextant.shared.scenario.scenario import Scenario
from sextant.shared.scenario.terrain import HeightMap

SCALES = (0.5, 0.85, 1.11)


@pytest.mark.slow
@pytest.mark.parametrize("name", scenario_names())
def test_scaled_ground_is_the_same_ground(name: str) -> None:
    course, scale = load_scenario(name), 0.85
    small = course.scaled(scale)
    xy = np.random.default_rng(0).uniform((-1.0, -1.5), (4.0, 1.5), (2000, 2))
    ground, scaled = (build_terrain(one, np.random.default_rng([1000, 0])) for one in (course, small))
    np.testing.assert_allclose(scaled.height_at(scale * xy), scale * ground.height_at(xy), rtol=0, atol=1e-6)
    np.testing.assert_allclose(scaled.sink_at(scale * xy), scale * ground.sink_at(xy), rtol=0, atol=1e-6)
    assert small.goal.distance / small.walk.speed == pytest.approx(course.goal.distance / course.walk.speed)
    assert small.time_limit_s == course.time_limit_s
    assert small.name == f"{name}+x{scale}"


@pytest.mark.parametrize("name", scenario_names())
def test_scale_of_one_is_the_course_itself(name: str) -> None:
    course = load_scenario(name)
    assert course.scaled(1.0) == load_scenario(f"{name}+x1") == course


def test_scaled_course_of_a_scaled_robot_is_the_same_course() -> None:
    """Each course is as many leg lengths long for robots of all sizes."""
    profile, course = load_profile("phantomx_mk2"), load_scenario("mixed")
    assert leg_scale(profile) == 1.0
    for scale in SCALES:
        links = LegLinks(*(scale * length for length in dataclasses.astuple(profile.links)))
        robot = replace(profile, links=links)
        assert leg_scale(robot) == pytest.approx(scale)
        back = course.scaled(leg_scale(robot)).scaled(1.0 / scale)
        assert flat(config.as_table(replace(back, name=course.name))) == pytest.approx(flat(config.as_table(course)))


def flat(value: Any, place: str = "") -> dict[str, Any]:
    """Return the values of a table by their places."""
    if not isinstance(value, dict | list):
        return {place: value}
    items = value.items() if isinstance(value, dict) else enumerate(value)
    return {key: inner for name, item in items for key, inner in flat(item, f"{place}.{name}").items()}


def schemas(kind: type[Any]) -> Iterator[type[Any]]:
    """Yield a dataclass and those of its fields, but for the deviations of the robot."""
    yield kind
    for hint in get_type_hints(kind).values():
        for inner in tables_of(hint)[0]:
            yield from schemas(inner) if inner is not Mismatch else ()


@pytest.mark.parametrize("kind", sorted(set(schemas(Scenario)), key=lambda kind: kind.__name__))
def test_every_length_and_speed_is_scaled(kind: type[Any]) -> None:
    said = comments_of(kind)
    units = {field.name: parse(said.get(field.name, "")).unit for field in dataclasses.fields(kind)}
    expected = {name for name, unit in units.items() if unit in ("m", "m/s")} | ({"scale"} if kind is HeightMap else set())
    assert set(getattr(kind, "lengths", "").split()) == expected


def test_scale_and_trouble_are_composed_in_the_order_of_their_names() -> None:
    before, after = load_scenario("steps+legs+x0.5"), load_scenario("steps+x0.5+legs")
    assert before.terrain == after.terrain
    assert [mover.speed for mover in before.movers] == [0.5 * mover.speed for mover in after.movers]
    assert unscaled_name(before.name) == unscaled_name(after.name) == "steps+legs"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("steps+x0", "a scale from x0.1 to x10 expected, found 'x0'"),
        ("steps+x11", "a scale from x0.1 to x10 expected, found 'x11'"),
        ("steps+0.5", r"no trouble '0.5'; known: .*; or a scale such as x0.85"),
        ("steps+x-1", "no trouble 'x-1'"),
        ("steps+x1e3", "no trouble 'x1e3'"),
        ("stpes+x0.5", "no scenario 'stpes'; did you mean 'steps'"),
        ("steps+x0.5+x0.1", "scenario steps\\+x0.5\\+x0.1: map.*: a resolution of 0.001 to 1 m expected"),
    ],
)
def test_wrong_scale_is_refused_with_what_to_write(name: str, words: str) -> None:
    with pytest.raises(config.ConfigError, match=words):
        load_scenario(name)


def test_measured_ground_is_scaled_where_the_scenario_states_its_size(tmp_path: Path) -> None:
    np.save(tmp_path / "map.npy", np.add.outer(np.arange(60.0), np.arange(40.0)) * 1e-3)
    text = 'name = "mine"\n[goal]\ndistance = 1\n[[terrain]]\nkind = "height_map"\n'
    path = tmp_path / "mine.toml"
    path.write_text(f'{text}file = "map.npy"\nresolution = 0.02\nxy = [0, 0]\n')
    ground, scaled = (build_terrain(load_scenario(f"{path}{suffix}"), np.random.default_rng(0)) for suffix in ("", "+x0.5"))
    xy = np.array([[0.1, 0.2], [0.6, 0.5]])
    np.testing.assert_allclose(scaled.height_at(0.5 * xy), 0.5 * ground.height_at(xy))
    path.write_text(f'{text}file = "map.mcap"\n')
    with pytest.raises(config.ConfigError, match=r"resolution and xy of the map in map\.mcap expected, found none"):
        load_scenario(f"{path}+x0.5")
