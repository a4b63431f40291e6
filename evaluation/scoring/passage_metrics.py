"""Metrics of a gap crossed on pillars: footholds, feet off the pillars, planning."""

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.metrics.walk_metrics import runs
from sextant.evaluation.report import FootholdEdge, Passage, Section
from sextant.evaluation.trace.course import Course
from sextant.evaluation.trace.recorded_walk import Walk
from sextant.evaluation.trace.run_log import RunLog
from sextant.evaluation.trace.trace import Trace
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import LEGS
from sextant.shared.wire import topics
from sextant.shared.wire.messages import PassagePlan

_OVER_NOTHING = 0.03  # [m] of air under a standing foot: it stands on an edge at most
_FALLEN = 0.08  # [m] below the other feet: the foot stands in the gap
_GIVEN = 0.008  # [m] depth of a loaded foot below a top, from which the top has given way
_BESIDE = 0.02  # [m] a foot may stand beyond an edge of a top that gives way
_LASTING = round(0.1 * topics.TRUTH.rate_hz)  # samples of truth: shorter events occur around planned swings


def passage_metrics(walk: Walk, heard: RunLog, trace: Trace, course: Course, passable: bool | None = None) -> Passage:
    """Return the passage part of a report.

    `passable` is the result of an exhaustive search, None if there is none.
    """
    edge = course.edge_distance(trace.touchdowns.p[:, :2])
    edge = edge[np.isfinite(edge)]
    p05, median = np.percentile(edge, [5, 50]).tolist() if len(edge) else (float("nan"), float("nan"))
    return Passage(
        pillar_touchdowns=len(edge),
        foothold_edge_m=FootholdEdge(p05, median),
        feet_off=feet_off(walk.feet[..., 2] - trace.profile.foot.radius, walk.ground, _standing(walk)),
        tipped=tipped(walk.feet, walk.contact & _standing(walk), trace.profile.foot.radius, course.loose_tops()),
        passable=passable,
        sections=tuple(
            Section(plan.state, plan.reason, plan.generated_nodes, plan.expanded_nodes, plan.planning_ms, steps_of(plan))
            for plan, _ in heard.passage_plans
        ),
    )


def steps_of(plan: PassagePlan) -> int:
    """Return the number of leg steps in a plan.

    It is 0 if there is no way: such a plan only shows how far the robot would come.
    """
    return 0 if plan.state == "no way" else int(np.count_nonzero(plan.leg < len(LEGS)))


def feet_off(underside: Array, ground: Array, standing: NDArray[np.bool_]) -> int:
    """Count how often a standing foot is over nothing or in the gap.

    Shorter events than a tenth of a second are ignored.

    Args:
        underside: (n, 6) [m] lowest points of the feet.
        ground: (n, 6) [m] true ground under their centres, -inf where there is none.
        standing: (n, 6) feet that are not in the air by plan.
    """
    fallen = underside < np.median(underside, axis=1, keepdims=True) - _FALLEN
    off = standing & ((underside - ground > _OVER_NOTHING) | fallen)
    return sum(int(end - begin >= _LASTING) for leg in off.T for begin, end in runs(leg))


def tipped(feet: Array, carries: NDArray[np.bool_], radius: float, tops: tuple[Array, Array, Array]) -> int:
    """Count how often a foot stood on a top that tipped or sank under it.

    Args:
        feet: (n, 6, 3) [m] foot centres.
        carries: (n, 6) standing feet with contact.
        radius: [m] of the feet.
        tops: Boxes that sink or tip, where they were at the start: centre and half edges (k, 3) [m], rotation (k, 3, 3).
    """
    count = 0
    for centre, half, R in zip(*tops, strict=True):
        p = (feet - centre) @ R
        over = (np.abs(p[..., :2]) < half[:2] + _BESIDE).all(axis=-1) & (np.abs(p[..., 2]) < half[2] + _FALLEN)
        low = carries & over & (p[..., 2] - radius < half[2] - _GIVEN)
        count += sum(int(end - begin >= _LASTING) for leg in low.T for begin, end in runs(leg))
    return count


def _standing(walk: Walk) -> NDArray[np.bool_]:
    """Return the feet (n, 6) in stance by plan, from the first step on."""
    return np.asarray(~walk.swing & np.logical_or.accumulate(walk.walking)[:, None])
