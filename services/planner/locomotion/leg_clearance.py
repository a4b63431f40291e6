"""Whether the whole of each leg, not its foot alone, stays clear of the ground that is known while a step is walked.

Where a link would come too near, the foot is lifted higher, and so are knee and shank; where no lift helps there is no such
step. Ground that has not been seen stands in nobody's way, and what a leg is too near to before the step cannot be helped.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import leg_inverse, leg_nearest_reachable
from sextant.shared.robot.profile import LEGS, LegLinks, RobotProfile

# A swing as it is checked, at shares of its time: it passes below that of the feet.
SWING_TIME = np.array([0.0, 0.15, 0.32, 0.42, 0.50, 0.57, 0.68, 0.83, 1.0])
_ALONG = np.array([0.0, 0.08, 0.25, 0.40, 0.50, 0.62, 0.75, 0.90, 1.0])  # share of the way over the ground
_RISEN = np.array([0.0, 0.40, 0.90, 1.0, 1.0, 0.95, 0.85, 0.50, 0.0])  # share of the height over start, then over touchdown
LEVEL = 0.8  # of the clearance, over the higher end: there it flies
# The same for its end, closer: what of the level's height over the touchdown is left at shares of the way.
_SINKS_AT, _SINKS_TO = [0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95], [1.0, 0.97, 0.92, 0.80, 0.69, 0.54, 0.33]
_BESIDE = 0.02  # [m] around its touchdown, where the foot comes straight down beside what stands there
_LIFTS = 4  # that are tried, up to the highest

# Samples of a leg: shares of its femur, then of its tibia. What is nearer to the foot is judged as the foot's place.
_FEMUR = np.array([0.4, 0.7, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
_TIBIA = np.array([0.0, 0.0, 0.0, 0.17, 0.34, 0.51, 0.68, 0.85])
_BELOW = np.zeros((1, 2))  # [m]
_AROUND = 0.01 * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])  # [m] a shank's radius, and how well an edge is known
_WORSE = 0.01  # [m] by which a leg may come nearer to what it is too near to already
_RISES = 0.01 * np.outer([1, 2, 3, 4, 5], [0, 0, 1])  # [m] of a foot that leaves the ground
_PUSHED = 0.002  # [m] sideways, from which on it counts
_FINELY = np.linspace(0.0, 1.0, 21)  # shares of a swing's time at which it is looked whether the foot is pushed
# By then, at the latest, it has come along so much of its way, and risen by so much: beside something high it first goes up.
_LATE_TIME, _LATE_ALONG = [0.0, 0.3, 0.44, 0.62, 0.82, 1.0], [0.0, 0.05, 0.23, 0.60, 0.92, 1.0]
_LATE_RISE_TIME, _LATE_RISEN = [0.0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0], [0.0, 0.16, 0.44, 0.72, 0.95, 1.0, 0.5, 0.0]
# [m] around a foot that is pushed aside: it is as thick as it is, and an edge is known to within a centimetre.
_AROUND_FOOT = np.concatenate([r * np.array([(np.cos(a), np.sin(a)) for a in np.arange(8) * np.pi / 4]) for r in (0.01, 0.02)])


@dataclass(frozen=True, slots=True)
class Way:
    """What legs and body do in a step."""

    start: Array  # (6, 3) [m] {world} foot centres
    end: Array  # (6, 3) [m] {world} likewise; a standing foot's is its start
    T_start: Array  # (4, 4) body {world}
    T_end: Array  # (4, 4)
    swing: NDArray[np.bool_]  # (6,)


@dataclass(frozen=True, slots=True)
class Touching:
    """A link that would touch the ground."""

    leg: int
    reason: str


def cleared(
    way: Way,
    clearance: Array,
    margin: float,
    foot_margin: float,
    highest: float,
    profile: RobotProfile,
    terrain: Terrain,
) -> Array | Touching:
    """The clearances (6,) [m] by which the feet must pass over both ends so that the legs keep a margin to the ground.

    A folded leg whose foot cannot come as near as its way would have it pushes the foot aside, off the way that was looked at;
    what stands there must be lower than the foot.

    Args:
        way: The step.
        clearance: (6,) [m] that the feet's own ways ask for.
        margin: [m] of the links' middle lines over the ground.
        foot_margin: [m] of feet that are pushed aside, over what stands there.
        highest: [m] of clearance that a leg can lift its foot by.
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
        return Touching(leg, f"{LEGS[leg]} leg: its foot would be pushed against the ground at ({x:.2f}, {y:.2f}) m")
    if not bad.any():
        return out
    worst = np.unravel_index(int(np.argmin(np.where(bad, gaps, np.inf))), bad.shape)
    _, leg, sample = (int(i) for i in worst)
    link = "tibia" if _TIBIA[sample] else "femur"
    x, y, _ = points[worst]
    return Touching(leg, f"{LEGS[leg]} leg: its {link} would touch the ground at ({x:.2f}, {y:.2f}) m")


def stands_clear(
    leg: int, feet: Array, T_world_body: Array, margin: float, profile: RobotProfile, terrain: Terrain
) -> NDArray[np.bool_]:
    """With which (n,) of foot centres (n, 3) [m] {world} one leg keeps a margin [m] to the ground, the body at (4, 4).

    The ground beside its links counts as well as that below: a shank is as thick as it is, and an edge stands about where the
    map shows it.
    """
    T = T_world_body @ profile.T_body_coxa[leg]
    gaps, _ = _gaps(feet, T, profile.leg_reach[leg], profile.links, terrain, _AROUND)
    return np.asarray((gaps >= margin).all(axis=-1))


def rises_clear(
    leg: int, feet: Array, T_world_body: Array, margin: float, profile: RobotProfile, terrain: Terrain
) -> NDArray[np.bool_]:
    """From which (n,) of foot centres (n, 3) [m] {world} one leg's foot rises without being pushed against the ground.

    A folded leg cannot lift its foot straight up: it pushes it outwards, and what stands there must be a margin [m] lower than
    the foot by then. It may have to wherever the body is, (k, 4, 4), while the foot stands.
    """
    T = (T_world_body @ profile.T_body_coxa[leg])[:, None]
    R, p = T[..., :3, :3], T[..., None, :3, 3]
    risen = feet + _RISES[:, None]
    pushed = leg_nearest_reachable((risen - p) @ R, profile.leg_reach[leg], profile.links) @ R.mT + p
    beside = np.linalg.norm((pushed - risen)[..., :2], axis=-1) > _PUSHED
    if not beside.any():
        return np.ones(len(feet), dtype=np.bool_)
    ground = np.fmax.reduce(terrain.heights(pushed[..., None, :2] + _AROUND_FOOT), axis=-1)
    return np.asarray(~(beside & (ground > pushed[..., 2] - profile.foot.radius - margin)).any(axis=(0, 1)))


def swing_shape(start: Array, end: Array, clearance: Array) -> Array:
    """Where feet pass at least, at `SWING_TIME`: up beside the start, over both ends at a share of the clearance, and down.

    Args:
        start: (n, 3) [m] foot centres.
        end: (n, 3) [m] likewise.
        clearance: (n,) [m] over the higher end.

    Returns:
        (9, n, 3) [m].
    """
    return _shape(start, end, clearance, SWING_TIME, _ALONG, _RISEN)


def _shape(start: Array, end: Array, clearance: Array, time: Array, along: Array, risen: Array) -> Array:
    """Feet (k, n, 3) [m] at (k,) shares of a swing's time, by shares (k,) of the way and of the height, as `swing_shape`."""
    level = np.maximum(start[:, 2], end[:, 2]) + LEVEL * clearance
    feet = start + along[:, None, None] * (end - start)
    lower = np.where(time[:, None] < 0.5, start[:, 2], end[:, 2])
    feet[..., 2] = lower + risen[:, None] * (level - lower)
    return feet


def clearance_to_sink(ground: Array, start: Array, end: Array, margin: float) -> Array:
    """The clearance (n,) [m] with which feet, on their way down, pass over what stands before their touchdowns.

    Args:
        ground: (m, n) [m] highest ground at even shares of the ways, see `Terrain.ground_along`.
        start: (n, 3) [m] undersides of the feet.
        end: (n, 3) [m] likewise.
        margin: [m] over that ground.

    Returns:
        (n,) [m] over the higher end, -inf where nothing stands there.
    """
    share = np.linspace(0.0, 1.0, len(ground))[:, None]
    left = (1.0 - share) * np.linalg.norm((end - start)[:, :2], axis=1)
    stands = (share >= _SINKS_AT[0]) & (left >= _BESIDE) & (ground > end[:, 2] + margin)
    level = end[:, 2] + (np.where(stands, ground, -np.inf) + margin - end[:, 2]) / np.interp(share, _SINKS_AT, _SINKS_TO)
    return np.asarray((level.max(axis=0) - np.maximum(start[:, 2], end[:, 2])) / LEVEL)


def links_at(q: Array, links: LegLinks) -> Array:
    """Samples (..., 8, 3) [m] {coxa} along a leg's femur and tibia at joint angles q (..., 3) [rad]."""
    femur, shank = q[..., 1:2], q[..., 1:2] + q[..., 2:3]
    along, beyond = links.femur * _FEMUR, links.tibia * _TIBIA
    reach = links.coxa + np.cos(femur) * along + np.cos(shank) * beyond
    return np.stack(
        [np.cos(q[..., :1]) * reach, np.sin(q[..., :1]) * reach, np.sin(femur) * along + np.sin(shank) * beyond], axis=-1
    )


def _too_near(
    way: Way, clearance: Array, margin: float, profile: RobotProfile, terrain: Terrain
) -> tuple[NDArray[np.bool_], Array, Array]:
    """Where links come nearer to the ground than a margin, or than they are to begin with: (9, 6, 8), with gaps and places."""
    feet = np.where(way.swing[:, None], swing_shape(way.start, way.end, clearance), way.start)
    # The body turns by a few degrees in a step: between two poses so near their mean is one, too.
    T = way.T_start + SWING_TIME[:, None, None] * (way.T_end - way.T_start)
    gaps, points = _gaps(feet, T[:, None] @ profile.T_body_coxa, profile.leg_reach, profile.links, terrain)
    return gaps < np.minimum(margin, gaps[0].min(axis=-1, keepdims=True) - _WORSE), gaps, points


def _pushed(
    way: Way, clearance: Array, margin: float, profile: RobotProfile, terrain: Terrain
) -> tuple[NDArray[np.bool_], Array]:
    """Legs (6,) that would push their feet against what stands beside their ways, and where (6, 2) [m] {world}."""
    sooner = np.interp(_FINELY, SWING_TIME, _ALONG), np.interp(_FINELY, SWING_TIME, _RISEN)
    later = np.interp(_FINELY, _LATE_TIME, _LATE_ALONG), np.interp(_FINELY, _LATE_RISE_TIME, _LATE_RISEN)
    highest = clearance / LEVEL  # what folds a leg is the top of its foot's way, not what it passes over at least
    feet = np.concatenate([_shape(way.start, way.end, highest, _FINELY, *shares) for shares in (sooner, later)])
    time = np.tile(_FINELY, 2)
    T = (way.T_start + time[:, None, None] * (way.T_end - way.T_start))[:, None] @ profile.T_body_coxa
    R, p = T[..., :3, :3], T[..., :3, 3]
    wanted = ((feet - p)[..., None, :] @ R)[..., 0, :]
    reached = leg_nearest_reachable(wanted, profile.leg_reach, profile.links)
    aside = way.swing & (np.linalg.norm((reached - wanted)[..., :2], axis=-1) > _PUSHED)
    nowhere = np.zeros((6, 2))
    if not aside.any():
        return np.zeros(6, dtype=np.bool_), nowhere
    at: Array = (R @ reached[..., None])[..., 0] + p
    ground = np.fmax.reduce(terrain.heights(at[..., None, :2] + _AROUND_FOOT), axis=-1)
    radius = profile.foot.radius
    # What is no higher than the ground that a foot leaves, or comes to, stands in nobody's way.
    leaves, comes = (np.fmax(foot[:, 2] - radius, terrain.heights(foot[:, :2])) for foot in (way.start, way.end))
    level = np.where(time[:, None] < 0.5, leaves, comes)
    passes = at[..., 2] - radius - (1.0 - LEVEL) * clearance
    stands = ground > np.maximum(passes - margin, level + margin)
    hits = aside & stands
    return hits.any(axis=0), at[hits.argmax(axis=0), np.arange(6), :2]


def _gaps(
    feet: Array, T_world_coxa: Array, reach: Array, links: LegLinks, terrain: Terrain, around: Array = _BELOW
) -> tuple[Array, Array]:
    """How high (..., 8) [m] a leg's samples are over the ground, infinite where that is unknown, and where they are.

    Args:
        feet: (..., 3) [m] {world} foot centres.
        T_world_coxa: (..., 4, 4) of the legs.
        reach: (..., 2) [m] shortest and longest way from the femur's axis to the foot.
        links: Coxa, femur and tibia lengths [m].
        terrain: The map.
        around: (k, 2) [m] beside a sample where the ground counts.
    """
    R, p = T_world_coxa[..., :3, :3], T_world_coxa[..., :3, 3]
    feet_coxa = ((feet - p)[..., None, :] @ R)[..., 0, :]
    q = leg_inverse(leg_nearest_reachable(feet_coxa, reach, links), links)
    points = links_at(q, links) @ R.mT + p[..., None, :]
    known = np.isfinite(points[..., 0])
    xy = np.where(known[..., None], points[..., :2], 0.0)
    ground = np.fmax.reduce(terrain.heights(xy[..., None, :] + around), axis=-1)
    known &= np.isfinite(ground)
    return np.where(known, points[..., 2] - np.where(known, ground, 0.0), np.inf), points
