"""Robots with two buses and several servo models walk, and stop when one bus is pulled out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profile_text import write_new_profile
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Mode
from tests.support.families import command_robot, two_bus_robot
from tests.support.walks import course, walk

COURSE = """
name = "short"
robot = "{robot}"
time_limit_s = 60.0
terrain = [{{ kind = "plane" }}]
goal = {{ distance = 1.0 }}
"""
AT_S, FOR_S = 8.0, 3.0
PULLED = f"""
[[bus_faults]]
target = "bus"
kind = "gone"
at_s = {AT_S}
for_s = {FOR_S}
servo = {{servo}}
"""


@pytest.mark.parametrize(
    "profile",
    [pytest.param(two_bus_robot(), id="registers"), pytest.param(command_robot(), id="commands", marks=pytest.mark.rare)],
)
def test_robot_with_several_models_on_two_buses_walks_over_steps(profile: RobotProfile, tmp_path: Path) -> None:
    path = tmp_path / "two_buses.toml"
    write_new_profile(path, profile)
    found = walk(replace(load_scenario("steps"), robot=str(path)), 1000)
    assert found.report.success, found.report.reason
    assert found.report.falls == found.report.shutdowns == 0


@pytest.mark.parametrize("profile", [two_bus_robot(), command_robot()], ids=["registers", "commands"])
def test_robot_stops_when_one_of_its_buses_is_pulled_out_and_walks_on(profile: RobotProfile, tmp_path: Path) -> None:
    robot = tmp_path / "two_buses.toml"
    write_new_profile(robot, profile)
    right = int(profile.servo_ids[1, 0])
    found = walk(course(tmp_path, COURSE.format(robot=robot) + PULLED.format(servo=right)), 1000)
    before, gone = found.states(AT_S - 1.0, AT_S)[-1], found.states(AT_S + 0.3, AT_S + FOR_S)
    assert before.mode is Mode.WALK
    assert {state.mode for state in gone} == {Mode.FAULT}
    assert all("bus right: " in state.reason and "the servo port is gone" in state.reason for state in gone), gone[0].reason
    still = np.array([truth.T_world_body[:3, 3] for truth in found.heard.of(topics.TRUTH, AT_S + 0.5, AT_S + FOR_S)])
    assert np.ptp(still, axis=0).max() < 0.003, "the servos of both buses hold their goals"
    assert found.report.success, "it walks on once the bus is back"
    assert found.report.falls == 0
