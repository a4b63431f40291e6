"""Path follower: walking direction, heading and speed on the way to a goal.

The path is planned again as the map changes. The camera looks forward, so the robot turns to face its path. If it makes no
progress although the map shows no reason, it remembers the place and takes another path. Unseen ground is traversable for the
planner. If there is no path even over unseen ground, no further look can help, and the robot reports the obstacle.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from math import atan2, cos, hypot, pi, radians, sin

import numpy as np

from sextant.services.planner.locomotion.gait import GAITS
from sextant.services.planner.navigation.path_planner import NoWay, Way, cost_of, find_way
from sextant.services.planner.navigation.stall_detection import Progress
from sextant.services.planner.navigation.traversability import BESIDE, Crossing, Prices, SeenGround, Size
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, yaw_of
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import MAX_PATH, Goal, TerrainMap, VelocityCommand

_SPARE = 0.045  # [m] margin between the feet and an obstacle
_LIKED = 0.20  # [m] preferred additional margin
_DETOUR = 1.5  # [m] maximum distance from the straight line between two waypoints
_FURTHEST = 1e4  # [m] maximum coordinate of a waypoint
_REPLAN_NS = 500_000_000  # [ns] minimum time between two path searches
_PASSED = 0.10  # [m] minimum radius within which an intermediate waypoint counts as passed
_LOOK_AHEAD = 0.25  # [m] along the path, to the point that the robot walks to
_FACE = 0.45  # [m] along the path, to the point that it faces if the path is seen
_FORESIGHT = 1.4  # [m] along the path, within which it looks at unseen ground
_AHEAD = 10.0  # [m] along the path, within which the ground is checked; beyond the size of any map
_VEILED = 0.02  # [1] share of unseen ground under the robot, from which a place on the path counts as unseen
_HALT = 0.35  # [m] distance to such a place, below which the robot turns before it walks
_TURN_FIRST = radians(50.0)  # heading error, above which the robot turns before it walks
_TURN_GAIN = 1.2  # [1/s]
_TURN = 0.21  # [rad/s] maximum yaw rate
_WORTH = 0.85  # [1] relative cost below which a new path replaces the current one
_OFF_WAY = 0.20  # [m] from the current path, beyond which a new one replaces it at any cost
_STUCK_AHEAD = 0.08  # [m] from the feet along the path to the place that counts as impassable
_STUCK_RADIUS = 0.08  # [m] radius of an impassable place
_ELSEWHERE = radians(20.0)  # heading change, from which the robot faces another place
_FACED = radians(6.0)  # heading error, below which the robot looks at a place
_TURN_ABOUT = radians(90.0)  # heading error to the first unseen place, from which it looks at one with a smaller error instead
_IN_SIGHT = radians(25.0)  # heading error, up to which a place is in the image
_SIGHT = 1.3  # [m] range at which ground is visible
_SOON_BESIDE = BESIDE + 0.20  # [m] distance to a place that must be in the image before the robot walks on


@dataclass(frozen=True, slots=True, eq=False)
class Heading:
    """Commands for the next step."""

    commands: tuple[VelocityCommand, ...]  # in order of preference; none: arrived
    words: str


@dataclass(slots=True, eq=False)
class _Errand:
    """A goal and the state on the way to it."""

    goal: Goal
    begin: Array  # (2,) [m] {world} start of the straight line to the next waypoint
    leg: int = 0  # index of the next waypoint
    arrived: bool = False
    map: TerrainMap | None = None  # the map of the last path search
    planned_ns: int = 0
    crossing: Crossing | None = None
    found: Way | NoWay | None = None
    way: Way | None = None  # the path that the robot follows
    stuck: list[Array] = field(default_factory=list)  # (2,) [m] {world} places without progress
    stuck_reason: str = ""
    reason: str = ""  # why the newest command has no step
    progress: Progress = field(default_factory=Progress)  # to the next waypoint
    facing: float = 0.0  # [rad] {world} heading of the newest command


class Pilot:
    """Follows the path to one goal at a time."""

    def __init__(self, profile: RobotProfile):
        """Initialize for a robot."""
        self._profile = profile
        feet = profile.rest_feet()
        half = float(np.linalg.norm(feet[:, :2], axis=1).max()) + _SPARE  # the robot must be able to turn
        # Next to a hole the outermost feet may stand closer, by the radius of the foothold search.
        closer = float(np.abs(feet[:, 1]).max()) - profile.stance.search_radius + _SPARE
        self._size = Size(half, min(closer, half), half + _LIKED)
        self._prices = Prices()
        self._ground = SeenGround()
        self._errand: _Errand | None = None

    @property
    def path(self) -> Array:
        """Return the corners (k, 2) [m] {world} of the current path."""
        errand = self._errand
        return np.zeros((0, 2)) if errand is None or errand.way is None else errand.way.corners[:MAX_PATH]

    def lead(self, goal: Goal, terrain: Terrain, T_world_body: Array, body: Array, now_ns: int) -> Heading | NoWay:
        """Return the next commands towards a goal, or why there is no path.

        Args:
            goal: The goal.
            terrain: The newest map.
            T_world_body: (4, 4) current body pose.
            body: (4, 4) {world} body pose at the start of the next step.
            now_ns: [ns] current time.
        """
        nonsense = objection(goal)
        if nonsense:
            return NoWay(nonsense)
        xy = body[:2, 3]
        # 1. For a new goal, discard the state of the old one.
        if self._errand is None or not same_goal(goal, self._errand.goal):
            self._errand = _Errand(goal, xy.copy())
        errand = self._errand
        errand.goal = goal
        # 2. Select the next waypoint.
        target = goal.waypoints[errand.leg]
        while errand.leg < len(goal.waypoints) - 1 and _length(target - xy) < max(goal.tolerance, _PASSED):
            errand.begin, errand.way, errand.map, errand.progress = target, None, None, Progress()
            errand.leg += 1
            target = goal.waypoints[errand.leg]
        # A robot that has arrived does not start again because of small changes of its estimate.
        near = _length(target - xy) <= goal.tolerance * (2.0 if errand.arrived else 1.0)
        errand.arrived = near and errand.leg == len(goal.waypoints) - 1
        if errand.arrived:
            errand.way = None
            return Heading((), f"at the goal ({target[0]:.1f}, {target[1]:.1f})")
        if _off(errand.begin, target, xy) > _DETOUR:
            errand.begin = xy.copy()  # another client has moved it
        # 3. Plan the path again if the map has changed and `_REPLAN_NS` has passed, or if there is no progress.
        if errand.way is not None:
            self._watch(errand, target, body, now_ns)
        changed = errand.map is not terrain.map and now_ns - errand.planned_ns >= _REPLAN_NS
        if errand.map is None or changed:
            errand.map, errand.planned_ns = terrain.map, now_ns
            self._ground.see(terrain, T_world_body, self._profile.camera, float(T_world_body[2, 3]) - goal.body_height)
            self._plan(errand, np.array([*xy, yaw_of(body)]), target)
        if isinstance(errand.found, NoWay):
            return errand.found
        return self._follow(errand, target, body, now_ns)

    def _step_s(self, goal: Goal) -> float:
        return self._profile.stance.step_s * GAITS[goal.gait].pace

    def note(self, reason: str) -> None:
        """Note why the robot stands, for the report of a stall."""
        if self._errand is not None:
            self._errand.reason = reason

    def pause(self) -> None:
        """Exclude the time until the next call of `lead` from stall detection.

        The cause of such a delay is not a property of the ground.
        """
        if self._errand is not None:
            self._errand.progress.pause()

    def _watch(self, errand: _Errand, target: Array, body: Array, now_ns: int) -> None:
        """Mark the place ahead as impassable if the robot makes no progress."""
        assert errand.way is not None
        assert errand.crossing is not None
        xy, yaw = body[:2, 3], yaw_of(body)
        way, _ = _rest(errand.way.corners, xy)
        left, error = _extent(way) + _length(target - way[-1]), abs(_wrapped(errand.facing - yaw))
        words = errand.progress.update(now_ns, np.array([*xy, yaw]), left, error, errand.goal.speed)
        if not errand.progress.astray_s:
            errand.reason = ""  # it belongs to an earlier command
        if not words:
            return
        # The first place ahead that is free for the body, so that the robot takes another path and never this one again.
        ahead = np.arange(self._size.half_width + _STUCK_AHEAD, min(_extent(way), _AHEAD), errand.crossing.edge)
        places = np.array([*(_along(way, d) for d in ahead), way[-1]])
        free = np.isfinite(errand.crossing.at(errand.crossing.cost, places))
        errand.stuck.append(places[int(np.argmax(free))])
        errand.stuck_reason = f"{words}: {errand.reason}" if errand.reason else words
        errand.map, errand.progress = None, Progress()  # plan another path immediately

    def _plan(self, errand: _Errand, place: Array, target: Array) -> None:
        """Plan the path; keep the current one unless the new one is clearly cheaper."""
        xy, stuck = place[:2], np.array(errand.stuck).reshape(-1, 2)
        crossing = self._ground.crossing(self._size, self._prices, place, stuck, _STUCK_RADIUS)
        crossing = crossing.beside(errand.begin, target, _DETOUR)
        found = find_way(crossing, xy, target, errand.goal.tolerance)
        errand.crossing, errand.found = crossing, found
        if isinstance(found, NoWay):
            because = f"; the robot got stuck before: {errand.stuck_reason}" if errand.stuck else ""
            errand.found, errand.way = NoWay(found.reason + because), None
            return
        if errand.way is not None:
            old, off = _rest(errand.way.corners, xy)
            cost = cost_of(crossing, old)
            same_end = _length(old[-1] - found.corners[-1]) < crossing.edge  # the known ground may reach further now
            if same_end and off < _OFF_WAY and found.cost > _WORTH * cost:
                errand.way = Way(old, cost)
                return
        errand.way, errand.progress.changed = found, True

    def _follow(self, errand: _Errand, target: Array, body: Array, now_ns: int) -> Heading:
        """Follow the path, facing it."""
        assert errand.way is not None
        goal, xy, yaw = errand.goal, body[:2, 3], yaw_of(body)
        way, _ = _rest(errand.way.corners, xy)
        left = _extent(way)
        to = _along(way, _LOOK_AHEAD) - xy
        course = atan2(to[1], to[0])
        # Face the unseen part of the path and stop before it. Over seen ground the robot may walk sideways while it turns.
        veiled_at, veiled = self._veiled(errand, way, yaw)
        if veiled is None:
            facing, turn_first = _along(way, _FACE) - xy, _TURN_FIRST
        else:
            facing = veiled - xy
            turn_first = _FACED if veiled_at < _HALT else _IN_SIGHT if _length(facing) < _SOON_BESIDE else pi
        error = _wrapped(atan2(facing[1], facing[0]) - yaw) if left > _LOOK_AHEAD else 0.0
        errand.progress.changed |= abs(_wrapped(yaw + error - errand.facing)) > _ELSEWHERE
        errand.facing = yaw + error
        turn = min(max(_TURN_GAIN * error, -_TURN), _TURN)
        # A step goes no further than to the look-ahead point, and not past a corner.
        speed = min(goal.speed, self._profile.stance.max_speed, _length(to) / self._step_s(goal))
        velocity = speed * np.array([cos(course - yaw), sin(course - yaw)])
        wanted = [(velocity, turn), (velocity, 0.0), (np.zeros(2), turn)]
        if abs(error) > turn_first:
            wanted = [(np.zeros(2), turn), (velocity, 0.0)]
        # Ground that is too close to be seen becomes visible from further back, or from the side.
        for away in (pi, pi / 2, -pi / 2):
            back = course - yaw + away
            wanted.append((0.5 * speed * np.array([cos(back), sin(back)]), 0.0))
        wanted.append((np.zeros(2), -turn))
        commands = tuple(_command(goal, now_ns, v, w) for v, w in wanted if _length(v) > 0.0 or w != 0.0)
        return Heading(commands, f"{left:.1f} m of path left to ({target[0]:.1f}, {target[1]:.1f})")

    def _veiled(self, errand: _Errand, way: Array, yaw: float) -> tuple[float, Array | None]:
        """Return distance [m] and place (2,) of the unseen ground to look at.

        The distance is along the path (k, 2) [m] to the first ground that is unseen but visible from here. The place is that
        ground, unless the robot would have to turn far for it and another place needs a smaller turn. It is None if there is no
        such ground.
        """
        crossing = errand.crossing
        assert crossing is not None
        distance = np.arange(0.0, min(_extent(way), _AHEAD) + crossing.edge, crossing.edge)
        places = np.array([_along(way, d) for d in distance])
        reach = np.arange(-self._size.half_width, self._size.half_width + crossing.edge, crossing.edge)
        under = np.stack(np.meshgrid(reach, reach, indexing="ij"), axis=-1).reshape(-1, 2)
        first, looks = np.inf, list[tuple[float, Array]]()
        for k in np.flatnonzero(crossing.at(crossing.veiled, places) > _VEILED):
            ground = places[k] + under
            off = np.linalg.norm(ground - way[0], axis=1)
            hidden = crossing.at(crossing.unseen, ground) & (off > BESIDE)
            if not hidden.any() or (distance[k] > _FORESIGHT and not looks):
                continue
            place = ground[hidden].mean(axis=0)
            turn = abs(_wrapped(atan2(*(place - way[0])[::-1]) - yaw))
            if not looks:
                first = float(distance[k])
                if turn < _TURN_ABOUT:
                    return first, place
            if not looks or (_length(place - way[0]) < _SIGHT and turn > _IN_SIGHT):
                looks.append((turn, place))
        return first, min(looks, key=lambda look: look[0])[1] if looks else None


def objection(goal: Goal) -> str:
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
    return VelocityCommand(now_ns, velocity, yaw_rate, goal.body_height, goal.lift, goal.gait)


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
