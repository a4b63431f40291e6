"""A run as arrays, for plots and detailed analysis."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.metrics.map_metrics import Mosaic
from sextant.evaluation.metrics.walk_metrics import angle_between
from sextant.evaluation.trace.course import Course
from sextant.evaluation.trace.recorded_walk import Walk
from sextant.evaluation.trace.run_log import RunLog
from sextant.evaluation.trace.status_log import StatusEvent, StatusInterval, complaints, spells
from sextant.evaluation.trace.touchdowns import Touchdowns, find_touchdowns
from sextant.shared.geometry import Array, apply
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.scenario.scenario import Scenario
from sextant.shared.wire.messages import PassageMap, PassagePlan, StepPlan


@dataclass(frozen=True, slots=True)
class PlannedSection:
    """The plan of one stop of a passage, its map, and the robot's true stance."""

    plan: PassagePlan
    map: PassageMap | None  # None if no map was received
    feet: Array  # (6, 3) [m] {start} true foot centres
    p: Array  # (3,) [m] {start} true body


@dataclass(frozen=True, slots=True)
class Touches:
    """Touches of feet that found no ground, in order of time."""

    t: Array  # (k,) [s]
    leg: NDArray[np.intp]  # (k,)
    p: Array  # (k, 3) [m] {start} the lowest point reached


@dataclass(frozen=True, slots=True)
class Trace:
    """A run as arrays.

    Times count from the first message of truth. Frame: {start}, as in `sextant.evaluation.trace.course`.
    """

    t: Array  # (n,) [s]
    walking: NDArray[np.bool_]  # (n,)
    p_true: Array  # (n, 3) [m] {start} body
    height_reference: Array  # (n,) [m] {start} commanded body height, NaN before the first actuator state
    tilt: Array  # (n,) [rad] from the commanded attitude
    attitude: Array  # (n, 2) [rad] {start} true roll and pitch of the body
    attitude_reference: Array  # (n, 2) [rad] commanded roll and pitch
    feet: Array  # (n, 6, 3) [m] {start} true foot centres
    ground: Array  # (n, 6) [m] {start} true height of the visible ground under the feet
    T: Array  # (n, 4, 4) {start} true body
    torque: Array  # (n, 6, 3) [N m] absolute motor torques
    shutdown: NDArray[np.bool_]  # (n, 6, 3) servos that have latched an error
    margin: Array  # (n,) [m] from the centre of mass to the edge of the support polygon, negative outside, NaN if unknown
    carrying: NDArray[np.bool_]  # (n, 6) supporting legs
    in_the_way: NDArray[np.bool_]  # (n, 7) feet, then the body, in collision
    t_estimate: Array  # (m,) [s]
    p_estimate: Array  # (m, 3) [m] {start} body position estimated by perception
    pose_error: Array  # (m,) [m] error of that position, NaN before the first step
    touchdowns: Touchdowns
    no_ground: Touches
    spells: tuple[StatusInterval, ...]
    complaints: tuple[StatusEvent, ...]
    plans: tuple[tuple[float, StepPlan], ...]  # newest revision of each step and its time [s]; {world}
    mosaic: Mosaic | None
    sections: tuple[PlannedSection, ...]  # of passages
    routes: tuple[Array, ...]  # (k, 2) [m] {start} corners of the planner's routes to the goal, each starting at the robot
    blocks: Array  # (b, 4, 2) [m] {start} corners of the boxes of the true terrain
    weak: NDArray[np.intp]  # indices of the boxes that yield under a foot
    goal_distance: float  # [m]
    corridor: float  # [m]
    profile: RobotProfile

    @property
    def torque_worst(self) -> Array:
        """Highest torque (n,) [N m] of all joints."""
        return np.asarray(self.torque.reshape(-1, 18).max(axis=1))


def trace_of(
    walk: Walk, heard: RunLog, course: Course, scenario: Scenario, profile: RobotProfile, mosaic: Mosaic | None
) -> Trace:
    """Return the run as arrays, from the messages received so far and the mosaic."""
    t_estimate = np.array([pose.stamp_ns - heard.begin_ns for pose in heard.poses]) * 1e-9
    p_estimate = np.array([pose.T_world_body[:3, 3] for pose in heard.poses]).reshape(-1, 3)
    return Trace(
        t=walk.t_ns * 1e-9,
        walking=walk.walking,
        p_true=walk.p,
        height_reference=walk.height_reference,
        tilt=angle_between(walk.up, walk.up_reference),
        attitude=_lean(walk.up),
        attitude_reference=_lean(walk.up_reference),
        feet=walk.feet,
        ground=walk.ground,
        T=walk.T,
        torque=walk.torque,
        shutdown=walk.shutdown,
        margin=walk.margin,
        carrying=walk.carrying,
        in_the_way=walk.in_the_way,
        t_estimate=t_estimate,
        p_estimate=p_estimate,
        pose_error=_pose_error(walk, t_estimate, p_estimate),
        touchdowns=find_touchdowns(walk, heard, course, profile),
        no_ground=_no_ground(heard),
        spells=spells(heard),
        complaints=complaints(heard),
        plans=tuple(((plan.stamp_ns - heard.begin_ns) * 1e-9, plan) for _, plan in sorted(heard.plans.items())),
        mosaic=mosaic,
        sections=_sections(walk, heard),
        routes=tuple(heard.routes),
        blocks=course.block_corners(),
        weak=course.weak_blocks(),
        goal_distance=scenario.goal.distance,
        corridor=scenario.goal.corridor,
        profile=profile,
    )


def _sections(walk: Walk, heard: RunLog) -> tuple[PlannedSection, ...]:
    sections = []
    for plan, known in heard.passage_plans:
        k = min(int(np.searchsorted(walk.t_ns, plan.stamp_ns - heard.begin_ns)), len(walk.t_ns) - 1)
        sections.append(PlannedSection(plan, known, walk.feet[k], walk.p[k]))
    return tuple(sections)


def _pose_error(walk: Walk, t: Array, p: Array) -> Array:
    """Return the position error (m,) [m] of estimates (m, 3) at times (m,) [s].

    NaN before the first step.
    """
    error = np.full(len(t), np.nan)
    if not walk.walking.any():
        return error
    seconds = walk.t_ns * 1e-9
    known = (t >= seconds[int(np.argmax(walk.walking))]) & (t <= seconds[-1])
    true = np.stack([np.interp(t[known], seconds, walk.p[:, k]) for k in range(3)], axis=1)
    error[known] = np.linalg.norm(p[known] - true, axis=1)
    return error


def _no_ground(heard: RunLog) -> Touches:
    """Return the touches that found no ground, each once."""
    found: dict[tuple[int, int], Array] = {}
    for state in heard.states:
        for leg in np.flatnonzero(~state.touchdown_contact & (state.touchdown_ns >= heard.begin_ns)):
            found.setdefault((int(state.touchdown_ns[leg]), int(leg)), apply(state.T_world_odom, state.touchdown_point[leg]))
    keys = sorted(found)
    return Touches(
        t=np.array([stamp - heard.begin_ns for stamp, _ in keys], dtype=np.float64) * 1e-9,
        leg=np.array([leg for _, leg in keys], dtype=np.intp),
        p=np.array([found[key] for key in keys]).reshape(-1, 3),
    )


def _lean(up: Array) -> Array:
    """Return roll and pitch (n, 2) [rad] of bodies with the vertical (n, 3) {body}."""
    return np.stack([np.arctan2(up[:, 1], up[:, 2]), -np.arcsin(np.clip(up[:, 0], -1.0, 1.0))], axis=1)
