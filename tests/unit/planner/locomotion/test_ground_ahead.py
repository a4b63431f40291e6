"""What the map shows of the ground ahead."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sextant.services.planner.locomotion.ground_ahead import GroundAhead, look_ahead
from sextant.services.planner.locomotion.params import GaitChoiceParams
from sextant.services.planner.terrain import Terrain, flat_terrain
from sextant.shared.geometry import from_xyz_rpy

PARAMS = GaitChoiceParams()
BODY = from_xyz_rpy((0.0, 0.0, 0.11), np.zeros(3))
Maker = Callable[..., Terrain]


def test_level_ground_carries_everywhere(make_terrain: Maker) -> None:
    assert look_ahead(make_terrain(), BODY, 0.3, PARAMS) == GroundAhead(0.0, 1.0, 0.0, 0.0)


@pytest.mark.parametrize("course", [0.0, 0.7, np.pi])
def test_slope_is_that_of_the_plane(make_terrain: Maker, course: float) -> None:
    ground = look_ahead(make_terrain(lambda x, y: 0.1 * x + 0.05 * y), BODY, course, PARAMS)
    assert ground.slope_deg == pytest.approx(np.degrees(np.arctan(np.hypot(0.1, 0.05))), abs=0.01)
    assert ground.step_m < 0.004


def test_step_ahead_is_found_and_the_one_behind_is_not(make_terrain: Maker) -> None:
    terrain = make_terrain(lambda x, y: np.where(x > 0.4, 0.04, 0.0))
    assert look_ahead(terrain, BODY, 0.0, PARAMS).step_m == pytest.approx(0.04, abs=1e-6)
    assert look_ahead(terrain, BODY, np.pi, PARAMS).step_m == 0.0


def test_shares_are_those_of_the_rectangle(make_terrain: Maker) -> None:
    half = PARAMS.ahead_m / 2
    bad = make_terrain(score=lambda x, y: np.where(x > half, 3.0, 0.0))
    assert look_ahead(bad, BODY, 0.0, PARAMS).carrying == pytest.approx(0.5, abs=0.04)
    unseen = make_terrain(lambda x, y: np.where(x > half, np.nan, 0.0))
    ground = look_ahead(unseen, BODY, 0.0, PARAMS)
    assert (ground.unseen, ground.carrying) == (pytest.approx(0.5, abs=0.04), 1.0)


def test_rule_of_masri_is_used_where_it_decides_on_footholds(make_terrain: Maker) -> None:
    terrain = replace(make_terrain(evaluation=lambda x, y: 0.0 * x + 2.0), layer="evaluation")
    assert look_ahead(terrain, BODY, 0.0, PARAMS).carrying == 0.0


def test_assumed_ground_and_ground_outside_of_the_map_are_unseen(make_terrain: Maker) -> None:
    assert look_ahead(flat_terrain(0, np.zeros(2), 0.0), BODY, 0.0, PARAMS) == GroundAhead(1.0, 0.0, 0.0, 0.0)
    far = from_xyz_rpy((50.0, 0.0, 0.11), np.zeros(3))
    assert look_ahead(make_terrain(), far, 0.0, PARAMS).unseen == 1.0
