"""One cycle of a gait over level ground: joint angles, rates and motor torques, without physics.

The body moves at constant speed. Standing feet carry the weight as the actuator's feed-forward distributes it, and swinging
feet take the actuator's path. A motor holds the static load, and works against damping, friction and inertia of its gear.
"""

from dataclasses import dataclass

import numpy as np

from sextant.services.actuator.config import ActuatorParams
from sextant.services.actuator.locomotion.feedforward import centre_of_mass, foot_forces, leg_shapes, outward_forces
from sextant.services.actuator.locomotion.swing_trajectory import Swing
from sextant.services.planner.locomotion.gait import GAITS
from sextant.services.planner.locomotion.params import StepParams
from sextant.services.planner.locomotion.step_planner import time_to_swing
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import body_inverse, joint_torques, link_torques, nearest_reachable
from sextant.shared.robot.profile import GRAVITY, RobotProfile
from sextant.shared.wire.messages import GaitName

_PERIOD_S = 0.02  # [s] between two samples: the actuator's control cycle
_LIFT_M = 0.025  # [m] clearance of a swing over level ground, the default of scenarios


@dataclass(frozen=True, slots=True)
class GaitCycle:
    """Samples of one cycle."""

    speed: float  # [m/s] of the body
    step_s: float  # [s] duration of a step
    sample_s: float  # [s] between two samples
    travel: float  # [m] of the body in a step
    lift: float  # [m] clearance of a swing
    feet: Array  # (n, 6, 3) [m] {body}
    share: Array  # (n, 6) share of its load that each leg may carry, 0 to 1
    q: Array  # (n, 6, 3) [rad]
    rate: Array  # (n, 6, 3) [rad/s]
    torque: Array  # (n, 6, 3) [N m] of the motors that follow the path exactly, also beyond their stall torque
    standing_torque: Array  # (n, 6, 3) [N m] the static part alone

    @property
    def rms_torque(self) -> Array:
        """Root mean square (6, 3) [N m] of the motor torques."""
        return np.asarray(np.sqrt((self.torque**2).mean(axis=0)))


def standing_torques(profile: RobotProfile, q: Array, feet: Array, share: Array) -> Array:
    """Compute static motor torques (6, 3) [N m] of a level robot.

    Args:
        profile: The robot.
        q: (6, 3) [rad] joint angles.
        feet: (6, 3) [m] {body} foot centres.
        share: (6,) share of its load that each leg may carry, 0 to 1.
    """
    x, y, _ = centre_of_mass(profile, leg_shapes(profile, q))
    places = [(foot_x - x, foot_y - y) for foot_x, foot_y, _ in feet.tolist()]
    vertical = foot_forces(places, share.tolist(), profile.body.total_mass * GRAVITY)
    forces = np.column_stack([outward_forces(places, vertical), vertical])
    return joint_torques(profile, q, forces) + link_torques(profile, q)


def walk_cycle(profile: RobotProfile, gait_name: GaitName, body_height: float | None = None) -> GaitCycle:
    """Return a cycle of straight walking at the robot's highest speed in a gait.

    Args:
        profile: The robot.
        gait_name: The gait.
        body_height: [m] of the body's origin over the ground; None: that of the stance.
    """
    gait, stance = GAITS[gait_name], profile.stance
    duration, rest = stance.step_s * gait.pace, profile.rest_feet(body_height)
    travel = min(stance.max_speed * duration, stance.stride / gait.stances)
    ahead = np.array([travel * gait.stances / 2, 0.0, 0.0])
    lift = np.full(6, clearance := min(_LIFT_M, stance.max_lift))
    way = (rest - ahead, rest + ahead + [travel, 0.0, 0.0])  # over the ground, while the body moves by `travel`
    duration = max(duration, float(time_to_swing(profile, StepParams(), *way, lift).max()))

    n, groups = max(round(duration / _PERIOD_S), 2), len(gait.groups)
    dt, advance = duration / n, np.array([travel / n, 0.0, 0.0])
    swing, loaded = _swing(*way, lift, duration, n)
    swing -= np.arange(n)[:, None, None] * advance
    stand = rest + ahead - np.arange((groups - 1) * n)[:, None, None] * advance
    feet, share = np.concatenate([swing, stand]), np.concatenate([loaded, np.ones((groups - 1) * n)])
    turns = np.array([next(k for k, legs in enumerate(gait.groups) if leg in legs) for leg in range(6)])
    feet = np.stack([np.roll(feet[:, leg], turns[leg] * n, axis=0) for leg in range(6)], axis=1)
    shares = np.stack([np.roll(share, turn * n) for turn in turns.tolist()], axis=1)

    feet = np.array([nearest_reachable(profile, now) for now in feet])
    q = body_inverse(profile, feet)
    rate = (np.roll(q, -1, axis=0) - np.roll(q, 1, axis=0)) / (2 * dt)
    acceleration = (np.roll(q, -1, axis=0) - 2 * q + np.roll(q, 1, axis=0)) / dt**2
    static = np.array([standing_torques(profile, *now) for now in zip(q, feet, shares, strict=True)])
    servos = profile.servos
    moving = servos.damping * rate + servos.friction * np.sign(rate) + servos.armature * acceleration
    return GaitCycle(travel / duration, duration, dt, travel, clearance, feet, shares, q, rate, static + moving, static)


def _swing(start: Array, end: Array, lift: Array, duration: float, n: int) -> tuple[Array, Array]:
    """Return feet (n, 6, 3) [m] of a swing of all legs over the ground, and the share (n,) of its load that a leg may carry.

    The samples are evenly spaced over the duration [s] of the step.
    """
    settings, t = ActuatorParams(), np.linspace(0.0, duration, n, endpoint=False)
    air_s = duration - settings.unload_s - settings.load_s
    progress = np.clip((t - settings.unload_s) / air_s, 0.0, 1.0)
    flight, feet, before = Swing(start, end, lift), [], 0.0
    for now in progress.tolist():
        feet.append((start if now == 0.0 else flight.update(end, before, now - before)).copy())
        before = now
    landing = 1.0 + (t - duration) / settings.load_s
    return np.array(feet), np.clip(np.maximum(1.0 - t / settings.unload_s, landing), 0.0, 1.0)
