"""Families of scenarios."""

import itertools
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sextant.services.simulator.physics.terrain import build_terrain
from sextant.shared.files.config import ConfigError
from sextant.shared.scenario.family import check_values
from sextant.shared.scenario.loading import absolute, family_names, load_family, load_scenario, point_names, scenario_names

ROOT = Path(__file__).parents[4]
OWN = """about = "a step"
parameter = "height"
values = [0.02, 0.05]
[[depends]]
key = "terrain.1.top"
offset = 0.01
[scenario.goal]
distance = 1.0
[[scenario.terrain]]
kind = "plane"
[[scenario.terrain]]
kind = "box"
xy = [2.0, 0.0]
size = [1.0, 1.0]
top = 0.1
"""


@pytest.mark.parametrize("name", family_names())
def test_family_has_ground_at_every_value_for_every_seed(name):
    found = load_family(name)
    names = set()
    for value in found.family.values:
        scenario = found.at(value)
        names.add(scenario.name)
        for seed in range(1000, 1003):
            build_terrain(scenario, np.random.default_rng([seed, 0]))
    assert len(names) == len(found.family.values)


@pytest.mark.parametrize("name", sorted(set(family_names()) - {"speed", "mismatch"}))
def test_ground_changes_with_the_parameter_and_leaves_the_start_level(name):
    found = load_family(name)
    grounds = [build_terrain(found.at(value), np.random.default_rng([1000, 0])) for value in found.family.values]
    around = np.stack(np.meshgrid(np.linspace(-0.25, 0.25, 11), np.linspace(-0.25, 0.25, 11)), -1).reshape(-1, 2)
    heights = [ground.raster(0.5, -0.5, 150, 50, 0.02) for ground in grounds]
    assert all(not np.array_equal(a, b) for a, b in itertools.pairwise(heights))
    assert all(np.ptp(ground.height_at(around)) == 0.0 for ground in grounds)


def test_families_are_listed_in_the_documentation():
    text = (ROOT / "docs/trials.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE) == family_names()


def test_values_of_the_parameter_are_put_into_the_scenario(tmp_path):
    path = tmp_path / "step.toml"
    path.write_text(OWN)
    found = load_family(str(path))
    scenario = found.at(0.05)
    assert (scenario.name, scenario.terrain[1].top, scenario.folder) == ("step@0.05", pytest.approx(0.06), str(tmp_path))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("terrain.1.top", "terrain.2.top", "terrain.2.top: the place of a value in the scenario expected, found none"),
        ("terrain.1.top", "terrain.1.tip", "terrain.1.tip: the place of a value in the scenario expected, found none"),
        ("values = [0.02, 0.05]", "values = [0.02, 0.05, 0.03]", "rising or falling values expected"),
        ("values = [0.02, 0.05]", "values = [0.02]", "2 to 100 rising or falling values expected"),
        ("about", "obout", "obout: unknown key"),
        ("size = [1.0, 1.0]", "size = [1.0]", "family step at 0.02"),
    ],
)
def test_invalid_family_is_refused(tmp_path, old, new, words):
    path = tmp_path / "step.toml"
    path.write_text(OWN.replace(old, new))
    with pytest.raises(ConfigError, match=re.escape(words)):
        load_family(str(path))


def test_family_at_a_value_is_a_scenario(tmp_path):
    path = tmp_path / "step@home.toml"
    path.write_text(OWN)
    assert load_scenario("riser@0.05").terrain == load_family("riser").at(0.05).terrain
    assert load_scenario("riser@0.05").name == "riser@0.05"
    assert load_scenario("cross_slope@10+x0.9").name == "cross_slope@10+x0.9"
    assert load_scenario(f"{path}@0.07").terrain[1].top == pytest.approx(0.08)


@pytest.mark.parametrize("value", [10.0, 1 / 3, 0.0512345678, 1.2e-7, 86399.125])
def test_name_of_a_point_stands_for_the_same_scenario(value):
    found = load_family("speed").at(value)
    assert found.time_limit_s == value
    assert load_scenario(found.name) == found


def test_zero_has_one_name():
    assert load_scenario("cross_slope@-0").name == load_scenario("cross_slope@0.0").name == "cross_slope@0"


@pytest.mark.parametrize("name", family_names())
def test_listed_points_of_a_family_are_its_scenarios(name):
    assert [load_scenario(point).name for point in point_names(name)] == point_names(name)


@pytest.mark.parametrize("added", ["", "@0.07", "@0.07+sun", "+x0.9"])
def test_file_is_found_from_elsewhere_by_its_absolute_path(tmp_path, monkeypatch, added):
    folder = tmp_path / "a+b@c.toml.d"
    folder.mkdir()
    scenario = 'name = "f"\n' + OWN.partition("offset = 0.01\n")[2].replace("scenario.", "")
    (folder / "f+g@h.toml").write_text(OWN if "@" in added else scenario)
    monkeypatch.chdir(folder)
    here = load_scenario(f"f+g@h.toml{added}")
    path = absolute(f"f+g@h.toml{added}")
    monkeypatch.chdir(tmp_path)
    assert path == f"{folder.resolve()}{os.sep}f+g@h.toml{added}"
    assert load_scenario(path) == here


def test_name_without_a_file_has_no_absolute_path():
    for name in (*scenario_names(), "riser@0.05", "steps+sun"):
        assert absolute(name) == name


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("riser@", "a value of the family's parameter after the @ expected, such as riser@0.05, found ''"),
        ("riser@nan", "such as riser@0.05, found 'nan'"),
        ("risr@0.05", "no family of scenarios 'risr'; did you mean 'riser'"),
        ("riser@-5000", "family riser at -5000"),
        ("riser", "a point of it expected, such as riser@0.03; `sextant trials riser --curve` walks all of them"),
        ("riser+sun", "'riser' is a family of scenarios; a point of it expected, such as riser@0.03"),
        ("risr", "no scenario 'risr'; did you mean 'riser'?; or give a point of a family, such as riser@0.05"),
    ],
)
def test_value_or_family_that_does_not_exist_is_refused(name, words):
    with pytest.raises(ConfigError, match=re.escape(words)):
        load_scenario(name)


def test_file_of_a_family_in_place_of_a_scenario_is_named_as_such(tmp_path):
    own = tmp_path / "own.toml"
    own.write_text(OWN, encoding="utf-8")
    words = (
        f"'{own}' is a family of scenarios; a point of it expected, such as {own}@0.02; `sextant trials {own} --curve` walks"
    )
    with pytest.raises(ConfigError, match=re.escape(words)):
        load_scenario(str(own))
    own.write_text(OWN.replace("values = [0.02, 0.05]", "values = 3"), encoding="utf-8")
    with pytest.raises(ConfigError, match="values: a list expected, found 3"):
        load_scenario(str(own))


def test_unknown_family_is_refused_with_the_nearest_name():
    with pytest.raises(ConfigError, match="no family of scenarios 'risr'; did you mean 'riser'"):
        load_family("risr")


def test_falling_values_are_accepted():
    check_values((0.12, 0.10, 0.03))
    family = load_family("riser").family
    assert replace(family, values=(0.1, 0.05)).values == (0.1, 0.05)
