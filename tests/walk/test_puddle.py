"""Water that depth alone shows as flat ground.

With colour the robot avoids it, without colour it steps in; it stops before a pool.
"""

from dataclasses import replace

import numpy as np

from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Goal
from sextant.shared.scenario.terrain import Plane, Puddle
from tests.support.walks import blocked, walk

SHORT = replace(load_scenario("puddle"), goal=Goal(1.0))
POOL = replace(SHORT, terrain=(Plane(), Puddle((1.1, 0.0), (0.6, 3.0))))


def test_color_camera_avoids_water_that_depth_alone_does_not() -> None:
    seeing, blind_to_it = (walk(replace(SHORT, robot=robot), 1001).report for robot in ("phantomx_mk2_rgbd", "phantomx_mk2"))
    assert seeing.success, seeing.reason
    assert seeing.missteps == 0
    assert blind_to_it.missteps > 0


def test_robot_stops_before_pool_with_reason() -> None:
    reason, newest = blocked(POOL, 1000)
    assert " water" in reason
    wet = newest.hazard == 1
    assert wet.sum() > 1000
    assert (newest.evaluation[wet] >= 1).all(), "by Masri's layer it is no foothold, either"
    scores = newest.score[wet]
    assert (scores[np.isfinite(scores)] > 1.0).all()
    assert newest.color.any(axis=-1)[wet].mean() > 0.9
