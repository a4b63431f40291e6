"""A run as arrays, for the picture and for whoever looks closer."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deploy.course import Course
from deploy.heard import Heard
from deploy.map_metrics import Mosaic
from deploy.touchdowns import Touchdowns, find_touchdowns
from deploy.walk import Walk
from deploy.walk_metrics import angle_between
from shared.geometry import Array
from shared.messages import PassageMap, PassagePlan
from shared.robot import RobotProfile
from shared.scenario import Scenario


@dataclass(frozen=True, slots=True)
class PlannedSection:
    """What was planned at one stop of a passage, on what map, and how the robot stood there."""

    plan: PassagePlan
    map: PassageMap | None  # None where none was heard
    feet: Array  # (6, 3) [m] {start} true foot centres
    p: Array  # (3,) [m] {start} true body


@dataclass(frozen=True, slots=True)
class Trace:
    """A run as arrays. Times count from the first message of truth; {start} as in `deploy.course`."""

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
    sections: tuple[PlannedSection, ...]  # of passages
    routes: tuple[Array, ...]  # (k, 2) [m] {start} corners of the ways to a goal that the planner took, each from the robot on
    blocks: Array  # (b, 4, 2) [m] {start} corners of the boxes of the true terrain
    weak: NDArray[np.intp]  # which of them give way under a foot
    goal_distance: float  # [m]
    corridor: float  # [m]
    profile: RobotProfile


def trace_of(
    walk: Walk, heard: Heard, course: Course, scenario: Scenario, profile: RobotProfile, mosaic: Mosaic | None
) -> Trace:
    """The run as it has been heard so far, with its maps laid over each other."""
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
        torque_worst=walk.torque.reshape(-1, 18).max(axis=1),
        t_estimate=np.array([pose.stamp_ns - heard.begin_ns for pose in heard.poses]) * 1e-9,
        p_estimate=np.array([pose.T_world_body[:3, 3] for pose in heard.poses]).reshape(-1, 3),
        touchdowns=find_touchdowns(walk, heard, course, profile),
        mosaic=mosaic,
        sections=_sections(walk, heard),
        routes=tuple(heard.routes),
        blocks=course.block_corners(),
        weak=course.weak_blocks(),
        goal_distance=scenario.goal.distance,
        corridor=scenario.goal.corridor,
        profile=profile,
    )


def _sections(walk: Walk, heard: Heard) -> tuple[PlannedSection, ...]:
    sections = []
    for plan, known in heard.passage_plans:
        k = min(int(np.searchsorted(walk.t_ns, plan.stamp_ns - heard.begin_ns)), len(walk.t_ns) - 1)
        sections.append(PlannedSection(plan, known, walk.feet[k], walk.p[k]))
    return tuple(sections)


def _lean(up: Array) -> Array:
    """Roll and pitch (n, 2) [rad] of bodies that have the vertical at (n, 3) {body}."""
    return np.stack([np.arctan2(up[:, 1], up[:, 2]), -np.arcsin(np.clip(up[:, 0], -1.0, 1.0))], axis=1)
