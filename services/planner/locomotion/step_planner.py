"""One step of the walk: footholds for the legs that swing and a place for the body, or the reason why there is none."""

from collections.abc import Iterator, Set
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion.body_pose import clear_of_ground, floor_height, leaning, slope_under
from sextant.services.planner.locomotion.foothold_search import Foothold, NoFoothold, nearest_foothold, offsets_by_distance
from sextant.services.planner.locomotion.gait import GAITS, carried_on, directions, nominal_touchdowns, swing_order
from sextant.services.planner.locomotion.leg_clearance import (
    Touching,
    Way,
    clearance_to_sink,
    cleared,
    rises_clear,
    stands_clear,
)
from sextant.services.planner.terrain import GOOD, NONE, Terrain
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, rpy_from_rotation, yaw_of
from sextant.shared.robot.kinematics import body_inverse, leg_inverse, within_limits
from sextant.shared.robot.profile import LEGS, RobotProfile
from sextant.shared.robot.stability import resting_centre_of_mass, support_margin
from sextant.shared.wire.messages import VelocityCommand

SHARES = (1.0, 0.7, 0.45, 0.25)  # of the commanded travel that are tried when the whole does not work
_WIDTHS = (1.0, 1.5)  # of the search for footholds: the wider where the narrower leaves no step
_ROOM_ENOUGH = 1.75  # of a foothold's suitability: for more a step is not made shorter
_DESCENT = np.array([0.0, 0.0, 0.03])  # [m] over a foothold, from where a foot comes straight down
_DEARER = 2.0  # than way is height: of a foot's way over the ground the body makes half
_DEARER_YET = 2.5  # where a foot goes higher than commanded, over uneven ground: there legs stand less well, too
_STOOPS = np.arange(7) * 0.005  # [m] by which the body may be lower than commanded
_LEANS = (0.0, 0.25, 0.5, 0.75, 1.0)  # share of the ground's slope by which it may lean
_GATHERED = 0.02  # [m] by which a step on the spot must bring feet nearer to their resting places, all together
_ASIDE, _AROUND = (0.02, 0.04, 0.06), np.arange(8) * np.pi / 4  # [m] and [rad] of a shift of the body that makes room for a leg
_SHIFT_S = 1.0  # [s] that it takes
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
    body_after: Array  # (4, 4) {world} where the body would be when the swinging feet are to leave their touchdowns
    start: Array  # (6, 3) [m] {world} foot centres before it
    moved: int  # footholds away from their nominal place
    share: float  # of the commanded travel
    duration: float  # [s]
    room: float  # how good its poorest foothold is, see `Terrain.suitability`
    instead: str = ""  # why legs that were due more do not take it, in words

    def moved_by(self, T: Array) -> "Stride":
        """The same step after a correction (4, 4) of where the world is believed to be."""
        nominal = apply(T, np.column_stack([self.nominal, self.touchdown[:, 2]]))[:, :2]
        touchdown, start = apply(T, self.touchdown), apply(T, self.start)
        goal, after = T @ self.body_goal, T @ self.body_after
        return replace(self, touchdown=touchdown, nominal=nominal, body_goal=goal, body_after=after, start=start)


@dataclass(frozen=True, slots=True)
class Blocked:
    """Why there is no step, in words."""

    reason: str
    leg: int = -1  # the leg it fails for, -1 for the whole robot
    unseen: bool = False  # for it the ground has not been seen
    touching: bool = False  # it would run into the ground that it is to rise from, or pass


class StridePlanner:
    """Plans steps for one robot; it keeps only tables."""

    def __init__(self, profile: RobotProfile, settings: Settings):
        """Plan for a robot."""
        self._profile = profile
        self._settings = settings
        self._foot_up = np.array([0.0, 0.0, profile.foot.radius])  # [m] from the ground to a foot's centre
        self._offsets: dict[
            float, Array
        ] = {}  # [m] of the cells to try by `_WIDTHS`, made for the resolution of the map at hand
        self._offsets_resolution = 0.0  # [m]

    def objection(self, command: VelocityCommand) -> str:
        """Why a command cannot be walked by this robot anywhere, in words, or nothing."""
        low, high = self._profile.stance.body_height_range
        if not low <= command.body_height <= high:
            return f"a body height of {low:g} to {high:g} m expected, {command.body_height:g} m commanded"
        highest = self._profile.stance.max_lift
        if not 0.0 < command.lift <= highest:
            return f"a lift of more than 0 and at most {highest:g} m expected, {command.lift:g} m commanded"
        return ""

    def duration(self, command: VelocityCommand) -> float:
        """How long [s] a step in the commanded gait takes where its feet need not be lifted far."""
        return self._profile.stance.step_s * GAITS[command.gait].pace

    def short_of(self, command: VelocityCommand, stride: Stride) -> str:
        """By how much a step is slower than commanded, since legs reach no further and move no faster, in words."""
        asked = float(np.linalg.norm(command.velocity))
        reached = float(np.linalg.norm(self._travel(command, 1.0)[0])) / stride.duration
        if reached > asked - 1e-3:
            return ""
        why = f"no more by reach and speed of the legs in the {command.gait} gait"
        return f", {reached * 100:.1f} of {asked * 100:.1f} cm/s: {why}"

    def plan(
        self,
        at: Situation,
        terrain: Terrain,
        refused: Set[int] = frozenset(),
        width: float = 1.0,
        foot_margin: float | None = None,
    ) -> Stride | Blocked:
        """The longest step towards the command onto good footholds; some of `SHARES` are not to be tried.

        Where there is none, the one whose poorest foothold has the most room around it. Footholds are looked for within the
        robot's search radius times a width of `_WIDTHS`. Feet that a folded leg pushes aside keep a margin [m] to what
        stands there; the settings', when left out.
        """
        foot_margin = self._settings.sink_margin if foot_margin is None else foot_margin
        best: Stride | None = None
        first: Blocked | None = None
        for number, share in enumerate(SHARES):
            if number in refused:
                continue
            found = self._attempt(at, terrain, share, width, foot_margin)
            if isinstance(found, Blocked):
                first = first or found
            elif best is None or found.room > best.room:
                best = found
            if best is not None and best.room >= _ROOM_ENOUGH:
                break
        return best or first or Blocked("every step was refused")

    def choose(
        self, situations: list[Situation], terrain: Terrain, refused: Set[int] = frozenset()
    ) -> tuple[Stride | Blocked, int]:
        """The step to take and the number of its way, or why legs that are most due cannot take it.

        Feet go further from their places only where no legs find a step otherwise: what is gained on a ditch is lost on rubble,
        where long reaches take time. Only where that does not help either, a folded leg may push its foot against what stands
        beside it; and before that the body alone shifts to where the leg has room. Ways are counted through the situations, and
        in each through the shares of the travel; the last is that shift.

        Args:
            situations: What it may begin with, the legs most due first.
            terrain: The map.
            refused: Ways that are not to be tried.
        """
        first: Blocked | None = None
        for foot_margin in (self._settings.sink_margin, -np.inf):
            for width, (turn, at) in product(_WIDTHS, enumerate(situations)):
                ways = range(turn * len(SHARES), (turn + 1) * len(SHARES))
                found = self.plan(at, terrain, {way - ways[0] for way in refused if way in ways}, width, foot_margin)
                if isinstance(found, Stride):
                    return replace(found, instead=first.reason if first else ""), ways[SHARES.index(found.share)]
                first = first or found
            shift = len(situations) * (len(SHARES) + 1)  # behind those of `gather`
            if first is not None and first.touching and foot_margin > -np.inf and shift not in refused:
                shifted = self._make_room(situations[0], first.leg, terrain)
                if shifted is not None:
                    return replace(shifted, instead=first.reason), shift
        return first or Blocked("every step was refused"), 0

    def _make_room(self, at: Situation, leg: int, terrain: Terrain) -> Stride | None:
        """The step of the body alone, the smallest and straightest away from a leg's foot, after which its legs can swing."""
        body = at.T_world_body
        away = np.arctan2(*(body[:2, 3] - at.feet[leg, :2])[::-1])
        turns = _AROUND[np.argsort(np.abs((_AROUND + np.pi) % (2.0 * np.pi) - np.pi), kind="stable")]
        for distance, turn in product(_ASIDE, turns):
            moved = body.copy()
            moved[:2, 3] += distance * np.array([np.cos(away + turn), np.sin(away + turn)])
            if not self.reached(at.feet, moved).all() or self._unstable(at.feet, moved, ""):
                continue
            if isinstance(self.plan(replace(at, T_world_body=moved), terrain), Stride):
                nobody, low = np.zeros(6, dtype=np.bool_), np.full(6, self._settings.path_margin)
                return Stride(nobody, at.feet, at.feet[:, :2], low, moved, moved, at.feet, 0, 1.0, _SHIFT_S, GOOD)
        return None

    def gather(
        self, situations: list[Situation], terrain: Terrain, refused: Set[int] = frozenset()
    ) -> tuple[Stride | Blocked, int]:
        """A step on the spot that brings feet back under the body, and the number of its way; or why there is none.

        Short steps towards ground that has not been seen leave all legs stretched: then no step goes on from there, even
        once the ground is seen. Each such step brings feet nearer to their resting places, so they come to an end.

        Args:
            situations: What it may begin with, the legs most due first.
            terrain: The map.
            refused: Ways that are not to be tried; they are counted on from those of `choose`.
        """
        for way, at in enumerate(situations, len(SHARES) * len(situations)):
            found = self._attempt(at, terrain, 0.0, _WIDTHS[0], self._settings.sink_margin) if way not in refused else None
            if isinstance(found, Stride):
                legs = found.swing
                before = np.linalg.norm((found.start[:, :2] - found.nominal)[legs], axis=1)
                after = np.linalg.norm((found.touchdown[:, :2] - found.nominal)[legs], axis=1)
                if before.sum() - after.sum() > _GATHERED:
                    return found, way
        return Blocked("no step on the spot brings feet nearer to their resting places"), 0

    def retarget(self, stride: Stride, terrain: Terrain) -> Stride:
        """The same step with its touchdowns chosen anew on a newer map; a leg that finds nothing better keeps its own.

        Nothing is better that asks for more lift than the foot has been given.
        """
        touchdown = stride.touchdown.copy()
        for leg in np.flatnonzero(stride.swing).tolist():
            ground = self._foothold(leg, stride.nominal[leg], touchdown, stride.body_goal, stride.body_after, terrain)
            if isinstance(ground, NoFoothold):
                continue
            moved = touchdown.copy()
            moved[leg] = ground.p_world + self._foot_up
            if self._clearance(stride.start, moved, 0.0, terrain)[leg] <= stride.clearance[leg]:
                touchdown = moved
        return replace(stride, touchdown=touchdown)

    def _attempt(self, at: Situation, terrain: Terrain, share: float, width: float, foot_margin: float) -> Stride | Blocked:
        settings = self._settings
        gait = GAITS[at.command.gait]
        travel, turn = self._travel(at.command, share)
        level = from_xyz_rpy(at.T_world_body[:3, 3], (0.0, 0.0, yaw_of(at.T_world_body)))
        T_end, T_middle, T_after = (
            carried_on(level, travel, turn, 1.0 + steps) for steps in (0.0, gait.stances / 2, float(gait.stances))
        )
        rest = self._profile.rest_feet(at.command.body_height)
        nominal = nominal_touchdowns(rest, T_middle)
        T_end, T_after = self._raised(at, terrain, T_end, T_after, nominal)

        touchdown, moved, room = at.feet.copy(), 0, GOOD
        touchdown[at.swing] = np.nan
        for leg in np.flatnonzero(at.swing).tolist():
            found = self._foothold(leg, nominal[leg], touchdown, T_end, T_after, terrain, width)
            if isinstance(found, NoFoothold):
                return Blocked(f"{LEGS[leg]} leg: {found.reason}", leg, found.unseen)
            touchdown[leg] = found.p_world + self._foot_up
            moved += found.moved > terrain.map.resolution
            room = min(room, found.room)

        standing = ~at.swing
        problem = (
            self._unreachable(touchdown, T_end)
            or self._unstable(at.feet[standing], at.T_world_body, "where it is")
            or self._unstable(at.feet[standing], T_end, "at the end of the step")
            or self._unstable(touchdown[self._standing_next(at.command, touchdown, T_end)], T_end, "after the step")
        )
        if problem:
            return Blocked(problem)
        clearance = self._clearance(at.feet, touchdown, at.command.lift, terrain)
        too_high = np.flatnonzero(at.swing & (clearance > self._profile.stance.max_lift))
        if len(too_high):
            leg = int(too_high[0])
            return Blocked(f"{LEGS[leg]} leg: something on its way asks for {clearance[leg] * 100:.0f} cm of lift", leg)
        way = Way(at.feet, touchdown, at.T_world_body, T_end, at.swing)
        highest = self._profile.stance.max_lift
        lifted = cleared(way, clearance, settings.leg_margin, foot_margin, highest, self._profile, terrain)
        if isinstance(lifted, Touching):
            return Blocked(lifted.reason, lifted.leg, touching=True)
        clearance = lifted
        clearance = np.where(at.swing, clearance, settings.path_margin)
        dearer = np.where(clearance > at.command.lift, _DEARER_YET, _DEARER)
        swinging = time_to_swing(self._profile, settings, at.feet, touchdown, clearance, dearer)
        duration = max(self.duration(at.command), swinging[at.swing].max())
        return Stride(at.swing, touchdown, nominal, clearance, T_end, T_after, at.feet, moved, share, duration, room)

    def _travel(self, command: VelocityCommand, share: float) -> tuple[Array, float]:
        """What the body travels (2,) [m] {body} and turns [rad] in a step: as commanded, as far as legs reach."""
        settings, gait = self._settings, GAITS[command.gait]
        duration = self.duration(command)
        travel = command.velocity * duration
        longest = self._profile.stance.stride / gait.stances
        travel = travel * (share * min(1.0, longest / max(float(np.linalg.norm(travel)), 1e-9)))
        limit = np.radians(settings.max_turn_deg) / gait.stances
        return travel, share * float(np.clip(command.yaw_rate * duration, -limit, limit))

    def _standing_next(self, command: VelocityCommand, feet: Array, T_world_body: Array) -> NDArray[np.bool_]:
        """Legs (6,) that will stand in the step after one that ends with feet (6, 3) [m] and a body (4, 4), both {world}."""
        rest = self._profile.rest_feet(command.body_height)
        along = directions(command.velocity, command.yaw_rate, rest)
        return ~swing_order(GAITS[command.gait], along, apply(inverse(T_world_body), feet), rest)[0]

    def _raised(self, at: Situation, terrain: Terrain, T_end: Array, T_after: Array, nominal: Array) -> tuple[Array, Array]:
        """The same poses at the height over the floor that is commanded, climbing no faster than the robot can.

        Where legs would not reach the ground from there, the body is lower or leans with the ground, no more than it takes.
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
        # A place that carries no foot is not worth stooping for.
        wanted = ~at.swing | (terrain.suitability(nominal) > NONE)
        lowest = max(floor + self._profile.stance.body_height_range[0], now - climb)
        second_best = T_end, T_after
        for lean, stoop in self._postures(at.T_world_body, slope_under(stance, T_end), height - lowest):
            spare = _REACH_SPARE if stoop > 0.0 or lean.any() else np.zeros(3)
            feet = np.where(at.swing[:, None], stance + self._foot_up, at.feet) - spare
            end, after = leaning(T_end, lean, stoop), leaning(T_after, lean, stoop)
            reached = self.reached(feet, end) & (self.reached(feet, after) | ~at.swing)
            if reached[wanted].all():
                return end, after
            if reached[~at.swing].all() and second_best[0] is T_end:
                second_best = end, after
        return second_best

    def _postures(self, T_world_body: Array, slope: Array, room: float) -> Iterator[tuple[Array, float]]:
        """Leans (2,) [rad], roll and pitch, and stoops [m] that a body may take, by rising departure from level and height.

        Args:
            T_world_body: (4, 4) the body as it is.
            slope: (2,) [rad] of the ground, as `leaning` takes it.
            room: [m] by which the body may be lower.
        """
        settings = self._settings
        most = min(1.0, np.radians(settings.max_lean_deg) / max(float(np.linalg.norm(slope)), 1e-9))
        now, change = rpy_from_rotation(T_world_body[:3, :3])[:2], np.radians(settings.max_tilt_deg)
        for share in _LEANS:
            lean = np.clip(share * most * slope, now - change, now + change)
            for stoop in _STOOPS[(_STOOPS == 0.0) | (room >= _STOOPS)].tolist():
                yield lean, stoop

    def _foothold(
        self, leg: int, nominal: Array, feet: Array, T_end: Array, T_after: Array, terrain: Terrain, width: float = 1.0
    ) -> Foothold | NoFoothold:
        """The best foothold of one leg near its nominal place.

        The other feet (6, 3) [m] {world} are NaN where not known yet.
        """
        known = np.isfinite(feet[:, 0])
        known[leg] = False
        others = feet[known, :2]

        passed = np.stack([T_end, (T_end + T_after) / 2.0, T_after])  # by the body while the foot stands, see `_too_near`

        def reachable(points: Array) -> NDArray[np.bool_]:
            at = points + self._foot_up
            above = at + _DESCENT  # a folded leg comes down further out
            reached = self._reaches(leg, (above, T_end), (at, T_end), (at, T_after))
            for T in (T_end, T_after):
                reached[reached] = stands_clear(leg, at[reached], T, self._settings.leg_margin, self._profile, terrain)
            reached[reached] = rises_clear(leg, at[reached], passed, self._settings.sink_margin, self._profile, terrain)
            return reached

        if terrain.map.resolution != self._offsets_resolution:
            radius, self._offsets_resolution = self._profile.stance.search_radius, terrain.map.resolution
            self._offsets = {w: offsets_by_distance(w * radius, terrain.map.resolution) for w in _WIDTHS}
        return nearest_foothold(terrain, nominal, self._offsets[width], others, self._profile.stance.foot_distance, reachable)

    def _reaches(self, leg: int, *ways: tuple[Array, Array]) -> NDArray[np.bool_]:
        """Which (n,) of foot centres (n, 3) [m] {world} one leg reaches from a body pose, in each of some pairs of the two."""
        profile = self._profile
        feet = np.stack([apply(profile.T_coxa_body[leg] @ inverse(T), feet_world) for feet_world, T in ways])
        q = leg_inverse(feet, profile.links)
        limits = profile.joint_limits[leg]
        return np.asarray(((q >= limits[:, 0]) & (q <= limits[:, 1])).all(axis=(0, 2)))  # NaN, out of reach, is in no limits

    def reached(self, feet_world: Array, T_world_body: Array) -> NDArray[np.bool_]:
        """Which legs (6,) have their feet (6, 3) [m] {world} in reach."""
        q = body_inverse(self._profile, apply(inverse(T_world_body), feet_world))
        return np.asarray(within_limits(self._profile, q).all(axis=1))

    def _unreachable(self, feet_world: Array, T_world_body: Array) -> str:
        """Which leg would be overstretched at the end of the step, in words, or nothing."""
        bad = np.flatnonzero(~self.reached(feet_world, T_world_body))
        return f"{LEGS[bad[0]]} leg: would be stretched beyond its limits at the end of the step" if len(bad) else ""

    def _unstable(self, feet: Array, T_world_body: Array, when: str) -> str:
        centre = apply(T_world_body, resting_centre_of_mass(self._profile))
        margin = support_margin(feet[:, :2], centre[:2])
        least = self._profile.stance.support_margin
        if margin >= least:
            return ""
        needed = f"{least * 100:.1f} cm needed"
        return f"the centre of mass would be {margin * 100:.1f} cm inside its three feet {when}, {needed}"

    def _clearance(self, feet: Array, touchdown: Array, lift: float, terrain: Terrain) -> Array:
        """Clearance (6,) [m] over both ends: over what lies between them, too, and more where the ground is rough."""
        settings = self._settings
        start, end = feet[:, 2] - self._profile.foot.radius, touchdown[:, 2] - self._profile.foot.radius
        higher, lower = np.maximum(start, end), np.minimum(start, end)
        ground = terrain.ground_along(feet[:, :2], touchdown[:, :2])
        between = ground.max(axis=0)
        rough = np.maximum(higher, between) - lower > settings.uneven
        lift_if_rough = max(lift, self._profile.stance.rough_lift)
        clearance = np.maximum(np.where(rough, lift_if_rough, lift), between - higher + settings.path_margin)
        sole = np.array([0.0, 0.0, self._profile.foot.radius])
        to_sink = clearance_to_sink(ground, feet - sole, touchdown - sole, settings.sink_margin)
        return np.asarray(np.maximum(clearance, to_sink))


def time_to_swing(
    profile: RobotProfile, settings: Settings, start: Array, end: Array, clearance: Array, dearer: Array | float = _DEARER
) -> Array:
    """How long (n,) [s] a step takes in which feet go from start to end (n, 3) [m], no faster than servos can for long.

    Args:
        profile: The robot.
        settings: Of the planner.
        start: (n, 3) [m] foot centres.
        end: (n, 3) [m] likewise.
        clearance: (n,) [m] over the higher end.
        dearer: By how much height counts for more than way, (n,) or for all.
    """
    up_and_down = 2.0 * clearance + np.abs((end - start)[:, 2])
    way = np.linalg.norm((end - start)[:, :2], axis=1) + dearer * up_and_down
    return np.asarray(settings.handover_s + way / profile.stance.foot_speed)
