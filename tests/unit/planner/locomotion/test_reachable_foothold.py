"""Reachable footholds: in reach of the leg at all poses of the body while the foot stands."""

from collections.abc import Callable

import numpy as np
import pytest

from sextant.services.planner.locomotion.foothold_search import Foothold, NoFoothold
from sextant.services.planner.locomotion.params import StepParams
from sextant.services.planner.locomotion.reachable_foothold import FootholdFinder, feet_in_reach
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
HEIGHT = 0.11
REST = PROFILE.rest_feet(HEIGHT)
LEG = 1
Maker = Callable[..., Terrain]


def body_at(x: float) -> Array:
    return from_xyz_rpy((x, 0.0, HEIGHT), np.zeros(3))


FEET = apply(body_at(0.0), REST)


@pytest.fixture
def finder() -> FootholdFinder:
    return FootholdFinder(PROFILE, StepParams())


def test_nominal_place_on_level_ground_is_taken(finder: FootholdFinder, make_terrain: Maker) -> None:
    found = finder.find(LEG, FEET[LEG, :2], FEET, body_at(0.0), body_at(0.0), make_terrain())
    assert isinstance(found, Foothold)
    np.testing.assert_allclose(found.p_world[:2], FEET[LEG, :2], atol=0.011)


def test_foothold_must_stay_in_reach_until_the_foot_leaves_it(finder: FootholdFinder, make_terrain: Maker) -> None:
    found = finder.find(LEG, FEET[LEG, :2], FEET, body_at(0.0), body_at(0.4), make_terrain())
    assert isinstance(found, NoFoothold)


def test_wider_search_reaches_over_bad_ground(finder: FootholdFinder, make_terrain: Maker) -> None:
    radius = PROFILE.stance.search_radius + 0.01
    x0, y0 = FEET[LEG, :2]
    bad = make_terrain(score=lambda x, y: np.where(np.hypot(x - x0, y - y0) < radius, 9.0, 0.0))
    narrow, wide = (finder.find(LEG, FEET[LEG, :2], FEET, body_at(0.0), body_at(0.0), bad, width) for width in finder.widths)
    assert isinstance(narrow, NoFoothold)
    assert isinstance(wide, Foothold)


def test_feet_in_reach_by_leg() -> None:
    far = FEET + 0.5 * (np.arange(6) == LEG)[:, None] * np.array([1.0, 0.0, 0.0])
    np.testing.assert_array_equal(feet_in_reach(PROFILE, far, body_at(0.0)), np.arange(6) != LEG)
