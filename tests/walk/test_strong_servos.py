"""A light and low robot with strong, stiff servos walks over blocks: their dry friction hides no touchdown.

A touchdown that is felt too late lifts the body: it tilts, and feet miss their footholds.
"""

import json
from pathlib import Path

import pytest

from sextant.deploy import cli

# 18 RX-64 by their data sheet on a robot of 2.1 kg: the dry friction of a femur is 0.9 N at a foot 0.1 m away.
ROBOT = """extends = "phantomx_mk2"
name = "strong_and_low"
[servo]
model = "RX-64"
stall_torque = 4.24
no_load_speed = 5.36
stiffness = 25.9
armature = 0.0085
friction = 0.085
temperature_limit = 80.0
[links]
coxa = 0.048
femur = 0.085
tibia = 0.135
[body]
mass = 1.1
leg_link_masses = [0.07, 0.06, 0.035]
[stance]
foot_radius_from_coxa = [0.135, 0.13, 0.14]
body_height = 0.075
body_height_range = [0.06, 0.12]
"""
COURSE = """name = "low_blocks"
time_limit_s = 60.0
[goal]
distance = 1.0
[[terrain]]
kind = "plane"
[[terrain]]
kind = "rubble"
x = [0.6, 1.2]
y = [-0.45, 0.45]
count = 13
size = [0.10, 0.20]
top = [0.01, 0.035]
gap = 0.015
yaw_deg = 20.0
"""


def test_light_robot_with_strong_servos_stays_level_on_blocks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot, course = tmp_path / "robot.toml", tmp_path / "course.toml"
    robot.write_text(ROBOT, encoding="utf-8")
    course.write_text(COURSE, encoding="utf-8")
    words = ["--lockstep", "--seed", "1000", "--robot", str(robot), "--json", "--out", str(tmp_path / "run")]
    assert cli.main(["run", str(course), *words]) == 0, capsys.readouterr()
    report = json.loads(capsys.readouterr().out)
    assert report["success"], report["reason"]
    assert report["missteps"] == 0
    assert report["raised_block_touchdowns"] >= 5
    assert report["tilt_deg"]["max"] < 1.0
    assert report["min_stability_margin_m"] > 0.03
