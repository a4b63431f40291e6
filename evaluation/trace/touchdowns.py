"""Touchdowns: which ones the planner moved, and which ones are missteps."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.metrics.walk_metrics import is_foothold, touchdowns
from sextant.evaluation.trace.course import RAISED, Course
from sextant.evaluation.trace.recorded_walk import DEBOUNCE, Walk
from sextant.evaluation.trace.run_log import RunLog
from sextant.shared.geometry import Array, apply, inverse
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import StepPlan

_MOVED = 0.008  # [m] minimum deviation of a moved touchdown from the pattern of the others


@dataclass(frozen=True, slots=True)
class Touchdowns:
    """Touchdowns in order of time."""

    t: Array  # (k,) [s]
    leg: NDArray[np.intp]  # (k,)
    p: Array  # (k, 3) [m] {start} foot centres
    chosen: Array  # (k, 3) [m] {start} the planner's foothold, NaN where unknown
    moved: NDArray[np.bool_]  # (k,) not at the nominal place
    raised: NDArray[np.bool_]  # (k,)
    misstep: NDArray[np.bool_]  # (k,)


def find_touchdowns(walk: Walk, heard: RunLog, course: Course, profile: RobotProfile) -> Touchdowns:
    """Return the touchdowns of a walk.

    In a misstep, the true ground does not support a foot, or yields under it.
    """
    found = touchdowns(walk.contact, walk.swing)
    wanted = np.full((len(found), 3), np.nan)
    sample = np.minimum(found[:, 0] + DEBOUNCE, len(walk.t_ns) - 1)  # the foot has settled
    leg = found[:, 1]
    p = walk.feet[sample, leg]
    swung = walk.step[np.maximum(found[:, 0] - 1, 0)]
    for k, (n, of) in enumerate(zip(swung, leg, strict=True)):
        if int(n) in heard.plans:
            wanted[k] = heard.plans[int(n)].touchdown[of]
    moved = [
        bool(moved_legs(heard.plans.get(int(n)), heard.moved.get(int(n)), profile)[k]) for n, k in zip(swung, leg, strict=True)
    ]
    return Touchdowns(
        t=(walk.t_ns * 1e-9)[found[:, 0]],
        leg=leg,
        p=p,
        chosen=wanted,
        moved=np.array(moved, dtype=bool),
        raised=course.height_at(p[:, :2]) > RAISED,
        misstep=~is_foothold(course.carrying_at, p[:, :2]) | (course.sink_at(p[:, :2]) > 0),
    )


def moved_legs(plan: StepPlan | None, count: int | None, profile: RobotProfile) -> NDArray[np.bool_]:
    """Return the legs (6,) whose touchdown the planner moved.

    The planner reports only their number. They are found by their pattern: nominal touchdowns have the same offset from their
    resting places.

    Args:
        plan: The step's plan, None if it was not received.
        count: The number of moved touchdowns reported by the planner, None if unknown.
        profile: The robot, with its resting places.
    """
    moved = np.zeros(6, dtype=bool)
    if plan is None or not plan.swing.any():
        return moved
    offset = (apply(inverse(plan.body_goal), plan.touchdown) - profile.rest_feet())[:, :2]
    strange = np.where(plan.swing, np.linalg.norm(offset - np.median(offset[plan.swing], axis=0), axis=1), -1.0)
    if count is None:
        return np.asarray(strange > _MOVED)
    moved[np.argsort(-strange, kind="stable")[: min(count, int(plan.swing.sum()))]] = True
    return moved
