"""Interface of a step planner, which replaces the planner's choice of footholds and body motion.

Sextant still finds the path to a goal, crosses gaps and walks by touch. It asks the plug-in for one step at a time, and the
actuator checks each step before it is executed.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array, is_rigid, orthonormal
from sextant.shared.wire.messages import TerrainMap

_LONGEST_S = 20.0  # [s] maximum duration of a step
_ROUNDING = 1e-3  # [1] largest error of a rotation matrix, which is then made orthonormal


@dataclass(frozen=True, slots=True, eq=False)
class StepRequest:
    """The robot at the start of a step, all feet standing, and the motion that is wanted."""

    T_world_body: Array  # (4, 4) body pose, the reference that the legs follow
    feet: Array  # (6, 3) [m] {world} foot centres
    due: tuple[NDArray[np.bool_], ...]  # (6,) groups of legs of the gait, the one that should swing first comes first
    velocity: Array  # (2,) [m/s] {body} as commanded, which may be faster than the legs can
    yaw_rate: float  # [rad/s]
    body_height: float  # [m] of the body's origin above the ground
    lift: float  # [m] minimum height of a swinging foot over both ends of its swing, on level ground
    step_s: float  # [s] duration of a step in the gait
    stances: int  # number of steps for which a foot stands, in the gait
    map: TerrainMap
    refused: int = 0  # number of plans for this step that the actuator has refused
    refusal: str = ""  # reason of the last refusal


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One step. It must end in a statically stable stance.

    Standing legs must reach the body's pose at the end. So a step from rest must be shorter than the others, and so should be
    the one after a refusal.
    """

    swing: NDArray[np.bool_]  # (6,) legs that swing
    touchdown: Array  # (6, 3) [m] {world} foot centres at the end; those of standing legs do not matter
    T_world_body: Array  # (4, 4) body pose at the end
    # (6,) [m] height of a swinging foot over both ends of its swing. What lies between them is not added: a foot that swings
    # over a block needs the height of the block, too.
    clearance: Array
    duration_s: float


@dataclass(frozen=True, slots=True)
class NoStep:
    """Reason why there is no step."""

    reason: str
    leg: int = -1  # index of the leg that has no foothold, -1 for the whole robot


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
    if not 0.0 < step.duration_s <= _LONGEST_S:
        raise ValueError(f"a duration_s of more than 0 and at most {_LONGEST_S:g} s expected, found {step.duration_s}")
    return Step(swing, touchdown, orthonormal(T), np.array(step.clearance, dtype=np.float64), float(step.duration_s))
