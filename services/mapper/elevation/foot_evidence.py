"""Evidence of the feet about the map: touchdowns correct it, standing feet may refute it."""

import numpy as np

from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.services.mapper.elevation.leg_heights import LegHeights
from sextant.shared.geometry import Array, apply
from sextant.shared.wire.messages import ActuatorState, BodyPose, Mode

# [m] largest height difference between a foot and the map; beyond it, pose and map do not belong together
MAX_HEIGHT_ERROR_M = 0.30
_FARTHEST_FOOT_M = 1.0  # [m] from the body
_MIN_STANDING = 2  # minimum number of feet that carry load if the robot stands: a body balances on two feet and brushes others
_MIN_LOADED_FEET = 5  # minimum number of feet that carry load before the first step
_CONTRADICTED, _CONTRADICTED_NS = 0.10, 1_000_000_000  # [m], [ns] height error and its duration from which feet refute the map
_SOLE_RADIUS_M, _SOLE_AGREES = 0.05, 0.1  # [m] around a foot, and the minimum share of the cells there that must agree with it
# Feet that must stand on the map, their median height error [m], and the time [ns] for which this counts.
_MIN_CONFIRMING, _CONFIRMED_M, _CONFIRMED_NS = 3, 0.02, 2_000_000_000
_TOUCH_SIGMA_M = 0.005  # [m] of a height measured by a foot: joint errors and the spherical shape of the foot
_LEVEL_M = 0.01  # [m] largest height range of the map around a foot that shows the difference of its leg


class FootEvidence:
    """Compares the feet with the map."""

    def __init__(self, foot_radius_m: float, resolution: float, leg_difference: float = 0.0):
        """Start without touchdowns.

        Args:
            foot_radius_m: [m] from a foot's centre to its underside.
            resolution: [m] cell edge of the map.
            leg_difference: [m] largest difference of the ground's height by a leg and by the camera.
        """
        self.leg_heights = LegHeights(leg_difference)
        self._foot_radius_m = foot_radius_m
        around = resolution * np.arange(-1, 2)
        self._sole = np.stack(np.meshgrid(around, around), axis=-1)  # (3, 3, 2) [m] of the cells under a foot
        self._offsets = np.arange(-_SOLE_RADIUS_M, _SOLE_RADIUS_M + 1e-9, resolution)  # [m] of the cells around a foot
        self._touch_ns = np.full(6, -1, dtype=np.int64)  # stamps of the newest touchdowns in the map
        self._ground: tuple[int, float] | None = None  # stamp [ns] and height [m] of the ground that the feet confirm
        self._refuted_ns = -1  # stamp of the first scan that the feet refuted without interruption, or -1

    def apply_touchdowns(self, grid: ElevationGrid, pose: BodyPose, legs: ActuatorState) -> None:
        """Correct the map at the newest touchdowns, with or without ground.

        The height of a foot that stands follows from the attitude of the pose. The tilt of {odom} is averaged over steps.
        """
        new = np.flatnonzero(legs.touchdown_ns > self._touch_ns)
        self._touch_ns = legs.touchdown_ns.copy()
        heights = apply(pose.T_world_body, legs.feet)[:, 2] - self._foot_radius_m
        for leg, p in zip(new.tolist(), apply(pose.T_world_odom, legs.touchdown_point[new]), strict=True):
            if legs.contact[leg] and not legs.swing[leg]:
                p[2] = heights[leg]
            if not abs(float(grid.heights(p[:2])) - p[2]) <= MAX_HEIGHT_ERROR_M:  # or NaN
                continue
            sole = p[:2] + self._sole
            seen = grid.heights(sole)
            if legs.touchdown_contact[leg] and grid.is_seen(sole) and np.ptp(seen) <= _LEVEL_M:
                self.leg_heights.update(leg, float(p[2]), float(seen.mean()))
            p[2] -= self.leg_heights.differences[leg]
            grid.touch(p, _TOUCH_SIGMA_M, self._foot_radius_m)

    def change_ground(self, change: Array, pose: BodyPose, legs: ActuatorState) -> None:
        """Follow a change (3,) of the map's heights, see `ElevationGrid.change_ground`."""
        feet = apply(pose.T_world_body, legs.feet)
        self.leg_heights.change_ground(feet[:, :2] @ change[:2] + change[2])

    def confirmed_ground(self, grid: ElevationGrid, stamp_ns: int, pose: BodyPose, legs: ActuatorState) -> float | None:
        """Return the height [m] {world} of the lowest loaded foot's ground, None if the feet do not stand on the map.

        A step, in which few feet carry load, does not change it.
        """
        feet = apply(pose.T_world_body, legs.feet)[legs.contact & ~legs.swing] - [0.0, 0.0, self._foot_radius_m]
        off = np.abs(grid.heights(feet[:, :2]) - feet[:, 2])
        known = off[np.isfinite(off)]
        if len(known) >= _MIN_CONFIRMING:
            confirmed = float(np.median(known)) < _CONFIRMED_M
            self._ground = (stamp_ns, float(feet[:, 2].min())) if confirmed else None
        if self._ground is None or not 0 <= stamp_ns - self._ground[0] <= _CONFIRMED_NS:
            return None
        return self._ground[1]

    def is_refuted(self, grid: ElevationGrid, stamp_ns: int, pose: BodyPose, legs: ActuatorState) -> bool:
        """Return whether stance feet have refuted the map for `_CONTRADICTED_NS`.

        At least three feet that carry load, and all of them but one, must disagree with the known heights around them. A
        single foot over an edge, or a pose error of a few centimetres, does not refute the map.
        """
        if legs.swing.any() or not feet_show_ground(legs):
            self.forget()
            return False
        feet = apply(pose.T_world_body, legs.feet)[legs.contact] - [0.0, 0.0, self._foot_radius_m]
        refuted = np.count_nonzero([self._disagrees(grid, foot) for foot in feet])
        if refuted < max(3, len(feet) - 1):
            self.forget()
            return False
        if not 0 <= self._refuted_ns <= stamp_ns:
            self._refuted_ns = stamp_ns
        return stamp_ns - self._refuted_ns >= _CONTRADICTED_NS

    def forget(self) -> None:
        """Forget that the feet have refuted the map."""
        self._refuted_ns = -1

    def _disagrees(self, grid: ElevationGrid, foot: Array) -> bool:
        """Return whether the map around a foot's underside (3,) [m] {world} is wrong."""
        around = foot[:2] + np.stack(np.meshgrid(self._offsets, self._offsets), axis=-1)
        above = grid.heights(around) - foot[2]
        known = above[np.isfinite(above)]
        return bool(len(known)) and float(np.mean(np.abs(known) < _CONTRADICTED)) < _SOLE_AGREES


def may_stand(legs: ActuatorState) -> bool:
    """Return whether the robot may stand on all feet, of which two carry load, before its first step."""
    near = np.abs(legs.feet).max() < _FARTHEST_FOOT_M
    starts = legs.step == 0 and not legs.swing.any() and legs.mode in (Mode.STAND, Mode.HOLD, Mode.WALK)
    return bool(starts and np.count_nonzero(legs.contact) >= _MIN_STANDING and near)


def feet_show_ground(legs: ActuatorState) -> bool:
    """Return whether the feet show the height of the ground.

    They do not with torque off or while the robot is carried. Before the first step, `_MIN_LOADED_FEET` feet must carry load:
    if more feet hang, the ground is not a plane.
    """
    carrying = legs.contact & ~legs.swing
    enough = _MIN_LOADED_FEET if legs.step == 0 and not legs.swing.any() else 3
    near = np.abs(legs.feet).max() < _FARTHEST_FOOT_M
    return bool(legs.mode is not Mode.OFF and np.count_nonzero(carrying) >= enough and near)
