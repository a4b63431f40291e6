"""The planner chooses gait and speed by what it sees, in lockstep: level ground, steps, level ground."""

import json
from pathlib import Path

import pytest

from sextant.deploy import cli

_FLAT_THEN_STEPS = """
name = "flat-then-steps"
time_limit_s = 60.0
[goal]
distance = 2.6
[[terrain]]
kind = "plane"
[[terrain]]
kind = "stairs"
xy = [1.6, 0.0]
riser = 0.03
tread = 0.2
count = 2
width = 2.4
landing = 2.0
"""


def test_choice_changes_where_the_ground_changes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    course = tmp_path / "flat-then-steps.toml"
    course.write_text(_FLAT_THEN_STEPS, encoding="utf-8")
    table = {}
    for name, words in (("auto", ["--gait", "auto", "--speed", "auto"]), ("explicit", [])):
        out = ["--out", str(tmp_path / name), "--json"]
        assert cli.main(["run", str(course), "--lockstep", "--seed", "1000", *words, *out]) == 0
        table[name] = json.loads(capsys.readouterr().out)
    auto, explicit = table["auto"], table["explicit"]
    assert (auto["success"], auto["falls"], auto["shutdowns"], auto["missteps"]) == (True, 0, 0, 0)
    assert auto["speed_mps"] > 1.08 * explicit["speed_mps"]
    assert auto["torque_nm"]["rms_worst_joint"] < 0.5
    assert explicit["gait_choices"] == []

    classes = [choice["reason"].partition(" ground:")[0] for choice in auto["gait_choices"]]
    assert classes[0] == "doubtful", "the ground at the robot's feet is unseen at first"
    assert "".join(classes).count("even") >= 3
    at = classes.index("even")
    assert classes[at : at + 3] == ["even", "uneven", "even"]
    even, uneven, _ = auto["gait_choices"][at : at + 3]
    assert even["speed_mps"] > uneven["speed_mps"]
    assert {choice["gait"] for choice in auto["gait_choices"]} == {"tripod"}
