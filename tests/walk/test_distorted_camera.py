"""Walks over a bare floor with a camera whose lens distorts: its bow is no shape that holds the pose back."""

from dataclasses import replace
from pathlib import Path

import pytest

from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.mismatch import Mismatch
from sextant.shared.scenario.scenario import Goal
from tests.support.walks import walk

SHORT = replace(load_scenario("flat"), goal=Goal(0.6))


@pytest.mark.parametrize("distortion", [-0.02, 0.02])
def test_profile_that_states_the_distortion_gives_the_true_pose(distortion: float, tmp_path: Path) -> None:
    robot = tmp_path / "distorted.toml"
    robot.write_text(f'extends = "phantomx_mk2"\nname = "distorted"\n[camera]\ndistortion = {distortion}\n', encoding="utf-8")
    walked = walk(replace(SHORT, robot=str(robot)), 1000)
    assert walked.report.success, walked.report.reason
    assert walked.report.pose_error_m.final < 0.01


def test_distortion_that_the_profile_does_not_state_is_no_shape_of_the_floor() -> None:
    walked = walk(replace(SHORT, mismatch=Mismatch(distortion=0.02, at_bounds=True)), 1000)
    assert walked.report.success, walked.report.reason
    assert walked.report.pose_error_m.final < 0.02
