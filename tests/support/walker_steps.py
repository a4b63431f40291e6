"""A separate walker, and steps for it."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.config import Settings
from sextant.services.actuator.locomotion.step_executor import StepExecutor, Targets
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.robot import kinematics
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import StepPlan

Flags = NDArray[np.bool_]

PROFILE = load_profile("phantomx_mk2")
SETTINGS = Settings()
REST = PROFILE.rest_feet()
START = from_xyz_rpy((0.0, 0.0, PROFILE.stance.body_height), np.zeros(3))
TRIPOD = np.arange(6) % 2 == 0
NOTHING, ALL = np.zeros(6, dtype=bool), np.ones(6, dtype=bool)
DT = 0.02
DURATION = 0.8


def body_at(x: float, y: float = 0.0, yaw: float = 0.0, z: float = PROFILE.stance.body_height) -> Array:
    return from_xyz_rpy((x, y, z), (0.0, 0.0, yaw))


def plan_to(number: int, goal: Array, ahead: float = 0.03, **changes: Any) -> StepPlan:
    """Return a step whose swing feet land around rest, relative to the body's goal.

    {world} equals {odom}.
    """
    swing = TRIPOD if number % 2 else ~TRIPOD
    plan = StepPlan(
        stamp_ns=number,
        epoch=0,
        step=number,
        revision=1,
        T_world_odom=np.eye(4),
        swing=swing,
        touchdown=apply(goal, REST + np.array([ahead, 0.0, 0.0])),
        clearance=np.full(6, 0.04),
        body_goal=goal,
        duration=DURATION,
        stop=False,
    )
    return replace(plan, **changes) if changes else plan


def new_walker() -> StepExecutor:
    return StepExecutor(SETTINGS, REST.copy(), START)


def reaches(feet: Array) -> bool:
    return bool(kinematics.reaches(PROFILE, feet).all())


def cycle(walker: StepExecutor, dt: float = DT) -> Targets:
    """Run one cycle of a robot that is exactly at its reference."""
    return walker.update(dt, walker.body_ref)


def walk(walker: StepExecutor, plans: list[StepPlan], dt: float = DT, rest_s: float = 0.0) -> tuple[list[Targets], Array]:
    """Feed plans when they fit; return all targets and the body's positions (n, 3)."""
    targets, places, waiting = [], [], list(plans)
    while waiting or not walker.resting or rest_s > 0:
        if waiting and (walker.resting or (walker.phase > 0.5 and waiting[0].step == walker.step + 1)):
            walker.accept(waiting.pop(0))
        if walker.resting and not waiting:
            rest_s -= dt
        targets.append(cycle(walker, dt))
        places.append(walker.body_ref[:3, 3])
    return targets, np.array(places)


def largest_jump(targets: list[Targets]) -> float:
    return float(max(np.linalg.norm(b.feet - a.feet, axis=1).max() for a, b in pairwise(targets)))
