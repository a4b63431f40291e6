"""Ground at the start, which the camera does not see: the plane of the standing feet."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.config import Settings
from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.shared.geometry import Array, apply
from sextant.shared.wire.messages import ActuatorState, BodyPose

_COLOR_RANGE_M = 0.20  # [m] length of the band beyond the assumed ground that is taken as the nearest seen ground
_MAX_PLANE_DEVIATION_M = 0.01  # [m] largest deviation from a plane for ground that continues it
_MIN_SEEN_SHARE = 0.3  # [1] minimum share of measured points ahead for this comparison
_PERCENTILE = 95  # [%] of their deviations that is compared with it


def assume_start_ground(
    grid: ElevationGrid, settings: Settings, foot_radius_m: float, pose: BodyPose, legs: ActuatorState
) -> None:
    """Fill the ground that is out of view at the start with the feet's plane.

    Args:
        grid: The map.
        settings: Size of the assumed ground.
        foot_radius_m: [m] from a foot's centre to its underside.
        pose: Body pose.
        legs: Legs, at least three of which carry load.
    """
    T = pose.T_world_body
    feet = apply(T, legs.feet)[legs.contact & ~legs.swing] - [0.0, 0.0, foot_radius_m]
    plane = feet_plane(feet)
    # A mapper that restarts in mid-course does not know the ground ahead. It then assumes ground ahead only if the measured
    # ground continues the plane of the feet, and otherwise only under the robot.
    assumes_ahead = legs.step == 0 or _continues_plane(grid, settings, T, plane)
    ahead = settings.assumed_ahead if assumes_ahead else float(legs.feet[:, 0].max())
    corners: Array = np.array(
        [
            [ahead, settings.assumed_aside, 0.0],
            [ahead, -settings.assumed_aside, 0.0],
            [-settings.assumed_behind, -settings.assumed_aside, 0.0],
            [-settings.assumed_behind, settings.assumed_aside, 0.0],
        ]
    )
    grid.seed_plane(apply(T, corners)[:, :2], plane)


def nearest_seen_ground(grid: ElevationGrid, settings: Settings, T_world_body: Array) -> NDArray[np.bool_]:
    """Return the mask (nx, ny) of the nearest measured cells ahead of the body."""
    snapshot = grid.snapshot()
    x, y = (snapshot.origin[k] + settings.resolution * np.arange(settings.shape[k]) for k in (0, 1))
    off = np.stack(np.broadcast_arrays(x[:, None] - T_world_body[0, 3], y - T_world_body[1, 3]), axis=-1)
    ahead, aside = np.moveaxis(off @ T_world_body[:2, :2], -1, 0)
    near = (ahead < settings.assumed_ahead + _COLOR_RANGE_M) & (ahead > 0) & (np.abs(aside) < settings.assumed_aside)
    return np.asarray(near & np.isfinite(snapshot.elevation))


def feet_plane(feet: Array) -> Array:
    """Fit a plane z = a + b x + c y to soles (n, 3) [m] and return (a, b, c).

    The fit is by least squares, with n >= 3.

    Raises:
        ValueError: There are fewer than three feet.

    Source: Masri 2016, section 4.7.
    """
    if feet.ndim != 2 or feet.shape[1] != 3 or len(feet) < 3:
        raise ValueError(f"feet (n, 3), three or more, expected, found {feet.shape}")
    A = np.column_stack([np.ones(len(feet)), feet[:, :2]])
    return np.asarray(np.linalg.lstsq(A, feet[:, 2], rcond=None)[0], dtype=np.float64)


def _continues_plane(grid: ElevationGrid, settings: Settings, T_world_body: Array, plane: Array) -> bool:
    """Return whether the nearest ground ahead lies in a plane (a, b, c) {world}."""
    x, y = np.meshgrid(
        settings.assumed_ahead + np.linspace(-0.1, 0.1, 11), np.linspace(-1, 1, 21) * settings.assumed_aside, indexing="ij"
    )
    points = apply(T_world_body, np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]))[:, :2]
    above = grid.heights(points) - np.column_stack([np.ones(len(points)), points]) @ plane
    seen = above[np.isfinite(above)]
    return bool(len(seen) > _MIN_SEEN_SHARE * len(points) and np.percentile(np.abs(seen), _PERCENTILE) < _MAX_PLANE_DEVIATION_M)
