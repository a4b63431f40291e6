"""Warm-up: plan a step, so that the functions of every walk are compiled in advance."""

import numpy as np

from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion.gait import gait_of
from sextant.services.planner.locomotion.step_planner import StepPlanner, StepStart
from sextant.services.planner.terrain import flat_terrain
from sextant.shared.geometry import apply, from_xyz_rpy
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import VelocityCommand

_SPEED = 0.05  # [m/s] of a step


def compile_functions(profile: RobotProfile, settings: Settings) -> None:
    """Compile all functions that the planning of steps calls."""
    height = profile.stance.body_height
    body = from_xyz_rpy((0.0, 0.0, height), np.zeros(3))
    command = VelocityCommand(0, np.array([_SPEED, 0.0]), 0.0, height, profile.stance.rough_lift, "tripod")
    swing = np.isin(np.arange(6), gait_of(command.gait).groups[0])
    start = StepStart(body, apply(body, profile.rest_feet(height)), swing, command)
    StepPlanner(profile, settings).plan(start, flat_terrain(0, np.zeros(2), 0.0))
