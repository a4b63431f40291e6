"""Interface of a step planner, which replaces the planner's choice of footholds and body motion.

Sextant still finds the path to a goal, crosses gaps and walks by touch. It asks the plug-in for one step at a time, and the
actuator checks each step before it is executed.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array, is_rigid, orthonormal
from sextant.shared.robot.profile import LONGEST_STEP_S, SHORTEST_STEP_S
from sextant.shared.wire.messages import TerrainMap

_ROUNDING = 1e-3  # [1] largest error of a rotation matrix, which is then made orthonormal


@dataclass(frozen=True, slots=True, eq=False)
class StepRequest:
    """The robot at the start of a step, all feet standing, and the motion that is wanted.

    The planner asks for the same step with each new map until the step begins. The robot walks the last answer. Legs are in the
    order left front, right front, right middle, right rear, left rear, left middle.

    Attributes:
        T_world_body: (4, 4) body pose, the reference that the legs follow.
        feet: (6, 3) [m] {world} foot centres.
        due: (6,) groups of legs of the gait, the one that should swing first comes first. Other legs may swing, too.
        velocity: (2,) [m/s] {body} as commanded, which may be faster than the legs can.
        yaw_rate: [rad/s] as commanded.
        body_height: [m] of the body's origin above the ground.
        lift: [m] minimum height of a swinging foot over both ends of its swing, on level ground.
        step_s: [s] duration of a step in the gait. A step may take longer.
        stances: Number of steps for which a foot stands, in the gait.
        map: Elevation and score of footholds.
        refused: Number of plans for this step that the actuator has refused, at most 8. After 8 the planner pauses for two
            seconds, and the count is 0 again. The actuator may refuse the first plan because it is late, and accept it later.
        refusal: Reason of the last refusal.
        step: Number of the step.
    """

    T_world_body: Array
    feet: Array
    due: tuple[NDArray[np.bool_], ...]
    velocity: Array
    yaw_rate: float
    body_height: float
    lift: float
    step_s: float
    stances: int
    map: TerrainMap
    refused: int = 0
    refusal: str = ""
    step: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One step. It must end in a statically stable stance.

    Standing legs must reach the body's pose at the end. So a step from rest must be shorter than the others, and so should be
    the one after a refusal.

    Attributes:
        swing: (6,) legs that swing; the other three or more stand.
        touchdown: (6, 3) [m] {world} foot centres at the end; those of standing legs do not matter.
        T_world_body: (4, 4) body pose at the end.
        clearance: (6,) [m] height of a swinging foot over both ends of its swing. A foot that swings over a block needs the
            height of the block, too.
        duration_s: [s] of the step.
    """

    swing: NDArray[np.bool_]
    touchdown: Array
    T_world_body: Array
    clearance: Array
    duration_s: float


@dataclass(frozen=True, slots=True)
class NoStep:
    """Reason why there is no step.

    Attributes:
        reason: For the operator and the report.
        leg: Index of the leg that has no foothold, -1 for the whole robot.
    """

    reason: str
    leg: int = -1


class StepPlanner(Protocol):
    """A planner of steps; the class is called with the robot's profile."""

    def plan(self, request: StepRequest, /) -> Step | NoStep:
        """Return the next step, or why there is none.

        It is called up to 15 times a second, and should take less than 50 ms.
        """
        ...


def checked_step(step: object, request: StepRequest) -> Step | NoStep:
    """Return the step of a planner with the feet of standing legs filled in.

    Raises:
        TypeError: It is no step.
        ValueError: A number is missing, not finite, or out of range.
    """
    if isinstance(step, NoStep):
        if not step.reason or not -1 <= step.leg < 6:
            raise ValueError(f"a NoStep with a reason and a leg from -1 to 5 expected, found {step}")
        return step
    if not isinstance(step, Step):
        raise TypeError(f"a Step or a NoStep expected, found {type(step).__name__}")
    swing = np.asarray(step.swing)
    if swing.dtype != np.bool_ or swing.shape != (6,):
        raise ValueError(f"swing of bool (6,) expected, found {swing.dtype} {swing.shape}")
    touchdown = np.array(step.touchdown, dtype=np.float64)
    if touchdown.shape == (6, 3):
        touchdown[~swing] = request.feet[~swing]
    for name, array, shape in (
        ("touchdown", touchdown, (6, 3)),
        ("T_world_body", np.asarray(step.T_world_body, dtype=np.float64), (4, 4)),
        ("clearance", np.asarray(step.clearance, dtype=np.float64), (6,)),
    ):
        if array.shape != shape or not np.isfinite(array).all():
            raise ValueError(f"{name} of finite numbers {shape} expected, found {array.shape}: {array.tolist()}")
    T = np.array(step.T_world_body, dtype=np.float64)
    if not is_rigid(T, _ROUNDING):
        raise ValueError(f"a rigid transform as T_world_body expected, found {T.tolist()}")
    if not SHORTEST_STEP_S <= step.duration_s <= LONGEST_STEP_S:
        raise ValueError(f"a duration_s of {SHORTEST_STEP_S:g} to {LONGEST_STEP_S:g} s expected, found {step.duration_s}")
    return Step(swing, touchdown, orthonormal(T), np.array(step.clearance, dtype=np.float64), float(step.duration_s))
