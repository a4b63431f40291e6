"""Collision check between the legs and the known ground during a step.

If a link would come too close, the foot is lifted higher, which also lifts knee and shank. If no lift helps, the step is
impossible. Unseen ground is no obstacle. A leg that is already too close before the step does not exclude the step.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.compiled_terrain import AROUND_FOOT, FEMUR, PUSHED, TIBIA
from sextant.services.planner.locomotion.swing_clearance import ALONG, LEVEL, RISEN, SWING_TIME, lowest_path, path_at
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array
from sextant.shared.robot.body import LegLinks
from sextant.shared.robot.kinematics import leg_inverse, leg_nearest_reachable
from sextant.shared.robot.profile import LEGS, RobotProfile

_LIFTS = 4  # number of lifts to try, up to the highest

_WORSE = 0.01  # [m] by which a leg that is already too close may come closer
_FINELY = np.linspace(0.0, 1.0, 21)  # shares of a swing's time at which the push is checked
# Latest progress of a foot along its path, and its latest rise: next to a high obstacle it rises first.
_LATE_TIME, _LATE_ALONG = [0.0, 0.3, 0.44, 0.62, 0.82, 1.0], [0.0, 0.05, 0.23, 0.60, 0.92, 1.0]
_LATE_RISE_TIME, _LATE_RISEN = [0.0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0], [0.0, 0.16, 0.44, 0.72, 0.95, 1.0, 0.5, 0.0]


@dataclass(frozen=True, slots=True)
class StepMotion:
    """Motion of legs and body in a step."""

    start: Array  # (6, 3) [m] {world} foot centres
    end: Array  # (6, 3) [m] {world} foot centres at the end; equal to the start for a standing foot
    T_start: Array  # (4, 4) {world} body pose
    T_end: Array  # (4, 4)
    swing: NDArray[np.bool_]  # (6,)


@dataclass(frozen=True, slots=True)
class LegCollision:
    """A link or foot that would touch the ground."""

    leg: int
    reason: str


def find_clearances(
    way: StepMotion,
    clearance: Array,
    margin: float,
    foot_margin: float,
    highest: float,
    profile: RobotProfile,
    terrain: Terrain,
) -> Array | LegCollision:
    """Return the clearances (6,) [m] with which the legs keep clear of the ground.

    A folded leg cannot bring its foot as close as the foot's path requires: it pushes the foot aside, off the checked path. The
    ground there must be lower than the foot.

    Args:
        way: The step.
        clearance: (6,) [m] that the paths of the feet require, over the higher end.
        margin: [m] between the links' centre lines and the ground.
        foot_margin: [m] between the ground and a foot that is pushed aside.
        highest: [m] maximum clearance of a leg.
        profile: The robot.
        terrain: The map.
    """
    out = clearance.copy()
    for lift in np.linspace(0.0, 1.0, _LIFTS + 1):
        bad, gaps, points = _too_near(way, out, margin, profile, terrain)
        pushed, against = _pushed(way, out, foot_margin, profile, terrain)
        legs = way.swing & (bad.any(axis=(0, 2)) | pushed)
        if not legs.any():
            break
        out[legs] = clearance[legs] + (lift + 1.0 / _LIFTS) * np.maximum(highest - clearance[legs], 0.0)
    if pushed.any():
        leg = int(np.flatnonzero(pushed)[0])
        x, y = against[leg]
        return LegCollision(leg, f"{LEGS[leg]} leg: its foot would be pushed against the ground at ({x:.2f}, {y:.2f}) m")
    if not bad.any():
        return out
    worst = np.unravel_index(int(np.argmin(np.where(bad, gaps, np.inf))), bad.shape)
    _, leg, sample = (int(i) for i in worst)
    link = "tibia" if TIBIA[sample] else "femur"
    x, y, _ = points[worst]
    return LegCollision(leg, f"{LEGS[leg]} leg: its {link} would touch the ground at ({x:.2f}, {y:.2f}) m")


def links_at(q: Array, links: LegLinks) -> Array:
    """Return samples (..., 8, 3) [m] {coxa} of femur and tibia at q (..., 3) [rad]."""
    femur, shank = q[..., 1:2], q[..., 1:2] + q[..., 2:3]
    along, beyond = links.femur * np.array(FEMUR), links.tibia * np.array(TIBIA)
    reach = links.coxa + np.cos(femur) * along + np.cos(shank) * beyond
    return np.stack(
        [np.cos(q[..., :1]) * reach, np.sin(q[..., :1]) * reach, np.sin(femur) * along + np.sin(shank) * beyond], axis=-1
    )


def _too_near(
    way: StepMotion, clearance: Array, margin: float, profile: RobotProfile, terrain: Terrain
) -> tuple[NDArray[np.bool_], Array, Array]:
    """Return where links come closer to the ground than a margin, gaps and points.

    The flags have shape (9, 6, 8). A link that starts closer than the margin may come closer by `_WORSE`.
    """
    feet = np.where(way.swing[:, None], lowest_path(way.start, way.end, clearance), way.start)
    # The body turns by a few degrees in a step, so the mean of two poses is nearly a rigid transform.
    T = way.T_start + SWING_TIME[:, None, None] * (way.T_end - way.T_start)
    gaps, points = _gaps(feet, T[:, None] @ profile.T_body_coxa, profile.leg_reach, profile.links, terrain)
    return gaps < np.minimum(margin, gaps[0].min(axis=-1, keepdims=True) - _WORSE), gaps, points


def _pushed(
    way: StepMotion, clearance: Array, margin: float, profile: RobotProfile, terrain: Terrain
) -> tuple[NDArray[np.bool_], Array]:
    """Return legs (6,) that would push their feet against ground next to their paths.

    The second value is the place (6, 2) [m] {world}.
    """
    sooner = np.interp(_FINELY, SWING_TIME, ALONG), np.interp(_FINELY, SWING_TIME, RISEN)
    later = np.interp(_FINELY, _LATE_TIME, _LATE_ALONG), np.interp(_FINELY, _LATE_RISE_TIME, _LATE_RISEN)
    highest = clearance / LEVEL  # the top of a foot's path folds the leg, not the lowest path
    feet = np.concatenate([path_at(way.start, way.end, highest, _FINELY, *shares) for shares in (sooner, later)])
    time = np.tile(_FINELY, 2)
    T = (way.T_start + time[:, None, None] * (way.T_end - way.T_start))[:, None] @ profile.T_body_coxa
    R, p = T[..., :3, :3], T[..., :3, 3]
    wanted = ((feet - p)[..., None, :] @ R)[..., 0, :]
    reached = leg_nearest_reachable(wanted, profile.leg_reach, profile.links)
    aside = way.swing & (np.linalg.norm((reached - wanted)[..., :2], axis=-1) > PUSHED)
    nowhere = np.zeros((6, 2))
    if not aside.any():
        return np.zeros(6, dtype=np.bool_), nowhere
    at: Array = (R @ reached[..., None])[..., 0] + p
    ground = np.fmax.reduce(terrain.heights(at[..., None, :2] + AROUND_FOOT), axis=-1)
    radius = profile.foot.radius
    # Ground no higher than the ground at the start or at the touchdown of a foot is no obstacle.
    leaves, comes = (np.fmax(foot[:, 2] - radius, terrain.heights(foot[:, :2])) for foot in (way.start, way.end))
    level = np.where(time[:, None] < 0.5, leaves, comes)
    passes = at[..., 2] - radius - (1.0 - LEVEL) * clearance
    stands = ground > np.maximum(passes - margin, level + margin)
    hits = aside & stands
    return hits.any(axis=0), at[hits.argmax(axis=0), np.arange(6), :2]


def _gaps(feet: Array, T_world_coxa: Array, reach: Array, links: LegLinks, terrain: Terrain) -> tuple[Array, Array]:
    """Return heights (..., 8) [m] of a leg's samples over the ground, and the samples.

    The height is infinite where the ground is unknown.

    Args:
        feet: (..., 3) [m] {world} foot centres.
        T_world_coxa: (..., 4, 4) coxa poses of the legs.
        reach: (..., 2) [m] shortest and longest way from the femur's axis to the foot.
        links: Coxa, femur and tibia lengths [m].
        terrain: The map.
    """
    R, p = T_world_coxa[..., :3, :3], T_world_coxa[..., :3, 3]
    feet_coxa = ((feet - p)[..., None, :] @ R)[..., 0, :]
    q = leg_inverse(leg_nearest_reachable(feet_coxa, reach, links), links)
    points = links_at(q, links) @ R.mT + p[..., None, :]
    known = np.isfinite(points[..., 0])
    xy = np.where(known[..., None], points[..., :2], 0.0)
    ground = terrain.heights(xy)
    known &= np.isfinite(ground)
    return np.where(known, points[..., 2] - np.where(known, ground, 0.0), np.inf), points
