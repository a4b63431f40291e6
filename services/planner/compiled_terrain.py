"""Compiled loops over a terrain map: how places suit a foot, and the best foothold of a leg.

They are one file, because compiled functions must not call across files. Each argument and each call costs compilation, which
the first start of the robot waits for, so there are few.

Unknown ground is no obstacle. A leg pushes a foot that it does not reach to the nearest place within its reach.
"""

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.compiled import compiled, constants

NONE, POOR, GOOD = 0.0, 1.0, 2.0  # suitability of a place as a foothold
OK, UNSEEN, ROUGH, CROWDED, OUT_OF_REACH = constants(range(5))  # test results of a cell

_LIMITS, _REACH, _LINKS = constants([0, 6, 8])  # first columns of `leg_numbers`
_REACH_MARGIN = 1e-4  # [m] inside the reach, so that rounding errors do not exceed it

# Samples of a leg: shares of its femur, then of its tibia. Points nearer to the foot count as part of the foothold.
FEMUR = (0.4, 0.7, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
TIBIA = (0.0, 0.0, 0.0, 0.17, 0.34, 0.51, 0.68, 0.85)
_AROUND = 0.01 * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])  # [m] shank radius and map error at edges
_RISES, _RISE = 5, 0.01  # number of rises of a foot that leaves the ground, and [m] of each
PUSHED = 0.002  # [m] minimum sideways push that counts
# [m] around a foot that is pushed aside: the foot's radius, and the uncertainty of an edge of about 1 cm.
AROUND_FOOT = np.concatenate([r * np.array([(np.cos(a), np.sin(a)) for a in np.arange(8) * np.pi / 4]) for r in (0.01, 0.02)])

Layer = NDArray[np.float32]  # (nx, ny), NaN where unknown


class Grid(NamedTuple):
    """Cells of a map: cell (i, j) is centred at (x, y) + resolution * (i, j) {world}."""

    x: float  # [m]
    y: float  # [m]
    resolution: float  # [m]


class Choice(NamedTuple):
    """Which cells carry a foot, and which of them suit it best, see `Terrain.suitability`."""

    by_score: bool  # whether by Lotriet's score, or else by Masri's evaluation function
    most: float  # maximum value of a cell that carries a foot
    room: float  # [m] distance of the eight places around it that count
    firm: float  # [cells] evaluation from which a place is good in any case


class Ground(NamedTuple):
    """A terrain map."""

    elevation: Layer  # [m] {world}
    value: Layer  # score or evaluation function
    grid: Grid
    choice: Choice


class FootholdRules(NamedTuple):
    """Lengths [m] that a foothold must keep."""

    foot_distance: float  # from other feet
    foot_radius: float
    descent: float  # height from where the foot descends vertically
    leg_margin: float  # between the leg's links and the ground
    sink_margin: float  # between a foot that rises and the ground next to it


@cache
def leg_numbers(profile: RobotProfile) -> Array:
    """Return a robot's legs (6, 11) for compiled functions.

    A row holds lower and upper limits of coxa, femur and tibia (6) [rad], shortest and longest distance (2) [m] from femur axis
    to foot, and lengths of coxa, femur and tibia (3) [m].
    """
    links = np.tile([profile.links.coxa, profile.links.femur, profile.links.tibia], (6, 1))
    return np.hstack([profile.joint_limits.reshape(6, 6), profile.leg_reach, links])


# Places on the map ----------------------------------------------------------------------------------------------------------


@compiled
def _at(layer: Layer, grid: Grid, x: float, y: float) -> float:
    """Return the value of a layer at a place, NaN outside."""
    i, j = (x - grid.x) / grid.resolution, (y - grid.y) / grid.resolution
    nx, ny = layer.shape
    if not (-1.0 < i < nx and -1.0 < j < ny):
        return np.nan
    a, b = round(i), round(j)
    return float(layer[a, b]) if 0 <= a < nx and 0 <= b < ny else np.nan


@compiled
def _centre(at: float, first: float, resolution: float) -> float:
    """Return the coordinate of the centre of a cell."""
    return first + resolution * round((at - first) / resolution)


@compiled
def suitability_at(value: Layer, grid: Grid, choice: Choice, x: float, y: float) -> float:
    """Return the suitability of a place, NaN where unknown."""
    here = _at(value, grid, x, y)
    if not here <= choice.most:
        return NONE if here > choice.most else np.nan
    x, y = _centre(x, grid.x, grid.resolution), _centre(y, grid.y, grid.resolution)
    carrying, lowest = 0, np.inf
    for k in range(9):
        around = _at(value, grid, x + choice.room * (k // 3 - 1), y + choice.room * (k % 3 - 1))
        if k != 4 and around <= choice.most:  # an unseen place carries none
            carrying += 1
            lowest = min(lowest, around)
    if choice.by_score:
        return POOR + (GOOD - POOR) * (carrying / 8)
    return GOOD if here <= max(lowest, choice.firm) else POOR


@compiled
def footing_at(elevation: Layer, grid: Grid, x: float, y: float) -> float:
    """Return the height [m] at which a foot would stand, NaN where unknown."""
    patch, known = np.zeros(9, np.float32), 0
    for k in range(9):
        height = _at(elevation, grid, x + grid.resolution * (k // 3 - 1), y + grid.resolution * (k % 3 - 1))
        if math.isfinite(height):
            patch[k] = height
            known += 1
        elif k == 4:
            return np.nan
    for apart in (1, 2, 4):  # in the order of NumPy's sum
        for k in range(0, 8, 2 * apart):
            patch[k] += patch[k + apart]
    return float((patch[0] + patch[8]) / known)


@compiled
def _highest(elevation: Layer, grid: Grid, x: float, y: float, around: Array) -> float:
    """Return the highest known ground [m] at offsets (n, 2) [m] from a place, -inf for none."""
    highest = -np.inf
    for k in range(len(around)):
        height = _at(elevation, grid, x + around[k, 0], y + around[k, 1])
        if height > highest:
            highest = height
    return highest


# A leg ----------------------------------------------------------------------------------------------------------------------


@compiled
def _to_coxa(frame: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a place {world} in a coxa frame."""
    x, y, z = x - frame[0, 3], y - frame[1, 3], z - frame[2, 3]
    return (
        frame[0, 0] * x + frame[1, 0] * y + frame[2, 0] * z,
        frame[0, 1] * x + frame[1, 1] * y + frame[2, 1] * z,
        frame[0, 2] * x + frame[1, 2] * y + frame[2, 2] * z,
    )


@compiled
def _to_world(frame: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a place {coxa} in {world}."""
    return (
        frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z + frame[0, 3],
        frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z + frame[1, 3],
        frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z + frame[2, 3],
    )


@compiled
def _joint_angles(leg: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the joint angles [rad] of a foot {coxa}, as `leg_inverse` of `sextant.shared.robot.kinematics`."""
    femur, tibia = leg[_LINKS + 1], leg[_LINKS + 2]
    d_p = math.sqrt(x * x + y * y) - leg[_LINKS]
    cos_knee = (d_p * d_p + z * z - (femur * femur + tibia * tibia)) / (2.0 * femur * tibia)
    sin_knee = -math.sqrt((1.0 - cos_knee) * (1.0 + cos_knee))  # NaN out of reach
    along, across = femur + tibia * cos_knee, tibia * sin_knee
    knee = math.atan2(sin_knee, cos_knee)
    return math.atan2(y, x), math.atan2(z * along - d_p * across, d_p * along + z * across), knee


@compiled
def _reaches(leg: Array, frame: Array, x: float, y: float, z: float) -> bool:
    """Return whether a leg reaches a foot {world} within its joint limits."""
    x, y, z = _to_coxa(frame, x, y, z)
    coxa, femur, tibia = _joint_angles(leg, x, y, z)  # NaN is outside of all limits
    return bool(
        leg[_LIMITS] <= coxa <= leg[_LIMITS + 1]
        and leg[_LIMITS + 2] <= femur <= leg[_LIMITS + 3]
        and leg[_LIMITS + 4] <= tibia <= leg[_LIMITS + 5]
    )


@compiled
def _into_reach(leg: Array, frame: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return where {coxa} a leg holds a foot {world}, as `leg_nearest_reachable` of `sextant.shared.robot.kinematics`."""
    x, y, z = _to_coxa(frame, x, y, z)
    coxa, shortest, longest = leg[_LINKS], leg[_REACH] + _REACH_MARGIN, leg[_REACH + 1] - _REACH_MARGIN
    horizontal = max(math.sqrt(x * x + y * y), 1e-6)
    out = horizontal - coxa
    way = math.sqrt(out * out + z * z)
    if way < shortest:
        out = math.sqrt(max(shortest * shortest - z * z, 0.0))
    elif way > longest:
        out, z = out * longest / way, z * longest / way
    else:
        return x, y, z
    return x * (coxa + out) / horizontal, y * (coxa + out) / horizontal, z


@compiled
def stands_clear(
    elevation: Layer, grid: Grid, leg: Array, rules: FootholdRules, frame: Array, x: float, y: float, z: float
) -> bool:
    """Return whether femur and tibia are clear of the ground below and next to them, for a foot {world}.

    The ground next to them counts, because a shank has a thickness and an edge in the map has an uncertainty.
    """
    x, y, z = _into_reach(leg, frame, x, y, z)
    coxa, femur, knee = _joint_angles(leg, x, y, z)
    shank = femur + knee
    for k in range(len(FEMUR)):
        along, beyond = leg[_LINKS + 1] * FEMUR[k], leg[_LINKS + 2] * TIBIA[k]
        out = leg[_LINKS] + math.cos(femur) * along + math.cos(shank) * beyond
        up = math.sin(femur) * along + math.sin(shank) * beyond
        x, y, z = _to_world(frame, math.cos(coxa) * out, math.sin(coxa) * out, up)
        if z - _highest(elevation, grid, x, y, _AROUND) < rules.leg_margin:
            return False
    return True


@compiled
def rises_clear(
    elevation: Layer, grid: Grid, leg: Array, rules: FootholdRules, frame: Array, x: float, y: float, z: float
) -> bool:
    """Return whether a foot {world} rises without touching the ground.

    A folded leg cannot lift its foot vertically: it pushes the foot outwards. The ground there must be lower than the foot.
    """
    for k in range(1, _RISES + 1):
        u, v, w = _into_reach(leg, frame, x, y, z + _RISE * k)
        u, v, w = _to_world(frame, u, v, w)
        if math.sqrt((u - x) * (u - x) + (v - y) * (v - y)) <= PUSHED:
            continue
        if _highest(elevation, grid, u, v, AROUND_FOOT) > w - rules.foot_radius - rules.sink_margin:
            return False
    return True


# Footholds ------------------------------------------------------------------------------------------------------------------


@compiled
def _crowded(feet: Array, x: float, y: float, distance: float) -> bool:
    """Return whether a place is nearer than a distance [m] to a known foot."""
    for k in range(len(feet)):
        dx, dy = x - feet[k, 0], y - feet[k, 1]
        if dx * dx + dy * dy < distance * distance:  # not for NaN
            return True
    return False


@compiled
def _usable(
    elevation: Layer, grid: Grid, leg: Array, rules: FootholdRules, frames: Array, x: float, y: float, z: float
) -> bool:
    """Return whether a leg can hold a foot {world}: within reach, and with room for foot and shank."""
    if not _reaches(leg, frames[0], x, y, z + rules.descent):  # a folded leg descends further out
        return False
    for k in (0, 2, 1):
        if k != 1 and not (_reaches(leg, frames[k], x, y, z) and stands_clear(elevation, grid, leg, rules, frames[k], x, y, z)):
            return False
        if not rises_clear(elevation, grid, leg, rules, frames[k], x, y, z):
            return False
    return True


@compiled
def best_foothold(
    ground: Ground,
    leg: Array,
    rules: FootholdRules,
    nominal: tuple[float, float],
    feet: Array,
    frames: Array,
    offsets: Array,
) -> tuple[tuple[float, float, float], float, float, NDArray[np.int8]]:
    """Find the most suitable foothold near a nominal one; of equals, the nearest.

    Args:
        ground: The map.
        leg: A row of `leg_numbers`.
        rules: Distances to keep.
        nominal: [m] {world} where the foot would land on unobstructed ground.
        feet: (n, 3) [m] {world} centres of other feet, NaN where not known yet.
        frames: (3, 4, 4) {world} coxa poses of the leg when the foot lands, half-way, and when it leaves.
        offsets: (n, 2) [m] of the cells to try, the nearest first.

    Returns:
        The foothold [m] {world}; its distance [m] from the nominal one; its suitability, `NONE` if there is no foothold; and
        which test the cells (n,) fail, `OK` also for those that need no test.
    """
    elevation, value, grid, choice = ground
    x, y = nominal
    cx, cy = _centre(x, grid.x, grid.resolution), _centre(y, grid.y, grid.resolution)
    tests = np.zeros(len(offsets), np.int8)
    best, moved, room = (x, y, np.nan), np.inf, NONE
    for k in range(-1, len(offsets)):  # the nominal place is usually good, so it is tried before its cell
        u, v = (cx + offsets[k, 0], cy + offsets[k, 1]) if k >= 0 else nominal
        distance = math.sqrt((u - x) * (u - x) + (v - y) * (v - y))
        if room == GOOD and distance >= moved:
            continue
        suitability = suitability_at(value, grid, choice, u, v)
        if suitability < room or (suitability == room and distance >= moved) or (k < 0 and suitability != GOOD):
            continue
        height = footing_at(elevation, grid, u, v)
        if math.isnan(suitability) or math.isnan(height):
            test = UNSEEN
        elif suitability == NONE:
            test = ROUGH
        elif _crowded(feet, u, v, rules.foot_distance):
            test = CROWDED
        elif _usable(elevation, grid, leg, rules, frames, u, v, height + rules.foot_radius):
            test = OK
        else:
            test = OUT_OF_REACH
        if test == OK:
            best, moved, room = (u, v, height), distance, suitability
        elif k >= 0:
            tests[k] = test
    return best, moved, room, tests
