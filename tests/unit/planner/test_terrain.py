"""Terrain queries on the map."""

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sextant.services.planner.terrain import STEEPEST, Terrain, flat_terrain, plane_of
from sextant.shared.geometry import Array

Maker = Callable[..., Terrain]


@pytest.fixture
def ramp(make_terrain: Maker) -> Terrain:
    """Return a ramp that rises by x / 10, without height at y > 0.5, off the origin."""
    return make_terrain(lambda x, y: np.where(y > 0.5, np.nan, 0.1 * x), lambda x, y: np.abs(y), origin=(0.3, -0.2))


def test_cell_centres_match_map_message(ramp: Terrain) -> None:
    map_ = ramp.map
    for i, j in ((0, 0), (7, 30), (200, 3)):
        centre = map_.origin + map_.resolution * np.array([i, j])
        for nudge in ((0.0, 0.0), (0.0049, -0.0049), (-0.0049, 0.0049)):
            assert ramp.heights((centre + nudge)[None])[0] == map_.elevation[i, j]
            np.testing.assert_allclose(ramp.centres((centre + nudge)[None])[0], centre, atol=1e-12)


@given(st.floats(-0.5, 1.0), st.floats(-1.0, 0.4))
def test_footing_is_exact_on_a_plane(x: float, y: float) -> None:
    n = 300
    flat = flat_terrain(0, np.zeros(2), 0.0, half_size=1.5)
    flat.map.elevation[:] = 0.1 * (flat.map.origin[0] + 0.01 * np.arange(n))[:, None]
    centre = flat.centres(np.array([[x, y]]))
    assert flat.footing(centre)[0] == pytest.approx(0.1 * centre[0, 0], abs=1e-6)


def test_places_outside_map_or_unseen_are_unknown(ramp: Terrain) -> None:
    places = np.array([[9.0, 0.0], [0.0, -9.0], [-9.0, 9.0], [0.3, 0.7]])
    assert np.isnan(ramp.heights(places)).all()
    assert np.isnan(ramp.footing(places)).all()
    assert np.isnan(ramp.scores(places[:3])).all()


def test_footing_needs_own_cell_but_not_all_neighbours(make_terrain: Maker) -> None:
    ground = make_terrain(lambda x, y: np.where(x > 0.005, np.nan, 0.02))
    inside, outside = ground.footing(np.array([[0.0, 0.0], [0.01, 0.0]]))
    assert inside == pytest.approx(0.02)
    assert np.isnan(outside)


def test_highest_along_line_ignores_unseen_cells(make_terrain: Maker) -> None:
    wall = make_terrain(lambda x, y: np.where(np.abs(x) < 0.02, 0.05, 0.0) + np.where(y > 0.3, np.nan, 0.0))
    start = np.array([[-0.1, 0.0], [-0.1, 0.1], [0.05, 0.0], [-0.1, 0.5]])
    end = np.array([[0.1, 0.0], [-0.04, 0.1], [0.15, 0.05], [0.1, 0.5]])
    np.testing.assert_allclose(wall.highest_along(start, end), [0.05, 0.0, 0.0, -np.inf], atol=1e-7)


@pytest.mark.parametrize("x", np.arange(-0.09, 0.10, 0.01))
def test_wall_of_one_cell_is_found_along_line(make_terrain: Maker, x: float) -> None:
    wall = make_terrain(lambda u, v: np.where(np.abs(u - x) < 0.006, 0.06, 0.0))
    assert wall.highest_along(np.array([[-0.1, 0.02]]), np.array([[0.1, -0.02]]))[0] == pytest.approx(0.06)


def test_highest_under_rotated_rectangle(make_terrain: Maker) -> None:
    post = make_terrain(lambda x, y: np.where(np.hypot(x - 0.1, y) < 0.03, 0.06, 0.0))

    def highest(yaw: float) -> float:
        R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        return post.highest_under(np.array([[-0.12, -0.05], [0.12, -0.05], [-0.12, 0.05]]) @ R.T)

    assert highest(0.0) == pytest.approx(0.06)
    assert highest(np.pi) == pytest.approx(0.06)
    assert highest(np.pi / 2) == 0.0
    assert post.highest_under(np.array([[9.0, 9.0], [9.1, 9.0], [9.0, 9.1]])) == -np.inf


def test_flat_terrain_is_level_and_acceptable_everywhere() -> None:
    flat = flat_terrain(7, np.array([0.4, -0.3]), 0.05)
    places = np.array([0.4, -0.3]) + np.random.default_rng(0).uniform(-0.9, 0.9, (100, 2))
    np.testing.assert_allclose(flat.footing(places), 0.05, atol=1e-7)
    assert (flat.scores(places) == 0).all()
    assert flat.map.assumed.all()
    assert flat.map.stamp_ns == 7


@given(
    hnp.arrays(float, 2, elements=st.floats(-0.1, 0.1)),
    hnp.arrays(float, (3, 2), elements=st.floats(-0.05, 0.05)),
    st.floats(-1.0, 1.0),
)
def test_plane_of_three_feet_passes_through_them(slope: Array, moved: Array, height: float) -> None:
    feet = np.array([[0.2, 0.1], [-0.2, 0.1], [0.0, -0.2]]) + moved
    ground = np.column_stack([feet, height + feet @ slope])
    np.testing.assert_allclose(plane_of(0, ground).heights(feet), ground[:, 2], atol=0.003)  # half a cell times the slope


def test_slope_of_foot_plane_is_limited() -> None:
    ground = np.array([[0.2, 0.1, 0.3], [-0.2, 0.1, 0.0], [0.0, -0.2, 0.0]])
    x = plane_of(0, ground).heights(np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]]))
    assert np.hypot(x[1] - x[0], x[2] - x[0]) / 0.5 <= STEEPEST + 0.03


def test_queries_to_distant_places_use_bounded_memory(make_terrain: Maker) -> None:
    """Check memory for points far away, where a line of 1 cm cells fills a terabyte.

    A foot or a body may be claimed to be anywhere.
    """
    ground = make_terrain()
    near, far = np.zeros((6, 2)), np.full((6, 2), 1e9)
    tracemalloc.start()
    assert np.isfinite(ground.ground_along(near, far)[0]).all()
    assert ground.highest_under(np.array([[0.0, 0.0], [1e9, 1e9], [0.0, 0.01]])) > -np.inf
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 50e6
