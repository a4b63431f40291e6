"""Walks with the depth cameras of the packaged profiles, with the noise of their data sheets."""

import pytest

from sextant.evaluation.lockstep.lockstep_run import run_lockstep
from tests.support.walks import flat


@pytest.mark.parametrize(
    "camera", ["d405", *(pytest.param(name, marks=pytest.mark.rare) for name in ("d435", "oak", "gemini2", "gemini305"))]
)
def test_robot_walks_with_camera(camera: str) -> None:
    report = run_lockstep(flat(0.5, robot=f"phantomx_mk2_{camera}"), 1000)
    assert report.success, report.reason
    assert (report.falls, report.shutdowns) == (0, 0)
