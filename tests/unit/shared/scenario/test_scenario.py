"""Scenarios: the supplied ones are valid, and user files are read or rejected.

A rejection states its reason.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sextant.shared.files import config
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.course import Course, Level
from sextant.shared.scenario.loading import load_scenario, load_trouble, scenario_names, trouble_names
from sextant.shared.scenario.scenario import Fault, Goal, Scenario
from sextant.shared.scenario.terrain import Box, Hole, Plane, Rubble, Stairs

STAIRS = {"kind": "stairs", "xy": [0.0, 0.0], "riser": 0.04, "tread": 0.3, "count": 3, "width": 1.0}
PILLARS = {"kind": "pillars", "xy": [[1.0, 0.0]], "size": 0.1, "top": 0.0}
RUBBLE = {"kind": "rubble", "x": [0, 1], "y": [0, 1], "count": 3, "size": [0.1, 0.2], "top": [0.0, 0.1]}
PATCHES = {"kind": "patches", "x": [0, 1], "y": [0, 1], "count": 2, "size": [0.1, 0.2], "frictions": [0.2]}
FIELD = {"kind": "pillar_field", "x": [1.0, 2.0], "y": [-0.5, 0.5], "density": [0.2, 0.3], "size": 0.1, "top": 0.0}
COURSE = {"kind": "course", "width": 1.0}
STONES = {"kind": "stones", "length": 1.0, "size": 0.12, "gap": 0.05}
LEGS = {"kind": "legs", "path": [[1.0, -1.0], [1.0, 1.0]]}
CART = {"kind": "box", "path": [[1.0, -1.0], [1.0, 1.0]], "speed": 0.5, "size": [0.4, 0.3, 0.2]}
MINIMAL = {"name": "mine", "terrain": [{"kind": "plane"}], "goal": {"distance": 1.0}}


@pytest.mark.parametrize("name", scenario_names())
def test_packaged_scenarios_are_valid(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.name == name
    profile = load_profile(scenario.robot)
    low, high = profile.stance.body_height_range
    assert low <= scenario.walk.body_height <= high
    assert scenario.walk.speed <= profile.stance.max_speed
    assert scenario.goal.distance / scenario.walk.speed < scenario.time_limit_s
    assert Path(scenario.folder).is_absolute()


def test_flat_and_steps_are_packaged() -> None:
    assert {"flat", "steps"} <= set(scenario_names())


def test_every_course_begins_on_flat_ground() -> None:
    """Keep the first 0.8 m flat, but where the start is the difficulty: the camera sees nothing nearer than half a metre."""
    for name in scenario_names():
        if name.startswith("start_"):
            continue
        for piece in load_scenario(name).terrain:
            if isinstance(piece, Rubble):
                assert piece.x[0] >= 0.8 or piece.y[0] >= 0.8
            if isinstance(piece, Stairs):
                assert piece.xy[0] >= 0.8
            if isinstance(piece, Box | Hole):  # or it stands at the side
                extents = zip(piece.size, piece.size_spread, piece.xy_spread, strict=True)
                length, width = ((size + more) / 2 + aside for size, more, aside in extents)
                assert piece.xy[0] - length >= 0.8 or abs(piece.xy[1]) - width >= 0.45
            if isinstance(piece, Course):
                first = piece.stretches[0]
                assert isinstance(first, Level)
                assert piece.x + first.length >= 0.8 - 1e-9


def test_steps_has_a_dozen_low_blocks_and_two_stairs() -> None:
    terrain = load_scenario("steps").terrain
    assert sum(piece.count for piece in terrain if isinstance(piece, Rubble)) >= 12
    (stairs,) = (piece for piece in terrain if isinstance(piece, Stairs))
    assert stairs.count >= 2
    assert stairs.riser == pytest.approx(0.03)
    assert all(0.01 <= top <= 0.04 for piece in terrain if isinstance(piece, Rubble) for top in piece.top)


def test_minimal_scenario_is_valid() -> None:
    scenario = config.build(MINIMAL, Scenario)
    assert scenario.terrain == (Plane(),)
    assert scenario.goal == Goal(1.0)
    assert not scenario.walk.blind
    assert scenario.faults == ()


def test_files_are_relative_to_scenario(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(
        'name = "mine"\n[goal]\ndistance = 1\n'
        '[[terrain]]\nkind = "height_map"\nfile = "a.npy"\nresolution = 0.01\nxy = [0, 0]\n'
    )
    scenario = load_scenario(str(path))
    assert scenario.folder == str(tmp_path.resolve())


def test_unknown_name_lists_known_ones() -> None:
    with pytest.raises(config.ConfigError, match=r"no scenario 'stpes'; did you mean 'steps'"):
        load_scenario("stpes")
    with pytest.raises(config.ConfigError, match="no such file"):
        load_scenario("/nowhere/mine.toml")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"terrain": []}, "at least one terrain primitive expected"),
        ({"terrain": [{"kind": "plain"}]}, r"terrain\[0\].kind: found 'plain'; did you mean 'plane'\?"),
        ({"terrain": [{"kind": ["plane"]}]}, r"terrain\[0\].kind: found \['plane'\]"),
        ({"terrain": [{"kind": "plane", "height": 10**400}]}, r"terrain\[0\].height: a number that fits"),
        ({"goal": {"distance": -1}}, "goal: distance and corridor greater than 0 m"),
        ({"goal": {"distnace": 1}}, "goal.distnace: unknown key; did you mean 'distance'"),
        ({"walk": {"speed": 0}}, "walk: a speed greater than 0"),
        ({"walk": {"gait": "trot"}}, "walk.gait: one of 'tripod'"),
        ({"variation": {"friction": 0.5}}, "variation: factors of at least 1"),
        ({"faults": [{"at_s": -1, "service": "planner"}]}, r"faults\[0\]: a time of at least 0 s"),
        ({"faults": [{"at_s": 1, "service": "simulator"}]}, r"faults\[0\].service: one of"),
        ({"faults": [{"at_s": 1, "service": "camera"}]}, r"faults\[0\]: one of absent, frozen, stale, blind, noise, sun"),
        ({"faults": [{"at_s": 1, "service": "planner", "kind": "blind"}]}, r"faults\[0\]: one of kill, hang"),
        ({"name": "a/../b"}, "a name of letters"),
        ({"name": ""}, "a name of letters"),
        ({"terrain": [STAIRS | {"count": 0}]}, r"terrain\[0\]\.count: a count from 1 to 1000"),
        ({"terrain": [STAIRS | {"riser_spread": 0.05}]}, r"terrain\[0\]: a riser_spread from 0 to less than the riser"),
        ({"terrain": [STAIRS | {"tread_spread": -0.1}]}, r"terrain\[0\]: a tread_spread from 0"),
        ({"terrain": [PILLARS | {"jitter": -0.01}]}, r"terrain\[0\]: a jitter and a top_spread of at least 0 m"),
        ({"terrain": [PILLARS | {"weak": 2}]}, r"terrain\[0\]: 0 to 1 weak pillars, the number of pillars"),
        ({"terrain": [PILLARS | {"weak": 1, "sinks": 0.5}]}, r"terrain\[0\]: bears of at least 0 N and sinks between 0 m"),
        (
            {"terrain": [PILLARS | {"tipping": 2}]},
            r"terrain\[0\]: 0 to 1 tipping pillars",
        ),
        ({"terrain": [PILLARS | {"tipping": 1, "bears_within": 0.5}]}, r"terrain\[0\]: bears_within between 0 m and half"),
        ({"terrain": [PILLARS | {"tip_deg": 0}]}, r"terrain\[0\].tip_deg: more than 0 and at most 90 deg"),
        ({"terrain": [PATCHES | {"frictions": []}]}, r"terrain\[0\]: at least one friction"),
        ({"terrain": [PATCHES | {"frictions": [0.0]}]}, r"terrain\[0\].frictions"),
        ({"terrain": [PATCHES | {"size": [0.3, 0.2]}]}, r"terrain\[0\]: size in rising order"),
        ({"terrain": [FIELD | {"density": [0.3, 0.2]}]}, r"terrain\[0\]: densities in rising order"),
        ({"start": {"yaw_spread_deg": -1.0}}, "start: spreads of at least 0"),
        ({"terrain": [COURSE | {"stretches": []}]}, r"terrain\[0\]: at least one stretch expected"),
        ({"terrain": [COURSE | {"stretches": [{"kind": "level"}]}]}, r"terrain\[0\].stretches\[0\].length: missing"),
        ({"terrain": [COURSE | {"stretches": [STONES | {"jitter": 0.03}]}]}, "a jitter of at most half the gap"),
        ({"terrain": [COURSE | {"stretches": [STONES | {"length": 0.1}]}]}, "a length of at least 0.22 m, for one row"),
        (
            {"terrain": [COURSE | {"stretches": [{"kind": "gap", "length": 0.1, "spread": 0.1}]}]},
            "a spread from 0 to less than",
        ),
        ({"movers": [{"kind": "cart"}]}, r"movers\[0\].kind: found 'cart'; known kinds: box, legs"),
        ({"movers": [LEGS | {"speed": 0}]}, r"movers\[0\].speed: more than 0 and at most 5 m/s expected, found 0"),
        ({"movers": [LEGS | {"path": [[1, 0]]}]}, r"movers\[0\].path: 2 to 64 corners expected"),
        ({"movers": [LEGS | {"path": [[1, 0], [1, 0]]}]}, r"movers\[0\].path: corners of which no two neighbours coincide"),
        ({"movers": [LEGS | {"path": [[1, 0], [1e9, 0]]}]}, r"movers\[0\].path: corners within 50 m"),
        ({"movers": [LEGS | {"strides": 1}]}, r"movers\[0\].strides: unknown key; did you mean 'stride'"),
        ({"movers": [LEGS | {"height": 0.1}]}, r"movers\[0\].height: a height of more than two radii and the lift"),
        ({"movers": [LEGS | {"start_s": -1}]}, r"movers\[0\].start_s: 0 to 86400 s expected"),
        ({"movers": [CART | {"size": [1, 0, 1]}]}, r"movers\[0\].size\[1\]: more than 0 and at most 3 m"),
        ({"camera": {"loss": 1.5}}, "camera: a loss from 0 to 1 expected"),
        ({"faults": [{"at_s": 1, "service": "planner", "at_spread_s": -1}]}, r"faults\[0\]: an at_spread_s of at least 0"),
        ({"time_limit_s": 0}, "a time limit greater than 0 s"),
        ({"time_limit_s": 1e12}, "time_limit_s: at most 86400 s either way expected"),
        ({"map": {"cells": 10**12}}, r"map\.cells: at most 2048 cells either way expected"),
        ({"map": {"cells": 1024}}, "map: at most 441397 cells in all, which a message of mapper/terrain has room for"),
        ({"name": "a" * 101}, "a name of at most 100 characters expected"),
        ({"terrain": [RUBBLE | {"count": 10**12}]}, r"terrain\[0\]\.count: a count from 1 to 500 expected"),
        ({"terrain": [RUBBLE | {"x": [0, 1e300]}]}, r"terrain\[0\]\.x\[1\]: at most 1000 m either way expected"),
        ({"terrain": [PILLARS | {"xy": [[0, 1e300]]}]}, r"terrain\[0\]\.xy: places within 1000 m expected"),
        ({"goal": {"distance": 1e12}}, r"goal\.distance: at most 1000 m either way expected"),
        ({"battery_ah": 0}, "a battery_ah greater than 0 A h"),
        ({"time_limit_s": float("inf")}, "time_limit_s: a finite number expected"),
    ],
)
def test_invalid_values_are_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(config.ConfigError, match=words):
        config.build(MINIMAL | change, Scenario)


def test_fault_lasts_two_seconds_by_default() -> None:
    assert Fault(1.0, "planner").for_s == 2.0


@pytest.mark.parametrize("name", trouble_names())
def test_trouble_applies_to_any_course(name: str) -> None:
    course, trouble = load_scenario("stairs"), load_trouble(name)
    both = load_scenario(f"stairs+{name}")
    assert both.name == f"stairs+{name}"
    assert (both.terrain, both.goal, both.folder) == (course.terrain, course.goal, course.folder)
    assert (both.faults, both.bus_faults, both.movers) == (trouble.faults, trouble.bus_faults, trouble.movers)
    assert both.camera == (trouble.camera or course.camera)
    assert both.time_limit_s == course.time_limit_s + trouble.extra_time_s
    assert both.mismatch == (trouble.mismatch or course.mismatch)
    changed = both.camera != course.camera or both.mismatch != course.mismatch
    assert both.faults or both.bus_faults or both.movers or changed


def test_unknown_trouble_suggests_nearest_after_course_is_checked() -> None:
    with pytest.raises(config.ConfigError, match=r"no trouble 'snu'; did you mean 'sun'\? known: .*legs.*sun"):
        load_scenario("steps+snu")
    with pytest.raises(config.ConfigError, match="no scenario 'stpes'"):
        load_scenario("stpes+sun")


def test_fault_times_follow_seed_within_spread() -> None:
    scenario = config.build(
        MINIMAL | {"faults": [{"at_s": 3, "service": "planner", "at_spread_s": 4}, {"at_s": 1, "service": "mapper"}]}, Scenario
    )
    drawn = [scenario.faults_at(seed) for seed in range(50)]
    times = [faults[0].at_s for faults in drawn]
    assert 3 <= min(times) < 3.5 < 6.5 < max(times) <= 7
    assert {faults[1].at_s for faults in drawn} == {1.0}
    assert drawn == [scenario.faults_at(seed) for seed in range(50)]


def test_equal_scenarios_have_equal_hashes_with_and_without_params() -> None:
    scenario = load_scenario("steps")
    tuned = replace(scenario, params={"planner": {"costmap": {"max_step_m": 0.05}}})
    assert hash(tuned) == hash(replace(tuned))
    assert tuned != scenario
    assert {scenario: 1, tuned: 2}[replace(scenario)] == 1
