"""Predicted load of the servos in straight walking over level ground, without physics.

A motor holds the weight that its leg carries, and works against damping and friction of its gear. `sextant robot check`
computes the same in more detail, with the actuator's path and its distribution of the load.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.locomotion.gait import GAITS, Gait, Pace
from sextant.services.planner.locomotion.params import StepParams
from sextant.services.planner.locomotion.step_planner import time_to_swing
from sextant.services.planner.locomotion.swing_motion import SWING_TIME, swing_joints, swing_speeds
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import body_inverse, joint_torques, link_torques, nearest_reachable
from sextant.shared.robot.profile import GRAVITY, RobotProfile
from sextant.shared.robot.stability import resting_centre_of_mass
from sextant.shared.wire.messages import GaitName

_OUTWARDS = 0.15  # [1] mean outward push of standing feet, as a share of their load: the actuator's


@dataclass(frozen=True, slots=True)
class ServoLoad:
    """Load of the most loaded joint."""

    duty: float  # [1] root mean square of its torque over a cycle, as a share of the stall torque
    speed: float  # [1] its highest mean speed over a fifth of a swing, as a share of the no-load speed


def swing_ends(profile: RobotProfile, gait: Gait, body_height: float) -> tuple[Array, Array, Array]:
    """Return starts and ends (6, 3) [m] of full swings over the ground, and the body's travel (3,) [m] in the step.

    They are in the frame of the body at the start of the step. The stance at rest is in the middle of a leg's stance.
    """
    travel = np.array([profile.stance.stride / gait.stances, 0.0, 0.0])
    rest = profile.rest_feet(body_height)
    half = travel * gait.stances / 2
    return rest - half, rest + half + travel, travel


def pace_at(profile: RobotProfile, params: StepParams, gait_name: GaitName, lift: float, speed_factor: float) -> Pace:
    """Return the pace at a multiple of the profile's foot speed: a full swing between equal heights takes a whole step.

    Args:
        profile: The robot.
        params: Parameters of a step.
        gait_name: The gait.
        lift: [m] clearance of the swing.
        speed_factor: Foot speed, as a multiple of the profile's.
    """
    gait = GAITS[gait_name]
    start, end, _ = swing_ends(profile, gait, profile.stance.body_height)
    foot_speed = speed_factor * profile.stance.foot_speed
    seconds = float(time_to_swing(profile, params, start, end, np.full(6, lift), foot_speed=foot_speed).max())
    return Pace(seconds / gait.pace, foot_speed)


def predict_load(
    profile: RobotProfile, params: StepParams, gait_name: GaitName, pace: Pace, lift: float, body_height: float
) -> ServoLoad:
    """Return the load of the servos at a pace.

    Args:
        profile: The robot.
        params: Parameters of a step.
        gait_name: The gait.
        pace: Duration of steps and speed of feet.
        lift: [m] clearance of the swings.
        body_height: [m] of the body's origin over the ground.
    """
    gait, servos, cycle = GAITS[gait_name], profile.servos, _cycle(profile, gait_name, lift, body_height)
    step_s = pace.step_s * gait.pace
    air_s = max(step_s - params.handover_s, params.handover_s)
    swing_rate = cycle.swing_rate / air_s
    stance_rate = cycle.stance_rate / (gait.stances * step_s)
    lifting = servos.damping * swing_rate + servos.friction * np.sign(swing_rate) + cycle.swing_torque
    squares = (lifting**2).mean(axis=0)
    for torque, stands in zip(cycle.stance_torque, cycle.stands, strict=True):
        squares += ((torque + servos.damping * stance_rate) ** 2).mean(axis=0) * stands[:, None]
    duty = np.sqrt(squares / len(gait.groups)) / servos.stall_torque
    fastest = cycle.swing_speed / air_s / servos.no_load_speed
    return ServoLoad(float(duty.max()), float(fastest.max()))


@dataclass(frozen=True, slots=True)
class _Cycle:
    """Joints in a cycle of a gait with full strides, at even shares of a swing's and a stance's time."""

    swing_rate: Array  # (n, 6, 3) [rad] per whole swing
    swing_speed: Array  # (6, 3) [rad] per whole swing, see `swing_speeds`
    swing_torque: Array  # (n, 6, 3) [N m] that holds the links
    stance_rate: Array  # (n, 6, 3) [rad] per whole stance
    stance_torque: list[Array]  # (n, 6, 3) [N m] static, while each group swings
    stands: list[NDArray[np.bool_]]  # (6,) whether a leg stands then


@lru_cache(maxsize=64)
def _cycle(profile: RobotProfile, gait_name: GaitName, lift: float, body_height: float) -> _Cycle:
    gait = GAITS[gait_name]
    start, end, travel = swing_ends(profile, gait, body_height)
    T_start, T_end = np.eye(4), np.eye(4)
    T_end[:3, 3] = travel
    swing = swing_joints(profile, start, end, np.full(6, lift), T_start, T_end)
    standing = end - travel - SWING_TIME[:, None, None] * gait.stances * travel
    stance = body_inverse(profile, np.array([nearest_reachable(profile, feet) for feet in standing]))
    links = np.array([link_torques(profile, q) for q in stance])
    forces = _ground_forces(profile, gait, body_height)
    return _Cycle(
        np.gradient(swing, SWING_TIME, axis=0),
        swing_speeds(swing),
        np.array([link_torques(profile, q) for q in swing]),
        np.gradient(stance, SWING_TIME, axis=0),
        [joint_torques(profile, stance, np.broadcast_to(one, stance.shape)) + links for one in forces],
        [one[:, 2] > 0.0 for one in forces],
    )


def _ground_forces(profile: RobotProfile, gait: Gait, body_height: float) -> list[Array]:
    """Return the forces (6, 3) [N] {body} of the ground on resting feet while each group swings; zero for its legs.

    Of all vertical loads that balance the body, they have the least sum of squares. Feet also push outwards.
    """
    places = profile.rest_feet(body_height)[:, :2] - resting_centre_of_mass(profile)[:2]
    found = []
    for group in gait.groups:
        standing = ~np.isin(np.arange(6), group)
        balance = np.column_stack([np.ones(6), places])[standing].T
        forces = np.zeros((6, 3))
        forces[standing, 2] = np.linalg.lstsq(balance, np.array([profile.body.total_mass * GRAVITY, 0.0, 0.0]), rcond=None)[0]
        forces[:, :2] = -_OUTWARDS * forces[:, 2:] * places / np.linalg.norm(places, axis=1).mean()
        found.append(forces)
    return found
