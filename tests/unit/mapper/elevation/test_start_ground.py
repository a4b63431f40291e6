"""Start ground: the plane of the feet, where the camera sees nothing."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sextant.services.mapper.config import Settings
from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.services.mapper.elevation.start_ground import assume_start_ground, feet_plane, nearest_seen_ground
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import BodyPose, Mode
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


FEW = np.array([False, True, False, False, True, False])  # feet that carry load: the body balances on the middle legs
SWING = np.arange(6) == 0


def map_seen_ahead(plane: tuple[float, float, float], bump_m: float = 0.0) -> ElevationGrid:
    """Return a map that is seen only ahead, in a plane (a, b, c) [m, m/m], with bumps of two cells."""
    grid = ElevationGrid(SETTINGS.shape, SETTINGS.resolution)
    for strip, x in enumerate(np.arange(0.5, 0.9, 0.02).tolist()):
        ahead = np.array([[x, -0.45], [x + 0.02, -0.45], [x + 0.02, 0.45], [x, 0.45]])
        grid.seed_plane(ahead, np.add(plane, (bump_m * (strip % 2), 0.0, 0.0)))
    return grid


@pytest.mark.parametrize("plane", [(0.0, 0.0, 0.0), (0.02, 0.0, 0.0), (0.0, -0.05, 0.03)], ids=["level", "higher", "inclined"])
def test_robot_on_two_feet_knows_the_start_if_the_ground_ahead_is_flat(plane: tuple[float, float, float]) -> None:
    grid = map_seen_ahead(plane)
    assert assume_start_ground(grid, SETTINGS, PROFILE.foot.radius, POSE, replace(LEGS, contact=FEW))
    np.testing.assert_allclose(grid.heights([[0.0, 0.0], [0.45, 0.3], [-0.4, 0.0]]), 0.0, atol=2e-3)


def lifted(height_m: float) -> np.ndarray:
    """Return feet at rest, one of them lifted."""
    feet = PROFILE.rest_feet(HEIGHT)
    feet[0, 2] += height_m
    return feet


@pytest.mark.parametrize(
    ("plane", "bump_m", "changes"),
    [
        ((np.nan, 0.0, 0.0), 0.0, {}),
        ((0.0, 0.0, 0.0), 0.02, {}),
        ((0.06, 0.0, 0.0), 0.0, {}),
        ((0.0, 0.15, 0.0), 0.0, {}),
        ((0.0, 0.0, 0.0), 0.0, {"contact": np.arange(6) == 1}),
        ((0.0, 0.0, 0.0), 0.0, {"step": 1, "contact": FEW}),
        ((0.0, 0.0, 0.0), 0.0, {"swing": SWING}),
        ((0.0, 0.0, 0.0), 0.0, {"mode": Mode.OFF}),
        ((0.0, 0.0, 0.0), 0.0, {"mode": Mode.READY}),
        ((0.0, 0.0, 0.0), 0.0, {"feet": lifted(0.04)}),
    ],
    ids=["unseen", "rubble", "far higher", "steep", "one foot", "walking", "swinging", "torque off", "lying", "folded"],
)
def test_start_stays_unknown_without_flat_ground_ahead_or_a_stance(
    plane: tuple[float, float, float], bump_m: float, changes: dict[str, Any]
) -> None:
    grid = ElevationGrid(SETTINGS.shape, SETTINGS.resolution) if np.isnan(plane[0]) else map_seen_ahead(plane, bump_m)
    legs = replace(LEGS, **({"contact": FEW} | changes))
    assert not assume_start_ground(grid, SETTINGS, PROFILE.foot.radius, POSE, legs)
    assert np.isnan(float(grid.heights([0.0, 0.0])))


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
