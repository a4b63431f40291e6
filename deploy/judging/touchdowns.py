"""Where feet came down, which of them the planner had moved, and which stand on what is no foothold."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.deploy.judging.course import RAISED, Course
from sextant.deploy.judging.heard import Heard
from sextant.deploy.judging.walk import DEBOUNCE, Walk
from sextant.deploy.judging.walk_metrics import is_foothold, touchdowns
from sextant.shared.geometry import Array, apply, inverse
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import StepPlan

_MOVED = 0.008  # [m] a touchdown this far off its fellows' pattern has been moved


@dataclass(frozen=True, slots=True)
class Touchdowns:
    """Where feet came down, in order of time."""

    t: Array  # (k,) [s]
    leg: NDArray[np.intp]  # (k,)
    p: Array  # (k, 3) [m] {start} foot centres
    chosen: Array  # (k, 3) [m] {start} where the planner wanted them, NaN where nobody heard
    moved: NDArray[np.bool_]  # (k,) placed elsewhere than nominal
    raised: NDArray[np.bool_]  # (k,)
    misstep: NDArray[np.bool_]  # (k,)


def find_touchdowns(walk: Walk, heard: Heard, course: Course, profile: RobotProfile) -> Touchdowns:
    """The touchdowns of a walk; a misstep is one where the true ground carries no foot, or gives way under it."""
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
    """Legs (6,) whose touchdown the planner moved.

    It says how many; which ones shows in their pattern: nominal touchdowns lie alike to their resting places.

    Args:
        plan: Of the step, None where it was not heard.
        count: How many the planner says it moved, None where it did not say.
        profile: Whose resting places.
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
