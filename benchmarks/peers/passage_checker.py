"""Check plans for a passage independently of the planner that made them.

The checks use trigonometry, dense sampling in time, and the actuator's own swing trajectory. From the search, they use
only the resulting steps. They demand the documented rules; the search itself keeps slightly larger margins. Sources:
Masri 2016, Table 3.2, sections 5.1.1, 5.2.1 and 5.4. Rules that the thesis leaves out are marked where they occur.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.locomotion.swing_trajectory import Swing
from sextant.services.planner.roadmap.roadmap import PassageStep, Stance
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import Array, apply, rotation_z
from sextant.shared.robot.kinematics import body_inverse, joint_torques, leg_nearest_reachable, leg_points
from sextant.shared.robot.profile import GRAVITY, JOINTS, LEGS, RobotProfile
from sextant.shared.robot.stability import resting_centre_of_mass, support_margin

_TIMES = 31  # samples per step
_ALONG = np.linspace(0.0, 1.0, 13)  # positions along a link for distances between links
_ROUNDING = 1e-6
_MOVED = 1e-3  # [m] tolerated distance of a touchdown beyond reach
_SMALL_TURN = 1e-6  # [rad]


@dataclass(frozen=True, slots=True)
class Demands:
    """Required margins of a plan."""

    margin: float = 0.03  # [m] stability margin: 2 cm, if feet are off by 1 cm
    legs_apart: float = 0.04  # [m] between the centre lines of femurs and tibias of neighbouring legs
    body_clear: float = 0.02  # [m] between the trunk and the ground
    leg_clear: float = 0.01  # [m] between knees or upper shanks and the ground
    swing_clear: float = 0.02  # [m] between a swinging foot and the ground, less within 6 cm of both its ends
    torque: float = 0.6  # share of the stall torque
    worst_foothold: int = -1  # [cells] highest accepted value of the evaluation function
    body_step: float = 0.055  # [m] maximum body motion in one step


def violations(
    profile: RobotProfile, field: StripMap, start: Stance, steps: Sequence[PassageStep], demands: Demands | None = None
) -> list[str]:
    """Return the violations of a plan as text; empty for a valid plan.

    Args:
        profile: The robot.
        field: The strip on which the steps were planned.
        start: The initial stance. Its feet are not checked.
        steps: The plan.
        demands: The required margins.
    """
    check = _Check(profile, field, demands or Demands())
    out: list[str] = []
    body, yaw, feet, planned = start.body.copy(), start.yaw, start.feet.copy(), np.zeros(6, dtype=bool)
    for number, step in enumerate(steps):
        if not (np.isfinite(step.body).all() and np.isfinite(step.touchdown).all() and -1 <= step.leg < len(LEGS)):
            return [*out, f"step {number + 1}: none that could be taken"]
        found = [*check.step(body, yaw, feet, planned, step)]
        out += [f"step {number + 1}: {words}" for words in dict.fromkeys(found)]
        body, yaw = step.body, step.yaw
        if step.leg >= 0:
            feet[step.leg], planned[step.leg] = step.touchdown, True
    return out


class _Check:
    """All checks of one step."""

    def __init__(self, profile: RobotProfile, field: StripMap, demands: Demands):
        self._profile, self._field, self._demands = profile, field, demands

    def step(self, body: Array, yaw: float, feet: Array, planned: NDArray[np.bool_], step: PassageStep) -> Iterator[str]:
        """Yield the violations of a step.

        It begins with the body at (3,) [m] and yaw [rad] {strip}, and feet at (6, 3) [m] {strip}; `planned` marks feet that
        the plan has placed.
        """
        swing = np.arange(6) == step.leg
        if np.linalg.norm((step.body - body)[:2]) > self._demands.body_step:
            yield f"the body moves {np.linalg.norm((step.body - body)[:2]):.3f} m"
        if swing.any():
            yield from self._touchdown(feet, step)
        time = np.linspace(0.0, 1.0, _TIMES)
        # The body moves at constant speed between joined steps, or starts and stops with each: check both.
        for share in (time, time**2 * (3.0 - 2.0 * time)):
            bodies = body + share[:, None] * (step.body - body)
            placed = np.repeat(feet[None], _TIMES, axis=0)
            if swing.any():
                placed[:, step.leg] = _flown(feet[step.leg], step)
            headings = rotation_z(yaw + share * (step.yaw - yaw))
            yield from self._motion(bodies, headings, placed, swing, planned)

    def _touchdown(self, feet: Array, step: PassageStep) -> Iterator[str]:
        """Check a touchdown: on known good ground, at its height, away from other feet."""
        name, field = LEGS[step.leg], self._field
        i, j = np.rint((step.touchdown[:2] - field.first_cell) / field.resolution).astype(int).tolist()
        nx, ny = field.evaluation.shape
        if not (0 <= i < nx and 0 <= j < ny):
            yield f"{name} foot outside the strip"
            return
        if not -127 <= field.evaluation[i, j] <= self._demands.worst_foothold:
            yield f"{name} foot on a cell of value {field.evaluation[i, j]}"
        sole = step.touchdown[2] - self._profile.foot.radius
        if not abs(sole - field.elevation[i, j]) < 1e-3:
            yield f"{name} foot {sole - field.elevation[i, j]:+.3f} m over the ground"
        others = np.delete(feet, step.leg, axis=0)
        gap = float(np.linalg.norm((others - step.touchdown)[:, :2], axis=1).min())
        if gap < self._profile.stance.foot_distance - _ROUNDING:
            yield f"{name} foot {gap:.3f} m from another"
        if not 0.0 <= step.clearance <= self._profile.stance.max_lift + _ROUNDING:
            yield f"a clearance of {step.clearance:.3f} m"

    def _motion(
        self, bodies: Array, headings: Array, feet: Array, swing: NDArray[np.bool_], planned: NDArray[np.bool_]
    ) -> Iterator[str]:
        """Check bodies (n, 3), their rotations (n, 3, 3) and feet (n, 6, 3) [m] {strip} during a step."""
        profile, demands = self._profile, self._demands
        local = (feet - bodies[:, None]) @ headings
        for leg in np.flatnonzero(swing):  # as the actuator executes swings
            T, back = profile.T_coxa_body[leg], profile.T_body_coxa[leg]
            wanted = local[:, leg].copy()
            local[:, leg] = apply(back, leg_nearest_reachable(apply(T, wanted), profile.leg_reach[leg], profile.links))
            if np.linalg.norm(local[-1, leg] - wanted[-1]) > _MOVED:
                yield f"{LEGS[leg]} leg: its touchdown is out of reach"
        q = body_inverse(profile, local)
        yield from self._joints(q, swing, planned)
        yield from self._places(local, swing, planned)
        standing = feet[0][~swing]
        centre = resting_centre_of_mass(profile)
        centres = bodies + headings @ centre
        margin = min(support_margin(standing[:, :2], centre[:2]) for centre in centres)
        if margin < demands.margin - _ROUNDING:
            yield f"the centre of mass {margin * 1e3:.0f} mm inside its standing feet"
        yield from self._torques(q, local, swing)
        yield from self._trunk(bodies, headings)
        if np.isnan(q).any():
            return  # reported already
        points = leg_points(profile, q) @ np.swapaxes(headings, 1, 2)[:, None] + bodies[:, None, None]
        yield from self._distances(points)
        yield from self._over_ground(points, np.flatnonzero(swing))

    def _joints(self, q: Array, swing: NDArray[np.bool_], planned: NDArray[np.bool_]) -> Iterator[str]:
        """Check joint limits: Masri 2016, eq. (3.14)-(3.16).

        A foot of the initial stance may be slightly beyond its limits.
        """
        limits = self._profile.joint_limits
        for leg in range(6):
            spare = _SMALL_TURN if planned[leg] or swing[leg] else np.radians(0.5)
            ok = (q[:, leg] >= limits[leg, :, 0] - spare) & (q[:, leg] <= limits[leg, :, 1] + spare)
            first = 0 if planned[leg] or not swing[leg] else 1
            if not ok[first:].all():
                when, joint = np.argwhere(~ok[first:])[0]
                angle = np.degrees(q[first + when, leg, joint])
                yield f"{LEGS[leg]} leg: {JOINTS[joint]} at {angle:.1f} deg, {'swinging' if swing[leg] else 'standing'}"

    def _places(self, local: Array, swing: NDArray[np.bool_], planned: NDArray[np.bool_]) -> Iterator[str]:
        """Check foot regions (5.1.1, 5.2.1).

        No foot is under the body. Front feet are in front of the body's front axes, rear feet behind the rear ones.
        """
        length, width, _ = self._profile.body.size
        mounts = self._profile.T_body_coxa[:, 0, 3]
        for leg in range(6):
            if not (planned[leg] or swing[leg]):
                continue
            stands = local[-1:, leg] if swing[leg] else local[:, leg]
            if ((np.abs(stands[:, 0]) < length / 2 - _ROUNDING) & (np.abs(stands[:, 1]) < width / 2 - _ROUNDING)).any():
                yield f"{LEGS[leg]} foot under the body"
            ahead = np.sign(mounts[leg]) * (stands[:, 0] - mounts[leg])
            if abs(mounts[leg]) > length / 4 and (ahead < -_ROUNDING).any():
                yield f"{LEGS[leg]} foot beyond its axis by {-ahead.min():.3f} m"

    def _torques(self, q: Array, local: Array, swing: NDArray[np.bool_]) -> Iterator[str]:
        """Check static torques of the standing legs.

        The legs share the weight: the forces are the least-squares solution of the balance.
        """
        most = self._demands.torque * self._profile.servos.stall_torque  # (6, 3)
        weight = self._profile.body.total_mass * GRAVITY
        for k in (0, len(q) - 1):
            places = local[k][~swing]
            balance = np.vstack([np.ones(len(places)), places[:, 0], places[:, 1]])
            share = np.linalg.lstsq(balance, np.array([weight, 0.0, 0.0]), rcond=None)[0]
            forces = np.zeros((6, 3))
            forces[~swing, 2] = np.maximum(share, 0.0)
            torques = np.abs(joint_torques(self._profile, np.nan_to_num(q[k]), forces))
            if (torques > most + 1e-3).any():
                leg, joint = (int(n) for n in np.unravel_index(int((torques - most).argmax()), torques.shape))
                yield f"{LEGS[leg]} leg: {torques[leg, joint]:.2f} N m at the {JOINTS[joint]}"

    def _distances(self, points: Array) -> Iterator[str]:
        """Check distances between femurs and tibias (n, 6, 4, 3) of neighbouring legs.

        Points along the links of one leg are compared with the links of the other.
        """
        for leg in range(6):
            other = (leg + 1) % 6
            gap = min(_nearest(points[:, a, 1:], points[:, b, 1:]) for a, b in ((leg, other), (other, leg)))
            if gap < self._demands.legs_apart:
                yield f"{LEGS[leg]} and {LEGS[other]} legs {gap:.3f} m apart"

    def _trunk(self, bodies: Array, headings: Array) -> Iterator[str]:
        """Check the clearance of the trunk above the map."""
        length, width, height = self._profile.body.size
        along, across = (
            np.linspace(-size / 2, size / 2, 1 + round(2 * size / self._field.resolution)) for size in (length, width)
        )
        x, y = np.meshgrid(along, across, indexing="ij")
        for k in (0, len(bodies) // 2, -1):
            body, (ahead, left, _) = bodies[k], headings[k].T
            under = self._ground(body[0] + ahead[0] * x + left[0] * y, body[1] + ahead[1] * x + left[1] * y)
            if body[2] - height / 2 - under.max() < self._demands.body_clear - _ROUNDING:
                yield f"the trunk {body[2] - height / 2 - under.max():.3f} m over the ground"

    def _over_ground(self, points: Array, legs: NDArray[np.intp]) -> Iterator[str]:
        """Check the clearance of the legs and of the swinging foot above the map."""
        shank = (
            points[:, :, 3, None] + np.array([0.35, 0.5, 0.75, 1.0])[:, None] * (points[:, :, 2] - points[:, :, 3])[:, :, None]
        )
        gaps = shank[..., 2] - self._ground(shank[..., 0], shank[..., 1])
        if gaps.min() < self._demands.leg_clear - _ROUNDING:
            leg = int(np.argwhere(gaps == gaps.min())[0, 1])
            yield f"{LEGS[leg]} leg: its shank {gaps.min():.3f} m over the ground"
        for leg in legs:
            way = points[:, leg, 3]
            off = np.minimum(*(np.linalg.norm((way - end)[:, :2], axis=1) for end in (way[0], way[-1])))
            gap = way[:, 2] - self._profile.foot.radius - self._ground(way[:, 0], way[:, 1])
            short = gap - np.minimum(self._demands.swing_clear, 0.5 * off - 0.01)
            if short.min() < -_ROUNDING:
                at = int(short.argmin())
                yield f"{LEGS[leg]} foot passes {gap[at]:.3f} m over the ground, {off[at]:.3f} m from its end"

    def _ground(self, x: Array, y: Array) -> Array:
        """Return the height [m] of the ground under points.

        It is -inf where the ground is unknown, and outside the strip.
        """
        h, (x0, y0), resolution = self._field.elevation, self._field.first_cell, self._field.resolution
        i, j = np.rint((x - x0) / resolution).astype(int), np.rint((y - y0) / resolution).astype(int)
        inside = (i >= 0) & (j >= 0) & (i < h.shape[0]) & (j < h.shape[1])
        found = h[np.where(inside, i, 0), np.where(inside, j, 0)].astype(np.float64)
        return np.where(inside & np.isfinite(found), found, -np.inf)


def _nearest(one: Array, other: Array) -> float:
    """Return the least distance [m] between points on links and two other links.

    Links are (n, 3, 3) points, connected end to end.
    """
    places = (one[:, :2, None] + _ALONG[:, None] * (one[:, 1:] - one[:, :2])[:, :, None]).reshape(len(one), -1, 1, 3)
    begin, way = other[:, None, :2], (other[:, 1:] - other[:, :2])[:, None]
    share = np.clip(((places - begin) * way).sum(axis=-1) / (way * way).sum(axis=-1), 0.0, 1.0)
    return float(np.linalg.norm(begin + share[..., None] * way - places, axis=-1).min())


def _flown(foot: Array, step: PassageStep) -> Array:
    """Return foot positions (n, 3) [m] {strip} of the actuator's swing trajectory."""
    target = step.touchdown[None]
    swing = Swing(foot[None], target, np.array([step.clearance]))
    dt = 1.0 / (_TIMES - 1)
    return np.array([foot, *(swing.update(target, k * dt, dt)[0].copy() for k in range(_TIMES - 1))])
