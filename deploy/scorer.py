"""Judges a run by the truth: ends it, and says afterwards how good it was.

Per message it keeps what comes and looks only for the end (a fall, the goal, the time limit); once a second it compares the
newest map. All else is computed once, in `result`, over whole arrays.

Frames: {start} lies on the true ground under the robot's starting place, x along its starting direction, z up. It is what the
services call {world}, as the truth has it: where the robot stands before its first step, it is laid so that place and heading
of the truth are those of the estimate, so errors count from there; its height is never taken from an estimate.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from deploy.map_metrics import Grid, GroundHeights, MapJudge, Mosaic, judge_course
from deploy.report import ARRIVED, CourseMap, HeightError, MapError, PoseError, Report, Slip, Spread, StageTime, Torque
from deploy.walk_metrics import (
    angle_between,
    debounced,
    is_foothold,
    rubbing,
    slip_per_step,
    stability_margin,
    touchdowns,
    walked_into,
)
from shared import topics
from shared.geometry import Array, apply, inverse, rotation_z, transform, yaw_of
from shared.kinematics import leg_points
from shared.messages import ActuatorState, BodyPose, GroundTruth, Message, Mode, PlannerStatus, StepPlan, TerrainMap
from shared.robot import JOINTS, LEGS, RobotProfile
from shared.scenario import Box, Hole, Pillars, Plane, Puddle, Puddles, Rubble, Scenario
from shared.service import Inbox, Stages

Counted = TypeVar("Counted", ActuatorState, StepPlan)

FALL_TILT_DEG = 35.0  # [deg]
_FALL_COSINE = float(np.cos(np.radians(FALL_TILT_DEG)))
_CLEARANCE = 0.005  # [m] the body's underside this near the ground is a fall
_REST_NS = 500_000_000  # [ns] at rest once the body has kept still for so long
_REST_MOTION = 0.003  # [m] stillness
_LOST_NS = 2_000_000_000  # [ns] a run goes on after a servo has shut down: a latched error stays
_MAP_PERIOD_NS = 1_000_000_000  # [ns]
_COURSE_MARGIN = 1.2  # [m] of map around the course that is kept
_IN_THE_WAY = (Box, Hole, Rubble, Pillars, Puddle, Puddles)  # without which the ground is what blocks are raised over
_PATH_MARGIN = 0.5  # [m] around the straight path where a fall is looked up on a grid
_ROUTE_MARGIN = 2.0  # [m] likewise, where the planner finds the way
_REFUSED_NS = 10_000_000_000  # [ns] that a robot must stand and say why, where that is right
_COLLISION_SAMPLES = 5  # of truth, of which one is looked at for what was walked into
_RAISED = 0.005  # [m]
_DEBOUNCE = max(1, round(0.02 * topics.TRUTH.rate_hz))  # samples of truth, 20 ms
_GROUNDED = 0.2  # [1] of a swing at its ends, in which a touching foot carries and does not brush
_RESOLUTIONS, _FAR = (0.001, 1.0), 1e4  # [m] cells and places of maps that make sense
_HANGING = 0.003  # [m] a standing foot over its ground catches the body after a degree of tilt
_STALE_NS = 250_000_000  # [ns] an actuator that has been silent for longer is not walking
_MOVED = 0.008  # [m] a touchdown this far off its fellows' pattern has been moved


class Ground(Protocol):
    """The true terrain."""

    def height_at(self, xy: Array) -> Array:
        """True height (n,) [m] at (n, 2) [m] {world of the simulator}."""
        ...


@dataclass(frozen=True, slots=True)
class Touchdowns:
    """Where feet came down, in order of time."""

    t: Array  # (k,) [s]
    leg: NDArray[np.intp]  # (k,)
    p: Array  # (k, 3) [m] {start} foot centres
    moved: NDArray[np.bool_]  # (k,) placed elsewhere than nominal
    raised: NDArray[np.bool_]  # (k,)
    misstep: NDArray[np.bool_]  # (k,)


@dataclass(frozen=True, slots=True)
class Trace:
    """A run as arrays, for the picture and for whoever looks closer. Times count from the first message of truth."""

    t: Array  # (n,) [s]
    walking: NDArray[np.bool_]  # (n,)
    p_true: Array  # (n, 3) [m] {start} body
    height_reference: Array  # (n,) [m] {start} commanded height of the body, NaN before the actuator spoke
    tilt: Array  # (n,) [rad] against the commanded attitude
    attitude: Array  # (n, 2) [rad] {start} true roll and pitch of the body
    attitude_reference: Array  # (n, 2) [rad] and those commanded
    feet: Array  # (n, 6, 3) [m] {start} true foot centres
    ground: Array  # (n, 6) [m] {start} true height of what is seen under them
    torque_worst: Array  # (n,) [N m] highest of all joints
    t_estimate: Array  # (m,) [s]
    p_estimate: Array  # (m, 3) [m] {start} body as perception has it
    touchdowns: Touchdowns
    mosaic: Mosaic | None
    routes: tuple[Array, ...]  # (k, 2) [m] {start} corners of the ways to a goal that the planner took, each from the robot on
    blocks: Array  # (b, 4, 2) [m] {start} corners of the boxes of the true terrain
    goal_distance: float  # [m]
    corridor: float  # [m]
    profile: RobotProfile


class Scorer:
    """Judge of one run; reads the truth, writes nothing."""

    name = "scorer"
    paced_by = topics.TRUTH
    reads = (topics.BODY_POSE, topics.TERRAIN, topics.ACTUATOR_STATE, topics.STEP_PLAN, topics.PLANNER_STATUS)
    writes = ()

    def __init__(self, profile: RobotProfile, scenario: Scenario, seed: int, terrain: Ground | None = None):
        """Build the true ground.

        Args:
            profile: The robot.
            scenario: What it is to do.
            seed: The run's; the terrain's generator is `default_rng([seed, 0])`, as the simulator's.
            terrain: The ground, in place of the scenario's.
        """
        from services.simulator.terrain import build_terrain  # a robot without the simulator can import this module

        self.stages = Stages()
        self.finished = False
        self._profile, self._scenario, self._seed = profile, scenario, seed
        self._terrain: Ground = build_terrain(scenario, np.random.default_rng([seed, 0])) if terrain is None else terrain
        unblocked = tuple(part for part in scenario.terrain if not isinstance(part, _IN_THE_WAY))
        bare = replace(scenario, terrain=unblocked or (Plane(),))
        self._unblocked: Ground = build_terrain(bare, np.random.default_rng([seed, 0]))
        self._truth: list[GroundTruth] = []
        self._recent: deque[tuple[int, float, float]] = deque()  # stamp, x, y of the last half second
        self._poses: list[BodyPose] = []
        self._states: list[ActuatorState] = []
        self._newest_step = self._steps_before = 0  # of the actuator as it counts, and of those before it
        self._plans: dict[int, StepPlan] = {}  # the newest revision of each step
        self._routes: list[Array] = []
        self._moved: dict[int, int] = {}  # footholds moved in each step, by the planner's word
        self._first_step_ns: int | None = None
        self._goal_ns: int | None = None
        self._beside = False
        self._stood = False  # a robot that starts on its belly has not fallen
        self._fall = ""
        self._shutdown_ns: int | None = None
        self._blocked_since_ns: int | None = None
        self._refusal = ""  # why the robot does not go on, in the planner's words, once it has said so for long
        self._end = ""
        self._x = 0.0
        self._begin_ns = 0
        self._T_sim_start = self._T_start_sim = np.eye(4)
        self._maps: MapJudge | None = None
        self._map_due_ns = 0
        self._lowest = profile.body.size[2] / 2 + _CLEARANCE
        self._trace: Trace | None = None

    # -- while it runs

    def step(self, truth: GroundTruth, inbox: Inbox) -> Iterable[Message]:
        """Take in one message of truth and what the services have said."""
        self._truth.append(truth)
        if len(self._truth) == 1:
            self._begin(truth)
        self._trace = None
        self._poses += inbox.drain(topics.BODY_POSE)
        for state in inbox.drain(topics.ACTUATOR_STATE):
            if state.step < self._newest_step:
                self._steps_before += self._newest_step  # an actuator that began anew counts from zero
            self._newest_step = state.step
            self._states.append(self._counted_on(state))
            if self._first_step_ns is None and state.mode is Mode.WALK:
                self._first_step_ns = state.stamp_ns
                self._anchor()
        for plan in inbox.drain(topics.STEP_PLAN):
            plan = self._counted_on(plan)
            known = self._plans.get(plan.step)
            if known is None or plan.revision >= known.revision:
                self._plans[plan.step] = plan
        for status in inbox.drain(topics.PLANNER_STATUS):
            self._note(status)
        if truth.stamp_ns >= self._map_due_ns:
            terrain = inbox.latest(topics.TERRAIN)
            if terrain is not None and self._poses:
                self._map_due_ns = truth.stamp_ns + _MAP_PERIOD_NS
                self._look_at(terrain)
        if not self.finished:
            self._judge(truth)
        return ()

    def _counted_on(self, message: Counted) -> Counted:
        """A message with its step counted from the run's beginning, over restarts of the actuator."""
        return replace(message, step=message.step + self._steps_before) if self._steps_before else message

    def doing(self) -> str:
        """How far it is, by the truth."""
        return self._end or f"judging: truly {self._x:.2f} of {self._scenario.goal.distance:.2f} m"

    @property
    def reason(self) -> str:
        """Why the run is over, in words; empty while it is not."""
        return self._end

    def _begin(self, truth: GroundTruth) -> None:
        self._begin_ns = truth.stamp_ns
        self._lay_start(truth.T_world_body)

    def _lay_start(self, T: Array) -> None:
        """Lay {start} under a pose (4, 4) of the body in the simulator's world."""
        ground = float(self._terrain.height_at(T[None, :2, 3])[0])
        # Over an abyss the robot starts on what its feet stand on.
        level = ground if np.isfinite(ground) else float(self._truth[-1].feet[:, 2].min()) - self._profile.foot.radius
        self._T_sim_start = transform(rotation_z(yaw_of(T)), np.array([T[0, 3], T[1, 3], level]))
        self._T_start_sim = inverse(self._T_sim_start)
        self._maps = None  # what was laid over the old frame
        self._rows = self._T_start_sim[:3].tolist()
        margin = _ROUTE_MARGIN if self._scenario.goal.route else _PATH_MARGIN
        self._ground = GroundHeights(self._around(margin), self._T_start_sim, self._height_in_start)

    def _anchor(self) -> None:
        """Lay {start} anew where the robot stands before its first step, so that truth and estimate agree there."""
        newest = self._poses[-1].stamp_ns if self._poses else 0
        poses = [p for p in self._poses if p.stamp_ns > newest - _REST_NS and self._begin_ns <= p.stamp_ns]
        if not poses:
            return
        t = np.array([p.stamp_ns - self._begin_ns for p in poses], dtype=np.float64)
        nearest = np.minimum(np.searchsorted(self._stamps(), t), len(self._truth) - 1)
        both = zip(nearest, poses, strict=True)
        mean = np.mean([_flat(self._truth[k].T_world_body) @ inverse(_flat(p.T_world_body)) for k, p in both], axis=0)
        self._lay_start(transform(rotation_z(yaw_of(mean)), mean[:3, 3]))

    def _around(self, margin: float) -> tuple[float, float, float, float]:
        """Lowest and highest x, then y [m] {start}, of the course with a margin [m]."""
        return -margin, self._scenario.goal.distance + margin, -margin, margin

    def _height_in_start(self, xy: Array) -> Array:
        """True height (n,) [m] {start} at (n, 2) [m] {start}."""
        T = self._T_sim_start
        return np.asarray(self._terrain.height_at(xy @ T[:2, :2].T + T[:2, 3]) - T[2, 3])

    def _sink_in_start(self, xy: Array) -> Array:
        """How far (n,) [m] the ground at (n, 2) [m] {start} gives way."""
        sink_at = getattr(self._terrain, "sink_at", None)
        T = self._T_sim_start
        return np.zeros(len(xy)) if sink_at is None else np.asarray(sink_at(xy @ T[:2, :2].T + T[:2, 3]))

    def _carrying_in_start(self, xy: Array) -> Array:
        """Height (n,) [m] {start} of what carries at (n, 2) [m] {start}: below what is seen where that gives way."""
        return self._height_in_start(xy) - self._sink_in_start(xy)

    def _note(self, status: PlannerStatus) -> None:
        self._moved[status.step + self._steps_before] = status.moved_footholds
        if len(status.path) and not any(_goes_on(status.path, known) for known in self._routes[-1:]):
            self._routes.append(status.path)
        if status.state != "blocked":
            self._blocked_since_ns = None
            return
        if self._blocked_since_ns is None:
            self._blocked_since_ns = status.stamp_ns
        if status.stamp_ns - self._blocked_since_ns >= _REFUSED_NS:
            self._refusal = status.reason

    def _judge(self, truth: GroundTruth) -> None:
        T, now = truth.T_world_body, truth.stamp_ns
        position = T[:3, 3].tolist()
        x, y, z = (sum(a * b for a, b in zip(row, position, strict=False)) + row[3] for row in self._rows)
        self._x = x
        goal = self._scenario.goal
        seconds = (now - self._begin_ns) * 1e-9
        cos_tilt = max(-1.0, float(T[2, 2]))
        on_ground = z - self._ground.under(position[0], position[1]) < self._lowest
        self._stood |= not on_ground
        if cos_tilt < _FALL_COSINE:
            self._fall = f"fell {x:.2f} m along after {seconds:.1f} s: tilted by {np.degrees(np.arccos(cos_tilt)):.0f} deg"
        elif on_ground and self._stood:
            self._fall = f"fell {x:.2f} m along after {seconds:.1f} s: the body touched the ground"
        if self._shutdown_ns is None and truth.shutdown.any():
            self._shutdown_ns = now
        if x >= goal.distance:
            if self._goal_ns is None and abs(y) <= goal.corridor:
                self._goal_ns = now
            self._beside = self._goal_ns is None
        recent = self._recent
        recent.append((now, x, y))
        while now - recent[0][0] > _REST_NS:
            recent.popleft()
        _, x0, y0 = recent[0]
        at_rest = now - recent[0][0] > 0.9 * _REST_NS and (x - x0) ** 2 + (y - y0) ** 2 < _REST_MOTION**2
        if self._fall:
            self._end = self._fall
        elif self._shutdown_ns is not None and now - self._shutdown_ns >= _LOST_NS:
            self._end = self._shutdown_words()
        elif x >= goal.distance and at_rest:
            self._end = ARRIVED
            if self._goal_ns is None:
                self._end = f"passed the goal line {abs(y):.2f} m beside its middle; the corridor is {goal.corridor:.2f} m wide"
        elif goal.expect == "refusal" and self._refusal and at_rest:
            self._end = f"stood and said why: {self._refusal}"
        elif seconds >= self._scenario.time_limit_s:
            self._end = f"time limit of {self._scenario.time_limit_s:g} s, {x:.2f} of {goal.distance:.2f} m done"
        self.finished = bool(self._end)

    def _shutdown_words(self) -> str:
        legs, joints = np.nonzero(self._truth[-1].shutdown)
        names = [f"{LEGS[leg]} {JOINTS[joint]}" for leg, joint in zip(legs, joints, strict=True)]
        return f"servo shut down: {', '.join(names[:4])}" + (f" and {len(names) - 4} more" if len(names) > 4 else "")

    def _stamps(self) -> Array:
        return np.array([m.stamp_ns - self._begin_ns for m in self._truth], dtype=np.float64)

    def _look_at(self, terrain: TerrainMap) -> None:
        low, high = _RESOLUTIONS
        if not low <= terrain.resolution <= high or np.abs(terrain.origin).max() > _FAR or not terrain.elevation.size:
            return  # no map of anything, which the planner says; it must not end the judging
        if self._maps is None or not self._maps.grid.fits(terrain):
            grid = Grid.of(self._around(_COURSE_MARGIN), terrain)
            self._maps = MapJudge(grid, self._height_in_start)
        self._maps.add(terrain, self._poses[-1].T_world_body, compare=self._first_step_ns is not None)

    # -- when it is over

    @property
    def trace(self) -> Trace:
        """The run as arrays, empty where nothing came."""
        if self._trace is None:
            self._trace = self._make_trace()
        return self._trace

    def result(
        self,
        reason: str = "",
        real_time_factor: float = float("nan"),
        stages_ms: Mapping[str, StageTime] | None = None,
        in_a_hurry: bool = False,
    ) -> Report:
        """Judge the run as far as it has come.

        Args:
            reason: Why the run was ended, where the scorer did not end it (what the operator or the launcher says).
            real_time_factor: Simulated over elapsed time.
            stages_ms: How long the services' stages took.
            in_a_hurry: Leave out the map of the whole course, whose judge takes a second or two to get going.
        """
        scenario, profile = self._scenario, self._profile
        shutdowns = int(self._truth[-1].shutdown.sum()) if self._truth else 0
        refused = scenario.goal.expect == "refusal"
        right = bool(self._refusal) and self._goal_ns is None if refused else self._goal_ns is not None
        collisions = self._collisions() if len(self._truth) > 1 else 0
        success = right and not self._fall and not shutdowns and not (scenario.goal.route and collisions)
        report = Report(
            scenario=scenario.name,
            seed=self._seed,
            robot=profile.name,
            gait=scenario.walk.gait,
            blind=scenario.walk.blind,
            success=success,
            reason=(self._end if refused else ARRIVED) if success else self._failure(shutdowns, collisions, reason),
            distance_m=self._x,
            duration_s=0.0,
            speed_mps=0.0,
            falls=int(bool(self._fall)),
            shutdowns=shutdowns,
            steps=0,
            collisions=collisions,
            real_time_factor=real_time_factor,
            stages_ms=dict(stages_ms or {}),
        )
        if len(self._truth) < 2:
            return report
        return self._measured(report, in_a_hurry)

    def _collisions(self) -> int:
        """How often a foot or the body ran into what is higher than a step, or a foot hung in a hole."""
        some = self._truth[::_COLLISION_SAMPLES]
        feet = np.array([m.feet for m in some])
        bodies = np.array([m.T_world_body for m in some])
        return walked_into(self._terrain.height_at, feet, bodies, self._profile.foot.radius, self._profile.body.size)

    def _failure(self, shutdowns: int, collisions: int, reason: str) -> str:
        if not self._truth:
            return reason or "no ground truth came: is the simulator running?"
        if self._fall:
            return self._fall
        if shutdowns:
            return self._shutdown_words()
        if collisions and self._scenario.goal.route:
            return f"walked into something {collisions} times"
        stopped = f"stopped {self._x:.2f} of {self._scenario.goal.distance:.2f} m along"
        return self._end or (f"{reason} ({stopped})" if reason else stopped)

    def _measured(self, report: Report, in_a_hurry: bool) -> Report:
        trace = self.trace
        walking = trace.walking
        speed, duration = self._speed()
        stance_step = self._step_numbers()
        report = replace(
            report,
            distance_m=float(trace.p_true[-1, 0]),
            duration_s=duration,
            speed_mps=speed,
            pose_error_m=self._pose_error(trace),
            map_error_m=self._maps.error() if self._maps is not None else MapError(),
            course_map_m=CourseMap() if in_a_hurry else self._course_map(trace.mosaic),
        )
        if not walking.any():
            return report
        torque = np.abs(np.array([m.torque for m in self._truth]))[walking]
        height_error = (trace.p_true[:, 2] - trace.height_reference)[walking]
        height = trace.p_true[walking, 2]
        feet = self._feet()[..., :2]
        planted = self._contact() & ~self._swing() & walking[:, None]
        margin = stability_margin(feet[walking], self._carrying()[walking], trace.p_true[walking, :2])
        slip = slip_per_step(rubbing(feet, self._shanks(), self._profile.foot.radius), planted, stance_step)
        downs = trace.touchdowns
        commanded = self._commanded_tilt()[walking]
        return replace(
            report,
            steps=len(np.unique(stance_step[walking])),
            tilt_deg=_spread(np.degrees(trace.tilt[walking])),
            commanded_tilt_deg=_spread(np.degrees(commanded)),
            torque_nm=Torque(
                p95=float(np.percentile(torque, 95)),
                max=float(torque.max()),
                rms_worst_joint=float(np.sqrt(np.mean(torque**2, axis=0)).max()),
            ),
            touchdowns=len(downs.t),
            raised_touchdowns=int(downs.raised.sum()),
            raised_block_touchdowns=self._on_blocks(downs),
            body_height_error_m=HeightError(float(height_error.mean()), float(np.sqrt(np.mean(height_error**2)))),
            body_height_oscillation_m=float(np.subtract(*np.percentile(height, [95, 5]))),
            slip_m_per_step=Slip(*np.percentile(slip, [50, 95]).tolist()) if len(slip) else Slip(),
            missteps=int(downs.misstep.sum()),
            min_stability_margin_m=float(np.nanmin(margin)) if np.isfinite(margin).any() else np.nan,
        )

    def _course_map(self, mosaic: Mosaic | None) -> CourseMap:
        if mosaic is None:
            return CourseMap()
        from services.simulator.terrain import Terrain as Solid  # as above

        seen = None
        if isinstance(self._terrain, Solid):
            from services.simulator.render import Renderer

            renderer = Renderer(self._terrain, self._profile.camera.intrinsics)
            every = max(1, round(topics.TRUTH.rate_hz * _MAP_PERIOD_NS * 1e-9))
            bodies = (m.T_world_body for m in self._truth[::every])
            views = ((renderer.depth(T), T) for T in (T @ self._profile.camera.T_body_camera for T in bodies))
            seen = mosaic.in_view(((depth, self._T_start_sim @ T) for depth, T in views), self._profile.camera)
        return judge_course(mosaic, self._height_in_start, seen)

    def _make_trace(self) -> Trace:
        t_ns = self._stamps()
        p_true = apply(self._T_start_sim, np.array([m.T_world_body[:3, 3] for m in self._truth]).reshape(-1, 3))
        up_true = np.array([m.T_world_body[2, :3] for m in self._truth]).reshape(-1, 3)  # {body} the vertical
        self._align_states(t_ns)
        height = np.full(len(t_ns), np.nan)
        up = np.tile([0.0, 0.0, 1.0], (len(t_ns), 1))
        if self._states:
            z, up_states = self._references()
            before = t_ns < self._state_t[0]
            height = np.where(before, np.nan, np.interp(t_ns, self._state_t, z))
            up = up_states[self._state_of]
        self._up_commanded = up
        feet = self._feet()
        return Trace(
            t=t_ns * 1e-9,
            walking=self._walking,
            p_true=p_true,
            height_reference=height,
            tilt=angle_between(up_true, up),
            attitude=_lean(up_true),
            attitude_reference=_lean(up),
            feet=feet,
            ground=self._height_in_start(feet[..., :2].reshape(-1, 2)).reshape(-1, 6),
            torque_worst=np.abs(np.array([m.torque for m in self._truth]).reshape(-1, 18)).max(axis=1),
            t_estimate=np.array([p.stamp_ns - self._begin_ns for p in self._poses]) * 1e-9,
            p_estimate=np.array([p.T_world_body[:3, 3] for p in self._poses]).reshape(-1, 3),
            touchdowns=self._touchdowns(t_ns * 1e-9),
            mosaic=self._maps.mosaic() if self._maps is not None else None,
            routes=tuple(self._routes),
            blocks=self._block_corners(),
            goal_distance=self._scenario.goal.distance,
            corridor=self._scenario.goal.corridor,
            profile=self._profile,
        )

    def _align_states(self, t_ns: Array) -> None:
        """For each sample of truth the actuator's word that held then."""
        self._state_t = np.array([s.stamp_ns - self._begin_ns for s in self._states], dtype=np.float64)
        if not self._states:
            self._state_of = np.zeros(len(t_ns), dtype=np.intp)
            self._walking = np.zeros(len(t_ns), dtype=bool)
            return
        self._state_of = np.clip(np.searchsorted(self._state_t, t_ns, side="right") - 1, 0, None)
        age = t_ns - self._state_t[self._state_of]
        walk = np.array([s.mode is Mode.WALK for s in self._states])
        self._walking = walk[self._state_of] & (age >= 0) & (age < _STALE_NS)

    def _references(self) -> tuple[Array, Array]:
        """Commanded height (m,) [m] {start} and the vertical in the commanded body (m, 3), for each word of the actuator.

        A reference is {odom}'s; the plan of its step ties it to {world}.
        """
        numbers = np.array(sorted(self._plans) or [0])
        ties = np.array([self._plans[n].T_world_odom for n in numbers]) if self._plans else np.eye(4)[None]
        steps = np.array([s.step for s in self._states])
        tie = ties[np.clip(np.searchsorted(numbers, steps, side="right") - 1, 0, None)]
        reference = tie @ np.array([s.body_ref for s in self._states])
        return reference[:, 2, 3], reference[:, 2, :3]

    def _commanded_tilt(self) -> Array:
        return angle_between(self._up_commanded, np.array([0.0, 0.0, 1.0]))

    def _feet(self) -> Array:
        return apply(self._T_start_sim, np.array([m.feet for m in self._truth]).reshape(-1, 6, 3))

    def _shanks(self) -> Array:
        """Unit vectors (n, 6, 3) {start} from the feet up the shanks."""
        legs = leg_points(self._profile, np.array([m.q for m in self._truth]).reshape(-1, 6, 3))
        R = self._T_start_sim[:3, :3] @ np.array([m.T_world_body[:3, :3] for m in self._truth]).reshape(-1, 3, 3)
        shanks = (legs[:, :, 2] - legs[:, :, 3]) / self._profile.links.tibia
        return np.asarray(np.einsum("nij,nkj->nki", R, shanks))

    def _contact(self) -> NDArray[np.bool_]:
        return debounced(np.array([m.contact for m in self._truth], dtype=bool).reshape(-1, 6), _DEBOUNCE)

    def _swing(self) -> NDArray[np.bool_]:
        swing = np.array([s.swing for s in self._states]).reshape(-1, 6)
        if not len(swing):
            return np.zeros((len(self._truth), 6), dtype=bool)
        return np.asarray(swing[self._state_of] & self._walking[:, None])

    def _carrying(self) -> NDArray[np.bool_]:
        """Feet (n, 6) that carry, or would as soon as the body leaned on them.

        In contact and in stance by plan, about to leave or just landed; or in stance and no more than a little over its ground.
        """
        phase = np.array([s.phase for s in self._states])[self._state_of]
        grounded = (phase < _GROUNDED) | (phase > 1.0 - _GROUNDED)
        stance, trace = ~self._swing(), self.trace
        hangs_low = trace.feet[..., 2] - self._profile.foot.radius - trace.ground < _HANGING
        return np.asarray(self._contact() & (stance | grounded[:, None]) | (stance & hangs_low))

    def _step_numbers(self) -> NDArray[np.int64]:
        steps = np.array([s.step for s in self._states] or [0])
        return np.asarray(steps[self._state_of])

    def _touchdowns(self, t: Array) -> Touchdowns:
        found = touchdowns(self._contact(), self._swing())
        sample = np.minimum(found[:, 0] + _DEBOUNCE, len(t) - 1)  # the foot has settled
        leg = found[:, 1]
        p = self._feet()[sample, leg]
        swung = self._step_numbers()[np.maximum(found[:, 0] - 1, 0)]
        moved = np.array([bool(self._moved_legs(int(n))[k]) for n, k in zip(swung, leg, strict=True)], dtype=bool)
        return Touchdowns(
            t=t[found[:, 0]],
            leg=leg,
            p=p,
            moved=moved,
            raised=self._height_in_start(p[:, :2]) > _RAISED,
            misstep=~is_foothold(self._carrying_in_start, p[:, :2]) | (self._sink_in_start(p[:, :2]) > 0),
        )

    def _moved_legs(self, step: int) -> NDArray[np.bool_]:
        """Legs (6,) whose touchdown the planner moved.

        It says how many; which ones shows in their pattern: nominal touchdowns lie alike to their resting places.
        """
        plan = self._plans.get(step)
        moved = np.zeros(6, dtype=bool)
        if plan is None or not plan.swing.any():
            return moved
        rest = self._profile.rest_feet()
        offset = (apply(inverse(plan.body_goal), plan.touchdown) - rest)[:, :2]
        strange = np.where(plan.swing, np.linalg.norm(offset - np.median(offset[plan.swing], axis=0), axis=1), -1.0)
        count = self._moved.get(step)
        if count is None:
            return np.asarray(strange > _MOVED)
        moved[np.argsort(-strange, kind="stable")[: min(count, int(plan.swing.sum()))]] = True
        return moved

    def _on_blocks(self, downs: Touchdowns) -> int:
        T = self._T_sim_start
        xy = downs.p[:, :2] @ T[:2, :2].T + T[:2, 3]
        without = np.maximum(self._unblocked.height_at(xy), T[2, 3])
        return int((self._terrain.height_at(xy) > without + _RAISED).sum())

    def _speed(self) -> tuple[float, float]:
        """Mean speed [m/s] from the first step to the goal, or to the end, and the time [s] that took."""
        if self._first_step_ns is None:
            return 0.0, 0.0
        until = self._goal_ns if self._goal_ns is not None else self._truth[-1].stamp_ns
        duration = (until - self._first_step_ns) * 1e-9
        if duration <= 0:
            return 0.0, 0.0
        trace = self.trace
        ends = np.array([self._first_step_ns - self._begin_ns, until - self._begin_ns]) * 1e-9
        x = np.interp(ends, trace.t, trace.p_true[:, 0])
        return float(x[1] - x[0]) / duration, duration

    def _pose_error(self, trace: Trace) -> PoseError:
        if not trace.walking.any():
            return PoseError()
        # While it stands before its first step both are one by construction.
        first = trace.t[int(np.argmax(trace.walking))]
        known = (trace.t_estimate >= first) & (trace.t_estimate <= trace.t[-1])
        if not known.any():
            return PoseError()
        true = np.stack([np.interp(trace.t_estimate[known], trace.t, trace.p_true[:, k]) for k in range(3)], axis=1)
        error = np.linalg.norm(trace.p_estimate[known] - true, axis=1)
        return PoseError(float(np.sqrt(np.mean(error**2))), float(error[-1]))

    def _block_corners(self) -> Array:
        boxes = getattr(self._terrain, "boxes", None)
        if boxes is None or not len(boxes):
            return np.zeros((0, 4, 2))
        corners = np.array([[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]]) * boxes.half[:, None]
        top = np.einsum("bij,bkj->bki", boxes.R, corners) + boxes.centre[:, None]
        return apply(self._T_start_sim, top)[..., :2]


def _flat(T: Array) -> Array:
    """Place and heading of a pose (4, 4): the part that lies in the plane."""
    return transform(rotation_z(yaw_of(T)), np.array([T[0, 3], T[1, 3], 0.0]))


def _lean(up: Array) -> Array:
    """Roll and pitch (n, 2) [rad] of bodies that have the vertical at (n, 3) {body}."""
    return np.stack([np.arctan2(up[:, 1], up[:, 2]), -np.arcsin(np.clip(up[:, 0], -1.0, 1.0))], axis=1)


def _goes_on(path: Array, known: Array) -> bool:
    """Whether a way (k, 2) is what is left of a known one."""
    rest = path[1:]
    return len(rest) < len(known) and np.array_equal(rest, known[len(known) - len(rest) :])


def _spread(values: Array) -> Spread:
    p95, highest = np.percentile(values, [95, 100]).tolist()
    return Spread(p95, highest)
