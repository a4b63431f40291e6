"""Request of the operator: a velocity command, a posture or a goal, if it is current."""

from dataclasses import dataclass, replace

import numpy as np

from sextant.shared.wire.messages import Goal, PostureCommand, VelocityCommand

_MAX_STAMP_DIFFERENCE_S = 2.0  # [s] maximum difference between the stamp of a request and now, in the past or the future
_NAMES = {VelocityCommand: "velocity command", PostureCommand: "posture command", Goal: "goal"}
_STILL = 1e-3  # [m/s] and [rad/s]
_NEW_COURSE = (0.02, 0.02, 0.1, 0.005, 0.005)  # [m/s, m/s, rad/s, m, m] changes from which a command is a new one


@dataclass(frozen=True, slots=True, eq=False)
class OperatorRequest:
    """The operator's current request: a velocity command, else a posture, else a goal."""

    command: VelocityCommand | None
    posture: PostureCommand | None  # None if there is a command
    goal: Goal | None  # None if there is a command or a posture
    untimely_reason: str  # why a command or goal is ignored, or ""


def current_request(
    velocity: VelocityCommand | None, posture: PostureCommand | None, goal: Goal | None, now_ns: int, speed_scale: float
) -> OperatorRequest:
    """Return the request that holds now, at the speed that the servos can sustain.

    Args:
        velocity: Newest velocity command.
        posture: Newest posture command.
        goal: Newest goal.
        now_ns: [ns] time by the robot's clock.
        speed_scale: Share of the requested speed that the servos can sustain, see `ActuatorState.speed_scale`.
    """
    reasons = [_untimely_reason(request, now_ns) for request in (velocity, posture, goal)]
    untimely_reason = next((reason for reason in reasons if reason), "")
    if velocity is not None and not reasons[0]:
        return OperatorRequest(_scaled(velocity, speed_scale), None, None, untimely_reason)
    if posture is not None and not reasons[1]:
        return OperatorRequest(None, posture, None, untimely_reason)
    if goal is not None and not reasons[2]:
        return OperatorRequest(None, None, replace(goal, speed=goal.speed * speed_scale), untimely_reason)
    return OperatorRequest(None, None, None, untimely_reason)


def is_still(command: VelocityCommand) -> bool:
    """Return whether a command requests no motion."""
    return bool(np.abs(command.velocity).max() < _STILL and abs(command.yaw_rate) < _STILL)


def is_new_course(a: VelocityCommand, b: VelocityCommand | None) -> bool:
    """Return whether two commands request different steps."""
    if b is None:
        return True
    change = np.abs([*(a.velocity - b.velocity), a.yaw_rate - b.yaw_rate, a.body_height - b.body_height, a.lift - b.lift])
    return bool((change > _NEW_COURSE).any()) or a.gait != b.gait


def _untimely_reason(request: VelocityCommand | PostureCommand | Goal | None, now_ns: int) -> str:
    """Return why the stamp of a request is not current, or "".

    It is from a recording, or its sender uses another clock.
    """
    age_s = 0.0 if request is None else (now_ns - request.stamp_ns) * 1e-9
    if abs(age_s) <= _MAX_STAMP_DIFFERENCE_S:
        return ""
    what = _NAMES[type(request)]
    when = f"{age_s:.1f} s old" if age_s > 0.0 else f"stamped {-age_s:.1f} s ahead"
    limit = f"at most {_MAX_STAMP_DIFFERENCE_S:.0f} s allowed"
    return f"the {what} is {when} by the robot's clock, {limit}; the sender must use that clock"


def _scaled(command: VelocityCommand, speed_scale: float) -> VelocityCommand:
    if speed_scale >= 1.0:
        return command
    return replace(command, velocity=command.velocity * speed_scale, yaw_rate=command.yaw_rate * speed_scale)
