"""Relocalization map: it detects a misplaced frame and finds its place."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sextant.services.perception.registration.relocalization_map import RelocalizationMap
from sextant.shared.geometry import from_xyz_rpy

SIGMA = 0.0016  # [1/m]
LEVEL = from_xyz_rpy([0.0, 0.0, 0.5], [0.0, 0.0, 0.0])  # the points' frame is parallel to {world}, 0.5 m above the floor


def ground(x, y, seed):
    """Return heights [m] of a floor with blocks at points (n,) [m]."""
    rng = np.random.default_rng(seed)
    z = np.zeros(len(x))
    for _ in range(25):
        cx, cy, height = rng.uniform(-1.2, 1.2), rng.uniform(-1.2, 1.2), rng.uniform(0.05, 0.2)
        z[(np.abs(x - cx) < 0.1) & (np.abs(y - cy) < 0.1)] = height
    return z


def view(T, heights, half=0.7, step=0.011):
    """Return points (n, 3) [m] of the ground around a pose (4, 4), in its axes.

    All of the ground is in view.
    """
    a, b = (grid.ravel() for grid in np.meshgrid(np.arange(-half, half, step), np.arange(-half, half, step)))
    world = np.stack([a, b, np.zeros(len(a))], axis=1) @ T[:3, :3].T + T[:3, 3]
    z = heights(world[:, 0], world[:, 1])
    return np.column_stack([a, b, z - T[2, 3]])


def test_mapped_view_has_no_misfit():
    known_map = RelocalizationMap(SIGMA)
    points = view(LEVEL, lambda x, y: ground(x, y, 0))
    assert known_map.contradiction(points, LEVEL).share == 0.0  # the map is empty
    known_map.add(points, LEVEL)
    assert known_map.contradiction(points, LEVEL).share == 0.0
    known_map.clear()
    assert known_map.contradiction(points, from_xyz_rpy([0.3, 0.0, 0.5], [0.0, 0.0, 0.0])).share == 0.0


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(
    x=st.floats(-0.25, 0.25),
    y=st.floats(-0.25, 0.25),
    yaw=st.floats(-0.25, 0.25),
    z=st.floats(-0.05, 0.05),
    seed=st.integers(0, 3),
)
@example(x=-0.1875, y=-0.125, yaw=0.0, z=0.0, seed=1)  # every sixteenth point of this picture lies in one of eight columns
def test_lost_frame_is_relocalized_on_structured_ground(x, y, yaw, z, seed):
    known_map = RelocalizationMap(SIGMA)
    known_map.add(view(LEVEL, lambda x, y: ground(x, y, seed), half=1.2), LEVEL)
    T = from_xyz_rpy([x, y, 0.5], [0.0, 0.0, yaw])
    points = view(T, lambda x, y: ground(x, y, seed))
    expected = from_xyz_rpy([0.0, 0.0, 0.5 + z], [0.0, 0.0, 0.0])
    found = known_map.find(points, expected)
    if np.hypot(x, y) > 0.15 or abs(yaw) > 0.15:
        assert known_map.contradiction(points, expected).share > 0.015
        assert found.T_world_camera is not None, found.reason
    if found.T_world_camera is not None:
        error = np.linalg.inv(T) @ found.T_world_camera
        assert np.abs(error[:3, 3]).max() < 0.06  # within the range of registration
        assert abs(np.arctan2(error[1, 0], error[0, 0])) < np.radians(4.0)


def test_level_ground_gives_no_relocalization():
    known_map = RelocalizationMap(SIGMA)

    def floor(x, _):
        return np.zeros(len(x))

    known_map.add(view(LEVEL, floor, half=1.2), LEVEL)
    points = view(LEVEL, floor)
    moved = from_xyz_rpy([0.2, 0.1, 0.5], [0.0, 0.0, 0.2])
    assert known_map.contradiction(points, moved).share == 0.0
    found = known_map.find(points, moved)
    assert found.T_world_camera is None
    assert "no pose nearby fits better" in found.reason


@settings(max_examples=10, deadline=None)
@given(x=st.floats(0.0, 0.3), beyond=st.floats(0.28, 0.42))
def test_unmapped_ground_does_not_cause_relocalization(x, beyond):
    """Check the view beyond a level floor: it would fit there, but may be new ground."""
    known_map = RelocalizationMap(SIGMA)
    known_map.add(view(LEVEL, lambda x, _: np.zeros(len(x)), half=0.7), LEVEL)
    expected = from_xyz_rpy([x, 0.7 + beyond, 0.5], [0.0, 0.0, 0.0])
    points = view(expected, lambda x, _: np.zeros(len(x)), half=0.3)
    found = known_map.find(points, expected)
    assert found.T_world_camera is None


def test_unmapped_ground_is_reported_as_reason():
    known_map = RelocalizationMap(SIGMA)
    points = view(LEVEL, lambda x, y: ground(x, y, 0))
    known_map.add(points, LEVEL)
    assert "no mapped ground within" in known_map.find(points, from_xyz_rpy([3.0, 0.0, 0.5], [0.0, 0.0, 0.0])).reason
    # The same holds where the grid reuses its cells further on.
    far = from_xyz_rpy([512 * 0.02, 0.0, 0.5], [0.0, 0.0, 0.0])
    known_map.add(points, far)
    assert "no mapped ground within" in known_map.find(points, LEVEL).reason
    assert known_map.contradiction(points, far).share == 0.0


@pytest.mark.parametrize(("height", "doubted"), [(0.1, True), (0.0, False), (-0.1, True)])
def test_height_change_contradicting_seen_floor_is_misfit(height, doubted):
    camera = from_xyz_rpy([-1.0, 0.0, 0.5], [0.0, 0.0, 0.0])
    known_map = RelocalizationMap(SIGMA)
    floor = view(LEVEL, lambda x, _: np.zeros(len(x)))
    in_camera = floor + LEVEL[:3, 3] - camera[:3, 3]
    known_map.add(in_camera, camera)
    changed = in_camera.copy()
    changed[(np.abs(floor[:, 0]) < 0.2) & (np.abs(floor[:, 1]) < 0.2), 2] += height
    assert (known_map.contradiction(changed, camera).share > 0.015) is doubted


def test_newly_visible_face_is_not_misfit():
    camera = from_xyz_rpy([-1.0, 0.0, 0.5], [0.0, 0.0, 0.0])
    known_map = RelocalizationMap(SIGMA)
    y = np.repeat(np.arange(-0.7, 0.7, 0.01), 80)
    floor = np.column_stack([np.tile(np.arange(-0.4, 0.4, 0.01), 140), y, np.full(len(y), -0.5)])
    lower = np.column_stack([np.full(len(y), 0.405), y, np.tile(np.linspace(-0.5, -0.45, 80), 140)])
    upper = lower + np.array([0.0, 0.0, 0.05])
    beyond = lower + np.array([0.02, 0.0, 0.0])
    ahead = np.array([1.0, 0.0, 0.0])
    known_map.add(np.concatenate([floor, lower, beyond])[::3] + ahead, camera)
    assert known_map.contradiction(np.concatenate([floor, upper]) + ahead, camera).share == 0.0
