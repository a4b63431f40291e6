"""The check of a profile against the simulated robot: torques of standing and walking."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sextant.deploy import cli
from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.evaluation.robot_check.foot_lag import foot_lag
from sextant.evaluation.robot_check.gait_cycle import standing_torques, walk_cycle
from sextant.evaluation.robot_check.ground_limits import find_ground_limits
from sextant.evaluation.whole_maps.terrain_map import RESOLUTION_M
from sextant.services.actuator.locomotion.joint_goals import JointGoals
from sextant.services.actuator.locomotion.step_executor import Targets
from sextant.shared.robot.kinematics import body_forward, body_inverse, nearest_reachable
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Mode
from tests.support.walks import Heard, S, flat, walk


def test_standing_torques_are_those_of_the_simulated_robot() -> None:
    """Agree within 3.5 % of the stall torque.

    Statics do not determine by how much six feet push against each other, and friction keeps what standing up has left.
    """
    profile = load_profile("phantomx_mk2")
    heard = Heard((topics.TRUTH, topics.ACTUATOR_STATE))
    LockstepRun(flat(1.0), 1000, profile, heard.tap, every_frame=False).run(round(2.4 * S))
    assert heard.of(topics.ACTUATOR_STATE)[-1].mode is Mode.STAND
    measured = np.mean([truth.torque for truth in heard.of(topics.TRUTH, 2.2)], axis=0)
    feet = profile.rest_feet()
    computed = standing_torques(profile, body_inverse(profile, feet), feet, np.ones(6))
    np.testing.assert_allclose(measured, computed, atol=0.035 * profile.servo.stall_torque)


@pytest.mark.parametrize(("robot", "distance"), [("phantomx_mk2", 1.5), ("lotriet_rx64", 1.0)])
def test_rms_torque_of_the_worst_joint_is_that_of_the_simulated_walk(robot: str, distance: float) -> None:
    walked = walk(replace(flat(distance), robot=robot), 1000)
    computed = walk_cycle(load_profile(robot), "tripod").rms_torque.max()
    assert computed == pytest.approx(walked.report.torque_nm.rms_worst_joint, rel=0.1)


@pytest.mark.parametrize("robot", ["printed_sts3215", "printed_ds3218"])
def test_feet_of_the_simulated_robot_lag_as_computed(robot: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exact paths need more than the stall torque at the lowest body height; the feet are late, and land on their places."""
    profile = load_profile(robot)
    low = profile.stance.body_height_range[0]
    paths: list[tuple[int, np.ndarray, np.ndarray]] = []  # time [ns], feet [m] {body}, share of the load

    def follow(goals: JointGoals, targets: Targets, *others: Any) -> Any:
        paths.append((run.now_ns(), nearest_reachable(profile, targets.feet), targets.share.copy()))
        return usual(goals, targets, *others)

    usual = JointGoals.follow
    monkeypatch.setattr(JointGoals, "follow", follow)
    heard, scenario = Heard((topics.TRUTH,)), flat(0.6)
    scenario = replace(scenario, robot=robot, walk=replace(scenario.walk, body_height=low))
    run = LockstepRun(scenario, 1000, profile, heard.tap, every_frame=False)
    while not run.attendance.over():
        run.run(run.now_ns() + S // 2)
    assert run.attendance.judge(1.0, in_a_hurry=True).success

    begun_ns = 7 * S  # the body is at its height
    truths = heard.of(topics.TRUTH)
    times, feet, shares = (np.array(part) for part in zip(*(path for path in paths if path[0] >= begun_ns), strict=True))
    at = np.searchsorted([truth.stamp_ns for truth in truths], times).clip(max=len(truths) - 1)
    lag = np.linalg.norm([body_forward(profile, truths[k].q) for k in at.tolist()] - feet, axis=-1)
    touchdown = lag[1:][(shares[1:] > 0.0) & (shares[:-1] == 0.0)]
    computed = foot_lag(profile, walk_cycle(profile, "tripod", low))
    assert np.percentile(lag[shares == 0.0], 99) == pytest.approx(computed.in_air, abs=0.006)
    assert np.median(touchdown) == pytest.approx(computed.on_ground, abs=0.003)
    assert touchdown.max() < RESOLUTION_M


STEP = """
name = "one step"
time_limit_s = 60.0
[goal]
distance = 1.6
[[terrain]]
kind = "plane"
[[terrain]]
kind = "box"
xy = [2.3, 0.0]
size = [2.6, 2.4]
top = {height}
"""


def test_highest_step_of_the_check_is_climbed_and_a_higher_one_is_not(tmp_path: Path) -> None:
    riser = find_ground_limits(load_profile("phantomx_mk2")).riser
    assert riser.refused is not None
    for height, status in ((riser.passed, 0), (riser.refused, 1)):
        course = tmp_path / "step.toml"
        course.write_text(STEP.format(height=height), encoding="utf-8")
        words = ["run", str(course), "--lockstep", "--seed", "1000", "--set", "planner.costmap.max_step_m=0.13"]
        assert cli.main([*words, "--out", str(tmp_path / f"{height:.2f}")]) == status
