"""Leads the robot to a goal: which way, facing where, how fast; and what it does where there is no way.

The way is found anew as the map changes. The camera looks ahead, so the robot turns to face the way it goes. Where it cannot
go on although the map knows no reason, it remembers the place and takes another way. Ground that it has not seen is open to
it: where no way is left over that either, there is nothing more to look for, and it says what stands in the way.
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

_SPARE = 0.045  # [m] between the feet and what they must keep away from
_LIKED = 0.20  # [m] that the robot would like to have beyond that
_DETOUR = 1.5  # [m] from the straight way between two waypoints, at most
_FURTHEST = 1e4  # [m]
_REPLAN_NS = 500_000_000  # [ns] between two looks for a way
_PASSED = 0.10  # [m] at least, from a waypoint that is not the last, within which it counts as passed
_LOOK_AHEAD = 0.25  # [m] along the way, where the robot walks to
_FACE = 0.45  # [m] along the way, where it looks where all the way is seen, and
_FORESIGHT = 1.4  # [m] along the way, within which it looks at what it has not seen
_AHEAD = 10.0  # [m] along the way, of which the ground is looked at; no map reaches so far
_VEILED = 0.02  # [1] share of the ground under it, from which a place on the way counts as not seen
_HALT = 0.35  # [m] before such a place it turns before it walks
_TURN_FIRST = radians(50.0)  # off the way, from which it turns before it walks
_TURN_GAIN = 1.2  # [1/s]
_TURN = 0.21  # [rad/s] at most
_WORTH = 0.85  # [1] cost of another way, of that of the one being walked, from which it is taken
_OFF_WAY = 0.20  # [m] from the way, from which another is taken whatever it costs
_STUCK_AHEAD = 0.08  # [m] beyond its feet along the way lies the place where it cannot go on
_STUCK_RADIUS = 0.08  # [m]
_ELSEWHERE = radians(20.0)  # between what it faces and what it faced, from which that is another place
_FACED = radians(6.0)  # off a place, from which it is being looked at
_TURN_ABOUT = radians(90.0)  # off what it would look at first, from which it looks at what is nearer to where it faces
_IN_SIGHT = radians(25.0)  # off where it faces, up to which a place is in the picture
_SIGHT = 1.3  # [m] to which ground shows
_SOON_BESIDE = BESIDE + 0.20  # [m] from it, within which it must be in the picture before the robot walks on


@dataclass(frozen=True, slots=True, eq=False)
class Heading:
    """What to do now."""

    commands: tuple[VelocityCommand, ...]  # the first that can be walked; none: it has arrived
    words: str


@dataclass(slots=True, eq=False)
class _Errand:
    """A goal, and what was found on the way to it."""

    goal: Goal
    begin: Array  # (2,) [m] {world} of the straight way to the next waypoint
    leg: int = 0  # the next waypoint
    arrived: bool = False
    map: TerrainMap | None = None  # on which the way was found
    planned_ns: int = 0
    crossing: Crossing | None = None
    found: Way | NoWay | None = None
    way: Way | None = None  # that is being walked
    stuck: list[Array] = field(default_factory=list)  # (2,) [m] {world} places where it could not go on
    stuck_reason: str = ""
    reason: str = ""  # why the newest command could not be walked, in words
    progress: Progress = field(default_factory=Progress)  # to the next waypoint
    facing: float = 0.0  # [rad] {world} where the newest command turns to


class Pilot:
    """Leads to one goal at a time."""

    def __init__(self, profile: RobotProfile):
        """Lead a robot."""
        self._profile = profile
        feet = profile.rest_feet()
        half = float(np.linalg.norm(feet[:, :2], axis=1).max()) + _SPARE  # it must be able to turn
        # Beside a hole the feet that reach out furthest to the side may stand closer, by as much as footholds are looked for.
        closer = float(np.abs(feet[:, 1]).max()) - profile.stance.search_radius + _SPARE
        self._size = Size(half, min(closer, half), half + _LIKED)
        self._prices = Prices()
        self._ground = SeenGround()
        self._errand: _Errand | None = None

    @property
    def path(self) -> Array:
        """(k, 2) [m] {world} corners of the way being walked."""
        errand = self._errand
        return np.zeros((0, 2)) if errand is None or errand.way is None else errand.way.corners[:MAX_PATH]

    def lead(self, goal: Goal, terrain: Terrain, T_world_body: Array, body: Array, now_ns: int) -> Heading | NoWay:
        """What to do to come to a goal.

        Args:
            goal: Where to.
            terrain: The newest map.
            T_world_body: (4, 4) where the body is.
            body: (4, 4) {world} where it will be when the next step begins.
            now_ns: [ns]
        """
        nonsense = objection(goal)
        if nonsense:
            return NoWay(nonsense)
        xy = body[:2, 3]
        # 1. Another goal: what was found on the way to the old one does not count.
        if self._errand is None or not same_goal(goal, self._errand.goal):
            self._errand = _Errand(goal, xy.copy())
        errand = self._errand
        errand.goal = goal
        # 2. Which waypoint is next.
        target = goal.waypoints[errand.leg]
        while errand.leg < len(goal.waypoints) - 1 and _length(target - xy) < max(goal.tolerance, _PASSED):
            errand.begin, errand.way, errand.map, errand.progress = target, None, None, Progress()
            errand.leg += 1
            target = goal.waypoints[errand.leg]
        # A robot that has arrived does not start again because its estimate moves a little.
        near = _length(target - xy) <= goal.tolerance * (2.0 if errand.arrived else 1.0)
        errand.arrived = near and errand.leg == len(goal.waypoints) - 1
        if errand.arrived:
            errand.way = None
            return Heading((), f"at the goal ({target[0]:.1f}, {target[1]:.1f})")
        if _off(errand.begin, target, xy) > _DETOUR:
            errand.begin = xy.copy()  # somebody else has led it away
        # 3. The way, anew when the map has changed and some time has passed, or the robot does not get on.
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
        """Note why the robot stands, in words."""
        if self._errand is not None:
            self._errand.reason = reason

    def pause(self) -> None:
        """Leave out the time until the robot is led again: what held it up is no property of the ground."""
        if self._errand is not None:
            self._errand.progress.pause()

    def _watch(self, errand: _Errand, target: Array, body: Array, now_ns: int) -> None:
        """Where the robot does not get on the place ahead is one where it cannot go on."""
        assert errand.way is not None
        assert errand.crossing is not None
        xy, yaw = body[:2, 3], yaw_of(body)
        way, _ = _rest(errand.way.corners, xy)
        left, error = _extent(way) + _length(target - way[-1]), abs(_wrapped(errand.facing - yaw))
        words = errand.progress.update(now_ns, np.array([*xy, yaw]), left, error, errand.goal.speed)
        if not errand.progress.astray_s:
            errand.reason = ""  # of something else
        if not words:
            return
        # A place where it could be, so that it takes another way, and never this one again.
        ahead = np.arange(self._size.half_width + _STUCK_AHEAD, min(_extent(way), _AHEAD), errand.crossing.edge)
        places = np.array([*(_along(way, d) for d in ahead), way[-1]])
        free = np.isfinite(errand.crossing.at(errand.crossing.cost, places))
        errand.stuck.append(places[int(np.argmax(free))])
        errand.stuck_reason = f"{words}: {errand.reason}" if errand.reason else words
        errand.map, errand.progress = None, Progress()  # another way, now

    def _plan(self, errand: _Errand, place: Array, target: Array) -> None:
        """Find the way; the old one stays where another is hardly cheaper."""
        xy, stuck = place[:2], np.array(errand.stuck).reshape(-1, 2)
        crossing = self._ground.crossing(self._size, self._prices, place, stuck, _STUCK_RADIUS)
        crossing = crossing.beside(errand.begin, target, _DETOUR)
        found = find_way(crossing, xy, target, errand.goal.tolerance)
        errand.crossing, errand.found = crossing, found
        if isinstance(found, NoWay):
            because = f"; it got stuck there: {errand.stuck_reason}" if errand.stuck else ""
            errand.found, errand.way = NoWay(found.reason + because), None
            return
        if errand.way is not None:
            old, off = _rest(errand.way.corners, xy)
            cost = cost_of(crossing, old)
            same_end = _length(old[-1] - found.corners[-1]) < crossing.edge  # the ground that is kept may reach further by now
            if same_end and off < _OFF_WAY and found.cost > _WORTH * cost:
                errand.way = Way(old, cost)
                return
        errand.way, errand.progress.changed = found, True

    def _follow(self, errand: _Errand, target: Array, body: Array, now_ns: int) -> Heading:
        """Walk along the way, facing it."""
        assert errand.way is not None
        goal, xy, yaw = errand.goal, body[:2, 3], yaw_of(body)
        way, _ = _rest(errand.way.corners, xy)
        left = _extent(way)
        to = _along(way, _LOOK_AHEAD) - xy
        course = atan2(to[1], to[0])
        # Face what is not seen of the way yet, and stop before it; over what is seen it may walk sideways while it turns.
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
        # No further in a step than to the end, nor around a corner.
        speed = min(goal.speed, self._profile.stance.max_speed, _length(to) / self._step_s(goal))
        velocity = speed * np.array([cos(course - yaw), sin(course - yaw)])
        wanted = [(velocity, turn), (velocity, 0.0), (np.zeros(2), turn)]
        if abs(error) > turn_first:
            wanted = [(np.zeros(2), turn), (velocity, 0.0)]
        # Ground too near to be seen shows from further back, or from beside.
        for away in (pi, pi / 2, -pi / 2):
            back = course - yaw + away
            wanted.append((0.5 * speed * np.array([cos(back), sin(back)]), 0.0))
        wanted.append((np.zeros(2), -turn))
        commands = tuple(_command(goal, now_ns, v, w) for v, w in wanted if _length(v) > 0.0 or w != 0.0)
        return Heading(commands, f"{left:.1f} m of way left to ({target[0]:.1f}, {target[1]:.1f})")

    def _veiled(self, errand: _Errand, way: Array, yaw: float) -> tuple[float, Array | None]:
        """How far [m] along a way (k, 2) ground begins that is not seen but could be from here, and the place (2,) to look at.

        That is the first such place, unless the robot would have to turn about for it, and another shows sooner.
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
    """Why a goal is none for anybody, in words, or nothing."""
    if not (goal.tolerance > 0.0 and goal.speed > 0.0):
        return f"a goal's tolerance and speed greater than 0 expected, found {goal.tolerance:g} m and {goal.speed:g} m/s"
    if np.abs(goal.waypoints).max() > _FURTHEST:
        return f"waypoints within {_FURTHEST:g} m of the world's origin expected, found {goal.waypoints.tolist()}"
    return ""


def _off(start: Array, end: Array, xy: Array) -> float:
    """Distance [m] of a place (2,) from the straight way between two others."""
    return _rest(np.stack([start, end]), xy)[1]


def _command(goal: Goal, now_ns: int, velocity: Array, yaw_rate: float) -> VelocityCommand:
    return VelocityCommand(now_ns, velocity, yaw_rate, goal.body_height, goal.lift, goal.gait)


def same_goal(a: Goal, b: Goal) -> bool:
    """Whether two goals are one place."""
    return a.tolerance == b.tolerance and np.array_equal(a.waypoints, b.waypoints)


def _rest(corners: Array, xy: Array) -> tuple[Array, float]:
    """What is left of a way (k, 2) [m] from the place on it that is nearest to a robot (2,) [m], and how far that is [m]."""
    start, step = corners[:-1], np.diff(corners, axis=0)
    s = np.clip(((xy - start) * step).sum(axis=1) / np.maximum((step**2).sum(axis=1), 1e-12), 0.0, 1.0)
    on = start + s[:, None] * step
    off = np.linalg.norm(on - xy, axis=1)
    k = len(off) - 1 - int(np.argmin(off[::-1]))
    return np.vstack([xy, corners[k + 1 :]]), float(off[k])


def _along(way: Array, distance: float) -> Array:
    """The place (2,) so far [m] along a way (k, 2), at most its end."""
    for a, b in pairwise(way):
        length = _length(b - a)
        if length >= distance:
            return np.asarray(a + (b - a) * (distance / length))
        distance -= length
    return np.asarray(way[-1])


def _extent(way: Array) -> float:
    """How long [m] a way (k, 2) is."""
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())


def _length(v: Array) -> float:
    return hypot(float(v[0]), float(v[1]))


def _wrapped(angle: float) -> float:
    return (angle + pi) % (2.0 * pi) - pi
