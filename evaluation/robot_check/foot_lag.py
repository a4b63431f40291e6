"""How far feet lag behind their paths, because a servo gives no more than its stall torque.

Each joint is computed alone, by the servo's stiffness, damping, friction and armature, and with the actuator's feed-forward.
Links have no inertia, and the ground does not hold a foot back.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from sextant.evaluation.robot_check.gait_cycle import GaitCycle, walk_cycle
from sextant.evaluation.robot_check.limit import Limit, in_cm
from sextant.evaluation.whole_maps.terrain_map import RESOLUTION_M
from sextant.services.actuator.locomotion.feedforward import lag_feed_forward
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import body_forward
from sextant.shared.robot.profile import JOINTS, RobotProfile
from sextant.shared.wire.messages import GaitName

_SUBSTEPS = 20  # per sample of the cycle
_SLOWER, _ATTEMPTS = 0.9, 12  # factor of the foot speed from one attempt to the next


@dataclass(frozen=True, slots=True)
class FootLag:
    """Largest distances of the feet from their paths in a cycle of a gait."""

    in_air: float  # [m]
    on_ground: float  # [m] of feet that carry load; the largest is usually that at touchdown


def foot_lag(profile: RobotProfile, cycle: GaitCycle) -> FootLag:
    """Return the largest distances of the feet from their paths."""
    lag = np.linalg.norm(body_forward(profile, followed(profile, cycle)) - body_forward(profile, cycle.q), axis=-1)
    flies = cycle.share == 0.0
    return FootLag(float(lag.max(where=flies, initial=0.0)), float(lag.max(where=~flies, initial=0.0)))


def followed(profile: RobotProfile, cycle: GaitCycle) -> Array:
    """Return the joint angles (n, 6, 3) [rad] of servos with limited torque that follow a cycle, from its first sample on."""
    servos, dt = profile.servos, cycle.sample_s / _SUBSTEPS
    stall, stiffness, friction, inertia = servos.stall_torque, servos.stiffness, servos.friction, servos.armature / dt
    sag = np.clip(cycle.standing_torque, -stall, stall) / stiffness
    goals = cycle.q + sag + [lag_feed_forward(profile, rate, cycle.sample_s) for rate in cycle.rate]
    q, rate, angles = cycle.q[0], cycle.rate[0], np.empty_like(cycle.q)
    for k, (goal, load) in enumerate(zip(goals, cycle.standing_torque, strict=True)):
        angles[k] = q
        for _ in range(_SUBSTEPS):
            push = np.clip(stiffness * (goal - q), -stall, stall) - load + inertia * rate
            rate = (push - np.clip(push, -friction, friction)) / (inertia + servos.damping)
            q = q + dt * rate
    return angles


def lag_limits(profile: RobotProfile, cycles: Mapping[tuple[GaitName, float], GaitCycle]) -> Iterator[Limit]:
    """Yield limits of the lag in the air and at touchdown.

    Args:
        profile: The robot.
        cycles: Cycles by gait and body height [m].
    """
    lags = {key: foot_lag(profile, cycle) for key, cycle in cycles.items()}
    in_air, clearance = max(lag.in_air for lag in lags.values()), min(cycle.lift for cycle in cycles.values())
    words = f"feet lag behind their paths by up to {in_cm(in_air)} in the air, swings clear the ground by {in_cm(clearance)}"
    yield Limit("lag in the air", in_air, clearance, "m", in_air <= clearance, f"{words}; {_cause(profile, cycles)}")

    gait, height = max(lags, key=lambda key: lags[key].on_ground)
    lag = lags[gait, height].on_ground
    words = (
        f"a foot touches down up to {in_cm(lag)} off its foothold ({gait} gait, body height {in_cm(height)}), "
        f"a cell of the map has {in_cm(RESOLUTION_M)}; "
    )
    if lag <= RESOLUTION_M:
        words += "a lower stance.foot_speed lowers it"
    else:
        words += _slower(profile, gait, height, lambda robot, cycle: foot_lag(robot, cycle).on_ground <= RESOLUTION_M)
    yield Limit("lag at touchdown", lag, RESOLUTION_M, "m", lag <= RESOLUTION_M, words)


def _cause(profile: RobotProfile, cycles: Mapping[tuple[GaitName, float], GaitCycle]) -> str:
    """Return the largest torque of all cycles, and what lowers it, as the end of a sentence."""
    shares = {key: _shares(profile, cycle) for key, cycle in cycles.items()}
    gait, height = max(shares, key=lambda key: shares[key].max())
    found, cycle = shares[gait, height], cycles[gait, height]
    joint = JOINTS[np.unravel_index(found.argmax(), found.shape)[2]]
    words = f"exact paths need {found.max():.0%} of the stall torque at a {joint} ({gait} gait, body height {in_cm(height)})"
    if found.max() <= 1.0:
        return f"{words}; a lower stance.foot_speed lowers both"
    milliseconds = 1e3 * cycle.sample_s * int((found > 1.0).sum(axis=0).max())
    slower = _slower(profile, gait, height, lambda robot, of_robot: bool(_shares(robot, of_robot).max() <= 1.0))
    return f"{words} for {milliseconds:.0f} ms, and a servo gives 100%; {slower}"


def _shares(profile: RobotProfile, cycle: GaitCycle) -> Array:
    """Return the torques (n, 6, 3) that a cycle needs, as shares of the stall torque."""
    return np.asarray(np.abs(cycle.torque) / profile.servos.stall_torque)


def _slower(
    profile: RobotProfile, gait: GaitName, body_height: float, accepts: Callable[[RobotProfile, GaitCycle], bool]
) -> str:
    """Return the highest foot speed, in steps of 10 %, whose cycle is accepted, as the end of a sentence."""
    for _ in range(_ATTEMPTS):
        foot_speed = round(_SLOWER * profile.stance.foot_speed, 3)
        profile = replace(profile, stance=replace(profile.stance, foot_speed=foot_speed))
        if accepts(profile, walk_cycle(profile, gait, body_height)):
            return f"a stance.foot_speed of {foot_speed:g} m/s avoids that"
    return "servos with more torque and stiffness avoid that"
