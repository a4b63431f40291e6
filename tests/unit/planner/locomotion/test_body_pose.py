"""Body height above the ground."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sextant.services.planner.locomotion.body_pose import clear_of_ground, floor_height, leaning, slope_under
from sextant.services.planner.terrain import Terrain, flat_terrain
from sextant.shared.geometry import Array, from_xyz_rpy, yaw_of

SIZE = (0.24, 0.12, 0.04)
heights = hnp.arrays(np.float64, 6, elements=st.floats(-0.2, 0.2))


@given(heights, st.permutations(range(6)), st.floats(-1, 1))
def test_floor_height_is_mean_of_three_highest_feet(ground: Array, order: list[int], shift: float) -> None:
    floor = floor_height(ground)
    assert floor == pytest.approx(sum(sorted(ground.tolist(), reverse=True)[:3]) / 3)
    assert floor == pytest.approx(floor_height(ground[order]))
    assert floor + shift == pytest.approx(floor_height(ground + shift))
    assert ground.mean() - 1e-12 <= floor <= ground.max() + 1e-12


@given(st.floats(-0.1, 0.1))
def test_level_ground_below_floor_height_does_not_raise_body(floor: float) -> None:
    ground = flat_terrain(0, np.zeros(2), 0.0)
    assert clear_of_ground(floor, ground, np.eye(4), SIZE) == pytest.approx(max(floor, 0.0))


def test_block_raises_body_only_while_under_it(make_terrain: Callable[..., Terrain]) -> None:
    block = make_terrain(lambda x, y: np.where((np.abs(x - 0.3) < 0.03) & (np.abs(y) < 0.03), 0.08, 0.0))
    for x, expected in ((0.0, 0.0), (0.2, 0.08), (0.3, 0.08), (0.5, 0.0)):
        T = from_xyz_rpy((x, 0.0, 0.1), np.zeros(3))
        assert clear_of_ground(0.0, block, T, SIZE) == pytest.approx(expected)
    aside = from_xyz_rpy((0.2, 0.0, 0.1), (0.0, 0.0, np.pi / 2))  # turned by 90 degrees, the body does not reach the block
    assert clear_of_ground(0.0, block, aside, SIZE) == 0.0


def test_unseen_ground_does_not_raise_the_body(make_terrain: Callable[..., Terrain]) -> None:
    unseen = make_terrain(lambda x, y: np.full_like(x, np.nan))
    assert clear_of_ground(0.02, unseen, np.eye(4), SIZE) == 0.02


@given(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(-3.0, 3.0))
def test_leaned_body_is_parallel_to_slope(ahead: float, aside: float, yaw: float) -> None:
    xy = np.array([[0.2, 0.2], [0.2, -0.2], [0.0, -0.25], [-0.2, -0.2], [-0.2, 0.2], [0.0, 0.25]])
    xy += np.array([3.0, -1.0])
    T = from_xyz_rpy((3.0, -1.0, 0.1), (0.0, 0.0, yaw))
    leant = leaning(T, slope_under(np.column_stack([xy, xy @ [ahead, aside]]), T), 0.02)
    normal = np.array([-ahead, -aside, 1.0]) / np.linalg.norm([-ahead, -aside, 1.0])
    np.testing.assert_allclose(leant[:3, 2], normal, atol=1e-9)
    np.testing.assert_allclose(leant[:3, 3], [3.0, -1.0, 0.08])
    assert yaw_of(leant) == pytest.approx(yaw)
