"""Plan of a walk on a whole map: path, footholds and gap crossings, without a robot.

The planner's own functions plan for a robot that moves as planned. It is an upper bound: nothing sinks, slips or is unseen.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.whole_maps.strip import strip_ahead
from sextant.evaluation.whole_maps.terrain_map import MapPlanError, terrain_of
from sextant.services.planner.config import Settings
from sextant.services.planner.gap_crossing.gap_detection import detect_gap
from sextant.services.planner.gap_crossing.strip_survey import BEHIND, TURNING_WIDTH
from sextant.services.planner.locomotion.gait import GAITS, directions, gait_of, swing_order
from sextant.services.planner.locomotion.step_planner import NoStep, PlannedStep, StepPlanner, StepStart
from sextant.services.planner.navigation.path_follower import PathFollower
from sextant.services.planner.navigation.path_planner import NoPath
from sextant.services.planner.roadmap.params import PassageSettings
from sextant.services.planner.roadmap.roadmap import NoSection, Roadmap, SectionPlan, Stance
from sextant.services.planner.roadmap.sections import goal_behind
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, rpy_from_rotation, yaw_of
from sextant.shared.robot.profile import LEGS, RobotProfile
from sextant.shared.wire.messages import GaitName, Goal, TerrainMap, VelocityCommand

_TOLERANCE_M = 0.05  # [m] from the goal
_LIFT_M = 0.025  # [m] clearance of a swing over level ground, the default of scenarios
_STANDS_S = 2.0  # [s] that pass while no step is possible: the path follower then looks for another path
_MOST_STANDS = 20  # of these in a row, after which the plan ends
_STEPS_PER_M, _MORE_STEPS = 150, 100  # maximum number of moves
_MOST_SECTIONS = 20  # of one crossing
_TURN_RAD_S = 0.3  # [rad/s] on the spot


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """A step of some legs, with the motion of the body."""

    legs: tuple[str, ...]  # that swing; empty if only the body moves
    feet: Array  # (6, 3) [m] {map} foot centres after it
    T_map_body: Array  # (4, 4) after it
    crosses: bool  # whether it belongs to a gap crossing


@dataclass(frozen=True, slots=True, eq=False)
class MapPlan:
    """A walk over a map, as far as there is one."""

    terrain: TerrainMap  # the map with its foothold layers
    start: Move  # the stance at the start; no leg moves
    goal: tuple[float, float]  # [m] {map}
    moves: tuple[Move, ...]
    path: Array  # (k, 2) [m] {map} corners of the path from the start; empty if there is none
    reached: bool
    reason: str  # why the plan ends where it does

    @property
    def length(self) -> float:
        """Length [m] of the body's way along the ground."""
        xy = np.array([move.T_map_body[:2, 3] for move in (self.start, *self.moves)])
        return float(np.linalg.norm(np.diff(xy, axis=0), axis=1).sum())

    def footholds(self) -> list[Array]:
        """Return the touchdowns (k, 3) [m] {map} of each leg."""
        return [
            np.array([move.feet[k] for move in self.moves if leg in move.legs]).reshape(-1, 3) for k, leg in enumerate(LEGS)
        ]

    def summary(self) -> dict[str, Any]:
        """Return the plan as plain values, in metres and degrees in the frame of the map."""
        return {
            "reached": self.reached,
            "reason": self.reason,
            "length_m": round(self.length, 3),
            "start": _described(self.start),
            "goal": list(self.goal),
            "path": self.path.round(4).tolist(),
            "moves": [_described(move) for move in self.moves],
        }


def _described(move: Move) -> dict[str, Any]:
    feet = {leg: move.feet[LEGS.index(leg)].round(4).tolist() for leg in (move.legs or LEGS)}
    return {
        "kind": "gap crossing" if move.crosses else "step",
        "body": move.T_map_body[:3, 3].round(4).tolist(),
        "rpy_deg": np.degrees(rpy_from_rotation(move.T_map_body[:3, :3])).round(2).tolist(),
        "footholds": {} if not move.legs and move.crosses else feet,
    }


def plan_on_map(
    profile: RobotProfile,
    heights: NDArray[np.floating[Any]],
    resolution: float,
    goal: tuple[float, float],
    *,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    origin: tuple[float, float] = (0.0, 0.0),
    gait: GaitName = "tripod",
    cross_gaps: bool = True,
) -> MapPlan:
    """Plan a walk on a map.

    Args:
        profile: The robot.
        heights: (nx, ny) [m] heights, NaN where unknown; cell (i, j) is centred at origin + resolution * (i, j).
        resolution: [m] of the cells; other cells than those of 1 cm are resampled.
        goal: [m] {map} goal of the body.
        start: [m, m, rad] {map} place and yaw of the body at the start.
        origin: [m] {map} centre of cell (0, 0).
        gait: Groups of legs that swing together.
        cross_gaps: Whether the robot crosses gaps where there is no path around them.

    Raises:
        MapPlanError: The map is empty, or the robot cannot stand at the start.
    """
    terrain = terrain_of(profile, np.asarray(heights, dtype=np.float32), resolution, origin)
    walker = _Walker(profile, terrain, start, gait)
    reached, reason = walker.walk(np.array(goal, dtype=np.float64), cross_gaps)
    return MapPlan(terrain, walker.start, goal, tuple(walker.moves), walker.path, reached, reason)


class _Walker:
    """A robot that moves as its planner plans."""

    def __init__(self, profile: RobotProfile, map_: TerrainMap, start: tuple[float, float, float], gait: GaitName) -> None:
        self._profile, self._terrain = profile, Terrain(map_)
        self._settings = Settings()
        self._planner, self._follower = StepPlanner(profile), self._new_follower()
        self._gait, self._now_ns = gait, 0
        self._height = profile.stance.body_height
        self._lift = min(_LIFT_M, profile.stance.max_lift)
        self._rest = profile.rest_feet(self._height)
        self._body, self._feet = self._standing(map_, start)
        self.start = Move((), self._feet, self._body, False)
        self.moves: list[Move] = []
        self.path: Array = np.zeros((0, 2))

    def walk(self, target: Array, cross_gaps: bool) -> tuple[bool, str]:
        """Walk to a target (2,) [m] {map}; return whether it is reached, and why the walk ends."""
        goal = self._goal(target, _TOLERANCE_M)
        most = _MORE_STEPS + round(_STEPS_PER_M * float(np.linalg.norm(target - self._body[:2, 3])))
        stands, reason = 0, ""
        while len(self.moves) < most and stands < _MOST_STANDS:
            led = self._follower.lead(goal, self._terrain, self._body, self._body, self._now_ns)
            if isinstance(led, NoPath):
                if not cross_gaps:
                    return False, led.reason
                why = self._cross(target)
                if why:
                    return False, f"{led.reason}; no gap crossing: {why}"
                self._follower = PathFollower(
                    self._profile, Settings(), complete_map=True
                )  # its knowledge of the path does not hold here
                continue
            if not self.moves:
                self.path = self._follower.path
            if not led.commands:
                return True, led.words
            reason = self._step(led.commands)
            stands = stands + 1 if reason else 0
            if reason:
                self._follower.note(reason)
                self._now_ns += round(_STANDS_S * 1e9)
        return False, reason or f"the robot does not arrive within {most} moves"

    def _walk_to(self, place: Array, tolerance: float) -> str:
        """Walk to a place (2,) [m] {map} without crossing gaps; return why that fails, or ""."""
        goal, follower = self._goal(place, tolerance), self._new_follower()
        for _ in range(_MORE_STEPS):
            led = follower.lead(goal, self._terrain, self._body, self._body, self._now_ns)
            if isinstance(led, NoPath):
                return led.reason
            if not led.commands:
                return ""
            if why := self._step(led.commands):
                return why
        return f"the robot does not arrive within {_MORE_STEPS} moves"

    def _goal(self, place: Array, tolerance: float) -> Goal:
        return Goal(0, place[None], tolerance, self._profile.stance.max_speed, self._height, self._lift, self._gait)

    def _new_follower(self) -> PathFollower:
        return PathFollower(self._profile, self._settings, complete_map=True)

    def _ground(self) -> float:
        """Return the ground height [m] {map} under the robot."""
        return float(self._feet[:, 2].mean()) - self._profile.foot.radius

    def _within_reach(self, ground: float) -> Terrain:
        """Return the map without ground that is too low for the legs of a robot at a height [m], such as the floor of a gap."""
        map_, links = self._terrain.map, self._profile.links
        low = map_.elevation < ground - links.femur - links.tibia
        unknown = np.float32(np.nan)
        elevation, score = (np.where(low, unknown, layer) for layer in (map_.elevation, map_.score))
        return Terrain(replace(map_, elevation=elevation, score=score))

    # ------------------------------------------------------------------------------------------------------- steps

    def _standing(self, map_: TerrainMap, start: tuple[float, float, float]) -> tuple[Array, Array]:
        """Return body pose (4, 4) and feet (6, 3) [m] {map} of the robot on six feet at the start."""
        x, y, yaw = start
        feet = apply(from_xyz_rpy((x, y, 0.0), (0.0, 0.0, yaw)), self._rest)
        cells = np.rint((feet[:, :2] - map_.origin) / map_.resolution).astype(np.int64)
        inside = np.asarray(((cells >= 0) & (cells < map_.elevation.shape)).all(axis=1))
        ground = np.full(6, np.nan)
        ground[inside] = map_.elevation[tuple(cells[inside].T)]
        for leg in np.flatnonzero(np.isnan(ground)):
            where = f"({feet[leg, 0]:.2f}, {feet[leg, 1]:.2f}) m"
            what = "unknown ground" if inside[leg] else "no cell of the map"
            raise MapPlanError(
                f"known ground under each foot at the start expected, found {what} under the {LEGS[leg]} one at {where}"
            )
        body = from_xyz_rpy((x, y, float(np.median(ground)) + self._height), (0.0, 0.0, yaw))
        feet[:, 2] = ground + self._profile.foot.radius
        if not self._planner.reached(feet, body).all():
            raise MapPlanError(
                f"a place at the start where the robot can stand level expected, found heights {ground.round(3).tolist()} m"
            )
        return body, feet

    def _step(self, commands: tuple[VelocityCommand, ...]) -> str:
        """Take the first step that is possible, or bring the feet back under the body; return why there is none, or ""."""
        reason = ""
        for command in commands:
            found, _ = self._planner.choose(self._starts(command), self._terrain)
            if isinstance(found, PlannedStep):
                self._take(found)
                return ""
            reason = reason or found.reason
        gathered, _ = self._planner.gather(self._starts(commands[0]), self._terrain)
        if isinstance(gathered, NoStep):
            return reason
        self._take(gathered)
        return ""

    def _starts(self, command: VelocityCommand) -> list[StepStart]:
        along = directions(command.velocity, command.yaw_rate, self._rest)
        order = swing_order(gait_of(command.gait), along, apply(inverse(self._body), self._feet), self._rest)
        return [StepStart(self._body, self._feet, swing, command) for swing in order]

    def _take(self, step: PlannedStep) -> None:
        self._now_ns += round(step.duration * 1e9)
        self._move(step.swing, step.touchdown, step.body_goal, crosses=False)

    def _move(self, swing: NDArray[np.bool_], feet: Array, body: Array, *, crosses: bool) -> None:
        self._body, self._feet = body, np.where(swing[:, None], feet, self._feet)
        self.moves.append(Move(tuple(LEGS[k] for k in np.flatnonzero(swing)), self._feet, body, crosses))

    # ---------------------------------------------------------------------------------------------------- crossings

    def _cross(self, target: Array) -> str:
        """Walk to the edge of the gap on the straight line to a target, and cross it; return why that fails, or ""."""
        approach, gaps, ground = self._settings.gap_approach, self._settings.gap_detection, self._ground()
        xy, max_step_m = self._body[:2, 3], self._settings.costmap.max_step_m
        gap = detect_gap(self._within_reach(ground), xy, target, ground, max_step_m, gaps)
        if isinstance(gap, str):
            return gap
        to_edge = gap.distance - approach.start_distance_m
        if to_edge > approach.start_tolerance_m:
            ahead = np.array([math.cos(gap.heading), math.sin(gap.heading)])
            if why := self._walk_to(xy + to_edge * ahead, approach.start_tolerance_m):
                return f"no path to the edge of the gap: {why}"
        way = target - self._body[:2, 3]
        heading, along = math.atan2(way[1], way[0]), float(np.linalg.norm(way))
        if why := self._turn(heading, math.radians(approach.aligned_deg)):
            return why
        xy = self._body[:2, 3].copy()
        strip = strip_ahead(self._terrain.map, xy, heading, self._height)
        goal_x = goal_behind(strip, BEHIND, BEHIND + along, gaps) or goal_behind(strip, BEHIND, BEHIND + along, gaps.narrow())
        if goal_x is None:
            return "there is no gap within reach on the straight line to the goal"
        roadmap = Roadmap(self._profile, PassageSettings(body_height=self._height))
        straight_refusal = ""
        for section in range(_MOST_SECTIONS):
            found = self._section(roadmap, strip, goal_x, section, bool(straight_refusal))
            if isinstance(found, NoSection) and not straight_refusal:
                straight_refusal = found.reason
                strip = strip_ahead(self._terrain.map, xy, heading, self._height, TURNING_WIDTH)
                found = self._section(roadmap, strip, goal_x, section, turning=True)
            if isinstance(found, NoSection):
                return f"straight on: {straight_refusal}; with turns of the body: {found.reason}"
            for step in found.steps:
                swing, feet = np.zeros(6, dtype=np.bool_), self._feet.copy()
                if step.leg >= 0:
                    swing[step.leg], feet[step.leg] = True, apply(strip.T_world_strip, step.touchdown)
                body = strip.T_world_strip @ from_xyz_rpy(step.body, (0.0, 0.0, step.yaw))
                self._move(swing, feet, body, crosses=True)
            if found.complete:
                return ""
        return f"the gap is not crossed after {_MOST_SECTIONS} sections"

    def _section(
        self, roadmap: Roadmap, strip: StripMap, goal_x: float, section: int, turning: bool
    ) -> SectionPlan | NoSection:
        """Return the next section, or why there is none with any of the samples that the planner tries."""
        T = strip.T_strip_world @ self._body
        stance = Stance(T[:3, 3].copy(), apply(strip.T_strip_world, self._feet), yaw_of(T))
        found: SectionPlan | NoSection | None = None
        attempts = roadmap.attempts(strip)
        for attempt, inward in enumerate(attempts):
            roadmap.begin(strip, stance, goal_x, len(attempts) * section + attempt, turning, inward)
            found = None
            while found is None:
                found = roadmap.grow(10_000)
            if isinstance(found, SectionPlan):
                break
        assert found is not None
        return found

    def _turn(self, heading: float, within: float) -> str:
        """Turn on the spot to a heading [rad], within a tolerance [rad]; return why that fails, or ""."""
        while abs(error := math.remainder(heading - yaw_of(self._body), 2.0 * math.pi)) > within:
            seconds = self._profile.stance.step_s * GAITS[self._gait].pace
            rate = math.copysign(min(abs(error) / seconds, _TURN_RAD_S), error)
            before = yaw_of(self._body)
            why = self._step((VelocityCommand(0, np.zeros(2), rate, self._height, self._lift, self._gait),))
            if why:
                return why
            if abs(math.remainder(yaw_of(self._body) - before, 2.0 * math.pi)) < 1e-4:
                return "the robot cannot turn towards the goal here"
        return ""
