"""Footholds of a leg: in reach at all poses of the body while the foot stands, with room for foot and shank."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.planner.compiled_terrain import GOOD
from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion.foothold_search import Foothold, FootholdFinder, NoFoothold, offsets_by_distance
from sextant.services.planner.locomotion.leg_collision import links_at
from sextant.services.planner.locomotion.params import StepParams
from sextant.services.planner.locomotion.step_planner import StepPlanner
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.robot.kinematics import leg_inverse, leg_nearest_reachable
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import MAX_FOOTHOLD_SCORE
from tests.unit.planner.conftest import terrain_of

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
    np.testing.assert_array_equal(StepPlanner(PROFILE, Settings()).reached(far, body_at(0.0)), np.arange(6) != LEG)


# ---- the search against the same tests on arrays


def usable(points: Array, T_end: Array, T_after: Array, ground: Terrain) -> NDArray[np.bool_]:
    """Return which (n,) of points (n, 3) [m] {world} on the ground carry the leg's foot, by NumPy."""
    params, reach, links, limits = StepParams(), PROFILE.leg_reach[LEG], PROFILE.links, PROFILE.joint_limits[LEG]
    feet, descent = points + np.array([0.0, 0.0, PROFILE.foot.radius]), np.array([0.0, 0.0, params.descent_m])
    angles = np.arange(8) * np.pi / 4
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    beside_foot = np.concatenate([0.01 * ring, 0.02 * ring])
    beside_shank = 0.01 * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
    good = np.ones(len(feet), dtype=bool)
    for pose, stays in ((T_end, True), ((T_end + T_after) / 2.0, False), (T_after, True)):
        T = pose @ PROFILE.T_body_coxa[LEG]
        R, p = T[:3, :3], T[:3, 3]
        if stays:
            for at in (feet + descent, feet) if pose is T_end else (feet,):
                q = leg_inverse((at - p) @ R, links)
                good &= ((q >= limits[:, 0]) & (q <= limits[:, 1])).all(axis=1)
            q = leg_inverse(leg_nearest_reachable((feet - p) @ R, reach, links), links)
            on_links = links_at(q, links) @ R.T + p
            highest = np.fmax.reduce(ground.heights(on_links[..., None, :2] + beside_shank), axis=-1)
            good &= ~(on_links[..., 2] - highest < params.leg_margin_m).any(axis=1)
        for rise in (0.01, 0.02, 0.03, 0.04, 0.05):
            risen = feet + np.array([0.0, 0.0, rise])
            pushed = leg_nearest_reachable((risen - p) @ R, reach, links) @ R.T + p
            highest = np.fmax.reduce(ground.heights(pushed[:, None, :2] + beside_foot), axis=-1)
            aside = np.linalg.norm((pushed - risen)[:, :2], axis=1) > 0.002
            good &= ~(aside & (highest > pushed[:, 2] - PROFILE.foot.radius - params.sink_margin_m))
    return good


@given(st.integers(0, 2**32 - 1), st.floats(-0.12, 0.12), st.floats(-0.12, 0.12), st.floats(0.0, 0.12), st.floats(-0.3, 0.3))
@settings(max_examples=100, deadline=None)
def test_search_agrees_with_tests_on_arrays(seed: int, x: float, y: float, travel: float, turn: float) -> None:
    rng = np.random.default_rng(seed)
    ground = terrain_of(half=0.5)
    map_, shape = ground.map, (5, 5)
    blocks = np.kron(rng.choice([0.0, 0.0, 0.03, 0.06, np.nan], (21, 21)), np.ones(shape))
    map_.elevation[:] = blocks[: map_.elevation.shape[0], : map_.elevation.shape[1]]
    map_.score[rng.random(map_.score.shape) < 0.3] = 2.0
    nominal, T_end, T_after = FEET[LEG, :2] + [x, y], body_at(0.0), from_xyz_rpy((travel, 0.0, HEIGHT), (0.0, 0.0, turn))
    found = FootholdFinder(PROFILE, StepParams()).find(LEG, nominal, FEET, T_end, T_after, ground)
    xy = np.vstack([nominal, ground.centres(nominal) + offsets_by_distance(PROFILE.stance.search_radius, map_.resolution)])
    room, height, score = ground.suitability(xy), ground.footing(xy), ground.scores(xy)
    unseen = np.isnan(score) | np.isnan(height)
    rough = ~unseen & (score > MAX_FOOTHOLD_SCORE)
    others = np.delete(FEET[:, :2], LEG, axis=0)
    crowded = ~unseen & ~rough & (np.linalg.norm(xy[:, None] - others, axis=2).min(axis=1) < PROFILE.stance.foot_distance)
    free = ~unseen & ~rough & ~crowded
    free[free] = usable(np.column_stack([xy, height])[free], T_end, T_after, ground)
    free[0] &= room[0] == GOOD
    moved = np.linalg.norm(xy - nominal, axis=1)
    if free.any():
        assert isinstance(found, Foothold)
        best = free & (room == room[free].max())
        nearest = int(np.argmin(np.where(best, moved, np.inf)))
        np.testing.assert_array_equal(found.p_world, [*xy[nearest], height[nearest]])
        assert (found.moved, found.room) == (moved[nearest], room[nearest])
        return
    assert isinstance(found, NoFoothold)
    counts = {
        "not seen": unseen[1:].sum(),
        "too steep or too near an edge": rough[1:].sum(),
        "too near another foot": crowded[1:].sum(),
        "out of reach or too tight for the leg": (~unseen & ~rough & ~crowded)[1:].sum(),
    }
    for words, n in counts.items():
        assert (f"{n} {words}" in found.reason) == (n > 0)
    assert found.unseen == (2 * unseen[1:].sum() > len(xy) - 1)
