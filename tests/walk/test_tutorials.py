"""Courses and rule of the tutorials, as their pages have them."""

import json
import re
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from sextant.deploy import cli
from sextant.services.actuator.safety import plan_validation
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.shared.files import config
from sextant.shared.robot import profile
from sextant.shared.scenario.scenario import Scenario

DOCS = Path(__file__).parents[2] / "docs"
COURSES = ("first_hour.md", "your_course.md", "foothold_rule.md")  # pages with courses


def blocks(page: str, language: str) -> list[str]:
    """Return the fenced blocks of a page in a language."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("text", [block for page in COURSES for block in blocks(page, "toml")])
def test_each_course_is_built_with_different_seeds(text: str) -> None:
    scenario = config.build(tomllib.loads(text), Scenario)
    for seed in range(5):
        assert np.isfinite(build_terrain(scenario, np.random.default_rng(seed)).height_at(np.zeros((1, 2)))).all()


@pytest.mark.slow
def test_course_and_rule_of_tutorials_walk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path.copy())
    (course,), (rule,) = blocks("foothold_rule.md", "toml"), blocks("foothold_rule.md", "python")
    Path("small_blocks.toml").write_text(course)
    Path("my_rules.py").write_text(rule)
    words = ["trials", "small_blocks.toml", "--seeds", "1000:1001", "--out", "runs/rule", "--foothold", "my_rules:level"]
    assert cli.main([*words, "--set", "planner.step.path_margin_m=0.03"]) == 0
    (run,) = map(json.loads, Path("runs/rule/trials.jsonl").read_text().splitlines())
    assert run["report"]["success"], run["report"]["reason"]
    assert run["report"]["plugins"]["foothold"] == "my_rules:level"
    assert run["report"]["raised_block_touchdowns"] >= 5, "the course shows nothing of a rule"


@pytest.mark.slow
def test_planner_of_tutorial_walks_over_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path.copy())
    (course,), (planner,) = blocks("foothold_rule.md", "toml"), blocks("step_planner.md", "python")
    Path("small_blocks.toml").write_text(course)
    Path("my_planner.py").write_text(planner)
    words = ["run", "small_blocks.toml", "--lockstep", "--seed", "1000", "--out", "run", "--planner", "my_planner:BestCell"]
    assert cli.main(words) == 0
    report = json.loads(Path("run/report.json").read_text())
    assert report["success"], report["reason"]
    assert report["plugins"] == {"planner": "my_planner:BestCell"}


def test_page_states_limits_of_a_step_and_size_of_planner() -> None:
    text, (planner,) = (DOCS / "step_planner.md").read_text(encoding="utf-8"), blocks("step_planner.md", "python")
    assert f"one of {sum(bool(line.strip()) for line in planner.splitlines())} lines" in text
    limits = dict(re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", text, re.MULTILINE))
    assert limits["duration"] == f"{profile.SHORTEST_STEP_S:g} to {profile.LONGEST_STEP_S:g} s"
    assert limits["travel of the body"] == f"{profile.MAX_TRAVEL_M:.2f} m"
    assert limits["its roll and pitch, and its yaw"] == f"{profile.MAX_TILT_DEG:g} deg, {profile.MAX_TURN_DEG:g} deg"
    assert limits["clearance"] == f"0 to {profile.MAX_CLEARANCE_M:g} m"
    assert limits["centre of mass"].startswith(f"at least {1e3 * profile.MIN_MARGIN_M:g} mm inside")
    assert limits["joints in a swing"].startswith(f"{plan_validation.MEAN_SPEED:g} of")
