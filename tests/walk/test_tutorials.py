"""Courses and rule of the tutorials, as their pages have them."""

import json
import re
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from sextant.deploy import cli
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.shared.files import config
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
    sys.modules.pop("my_rules", None)  # of another test
    (course,), (rule,) = blocks("foothold_rule.md", "toml"), blocks("foothold_rule.md", "python")
    Path("small_blocks.toml").write_text(course)
    Path("my_rules.py").write_text(rule)
    words = ["trials", "small_blocks.toml", "--seeds", "1000:1001", "--out", "runs/rule", "--foothold", "my_rules:level"]
    assert cli.main([*words, "--set", "planner.step.path_margin_m=0.03"]) == 0
    (run,) = map(json.loads, Path("runs/rule/trials.jsonl").read_text().splitlines())
    assert run["report"]["success"], run["report"]["reason"]
    assert run["report"]["plugins"]["foothold"] == "my_rules:level"
    assert run["report"]["raised_block_touchdowns"] >= 5, "the course shows nothing of a rule"
