"""Start ground: the plane of the feet, where the camera sees nothing."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.mapper.config import Settings
from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.services.mapper.elevation.start_ground import assume_start_ground, feet_plane, nearest_seen_ground
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import BodyPose
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
HEIGHT = 0.10
SETTINGS = Settings(cells=200)
POSE = BodyPose(0, from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3)), np.eye(4), np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6)))
LEGS = actuator_state(PROFILE, feet=PROFILE.rest_feet(HEIGHT))


def assumed_after(step: int, height_ahead: float = np.nan) -> ElevationGrid:
    """Return a map with assumed ground; ground ahead is seen at a height unless it is NaN."""
    grid = ElevationGrid(SETTINGS.shape, SETTINGS.resolution)
    if np.isfinite(height_ahead):
        ahead = np.array([[0.5, -0.45], [0.9, -0.45], [0.9, 0.45], [0.5, 0.45]])
        grid.seed_plane(ahead, np.array([height_ahead, 0.0, 0.0]))
    assume_start_ground(grid, SETTINGS, PROFILE.foot.radius, POSE, replace(LEGS, step=step))
    return grid


def test_plane_of_the_feet_is_assumed_around_the_robot() -> None:
    heights = assumed_after(0).heights([[0.0, 0.0], [0.6, 0.3], [-0.4, 0.0], [0.6, 0.6]])
    np.testing.assert_allclose(heights[:3], 0.0, atol=2e-3)
    assert np.isnan(heights[3])


@pytest.mark.parametrize(("height_ahead", "assumed"), [(np.nan, False), (0.0, True), (0.05, False)])
def test_restarted_mapper_assumes_ground_ahead_only_if_seen_ground_continues_it(height_ahead: float, assumed: bool) -> None:
    between = float(assumed_after(7, height_ahead).heights([0.4, 0.0]))
    assert np.isfinite(between) == assumed
    assert np.isfinite(float(assumed_after(7, height_ahead).heights([0.0, 0.0]))), "under the robot"


def test_nearest_seen_ground_lies_ahead_of_the_body() -> None:
    grid = assumed_after(0)
    mask = nearest_seen_ground(grid, SETTINGS, POSE.T_world_body)
    places = grid.snapshot().origin + SETTINGS.resolution * np.argwhere(mask)
    assert len(places)
    assert places[:, 0].min() > -1e-9
    assert places[:, 0].max() < SETTINGS.assumed_ahead + 0.2
    assert np.abs(places[:, 1]).max() < SETTINGS.assumed_aside


def test_plane_needs_three_feet() -> None:
    feet = np.array([[0.0, 0.0, 0.1], [1.0, 0.0, 0.3], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(feet_plane(feet), [0.1, 0.2, -0.1])
    with pytest.raises(ValueError, match="three or more"):
        feet_plane(feet[:2])
