"""Path follower: walking direction, heading and speed on the way to a goal.

The path is planned again as the map changes. The camera looks forward, so the robot turns to face its path. If it makes no
progress although the map shows no reason, it remembers the place and takes another path. Unseen ground is traversable for the
planner. If there is no path even over unseen ground, no further look can help, and the robot reports the obstacle.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from math import atan2, cos, hypot, pi, radians, sin

import numpy as np

from sextant.services.planner.config import PlannerParams
from sextant.services.planner.locomotion.gait import gait_of
from sextant.services.planner.navigation.path_planner import NoPath, PlannedPath, cost_of, find_path
from sextant.services.planner.navigation.stall_detection import StallDetector
from sextant.services.planner.navigation.traversability import (
    CostMap,
    LocalGroundMap,
    RequiredSpace,
)
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, yaw_of
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import MAX_PATH, Goal, TerrainMap, VelocityCommand

_FURTHEST = 1e4  # [m] maximum coordinate of a waypoint
_AHEAD = 10.0  # [m] along the path, within which the ground is checked; beyond the size of any map


@dataclass(frozen=True, slots=True, eq=False)
class MotionCommand:
    """Commands for the next step."""

    commands: tuple[VelocityCommand, ...]  # in order of preference; none: the goal is where the running step ends
    words: str


@dataclass(slots=True, eq=False)
class _ActiveGoal:
    """A goal and the state on the way to it."""

    goal: Goal
    begin: Array  # (2,) [m] {world} start of the straight line to the next waypoint
    progress: StallDetector  # to the next waypoint
    leg: int = 0  # index of the next waypoint
    arrived: bool = False
    map: TerrainMap | None = None  # the map of the last path search
    planned_ns: int = 0
    cost_map: CostMap | None = None
    found: PlannedPath | NoPath | None = None
    way: PlannedPath | None = None  # the path that the robot follows
    stuck: list[Array] = field(default_factory=list)  # (2,) [m] {world} places without progress
    stuck_reason: str = ""
    reason: str = ""  # why the newest command has no step
    facing: float = 0.0  # [rad] {world} heading of the newest command


class PathFollower:
    """Follows the path to one goal at a time."""

    def __init__(self, profile: RobotProfile, settings: PlannerParams, complete_map: bool = False):
        """Initialize for a robot.

        `complete_map` tells whether the maps show all ground that there is, so that no unseen ground can be explored.
        """
        params = settings.path_follower
        self._profile, self._params, self._stall = profile, params, settings.stall
        feet = profile.rest_feet()
        half = float(np.linalg.norm(feet[:, :2], axis=1).max()) + params.margin_m  # the robot must be able to turn
        # Next to a hole the outermost feet may stand closer, by the radius of the foothold search.
        closer = float(np.abs(feet[:, 1]).max()) - profile.stance.search_radius + params.margin_m
        self._size = RequiredSpace(half, min(closer, half), half + params.preferred_margin_m)
        self._blind_radius_m = settings.costmap.blind_radius_m
        self._ground = LocalGroundMap(settings.costmap, complete_map)
        self._active_goal: _ActiveGoal | None = None

    @property
    def path(self) -> Array:
        """Return the corners (k, 2) [m] {world} of the current path; the goal alone once arrived."""
        active_goal = self._active_goal
        if active_goal is not None and active_goal.arrived:
            return active_goal.goal.waypoints[-1:]
        return np.zeros((0, 2)) if active_goal is None or active_goal.way is None else active_goal.way.corners[:MAX_PATH]

    def lead(
        self, goal: Goal, terrain: Terrain, T_world_body: Array, body: Array, now_ns: int, resting: bool = True
    ) -> MotionCommand | NoPath:
        """Return the next commands towards a goal, or why there is no path.

        Args:
            goal: The goal.
            terrain: The newest map.
            T_world_body: (4, 4) current body pose.
            body: (4, 4) {world} body pose at the start of the next step.
            now_ns: [ns] current time.
            resting: Whether all legs stand. The end of a running step is a prediction, so a walking robot has not arrived yet.
        """
        invalid_reason = validation_error(goal)
        if invalid_reason:
            return NoPath(invalid_reason)
        params, xy = self._params, body[:2, 3]
        # 1. For a new goal, discard the state of the old one.
        if self._active_goal is None or not same_goal(goal, self._active_goal.goal):
            self._active_goal = _ActiveGoal(goal, xy.copy(), StallDetector(self._stall))
        active_goal = self._active_goal
        active_goal.goal = goal
        # 2. Select the next waypoint.
        target = goal.waypoints[active_goal.leg]
        while active_goal.leg < len(goal.waypoints) - 1 and _length(target - xy) < max(goal.tolerance, params.passed_m):
            active_goal.begin, active_goal.way, active_goal.map = target, None, None
            active_goal.progress = StallDetector(self._stall)
            active_goal.leg += 1
            target = goal.waypoints[active_goal.leg]
        # A robot that has arrived does not start again because of small changes of its estimate.
        near = _length(target - xy) <= goal.tolerance * (2.0 if active_goal.arrived else 1.0)
        ends = near and active_goal.leg == len(goal.waypoints) - 1
        active_goal.arrived = ends and (resting or active_goal.arrived)
        if ends:
            active_goal.way = None
            return MotionCommand((), f"at the goal ({target[0]:.1f}, {target[1]:.1f})")
        if _off(active_goal.begin, target, xy) > params.detour_m:
            active_goal.begin = xy.copy()  # another client has moved it
        # 3. Plan the path again if the map has changed and `replan_s` has passed, or if there is no progress.
        if active_goal.way is not None:
            self._watch(active_goal, target, body, now_ns)
        changed = active_goal.map is not terrain.map and now_ns - active_goal.planned_ns >= round(params.replan_s * 1e9)
        if active_goal.map is None or changed:
            active_goal.map, active_goal.planned_ns = terrain.map, now_ns
            self._ground.add_map(terrain, T_world_body, self._profile.camera, float(T_world_body[2, 3]) - goal.body_height)
            self._plan(active_goal, np.array([*xy, yaw_of(body)]), target)
        if isinstance(active_goal.found, NoPath):
            return active_goal.found
        return self._follow(active_goal, target, body, now_ns)

    def _step_s(self, goal: Goal) -> float:
        return self._profile.stance.step_s * gait_of(goal.gait).pace

    def note(self, reason: str) -> None:
        """Note why the robot stands, for the report of a stall."""
        if self._active_goal is not None:
            self._active_goal.reason = reason

    def pause(self) -> None:
        """Exclude the time until the next call of `lead` from stall detection.

        The cause of such a delay is not a property of the ground.
        """
        if self._active_goal is not None:
            self._active_goal.progress.pause()

    def _watch(self, active_goal: _ActiveGoal, target: Array, body: Array, now_ns: int) -> None:
        """Mark the place ahead as impassable if the robot makes no progress."""
        assert active_goal.way is not None
        assert active_goal.cost_map is not None
        xy, yaw = body[:2, 3], yaw_of(body)
        way, _ = _rest(active_goal.way.corners, xy)
        left, error = _extent(way) + _length(target - way[-1]), abs(_wrapped(active_goal.facing - yaw))
        words = active_goal.progress.update(now_ns, np.array([*xy, yaw]), left, error, active_goal.goal.speed)
        if not active_goal.progress.no_progress_s:
            active_goal.reason = ""  # it belongs to an earlier command
        if not words:
            return
        # The first place ahead that is free for the body, so that the robot takes another path and never this one again.
        nearest = self._size.half_width + self._params.stuck_ahead_m
        ahead = np.arange(nearest, min(_extent(way), _AHEAD), active_goal.cost_map.edge)
        places = np.array([*(_along(way, d) for d in ahead), way[-1]])
        free = np.isfinite(active_goal.cost_map.at(active_goal.cost_map.cost, places))
        active_goal.stuck.append(places[int(np.argmax(free))])
        active_goal.stuck_reason = f"{words}: {active_goal.reason}" if active_goal.reason else words
        active_goal.map, active_goal.progress = None, StallDetector(self._stall)  # plan another path immediately

    def _plan(self, active_goal: _ActiveGoal, place: Array, target: Array) -> None:
        """Plan the path; keep the current one unless the new one is clearly cheaper."""
        xy, stuck = place[:2], np.array(active_goal.stuck).reshape(-1, 2)
        cost_map = self._ground.cost_map(self._size, place, stuck, self._params.stuck_radius_m)
        cost_map = cost_map.beside(active_goal.begin, target, self._params.detour_m)
        found = find_path(cost_map, xy, target, active_goal.goal.tolerance)
        active_goal.cost_map, active_goal.found = cost_map, found
        if isinstance(found, NoPath):
            because = f"; the robot got stuck before: {active_goal.stuck_reason}" if active_goal.stuck else ""
            active_goal.found, active_goal.way = NoPath(found.reason + because), None
            return
        if active_goal.way is not None:
            old, off = _rest(active_goal.way.corners, xy)
            cost = cost_of(cost_map, old)
            same_end = _length(old[-1] - found.corners[-1]) < cost_map.edge  # the known ground may reach further now
            if same_end and off < self._params.off_path_m and found.cost > self._params.switch_cost_ratio * cost:
                active_goal.way = PlannedPath(old, cost)
                return
        active_goal.way, active_goal.progress.changed = found, True

    def _follow(self, active_goal: _ActiveGoal, target: Array, body: Array, now_ns: int) -> MotionCommand:
        """Follow the path, facing it."""
        assert active_goal.way is not None
        params, goal, xy, yaw = self._params, active_goal.goal, body[:2, 3], yaw_of(body)
        way, _ = _rest(active_goal.way.corners, xy)
        left = _extent(way)
        to = _along(way, params.look_ahead_m) - xy
        course = atan2(to[1], to[0])
        # Face the unseen part of the path and stop before it. Over seen ground the robot may walk sideways while it turns.
        veiled_at, veiled = self._veiled(active_goal, way, yaw)
        if veiled is None:
            facing, turn_first_deg = _along(way, params.face_m) - xy, params.turn_first_deg
        else:
            facing = veiled - xy
            near = _length(facing) < self._blind_radius_m + params.must_see_m
            turn_first_deg = params.faced_deg if veiled_at < params.halt_m else params.in_sight_deg if near else 180.0
        error = _wrapped(atan2(facing[1], facing[0]) - yaw) if left > params.look_ahead_m else 0.0
        active_goal.progress.changed |= abs(_wrapped(yaw + error - active_goal.facing)) > radians(params.new_facing_deg)
        active_goal.facing = yaw + error
        turn = min(max(params.turn_gain * error, -params.turn_rate_rad_s), params.turn_rate_rad_s)
        # A step goes no further than to the look-ahead point, and not past a corner.
        speed = min(goal.speed, self._profile.stance.max_speed, _length(to) / self._step_s(goal))
        velocity = speed * np.array([cos(course - yaw), sin(course - yaw)])
        wanted = [(velocity, turn), (velocity, 0.0), (np.zeros(2), turn)]
        if abs(error) > radians(turn_first_deg):
            wanted = [(np.zeros(2), turn), (velocity, 0.0)]
        # Ground that is too close to be seen becomes visible from further back, or from the side.
        for away in (pi, pi / 2, -pi / 2):
            back = course - yaw + away
            wanted.append((0.5 * speed * np.array([cos(back), sin(back)]), 0.0))
        wanted.append((np.zeros(2), -turn))
        commands = tuple(_command(goal, now_ns, v, w) for v, w in wanted if _length(v) > 0.0 or w != 0.0)
        return MotionCommand(commands, f"{left:.1f} m of path left to ({target[0]:.1f}, {target[1]:.1f})")

    def _veiled(self, active_goal: _ActiveGoal, way: Array, yaw: float) -> tuple[float, Array | None]:
        """Return distance [m] and place (2,) of the unseen ground to look at.

        The distance is along the path (k, 2) [m] to the first ground that is unseen but visible from here. The place is that
        ground, unless the robot would have to turn far for it and another place needs a smaller turn. It is None if there is no
        such ground.
        """
        params, cost_map = self._params, active_goal.cost_map
        assert cost_map is not None
        distance = np.arange(0.0, min(_extent(way), _AHEAD) + cost_map.edge, cost_map.edge)
        places = np.array([_along(way, d) for d in distance])
        reach = np.arange(-self._size.half_width, self._size.half_width + cost_map.edge, cost_map.edge)
        under = np.stack(np.meshgrid(reach, reach, indexing="ij"), axis=-1).reshape(-1, 2)
        first, looks = np.inf, list[tuple[float, Array]]()
        for k in np.flatnonzero(cost_map.at(cost_map.veiled, places) > params.unseen_share):
            ground = places[k] + under
            off = np.linalg.norm(ground - way[0], axis=1)
            hidden = cost_map.at(cost_map.unseen, ground) & (off > self._blind_radius_m)
            if not hidden.any() or (distance[k] > params.foresight_m and not looks):
                continue
            place = ground[hidden].mean(axis=0)
            turn = abs(_wrapped(atan2(*(place - way[0])[::-1]) - yaw))
            if not looks:
                first = float(distance[k])
                if turn < radians(params.turn_about_deg):
                    return first, place
            if not looks or (_length(place - way[0]) < params.sight_m and turn > radians(params.in_sight_deg)):
                looks.append((turn, place))
        return first, min(looks, key=lambda look: look[0])[1] if looks else None


def validation_error(goal: Goal) -> str:
    """Return why a goal is invalid, or ""."""
    if not (goal.tolerance > 0.0 and goal.speed > 0.0):
        return f"a goal's tolerance and speed greater than 0 expected, found {goal.tolerance:g} m and {goal.speed:g} m/s"
    if np.abs(goal.waypoints).max() > _FURTHEST:
        return f"waypoints within {_FURTHEST:g} m of the world's origin expected, found {goal.waypoints.tolist()}"
    return ""


def _off(start: Array, end: Array, xy: Array) -> float:
    """Return the distance [m] of a place (2,) from a line segment."""
    return _rest(np.stack([start, end]), xy)[1]


def _command(goal: Goal, now_ns: int, velocity: Array, yaw_rate: float) -> VelocityCommand:
    asked = goal.body_height, goal.lift, goal.gait
    return VelocityCommand(now_ns, velocity, yaw_rate, *asked, auto_speed=goal.auto_speed)


def same_goal(a: Goal, b: Goal) -> bool:
    """Return whether two goals have the same waypoints and tolerance."""
    return a.tolerance == b.tolerance and np.array_equal(a.waypoints, b.waypoints)


def _rest(corners: Array, xy: Array) -> tuple[Array, float]:
    """Return the rest of a path (k, 2) [m] and the robot's distance [m] from the path.

    The rest begins at the robot (2,) [m] and continues from the nearest point of the path.
    """
    start, step = corners[:-1], np.diff(corners, axis=0)
    s = np.clip(((xy - start) * step).sum(axis=1) / np.maximum((step**2).sum(axis=1), 1e-12), 0.0, 1.0)
    on = start + s[:, None] * step
    off = np.linalg.norm(on - xy, axis=1)
    k = len(off) - 1 - int(np.argmin(off[::-1]))
    return np.vstack([xy, corners[k + 1 :]]), float(off[k])


def _along(way: Array, distance: float) -> Array:
    """Return the place (2,) at a distance [m] along a path (k, 2), at most its end."""
    for a, b in pairwise(way):
        length = _length(b - a)
        if length >= distance:
            return np.asarray(a + (b - a) * (distance / length))
        distance -= length
    return np.asarray(way[-1])


def _extent(way: Array) -> float:
    """Return the length [m] of a path (k, 2)."""
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())


def _length(v: Array) -> float:
    return hypot(float(v[0]), float(v[1]))


def _wrapped(angle: float) -> float:
    return (angle + pi) % (2.0 * pi) - pi
