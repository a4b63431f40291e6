"""The message with the result of planning a section."""

from typing import Literal

import numpy as np

from sextant.services.planner.roadmap.failure_reasons import WHOLE_ROBOT
from sextant.services.planner.roadmap.roadmap import NoSection, SectionPlan
from sextant.shared.geometry import Array, apply, yaw_of
from sextant.shared.wire.messages import MAX_SECTION, MAX_TREE, PassagePlan


def make_plan_message(
    stamp_ns: int, section: int, found: SectionPlan | NoSection, T_world_strip: Array, goal: float, edges: Array, seconds: float
) -> PassagePlan:
    """Return the message with the result of planning a section.

    Args:
        stamp_ns: [ns] end of the planning.
        section: Number of the section.
        found: Result of the planning.
        T_world_strip: (4, 4).
        goal: [m] {strip} goal of the body.
        edges: (n, 2, 3) [m] {strip} of the tree.
        seconds: [s] planning time.
    """
    steps, end = found.steps[:MAX_SECTION], found.furthest if isinstance(found, NoSection) else found.end
    state: Literal["complete", "partial", "no way"]
    state = "no way" if isinstance(found, NoSection) else "complete" if found.complete else "partial"
    return PassagePlan(
        stamp_ns=stamp_ns,
        section=section,
        state=state,
        reason=found.reason,
        origin=T_world_strip[:2, 3].copy(),
        heading=yaw_of(T_world_strip),
        goal=goal,
        furthest=float(end.body[0]),
        generated_nodes=found.generated,
        expanded_nodes=found.expanded,
        planning_ms=1e3 * seconds,
        leg=np.array([step.leg if step.leg >= 0 else WHOLE_ROBOT for step in steps], dtype=np.uint8),
        footholds=apply(T_world_strip, np.array([step.touchdown for step in steps]).reshape(-1, 3)),
        body=apply(T_world_strip, np.array([step.body for step in steps]).reshape(-1, 3)),
        tree_edges=apply(T_world_strip, edges[:MAX_TREE].reshape(-1, 3)).reshape(-1, 2, 3).astype(np.float32),
        failure_point=apply(T_world_strip, _stopped(found)),
    )


def _stopped(found: SectionPlan | NoSection) -> Array:
    """Return the place (1, 3) [m] {strip} where the furthest stance fails a test.

    It is the foot of the failing leg, or the body; (0, 3) if no test fails.
    """
    if isinstance(found, SectionPlan):
        return np.zeros((0, 3))
    return (found.furthest.body if found.leg == WHOLE_ROBOT else found.furthest.feet[found.leg])[None]
