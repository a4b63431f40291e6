"""Plan one step: footholds and body pose, or the reason why there is none."""

from collections.abc import Set
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.compiled_terrain import GOOD, NONE
from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion.body_pose import clear_of_ground, floor_height, leaning, slope_under
from sextant.services.planner.locomotion.foothold_search import FootholdFinder, NoFoothold
from sextant.services.planner.locomotion.gait import (
    Pace,
    directions,
    extrapolate_pose,
    gait_of,
    nominal_touchdowns,
    swing_order,
)
from sextant.services.planner.locomotion.leg_collision import LegCollision, StepMotion, find_clearances
from sextant.services.planner.locomotion.params import StepParams
from sextant.services.planner.locomotion.swing_clearance import swing_clearance
from sextant.services.planner.locomotion.swing_motion import shortest_swing_s
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, rpy_from_rotation, yaw_of
from sextant.shared.robot.kinematics import reaches
from sextant.shared.robot.profile import LEGS, RobotProfile
from sextant.shared.robot.stability import resting_centre_of_mass, support_margin
from sextant.shared.wire.messages import VelocityCommand

# Shares of the commanded travel, tried in this order. At a ditch with both front feet at its edge, a long step brings the foot
# that stays too near its coxa axis, and a short one finds no foothold across.
SHARES = (1.0, 0.7, 0.45, 0.35, 0.25)
_STOOPS = np.arange(7) * 0.005  # [m] by which the body may be lower than commanded
_LEANS = np.array([0.0, 0.25, 0.5, 0.75, 1.0])  # shares of the ground's slope by which the body may lean
_ASIDE, _AROUND = (0.02, 0.04, 0.06), np.arange(8) * np.pi / 4  # [m] and [rad] of body shifts that make room for a leg


@dataclass(frozen=True, slots=True)
class StepStart:
    """Robot at the start of the step, all feet standing."""

    T_world_body: Array  # (4, 4) reference body pose
    feet: Array  # (6, 3) [m] {world} foot centres
    swing: NDArray[np.bool_]  # (6,) legs that will swing
    command: VelocityCommand
    pace: Pace | None = None  # of the step; None: that of the stance
    number: int = 0  # of the step since the actuator started


@dataclass(frozen=True, slots=True)
class PlannedStep:
    """A feasible step."""

    swing: NDArray[np.bool_]
    touchdown: Array  # (6, 3) [m] {world} foot centres
    nominal: Array  # (6, 2) [m] {world} touchdowns on unobstructed ground
    clearance: Array  # (6,) [m]
    body_goal: Array  # (4, 4) {world}
    body_after: Array  # (4, 4) {world} body pose when the swinging feet will leave their touchdowns
    start: Array  # (6, 3) [m] {world} foot centres before the step
    moved: int  # number of footholds away from their nominal place
    share: float  # share of the commanded travel
    duration: float  # [s]
    room: float  # suitability of its poorest foothold, see `Terrain.suitability`
    instead: str = ""  # why legs that are due earlier do not take the step

    def moved_by(self, T: Array) -> "PlannedStep":
        """Return the step after a correction (4, 4) of the {world} estimate."""
        nominal = apply(T, np.column_stack([self.nominal, self.touchdown[:, 2]]))[:, :2]
        touchdown, start = apply(T, self.touchdown), apply(T, self.start)
        goal, after = T @ self.body_goal, T @ self.body_after
        return replace(self, touchdown=touchdown, nominal=nominal, body_goal=goal, body_after=after, start=start)


@dataclass(frozen=True, slots=True)
class NoStep:
    """Reason why there is no step."""

    reason: str
    leg: int = -1  # the leg that fails, -1 for the whole robot
    unseen: bool = False  # the ground for that leg is unseen
    touching: bool = False  # the leg would touch the ground next to it as it rises or passes


class StepPlanner:
    """Plans steps for one robot; it keeps only lookup tables."""

    def __init__(self, profile: RobotProfile, settings: Settings | None = None):
        """Initialize for a robot; without settings with the default ones."""
        settings = settings or Settings()
        self._profile = profile
        self._params = settings.step
        self._footholds = FootholdFinder(profile, settings.step)
        self._foot_up = np.array([0.0, 0.0, profile.foot.radius])  # [m] from the ground to a foot's centre

    def validation_error(self, command: VelocityCommand) -> str:
        """Return why this robot can never execute a command, or ""."""
        low, high = self._profile.stance.body_height_range
        if not low <= command.body_height <= high:
            return f"a body height of {low:g} to {high:g} m expected, {command.body_height:g} m commanded"
        highest = self._profile.stance.max_lift
        if not 0.0 < command.lift <= highest:
            return f"a lift of more than 0 and at most {highest:g} m expected, {command.lift:g} m commanded"
        return ""

    def duration(self, command: VelocityCommand, pace: Pace | None = None) -> float:
        """Return the duration [s] of a step in the commanded gait.

        A step whose feet must go high takes longer.
        """
        return (self._profile.stance.step_s if pace is None else pace.step_s) * gait_of(command.gait).pace

    def describe(self, planned: PlannedStep) -> str:
        """Return how many feet go elsewhere than to their nominal place, as text."""
        if not planned.swing.any():
            return "moving only the body, to make room for a leg"
        return f"{planned.moved} of {planned.swing.sum()} footholds moved from their nominal place"

    def describe_slowdown(self, command: VelocityCommand, stride: PlannedStep) -> str:
        """Return by how much a step is slower than commanded, as text, or "".

        The limits are the reach and the speed of the legs.
        """
        asked = float(np.linalg.norm(command.velocity))
        reached = float(np.linalg.norm(self._travel(command, 1.0)[0])) / stride.duration
        if reached > asked - 1e-3:
            return ""
        limits = f"leg reach and joint speed in the {command.gait} gait"
        return f", speed limited to {reached * 100:.1f} of {asked * 100:.1f} cm/s ({limits})"

    def plan(
        self,
        at: StepStart,
        terrain: Terrain,
        refused: Set[int] = frozenset(),
        width: float = 1.0,
        foot_margin: float | None = None,
    ) -> PlannedStep | NoStep:
        """Return the longest step in the commanded direction onto good footholds.

        If no step has good footholds only, return the one whose poorest foothold is the most suitable.

        Args:
            at: Start of the step.
            terrain: The map.
            refused: Indices into `SHARES` that must not be tried.
            width: Factor of the robot's search radius for footholds, 1 or `wide_search_ratio`.
            foot_margin: [m] between the ground and a foot that a folded leg pushes aside; default `sink_margin_m`.
        """
        foot_margin = self._params.sink_margin_m if foot_margin is None else foot_margin
        best: PlannedStep | None = None
        first: NoStep | None = None
        for number, share in enumerate(SHARES):
            if number in refused:
                continue
            found = self._attempt(at, terrain, share, width, foot_margin)
            if isinstance(found, NoStep):
                first = first or found
            elif best is None or found.room > best.room:
                best = found
            if best is not None and best.room >= self._params.room_enough:
                break
        return best or first or NoStep("the actuator refused every step")

    def choose(
        self, situations: list[StepStart], terrain: Terrain, refused: Set[int] = frozenset()
    ) -> tuple[PlannedStep | NoStep, int]:
        """Return the next step and the number of its way, or why there is none.

        The reason is that of the most due legs. The order of attempts is:

        1. All situations with the narrow foothold search, then all with the wide one. A wider search helps at a ditch, but
           costs time on rubble, where long reaches are slow.
        2. A shift of the body alone to where a leg has room, if that leg would touch the ground.
        3. As 1, but a folded leg may push its foot against the ground next to it.

        Ways are numbered by situation, and within a situation by share of the travel. The shift has the last number.

        Args:
            situations: Possible starts of the step, the most due legs first.
            terrain: The map.
            refused: Ways that must not be tried.
        """
        first: NoStep | None = None
        for foot_margin in (self._params.sink_margin_m, -np.inf):
            for width, (turn, at) in product(self._footholds.widths, enumerate(situations)):
                ways = range(turn * len(SHARES), (turn + 1) * len(SHARES))
                found = self.plan(at, terrain, {way - ways[0] for way in refused if way in ways}, width, foot_margin)
                if isinstance(found, PlannedStep):
                    return replace(found, instead=first.reason if first else ""), ways[SHARES.index(found.share)]
                first = first or found
            shift = len(situations) * (len(SHARES) + 1)  # numbered after the ways of `gather`
            if first is not None and first.touching and foot_margin > -np.inf and shift not in refused:
                shifted = self._make_room(situations[0], first.leg, terrain)
                if shifted is not None:
                    return replace(shifted, instead=first.reason), shift
        return first or NoStep("the actuator refused every step"), 0

    def _make_room(self, at: StepStart, leg: int, terrain: Terrain) -> PlannedStep | None:
        """Return a step of the body alone after which the legs of a situation can swing.

        The shift is the smallest one; among equals it is the one most directly away from the foot of `leg`.
        """
        body = at.T_world_body
        away = np.arctan2(*(body[:2, 3] - at.feet[leg, :2])[::-1])
        turns = _AROUND[np.argsort(np.abs((_AROUND + np.pi) % (2.0 * np.pi) - np.pi), kind="stable")]
        shift_s = self._params.shift_s
        for distance, turn in product(_ASIDE, turns):
            moved = body.copy()
            moved[:2, 3] += distance * np.array([np.cos(away + turn), np.sin(away + turn)])
            if not self.reached(at.feet, moved).all() or self._unstable(at.feet, moved, ""):
                continue
            if isinstance(self.plan(replace(at, T_world_body=moved), terrain), PlannedStep):
                nobody, low = np.zeros(6, dtype=np.bool_), np.full(6, self._params.path_margin_m)
                return PlannedStep(nobody, at.feet, at.feet[:, :2], low, moved, moved, at.feet, 0, 1.0, shift_s, GOOD)
        return None

    def gather(
        self, situations: list[StepStart], terrain: Terrain, refused: Set[int] = frozenset()
    ) -> tuple[PlannedStep | NoStep, int]:
        """Return a step on the spot that brings feet back under the body, and its number.

        Short steps towards unseen ground leave all legs stretched. Then no further step is possible, even once the ground is
        seen. Each step of this kind brings feet nearer to their resting places, so their number is limited.

        Args:
            situations: Possible starts of the step, the most due legs first.
            terrain: The map.
            refused: Ways that must not be tried; their numbers continue those of `choose`.
        """
        for way, at in enumerate(situations, len(SHARES) * len(situations)):
            if way in refused:
                continue
            found = self._attempt(at, terrain, 0.0, self._footholds.widths[0], self._params.sink_margin_m)
            if isinstance(found, PlannedStep):
                legs = found.swing
                before = np.linalg.norm((found.start[:, :2] - found.nominal)[legs], axis=1)
                after = np.linalg.norm((found.touchdown[:, :2] - found.nominal)[legs], axis=1)
                if before.sum() - after.sum() > self._params.gathered_m:
                    return found, way
        return NoStep("no step on the spot brings the feet closer to their rest positions"), 0

    def retarget(self, stride: PlannedStep, terrain: Terrain) -> PlannedStep:
        """Return the step with its touchdowns chosen again on a newer map.

        A leg keeps its touchdown if there is no other one, or if the other one needs more lift than the foot was given.
        """
        touchdown = stride.touchdown.copy()
        for leg in np.flatnonzero(stride.swing).tolist():
            ground = self._footholds.find(leg, stride.nominal[leg], touchdown, stride.body_goal, stride.body_after, terrain)
            if isinstance(ground, NoFoothold):
                continue
            moved = touchdown.copy()
            moved[leg] = ground.p_world + self._foot_up
            needed = swing_clearance(stride.start, moved, 0.0, self._profile, self._params, terrain)
            if needed[leg] <= stride.clearance[leg]:
                touchdown = moved
        return replace(stride, touchdown=touchdown)

    def _attempt(self, at: StepStart, terrain: Terrain, share: float, width: float, foot_margin: float) -> PlannedStep | NoStep:
        params = self._params
        gait = gait_of(at.command.gait)
        travel, turn = self._travel(at.command, share, at.pace)
        level = from_xyz_rpy(at.T_world_body[:3, 3], (0.0, 0.0, yaw_of(at.T_world_body)))
        T_end, T_middle, T_after = (
            extrapolate_pose(level, travel, turn, 1.0 + steps) for steps in (0.0, gait.stances / 2, float(gait.stances))
        )
        rest = self._profile.rest_feet(at.command.body_height)
        nominal = nominal_touchdowns(rest, T_middle)
        T_end, T_after = self._raised(at, terrain, T_end, T_after, nominal)

        touchdown, moved, room = at.feet.copy(), 0, GOOD
        touchdown[at.swing] = np.nan
        for leg in np.flatnonzero(at.swing).tolist():
            found = self._footholds.find(leg, nominal[leg], touchdown, T_end, T_after, terrain, width)
            if isinstance(found, NoFoothold):
                return NoStep(f"{LEGS[leg]} leg: {found.reason}", leg, found.unseen)
            touchdown[leg] = found.p_world + self._foot_up
            moved += found.moved > terrain.map.resolution
            room = min(room, found.room)

        standing = ~at.swing
        problem = (
            self._unreachable(touchdown, T_end)
            or self._unstable(at.feet[standing], at.T_world_body, "at the start of the step")
            or self._unstable(at.feet[standing], T_end, "at the end of the step")
            or self._unstable(touchdown[self._standing_next(at.command, touchdown, T_end)], T_end, "after the step")
        )
        if problem:
            return NoStep(problem)
        clearance = swing_clearance(at.feet, touchdown, at.command.lift, self._profile, params, terrain)
        too_high = np.flatnonzero(at.swing & (clearance > self._profile.stance.max_lift))
        if len(too_high):
            leg = int(too_high[0])
            (x, y), (x_end, y_end) = at.feet[leg, :2], touchdown[leg, :2]
            words = f"{LEGS[leg]} leg: to pass the ground between ({x:.2f}, {y:.2f}) and ({x_end:.2f}, {y_end:.2f}) m"
            highest_m = self._profile.stance.max_lift
            return NoStep(f"{words} its foot must rise {clearance[leg]:.2f} m, max_lift allows {highest_m:g} m", leg)
        way = StepMotion(at.feet, touchdown, at.T_world_body, T_end, at.swing)
        highest = self._profile.stance.max_lift
        lifted = find_clearances(way, clearance, params.leg_margin_m, foot_margin, highest, self._profile, terrain)
        if isinstance(lifted, LegCollision):
            return NoStep(lifted.reason, lifted.leg, touching=True)
        clearance = lifted
        clearance = np.where(at.swing, clearance, params.path_margin_m)
        dearer = np.where(clearance > at.command.lift, params.rough_height_cost, params.height_cost)
        foot_speed = at.pace.foot_speed if at.pace else None
        swinging = time_to_swing(self._profile, params, at.feet, touchdown, clearance, dearer, foot_speed)
        if at.pace:  # faster feet than the profile's: long swings must not be too fast for the servos
            bodies = at.T_world_body, T_end, params.max_joint_speed
            in_air = shortest_swing_s(self._profile, at.feet, touchdown, clearance, *bodies)
            usual = time_to_swing(self._profile, params, at.feet, touchdown, clearance, dearer)
            swinging = np.maximum(swinging, np.minimum(usual, params.handover_s + in_air))
        duration = max(self.duration(at.command, at.pace), swinging[at.swing].max())
        return PlannedStep(at.swing, touchdown, nominal, clearance, T_end, T_after, at.feet, moved, share, duration, room)

    def _travel(self, command: VelocityCommand, share: float, pace: Pace | None = None) -> tuple[Array, float]:
        """Return the body's travel (2,) [m] {body} and turn [rad] in a step.

        They are as commanded, limited by the reach of the legs.
        """
        params, gait = self._params, gait_of(command.gait)
        duration = self.duration(command, pace)
        travel = command.velocity * duration
        longest = self._profile.stance.stride / gait.stances
        travel = travel * (share * min(1.0, longest / max(float(np.linalg.norm(travel)), 1e-9)))
        limit = np.radians(params.max_turn_deg) / gait.stances
        return travel, share * float(np.clip(command.yaw_rate * duration, -limit, limit))

    def _standing_next(self, command: VelocityCommand, feet: Array, T_world_body: Array) -> NDArray[np.bool_]:
        """Return the legs (6,) that stand in the following step.

        The present step ends with feet (6, 3) [m] and body (4, 4), both in {world}.
        """
        rest = self._profile.rest_feet(command.body_height)
        along = directions(command.velocity, command.yaw_rate, rest)
        return ~swing_order(gait_of(command.gait), along, apply(inverse(T_world_body), feet), rest)[0]

    def _raised(self, at: StepStart, terrain: Terrain, T_end: Array, T_after: Array, nominal: Array) -> tuple[Array, Array]:
        """Return the poses at the commanded height over the floor, within the climb limit.

        If legs would not reach the ground from there, the body is lower or leans with the ground, as little as necessary.
        """
        ground = at.feet[:, 2] - self._profile.foot.radius
        ahead = terrain.footing(nominal)
        ground = np.where(at.swing & np.isfinite(ahead), ahead, ground)
        floor = clear_of_ground(floor_height(ground), terrain, T_end, self._profile.body.size)
        now = at.T_world_body[2, 3]
        climb = self._profile.stance.max_climb
        height = float(np.clip(floor + at.command.body_height, now - climb, now + climb))
        T_end, T_after = T_end.copy(), T_after.copy()
        T_end[2, 3] = T_after[2, 3] = height
        stance = np.column_stack([np.where(at.swing[:, None], nominal, at.feet[:, :2]), ground])
        # An unsuitable place does not justify a lower body.
        wanted = ~at.swing | (terrain.suitability(nominal) > NONE)
        lowest = max(floor + self._profile.stance.body_height_range[0], now - climb)
        leans, stoops = self._postures(at.T_world_body, slope_under(stance, T_end), height - lowest)
        feet = np.where(at.swing[:, None], stance + self._foot_up, at.feet)
        second_best: tuple[Array, Array] | None = None
        for some in (slice(1), slice(1, None)):  # mostly the first one will do
            ends, afters = leaning(T_end, leans[some], stoops[some]), leaning(T_after, leans[some], stoops[some])
            spare = np.where((stoops[some] > 0.0) | leans[some].any(axis=1), self._params.reach_margin_m, 0.0)
            wanted_feet = feet - spare[:, None, None] * np.array([0.0, 0.0, 1.0])
            reached = self.reached(wanted_feet, ends) & (self.reached(wanted_feet, afters) | ~at.swing)
            best, second = reached[:, wanted].all(axis=1), reached[:, ~at.swing].all(axis=1)
            if best.any():
                return ends[best.argmax()], afters[best.argmax()]
            if second_best is None and second.any():
                second_best = ends[second.argmax()], afters[second.argmax()]
        return second_best or (T_end, T_after)

    def _postures(self, T_world_body: Array, slope: Array, room: float) -> tuple[Array, Array]:
        """Return possible leans (n, 2) [rad] (roll, pitch) and height reductions (n,) [m].

        They are ordered by departure from level and from the commanded height.

        Args:
            T_world_body: (4, 4) current body pose.
            slope: (2,) [rad] of the ground, in the convention of `leaning`.
            room: [m] maximum height reduction.
        """
        params = self._params
        most = min(1.0, np.radians(params.max_lean_deg) / max(float(np.linalg.norm(slope)), 1e-9))
        now, change = rpy_from_rotation(T_world_body[:3, :3])[:2], np.radians(params.max_tilt_deg)
        leans = np.clip(_LEANS[:, None] * most * slope, now - change, now + change)
        stoops = _STOOPS[(_STOOPS == 0.0) | (room >= _STOOPS)]
        return np.repeat(leans, len(stoops), axis=0), np.tile(stoops, len(leans))

    def reached(self, feet_world: Array, T_world_body: Array) -> NDArray[np.bool_]:
        """Return which legs (..., 6) reach their feet (..., 6, 3) [m] {world} from body poses (..., 4, 4)."""
        return reaches(self._profile, apply(inverse(T_world_body), feet_world))

    def _unreachable(self, feet_world: Array, T_world_body: Array) -> str:
        """Return which leg would be overstretched at the end of the step, or ""."""
        bad = np.flatnonzero(~self.reached(feet_world, T_world_body))
        return f"{LEGS[bad[0]]} leg: its foot would be out of reach at the end of the step" if len(bad) else ""

    def _unstable(self, feet: Array, T_world_body: Array, when: str) -> str:
        centre = apply(T_world_body, resting_centre_of_mass(self._profile))
        margin = support_margin(feet[:, :2], centre[:2])
        least = self._profile.stance.support_margin
        if margin >= least:
            return ""
        place = f"{abs(margin) * 100:.1f} cm {'inside' if margin > 0.0 else 'outside'} the support polygon {when}"
        return f"the centre of mass would be {place}, {least * 100:.1f} cm inside needed"


def time_to_swing(
    profile: RobotProfile,
    params: StepParams,
    start: Array,
    end: Array,
    clearance: Array,
    dearer: Array | None = None,
    foot_speed: float | None = None,
) -> Array:
    """Return the duration (n,) [s] of steps at the sustainable speed of the servos.

    Args:
        profile: The robot.
        params: Parameters of a step.
        start: (n, 3) [m] foot centres at the start.
        end: (n, 3) [m] foot centres at the end.
        clearance: (n,) [m] over the higher end.
        dearer: (n,) cost of height relative to ground distance; None: `height_cost` for all.
        foot_speed: [m/s] of the swings; None: that of the stance.
    """
    up_and_down = 2.0 * clearance + np.abs((end - start)[:, 2])
    way = np.linalg.norm((end - start)[:, :2], axis=1) + (params.height_cost if dearer is None else dearer) * up_and_down
    return np.asarray(params.handover_s + way / (foot_speed or profile.stance.foot_speed))
