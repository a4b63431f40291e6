"""One step of the walk: footholds for the swinging tripod and a place for the body, or the reason why there is none."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.planner.body import clear_of_ground, floor_height, leaning, slope_under
from services.planner.config import Settings
from services.planner.foothold import Foothold, NoFoothold, nearest_foothold, offsets_by_distance
from services.planner.gait import nominal_touchdowns
from services.planner.terrain import Terrain
from shared.geometry import Array, apply, from_xyz_rpy, inverse, rotation_z, yaw_of
from shared.kinematics import body_inverse, leg_inverse, within_limits
from shared.messages import VelocityCommand
from shared.robot import LEGS, RobotProfile
from shared.stability import support_margin

SHARES = (1.0, 0.7, 0.45, 0.25)  # of the commanded travel that are tried when the whole does not work
_DESCENT = np.array([0.0, 0.0, 0.03])  # [m] over a foothold, from where a foot comes straight down
_MAX_CLEARANCE = 0.11  # [m] over both ends that a leg can lift its foot
_STOOPS = np.arange(7) * 0.005  # [m] by which the body may be lower than commanded
_LEANS = np.arange(5)[:, None] * 0.25  # share of the ground's slope by which it may lean
_REACH_SPARE = np.array([0.0, 0.0, 0.005])  # [m] by which a standing foot may turn out to be lower than believed


@dataclass(frozen=True, slots=True)
class Situation:
    """Where the robot will be when the step begins, all feet standing."""

    T_world_body: Array  # (4, 4) where the body should be
    feet: Array  # (6, 3) [m] {world} foot centres
    swing: NDArray[np.bool_]  # (6,) legs that are to swing
    command: VelocityCommand


@dataclass(frozen=True, slots=True)
class Stride:
    """A step that can be walked."""

    swing: NDArray[np.bool_]
    touchdown: Array  # (6, 3) [m] {world} foot centres
    nominal: Array  # (6, 2) [m] {world} where swinging feet would land on unobstructed ground
    clearance: Array  # (6,) [m]
    body_goal: Array  # (4, 4) {world}
    moved: int  # footholds away from their nominal place
    share: float  # of the commanded travel


@dataclass(frozen=True, slots=True)
class Blocked:
    """Why there is no step, in words."""

    reason: str
    leg: int = -1  # the leg it fails for, -1 for the whole robot


class StridePlanner:
    """Plans steps for one robot; it keeps only tables."""

    def __init__(self, profile: RobotProfile, settings: Settings, resolution: float = 0.01):
        """Prepare the search order.

        Args:
            profile: The robot.
            settings: Of the planner.
            resolution: [m] cell edge of the maps to come.
        """
        self._profile = profile
        self._settings = settings
        self._foot_up = np.array([0.0, 0.0, profile.foot.radius])  # [m] from the ground to a foot's centre
        self._offsets = offsets_by_distance(settings.search_radius, resolution)

    def plan(self, at: Situation, terrain: Terrain, passed_over: int = 0) -> Stride | Blocked:
        """The longest step towards the command that the terrain allows, the longest few passed over."""
        first: Blocked | None = None
        for share in SHARES[passed_over:]:
            found = self._attempt(at, terrain, share)
            if isinstance(found, Stride):
                return found
            first = first or found
        assert first is not None
        return first

    def retarget(self, stride: Stride, terrain: Terrain) -> Stride:
        """The same step with its touchdowns chosen anew on a newer map; a leg that finds nothing better keeps its own."""
        touchdown = stride.touchdown.copy()
        for leg in np.flatnonzero(stride.swing).tolist():
            ground = self._foothold(leg, stride.nominal[leg], touchdown, stride.body_goal, stride.body_goal, terrain)
            if not isinstance(ground, NoFoothold):
                touchdown[leg] = ground.p_world + self._foot_up
        return replace(stride, touchdown=touchdown)

    def _attempt(self, at: Situation, terrain: Terrain, share: float) -> Stride | Blocked:
        settings = self._settings
        travel, T_end, T_after = self._body_way(at, share)
        rest = self._profile.rest_feet(at.command.body_height)
        nominal = nominal_touchdowns(rest, T_end, travel)
        T_end, T_after = self._raised(at, terrain, T_end, T_after, nominal)

        touchdown, moved = at.feet.copy(), 0
        touchdown[at.swing] = np.nan
        for leg in np.flatnonzero(at.swing).tolist():
            found = self._foothold(leg, nominal[leg], touchdown, T_end, T_after, terrain)
            if isinstance(found, NoFoothold):
                return Blocked(f"{LEGS[leg]} leg: {found.reason}", leg)
            touchdown[leg] = found.p_world + self._foot_up
            moved += found.moved > terrain.map.resolution

        standing = ~at.swing
        problem = (
            self._unreachable(touchdown, T_end)
            or self._unstable(at.feet[standing], at.T_world_body, "where it is")
            or self._unstable(at.feet[standing], T_end, "at the end of the step")
            or self._unstable(touchdown[at.swing], T_end, "after the step")
        )
        if problem:
            return Blocked(problem)
        clearance = self._clearance(at, touchdown, terrain)
        too_high = np.flatnonzero(at.swing & (clearance > _MAX_CLEARANCE))
        if len(too_high):
            leg = int(too_high[0])
            return Blocked(f"{LEGS[leg]} leg: something on its way asks for {clearance[leg] * 100:.0f} cm of lift", leg)
        clearance = np.where(at.swing, clearance, settings.path_margin)
        return Stride(at.swing, touchdown, nominal, clearance, T_end, moved, share)

    def _body_way(self, at: Situation, share: float) -> tuple[Array, Array, Array]:
        """Travel (2,) [m] {body} of the step, and the body, level, at its end and one step later."""
        settings = self._settings
        duration = settings.step_s
        travel = at.command.velocity * duration
        travel = travel * (share * min(1.0, settings.max_stride / max(float(np.linalg.norm(travel)), 1e-9)))
        limit = np.radians(settings.max_turn_deg)
        turn = share * float(np.clip(at.command.yaw_rate * duration, -limit, limit))
        poses = []
        yaw, position = yaw_of(at.T_world_body), at.T_world_body[:3, 3].copy()
        for _ in range(2):
            position[:2] += rotation_z(yaw + turn / 2)[:2, :2] @ travel
            yaw += turn
            poses.append(from_xyz_rpy(position, (0.0, 0.0, yaw)))
        return travel, poses[0], poses[1]

    def _raised(self, at: Situation, terrain: Terrain, T_end: Array, T_after: Array, nominal: Array) -> tuple[Array, Array]:
        """The same poses at the height over the floor that is commanded, climbing no faster than the robot can.

        Where the standing legs would not reach the ground from there, the body is lower or leans with the ground, no more than
        it takes.
        """
        ground = at.feet[:, 2] - self._profile.foot.radius
        ahead = terrain.footing(nominal)
        ground = np.where(at.swing & np.isfinite(ahead), ahead, ground)
        floor = clear_of_ground(floor_height(ground), terrain, T_end, self._profile.body.size)
        now = at.T_world_body[2, 3]
        climb = self._settings.max_climb
        height = float(np.clip(floor + at.command.body_height, now - climb, now + climb))
        T_end, T_after = T_end.copy(), T_after.copy()
        T_end[2, 3] = T_after[2, 3] = height
        stance = np.column_stack([np.where(at.swing[:, None], nominal, at.feet[:, :2]), ground])
        lean, stoop = self._posture(at, T_end, stance, floor)
        return leaning(T_end, lean, stoop), leaning(T_after, lean, stoop)

    def _posture(self, at: Situation, T_end: Array, stance: Array, floor: float) -> tuple[Array, float]:
        """Lean (2,) [rad], roll and pitch, and stoop [m] of the body at the end of a step.

        Args:
            at: Where the robot will be when it begins.
            T_end: (4, 4) the body at its end, level and as high as commanded.
            stance: (6, 3) [m] {world} ground under the feet when they have landed.
            floor: [m] {world} height of the ground that counts.

        Returns:
            Level and as commanded where the standing legs reach the ground so, or none helps; else the first that does.
        """
        if self._within_limits(at.feet, T_end)[~at.swing].all():
            return np.zeros(2), 0.0
        slope = slope_under(stance, T_end)
        most = min(1.0, np.radians(self._settings.max_lean_deg) / max(float(np.linalg.norm(slope)), 1e-9))
        lowest = floor + self._profile.stance.body_height_range[0]
        stoops = _STOOPS[(_STOOPS == 0.0) | (T_end[2, 3] - _STOOPS >= lowest)].tolist()
        feet = at.feet - _REACH_SPARE
        for lean in _LEANS * most * slope:
            for stoop in stoops:
                if self._within_limits(feet, leaning(T_end, lean, stoop))[~at.swing].all():
                    return lean, stoop
        return np.zeros(2), 0.0

    def _foothold(
        self, leg: int, nominal: Array, feet: Array, T_end: Array, T_after: Array, terrain: Terrain
    ) -> Foothold | NoFoothold:
        """The nearest foothold of one leg, given where the other feet (6, 3) [m] {world} are, NaN where not known yet."""
        others = np.delete(feet, leg, axis=0)[:, :2]
        others = others[np.isfinite(others[:, 0])]

        def reachable(points: Array) -> NDArray[np.bool_]:
            feet_world = points + self._foot_up
            from_above = self._reaches(leg, feet_world + _DESCENT, T_end)  # a folded leg comes down further out
            return from_above & self._reaches(leg, feet_world, T_end) & self._reaches(leg, feet_world, T_after)

        return nearest_foothold(terrain, nominal, self._offsets, others, self._settings.min_foot_distance, reachable)

    def _reaches(self, leg: int, feet_world: Array, T_world_body: Array) -> NDArray[np.bool_]:
        """Which of (n, 3) [m] {world} foot centres one leg reaches from a body pose."""
        profile = self._profile
        q = leg_inverse(apply(profile.T_coxa_body[leg] @ inverse(T_world_body), feet_world), profile.links)
        limits = profile.joint_limits[leg]
        return np.asarray(((q >= limits[:, 0]) & (q <= limits[:, 1])).all(axis=1))  # NaN, out of reach, is in no limits

    def _within_limits(self, feet_world: Array, T_world_body: Array) -> NDArray[np.bool_]:
        """Which legs (6,) have their feet (6, 3) [m] {world} in reach."""
        q = body_inverse(self._profile, apply(inverse(T_world_body), feet_world))
        return np.asarray(within_limits(self._profile, q).all(axis=1))

    def _unreachable(self, feet_world: Array, T_world_body: Array) -> str:
        """Which leg would be overstretched at the end of the step, in words, or nothing."""
        bad = np.flatnonzero(~self._within_limits(feet_world, T_world_body))
        return f"{LEGS[bad[0]]} leg: would be stretched beyond its limits at the end of the step" if len(bad) else ""

    def _unstable(self, feet: Array, T_world_body: Array, when: str) -> str:
        margin = support_margin(feet[:, :2], T_world_body[:2, 3])
        if margin >= self._settings.min_margin:
            return ""
        needed = f"{self._settings.min_margin * 100:.1f} cm needed"
        return f"the body would be {margin * 100:.1f} cm inside its three feet {when}, {needed}"

    def _clearance(self, at: Situation, touchdown: Array, terrain: Terrain) -> Array:
        """Clearance (6,) [m] over both ends: over what lies between them, too, and more where the ground is rough."""
        settings = self._settings
        start, end = at.feet[:, 2] - self._profile.foot.radius, touchdown[:, 2] - self._profile.foot.radius
        higher, lower = np.maximum(start, end), np.minimum(start, end)
        between = terrain.highest_along(at.feet[:, :2], touchdown[:, :2])
        rough = np.maximum(higher, between) - lower > settings.uneven
        lift = np.where(rough, max(at.command.lift, settings.rough_lift), at.command.lift)
        return np.maximum(lift, between - higher + settings.path_margin)
