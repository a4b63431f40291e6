"""Lotriet's foot placement planning as published (2024, sections 5.3 and 6): his score, and his step planner.

`sextant run steps --lockstep --seed 1000 --planner lotriet --foothold lotriet` walks by them. The thesis gives no weights, and
does not say what happens if a foot finds no place. The comment of each constant says what is assumed. Sextant still finds the
path to the goal, moves the feet along its own arcs, and checks each step.
"""

from collections.abc import Callable
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sextant.plugins import ElevationMap, NoStep, RobotProfile, Step, StepRequest, TerrainMap
from sextant.services.mapper.footholds.foothold_score import published_score
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, yaw_of
from sextant.shared.robot.kinematics import body_inverse, leg_inverse, within_limits
from sextant.shared.robot.stability import resting_centre_of_mass, support_margin

# Assumed: the weights of Sextant's own score, converted to his sums. Alone, a slope of 31 deg reaches the limit of 1.
_SLOPE_PER_GRADIENT: Final = 1.0 / 0.6
_PROXIMITY_PER_M: Final = 100.0
_KERNEL: Final = 5  # [cells] n of (6.4), assumed
_SIGMA: Final = 1.5  # [cells] of the kernel, assumed
_SEARCH_M: Final = 0.06  # [m] half the edge of the searched square, assumed: that of Sextant's search
_SHARES: Final = (1.0, 0.6, 0.3)  # of the commanded motion, tried in turn. Assumed: without shorter steps he stands still
_OVER_RISE_M: Final = 0.02  # [m] of a swinging foot over the higher end of its swing; Sextant's arcs need a number


def score(ground: ElevationMap) -> NDArray[np.float32]:
    """Return his score of each cell (nx, ny): slope and edge proximity, eq. (6.1) to (6.4)."""
    return published_score(
        ground.elevation,
        slope=_SLOPE_PER_GRADIENT / (8.0 * ground.resolution),
        proximity=_PROXIMITY_PER_M * _KERNEL**2,
        kernel=_KERNEL,
        sigma=_SIGMA,
    )


class Steps:
    """His tripod gait over his footholds, with a level body."""

    def __init__(self, profile: RobotProfile) -> None:
        """Plan for a robot."""
        self._profile = profile

    def plan(self, request: StepRequest) -> Step | NoStep:
        """Return the next step; a shorter one if a foot finds no place or the actuator has refused the longer one."""
        found: Step | NoStep = NoStep("no step was tried")
        for share in _SHARES[min(request.refused, len(_SHARES) - 1) :]:
            found = self._step(request, share)
            if isinstance(found, Step):
                break
        return found

    def _step(self, request: StepRequest, share: float) -> Step | NoStep:
        """Return a step with a share of the commanded motion."""
        profile, rest = self._profile, self._profile.rest_feet(request.body_height)
        travel = share * request.step_s * request.velocity
        travel = travel * min(1.0, profile.stance.stride / max(float(np.linalg.norm(travel)), 1e-9))
        turn = share * request.step_s * request.yaw_rate
        level = _level(request.T_world_body)
        swing = swinging(travel, apply(inverse(level), request.feet), rest)
        swing = request.due[0] if swing is None else swing
        end = _moved(level, travel, turn)
        nominal = apply(_moved(end, travel / 2, turn / 2), rest)  # (5.19): where the body is in the middle of the next stance
        targets = request.feet.copy()
        for leg in np.flatnonzero(swing):
            end[2, 3] = self._body_z(request, end, targets)
            place = first_place(request.map, nominal[leg, :2], partial(self._reached, end, int(leg)))
            if place is None:
                within = f"within {_SEARCH_M * 100:.0f} cm of its nominal place"
                return NoStep(f"no cell with a score of at most 1 in reach {within}", int(leg))
            targets[leg] = place + np.array([0.0, 0.0, profile.foot.radius])
        end[2, 3] = self._body_z(request, end, targets)
        if unmet := self._unmet(end, targets, swing):
            return unmet
        rise = np.abs(targets[:, 2] - request.feet[:, 2]).max(initial=0.0, where=swing)
        clearance = min(max(request.lift, float(rise) + _OVER_RISE_M), profile.stance.max_lift)
        return Step(swing, targets, end, np.full(6, clearance), request.step_s)

    def _body_z(self, request: StepRequest, end: Array, targets: Array) -> float:
        """Return the height [m] {world} of the body over the floor of targets (6, 3) [m] {world} (section 6.4)."""
        floor = floor_height(targets[:, 2] - self._profile.foot.radius)
        return max(floor, _highest_under(request.map, end, self._profile.body.size)) + request.body_height

    def _reached(self, end: Array, leg: int, places: Array) -> NDArray[np.bool_]:
        """Return which places (n, 3) [m] {world} a leg reaches at the end of a step (section 6.2.3)."""
        feet = places + np.array([0.0, 0.0, self._profile.foot.radius])
        T = self._profile.T_coxa_body[leg] @ inverse(end)
        q, limits = leg_inverse(apply(T, feet), self._profile.links), self._profile.joint_limits[leg]
        return np.asarray(((q >= limits[:, 0]) & (q <= limits[:, 1])).all(axis=-1))

    def _unmet(self, end: Array, feet: Array, swing: NDArray[np.bool_]) -> NoStep | None:
        """Return which constraint the end of a step does not meet (section 6.2.3), or None."""
        feet_body = apply(inverse(end), feet)
        q = body_inverse(self._profile, feet_body)
        beyond = np.flatnonzero(~within_limits(self._profile, q).all(axis=1))
        if beyond.size:
            return NoStep("its foot would be out of reach at the end of the step", int(beyond[0]))
        if support_margin(feet_body[swing, :2], resting_centre_of_mass(self._profile)[:2]) < 0.0:
            return NoStep("the centre of mass would be outside of the triangle of the feet that stand next")
        return None


def swinging(along: Array, feet: Array, rest: Array) -> NDArray[np.bool_] | None:
    """Return the legs (6,) that swing, None without a direction.

    Args:
        along: (2,) {body} direction of motion.
        feet: (6, 3) [m] {body} feet.
        rest: (6, 3) [m] {body} resting feet.

    Source: eq. (5.15) and (5.16), with the legs around the body.
    """
    if not np.any(along):
        return None
    middles = rest[:, :2] / np.linalg.norm(rest[:, :2], axis=1, keepdims=True)
    active = int(np.argmax(middles @ along))
    stretched = bool(np.linalg.norm(feet[active, :2]) > np.linalg.norm(rest[active, :2]))
    return np.asarray((np.arange(6) - active) % 2 == int(stretched))


def first_place(
    terrain: TerrainMap, xy: Array, reached: Callable[[Array], NDArray[np.bool_]] = lambda places: np.full(len(places), True)
) -> Array | None:
    """Return the first cell (3,) [m] {world} with a valid score that is reached, or None.

    The search goes in squares that grow around a place (2,) [m] {world}.

    Source: sections 6.2.3 and 6.3.
    """
    cells = np.rint((xy - terrain.origin) / terrain.resolution).astype(int) + squares(round(_SEARCH_M / terrain.resolution))
    cells = cells[((cells >= 0) & (cells < terrain.score.shape)).all(axis=1)]
    cells = cells[terrain.score[tuple(cells.T)] <= 1.0]  # NaN is unknown
    places = np.column_stack([terrain.origin + terrain.resolution * cells, terrain.elevation[tuple(cells.T)]])
    places = places[reached(places)]
    return places[0] if len(places) else None


def floor_height(ground: Array) -> float:
    """Return the mean of the three highest of (6,) [m] {world} targets (section 6.4)."""
    return float(np.sort(ground)[-3:].mean())


def squares(n: int) -> NDArray[np.intp]:
    """Return the cells (m, 2) around one, square by square up to n cells away."""
    offsets = np.stack(np.meshgrid(*2 * [np.arange(-n, n + 1)], indexing="ij"), -1).reshape(-1, 2)
    return np.asarray(offsets[np.argsort(np.abs(offsets).max(axis=1), kind="stable")])


def _level(T_world_body: Array) -> Array:
    """Return a pose (4, 4) without its lean."""
    return from_xyz_rpy(T_world_body[:3, 3], (0.0, 0.0, yaw_of(T_world_body)))


def _moved(T_world_body: Array, travel: Array, turn: float) -> Array:
    """Return a level pose (4, 4) after a travel (2,) [m] {body} and a turn [rad]."""
    return np.asarray(T_world_body @ from_xyz_rpy((*travel, 0.0), (0.0, 0.0, turn)))


def _highest_under(terrain: TerrainMap, T_world_body: Array, size: tuple[float, float, float]) -> float:
    """Return the highest known ground [m] {world} under the body's rectangle; minus infinity if none is known."""
    nx, ny = terrain.elevation.shape
    x = terrain.origin[0] + terrain.resolution * np.arange(nx)
    y = terrain.origin[1] + terrain.resolution * np.arange(ny)
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((nx, ny))], -1).reshape(-1, 3)
    inside = (np.abs(apply(inverse(T_world_body), points)[:, :2]) <= np.array(size[:2]) / 2).all(axis=1)
    under = terrain.elevation.reshape(-1)[inside]
    return float(np.nanmax(under, initial=-np.inf)) if under.size else -np.inf
