"""Evaluate a run against ground truth: detect its end, and compute its report.

For each message, the scorer stores the data and checks only for the end: a fall, the goal or the time limit. Once a second it
compares the newest map. `result` computes everything else once, over whole arrays. Frame: {start}, as in
`sextant.evaluation.trace.course`.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import replace
from math import hypot

import numpy as np

from sextant.evaluation.metrics.map_metrics import Grid, GroundHeights, MapJudge, Mosaic, judge_course
from sextant.evaluation.report import ARRIVED, CourseMap, MapError, Report, StageTime
from sextant.evaluation.scoring.passage_metrics import passage_metrics
from sextant.evaluation.scoring.walk_report import (
    add_walk_metrics,
    camera_found,
    capture_to_plan,
    gait_choices,
    horns_found,
    pose_error,
)
from sextant.evaluation.trace.course import Course, Ground
from sextant.evaluation.trace.recorded_walk import Walk
from sextant.evaluation.trace.run_log import RunLog
from sextant.evaluation.trace.status_log import last_reason
from sextant.evaluation.trace.trace import Trace, trace_of
from sextant.shared.geometry import Array, inverse, rotation_z, transform, yaw_of
from sextant.shared.robot.profile import JOINTS, LEGS, RobotProfile
from sextant.shared.runtime.service import Inbox, Stages
from sextant.shared.scenario.mismatch import Mismatch
from sextant.shared.scenario.scenario import Scenario
from sextant.shared.wire import topics
from sextant.shared.wire.messages import GroundTruth, Message, Mode, TerrainMap

FALL_TILT_DEG = 35.0  # [deg]
_FALL_COSINE = float(np.cos(np.radians(FALL_TILT_DEG)))
_CLEARANCE = 0.005  # [m] a body underside closer to the ground than this counts as a fall
_ON_GROUND = "the body touched the ground"
_STOPPED_S = 10.0  # [s] before the time limit, in which what stopped the robot is why it did not arrive
_REST_NS = 500_000_000  # [ns] the body is at rest after it has not moved for this time
_WAY_S = 0.5  # [s] between places whose distances are the length of a way
_REST_MOTION = 0.003  # [m] motion below which the body counts as not moving
_LOST_NS = 2_000_000_000  # [ns] a run continues for this time after a servo shutdown: a latched error persists
_MAP_PERIOD_NS = 1_000_000_000  # [ns]
_COURSE_MARGIN = 1.2  # [m] of map kept around the course
_PATH_MARGIN = 0.5  # [m] around the straight path: the area of the ground grid used to detect falls
_ROUTE_MARGIN = 2.0  # [m] the same margin for scenarios in which the planner chooses the route
_RESOLUTIONS, _FAR = (0.001, 1.0), 1e4  # [m] valid cell sizes of a map, and the largest valid origin


class Scorer:
    """Evaluator of one run; it reads the ground truth and publishes nothing."""

    name = "scorer"
    trigger = topics.TRUTH
    subscribes = (
        topics.BODY_POSE,
        topics.CAMERA_ERRORS,
        topics.HORN_ERRORS,
        topics.TERRAIN,
        topics.ACTUATOR_STATE,
        topics.STEP_PLAN,
        topics.PASSAGE_PLAN,
        topics.PASSAGE,
        topics.PLANNER_STATUS,
    )
    publishes = ()

    def __init__(
        self,
        profile: RobotProfile,
        scenario: Scenario,
        seed: int,
        terrain: Ground | None = None,
        passable: bool | None = None,
    ):
        """Build the true ground.

        Args:
            profile: The robot.
            scenario: The scenario of the run.
            seed: Seed of the run.
            terrain: The ground, in place of the scenario's.
            passable: Whether a way across exists, where the seed decides; None to let the scorer search for one.
        """
        self.stages = Stages()
        self.finished = self._looked = False
        self._profile, self._scenario, self._seed, self._passable = profile, scenario, seed, passable
        self._course = Course(scenario, seed, terrain)
        self._heard = RunLog()
        self._recent: deque[tuple[int, float, float]] = deque()  # stamp, x, y of the last half second
        self._goal_ns: int | None = None
        self._stood = False  # a robot that starts on its belly has not fallen
        self._fall = self._lain = ""
        self._shutdown_ns: int | None = None
        self._shutdown = np.zeros((6, 3), dtype=bool)  # servos that have shut down at any time, even if they work again
        self._end = ""
        self._x = 0.0
        self._waypoints = deque(scenario.goal.waypoints)  # [m] {start} that the body has not passed
        self._maps: MapJudge | None = None
        self._map_due_ns = 0
        self._lowest = profile.body.size[2] / 2 + _CLEARANCE
        self._walk: Walk | None = None
        self._trace: Trace | None = None

    # -- during the run

    def step(self, truth: GroundTruth, inbox: Inbox) -> Iterable[Message]:
        """Process one message of ground truth and the newly received service messages."""
        heard = self._heard
        stood = heard.first_step_ns is None
        heard.take_in(truth, inbox)
        self._walk = self._trace = None
        if len(heard.truth) == 1:
            self._lay_start(truth.T_world_body, truth.feet)
            self._end = self._mistaken(truth)
            self.finished = bool(self._end)
        if stood and heard.first_step_ns is not None:
            self._anchor(truth.feet)
        if truth.stamp_ns >= self._map_due_ns:
            terrain = inbox.latest(topics.TERRAIN)
            if terrain is not None and heard.poses:
                self._map_due_ns = truth.stamp_ns + _MAP_PERIOD_NS
                self._look_at(terrain)
        if not self.finished:
            self._judge(truth)
        return ()

    def status(self) -> str:
        """Return the progress by ground truth, or the reason for the end."""
        return self._end or f"judging: true distance {self._progress}"

    @property
    def _progress(self) -> str:
        """How far the body is, as text."""
        goal = self._scenario.goal
        if self._waypoints:
            return f"{len(goal.waypoints) - len(self._waypoints)} of {len(goal.waypoints)} waypoints"
        return f"{self._x:.2f} of {goal.distance:.2f} m"

    @property
    def reason(self) -> str:
        """Reason for the end of the run as text; empty while it goes on."""
        return self._end

    def _lay_start(self, T: Array, feet: Array) -> None:
        """Place {start} under a body pose (4, 4) and feet (6, 3) [m] in the simulator's world."""
        self._course.lay(T, float(feet[:, 2].min()) - self._profile.foot.radius)
        self._maps = None  # the old maps used the previous {start}
        self._rows = self._course.T_start_sim[:3].tolist()
        margin = _ROUTE_MARGIN if self._scenario.goal.route else _PATH_MARGIN
        self._ground = GroundHeights(self._course.around(margin), self._course.T_start_sim, self._course.height_at)

    def _anchor(self, feet: Array) -> None:
        """Place {start} again where the robot stands before its first step, on feet (6, 3) [m].

        There, truth and estimate then agree.
        """
        heard = self._heard
        newest = heard.poses[-1].stamp_ns if heard.poses else 0
        poses = [p for p in heard.poses if p.stamp_ns > newest - _REST_NS and heard.begin_ns <= p.stamp_ns]
        if not poses:
            return
        t = np.array([p.stamp_ns - heard.begin_ns for p in poses], dtype=np.float64)
        nearest = np.minimum(np.searchsorted(heard.stamps(), t), len(heard.truth) - 1)
        both = zip(heard.truth["T_world_body"][nearest], poses, strict=True)
        mean = np.mean([_flat(T_true) @ inverse(_flat(p.T_world_body)) for T_true, p in both], axis=0)
        self._lay_start(transform(rotation_z(yaw_of(mean)), mean[:3, 3]), feet)

    def _mistaken(self, truth: GroundTruth) -> str:
        """Return why this is not the expected run, or an empty string."""
        wanted = (self._scenario.name, self._seed, self._profile.name)
        found = (truth.scenario, truth.seed, truth.robot)
        words = "{} with seed {} and robot {}"
        if found == wanted:
            return ""
        return f"{words.format(*wanted)} expected, but the simulator runs {words.format(*found)}; start another simulator"

    def _judge(self, truth: GroundTruth) -> None:
        now, goal = truth.stamp_ns, self._scenario.goal
        position = truth.T_world_body[:3, 3].tolist()
        x, y, z = (sum(a * b for a, b in zip(row, position, strict=False)) + row[3] for row in self._rows)
        self._x = x
        seconds = (now - self._heard.begin_ns) * 1e-9
        how, order = self._falling(truth, z), self._heard.states[-1] if self._heard.states else None
        if how == _ON_GROUND and order is not None and order.mode is Mode.SIT:
            self._lain = f"lay down at {x:.2f} m after {seconds:.1f} s: {order.reason}"
        elif how:
            self._fall = f"fell at {x:.2f} m after {seconds:.1f} s: {how}"
        self._shutdown |= truth.shutdown
        if self._shutdown_ns is None and truth.shutdown.any():
            self._shutdown_ns = now
        while self._waypoints and hypot(x - self._waypoints[0][0], y - self._waypoints[0][1]) <= goal.corridor:
            self._waypoints.popleft()
        if self._goal_ns is None and not self._waypoints and x >= goal.distance and abs(y) <= goal.corridor:
            self._goal_ns = now
        self._end = self._ending(now, x, y)
        self.finished = bool(self._end)

    def _falling(self, truth: GroundTruth, z: float) -> str:
        """Return how the robot is falling, or ""; `z` is the body's height [m] {start}."""
        T = truth.T_world_body
        on_ground = z - self._ground.under(float(T[0, 3]), float(T[1, 3])) < self._lowest
        self._stood |= not on_ground
        cos_tilt = max(-1.0, float(T[2, 2]))
        if cos_tilt < _FALL_COSINE:
            return f"tilted by {np.degrees(np.arccos(cos_tilt)):.0f} deg"
        return _ON_GROUND if on_ground and self._stood else ""

    def _ending(self, now: int, x: float, y: float) -> str:
        """Return why the run ends at `now` [ns], or an empty string.

        The body is at (x, y) [m] {start}.
        """
        goal, at_rest = self._scenario.goal, self._rests(now, x, y)
        if self._fall or self._lain:
            return self._fall or self._lain
        if self._shutdown_ns is not None and now - self._shutdown_ns >= _LOST_NS:
            return self._shutdown_words()
        if not self._waypoints and x >= goal.distance and at_rest:
            beside = f"crossed the goal line {abs(y):.2f} m off its middle; the corridor is {goal.corridor:.2f} m wide"
            return beside if self._goal_ns is None else ARRIVED
        if goal.expect != "arrival" and self._heard.refusal and at_rest:
            return f"stood and reported why: {self._heard.refusal}"
        if (now - self._heard.begin_ns) * 1e-9 >= self._scenario.time_limit_s:
            limit_s = self._scenario.time_limit_s
            late = f"time limit of {limit_s:g} s, {self._progress} done"
            return f"{reason}; {late}" if (reason := last_reason(self._heard, limit_s - _STOPPED_S)) else late
        return ""

    def _rests(self, now: int, x: float, y: float) -> bool:
        """Return whether the body has not moved for `_REST_NS`."""
        recent = self._recent
        recent.append((now, x, y))
        while now - recent[0][0] > _REST_NS:
            recent.popleft()
        then, x0, y0 = recent[0]
        return now - then > 0.9 * _REST_NS and (x - x0) ** 2 + (y - y0) ** 2 < _REST_MOTION**2

    def _shutdown_words(self) -> str:
        legs, joints = np.nonzero(self._shutdown)
        names = [f"{LEGS[leg]} {JOINTS[joint]}" for leg, joint in zip(legs, joints, strict=True)]
        return f"servo shut down: {', '.join(names[:4])}" + (f" and {len(names) - 4} more" if len(names) > 4 else "")

    def _look_at(self, terrain: TerrainMap) -> None:
        low, high = _RESOLUTIONS
        if not low <= terrain.resolution <= high or np.abs(terrain.origin).max() > _FAR or not terrain.elevation.size:
            return  # an invalid map, which the planner reports; it must not end the evaluation
        if self._maps is None or not self._maps.grid.fits(terrain):
            grid = Grid.of(self._course.around(_COURSE_MARGIN), terrain)
            self._maps = MapJudge(grid, self._course.height_at)
        self._maps.add(terrain, self._heard.poses[-1].T_world_body, compare=self._heard.first_step_ns is not None)

    # -- after the run

    @property
    def walk(self) -> Walk:
        """The walk, one row per sample; empty without ground truth."""
        if self._walk is None:
            self._walk = Walk(self._heard, self._course, self._profile)
        return self._walk

    @property
    def trace(self) -> Trace:
        """The run as arrays; empty without ground truth."""
        if self._trace is None:
            mosaic = self._maps.mosaic() if self._maps is not None else None
            self._trace = trace_of(self.walk, self._heard, self._course, self._scenario, self._profile, mosaic)
        return self._trace

    def result(
        self,
        reason: str = "",
        real_time_factor: float = float("nan"),
        stages_ms: Mapping[str, StageTime] | None = None,
        in_a_hurry: bool = False,
    ) -> Report:
        """Evaluate the run so far.

        Args:
            reason: Why the run was ended if the scorer did not end it (by the operator or the launcher).
            real_time_factor: Simulated over elapsed time.
            stages_ms: Durations of the services' stages.
            in_a_hurry: Skip the map of the whole course, which takes one or two seconds to start, and the search for a way
                across, which may take a minute.
        """
        scenario, profile = self._scenario, self._profile
        if not in_a_hurry and len(self._heard.truth) > 1:
            self._look_for_a_way()
        shutdowns = int(self._shutdown.sum())
        arrived, right = self._goal_ns is not None, self._did_right()
        collisions = self.walk.collisions if len(self._heard.truth) > 1 else 0
        success = right and not self._fall and not shutdowns and not (scenario.goal.route and collisions)
        report = Report(
            scenario=scenario.name,
            seed=self._seed,
            robot=profile.name,
            gait=scenario.walk.gait,
            blind=scenario.walk.blind,
            success=success,
            reason=(ARRIVED if arrived else self._end) if success else self._failure(shutdowns, collisions, reason),
            distance_m=self._x,
            duration_s=0.0,
            speed_mps=0.0,
            falls=int(bool(self._fall)),
            shutdowns=shutdowns,
            steps=0,
            collisions=collisions,
            real_time_factor=real_time_factor,
            stages_ms=dict(stages_ms or {}),
            deviation={} if scenario.mismatch == Mismatch() else scenario.deviation(self._seed).as_table(),
        )
        if len(self._heard.truth) < 2:
            return report
        return self._measured(report, in_a_hurry)

    def _look_for_a_way(self) -> None:
        """Search once for a way across, if the seed decides and the result was not given."""
        if self._looked or self._passable is not None:
            return
        from sextant.evaluation.scoring.passage_truth import (  # imports the planner, which is not installed everywhere
            decided_by_seed,
            way_exists,
        )

        self._looked = True
        if decided_by_seed(self._scenario):
            self._passable = way_exists(self._profile, self._scenario, self._course)

    def _did_right(self) -> bool:
        """Return whether the robot did what is right here: arrive, or stop and report why.

        Refusing after a step onto a pillar is wrong.
        """
        expect, arrived = self._scenario.goal.expect, self._goal_ns is not None
        refused = bool(self._heard.refusal) and not arrived
        if expect == "either":
            refused = refused and not np.isfinite(self._course.edge_distance(self.trace.touchdowns.p[:, :2])).any()
            expect = "either" if self._passable is None else "arrival" if self._passable else "refusal"
        return (expect != "refusal" and arrived) or (expect != "arrival" and refused)

    def _failure(self, shutdowns: int, collisions: int, reason: str) -> str:
        if not self._heard.truth:
            return reason or "no ground truth received; is the simulator running?"
        if self._fall:
            return self._fall
        if shutdowns:
            return self._shutdown_words()
        if collisions and self._scenario.goal.route:
            return f"hit obstacles {collisions} times"
        if self._end == ARRIVED:
            return "crossed a passage that an exhaustive search found impassable"
        stopped = f"stopped at {self._progress}"
        return self._end or (f"{reason} ({stopped})" if reason else stopped)

    def _measured(self, report: Report, in_a_hurry: bool) -> Report:
        trace = self.trace
        speed, duration = self._speed()
        report = replace(
            report,
            distance_m=float(self._along()[-1]),
            duration_s=duration,
            speed_mps=speed,
            pose_error_m=pose_error(trace),
            map_error_m=self._maps.error() if self._maps is not None else MapError(),
            capture_to_plan_ms=capture_to_plan(self._heard),
            camera=camera_found(self._heard),
            horns=horns_found(self._heard),
            gait_choices=gait_choices(self._heard),
            warnings=tuple(self._heard.warnings.values()),
            hottest_servo_c=self._heard.hottest,
            course_map_m=CourseMap() if in_a_hurry else self._course_map(trace.mosaic),
        )
        if not trace.walking.any():
            return report
        report = add_walk_metrics(report, self.walk, trace, self._course)
        return replace(report, passage=passage_metrics(self.walk, self._heard, trace, self._course, self._passable))

    def _speed(self) -> tuple[float, float]:
        """Return the mean speed [m/s] and duration [s] from the first step to goal or end."""
        heard = self._heard
        if heard.first_step_ns is None:
            return 0.0, 0.0
        until = self._goal_ns if self._goal_ns is not None else heard.newest_ns
        duration = (until - heard.first_step_ns) * 1e-9
        if duration <= 0:
            return 0.0, 0.0
        ends = np.array([heard.first_step_ns - heard.begin_ns, until - heard.begin_ns]) * 1e-9
        along = np.interp(ends, self.trace.t, self._along())
        return float(along[1] - along[0]) / duration, duration

    def _along(self) -> Array:
        """Return the true progress (n,) [m] at each sample: ahead, or of a route with waypoints the length of the way so far.

        That is the length of the lines between places half a second apart, so that the body's sway in a step does not count.
        """
        trace = self.trace
        if not self._scenario.goal.waypoints:
            return trace.p_true[:, 0]
        times = np.append(np.arange(trace.t[0], trace.t[-1], _WAY_S), trace.t[-1])
        xy = np.stack([np.interp(times, trace.t, trace.p_true[:, k]) for k in range(2)], axis=1)
        lengths = np.hypot(*np.diff(xy, axis=0).T)
        return np.asarray(np.interp(trace.t, times, np.append(0.0, np.cumsum(lengths))))

    def _course_map(self, mosaic: Mosaic | None) -> CourseMap:
        if mosaic is None:
            return CourseMap()
        every = max(1, round(topics.TRUTH.rate_hz * _MAP_PERIOD_NS * 1e-9))
        camera = self._profile.camera
        views = self._course.views((T @ camera.T_body_camera for T in self._heard.truth["T_world_body"][::every]), camera)
        return judge_course(mosaic, self._course.height_at, None if views is None else mosaic.in_view(views, camera))


def _flat(T: Array) -> Array:
    """Return the planar part of a pose (4, 4): position x, y and yaw."""
    return transform(rotation_z(yaw_of(T)), np.array([T[0, 3], T[1, 3], 0.0]))
