"""Ground at the start, which the camera does not see: the plane of the standing feet."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.config import Settings
from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.services.mapper.elevation.foot_evidence import feet_show_ground, may_stand
from sextant.shared.geometry import Array, apply
from sextant.shared.wire.messages import ActuatorState, BodyPose

_COLOR_RANGE_M = 0.20  # [m] length of the band beyond the assumed ground that is taken as the nearest seen ground
_MAX_PLANE_DEVIATION_M = 0.01  # [m] largest deviation from a plane, for ground that continues it and for feet that stand on it
_MIN_SEEN_SHARE = 0.3  # [1] minimum share of measured points ahead for this comparison
_PERCENTILE = 95  # [%] of their deviations that is compared with it
# Flat ground ahead of a robot that stands on few feet: its largest deviation [m] from a plane of its own. Errors of camera and
# legs change the height [m] and the slope [m/m] of that plane against the plane of the feet, by this much at most.
_FLAT_M, _MOST_OFF_M, _MOST_SLOPE = 0.005, 0.05, 0.10


def assume_start_ground(
    grid: ElevationGrid, settings: Settings, foot_radius_m: float, pose: BodyPose, legs: ActuatorState
) -> bool:
    """Fill the ground that is out of view at the start with the feet's plane; return whether they show it.

    Before the first step, the feet show it if most carry load. Legs that differ from the profile may stand on two or three feet
    even on a floor. All feet show it then if the nearest seen ground is flat.

    Args:
        grid: The map.
        settings: Size of the assumed ground.
        foot_radius_m: [m] from a foot's centre to its underside.
        pose: Body pose.
        legs: State of the legs.
    """
    T, soles = pose.T_world_body, apply(pose.T_world_body, legs.feet) - [0.0, 0.0, foot_radius_m]
    if feet_show_ground(legs):
        plane = feet_plane(soles[legs.contact & ~legs.swing])
    elif may_stand(legs):
        plane = feet_plane(soles)
        if np.abs(_above(soles, plane)).max() > _MAX_PLANE_DEVIATION_M or not _is_flat_ahead(grid, settings, T, plane):
            return False
    else:
        return False
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
    return True


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
    _, above = _seen_above(grid, settings, T_world_body, plane, (-0.1, 0.1))
    return bool(len(above) and np.percentile(np.abs(above), _PERCENTILE) < _MAX_PLANE_DEVIATION_M)


def _is_flat_ahead(grid: ElevationGrid, settings: Settings, T_world_body: Array, plane: Array) -> bool:
    """Return whether the nearest ground ahead is flat and near a plane (a, b, c) {world}."""
    places, above = _seen_above(grid, settings, T_world_body, plane, (-0.2, 0.0))
    if not len(above):
        return False
    A = np.column_stack([np.ones(len(places)), places])
    fit = np.linalg.lstsq(A, above, rcond=None)[0]
    flat = np.percentile(np.abs(above - A @ fit), _PERCENTILE) < _FLAT_M
    return bool(flat and abs(np.median(above)) < _MOST_OFF_M and np.hypot(*fit[1:]) < _MOST_SLOPE)


def _above(points: Array, plane: Array) -> Array:
    """Return the heights (n,) [m] of points (n, 3) above a plane (a, b, c)."""
    return np.asarray(points[:, 2] - np.column_stack([np.ones(len(points)), points[:, :2]]) @ plane)


def _seen_above(
    grid: ElevationGrid, settings: Settings, T_world_body: Array, plane: Array, band: tuple[float, float]
) -> tuple[Array, Array]:
    """Return seen places (n, 2) [m] {body} ahead and their heights (n,) [m] above a plane; none if most are unseen.

    `band` is their distance [m] beyond the assumed ground.
    """
    ahead, aside = settings.assumed_ahead + np.linspace(*band, 11), np.linspace(-1, 1, 21) * settings.assumed_aside
    places = np.stack(np.meshgrid(ahead, aside, indexing="ij"), axis=-1).reshape(-1, 2)
    points = apply(T_world_body, np.column_stack([places, np.zeros(len(places))]))[:, :2]
    above = _above(np.column_stack([points, grid.heights(points)]), plane)
    seen = np.isfinite(above)
    if seen.sum() <= _MIN_SEEN_SHARE * len(points):
        return np.zeros((0, 2)), np.zeros(0)
    return places[seen], above[seen]
