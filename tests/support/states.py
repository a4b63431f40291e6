"""Actuator states of a standing robot, for tests to change."""

from typing import Any

import numpy as np

from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire import codec
from sextant.shared.wire.messages import ActuatorState, Mode


def actuator_state(profile: RobotProfile, **changes: Any) -> ActuatorState:
    """Return the state of a robot that holds still at the origin of {odom}.

    Its feet are at rest.
    """
    swing = np.asarray(changes.get("swing", np.zeros(6, dtype=bool)))
    values: dict[str, Any] = {
        "stamp_ns": 0,
        "mode": Mode.HOLD,
        "reason": "",
        "lease": "operator",
        "epoch": 0,
        "speed_scale": 1.0,
        "plan_refusal": "",
        "refused_plan_ns": -1,
        "plan_ns": -1,
        "step": 0,
        "phase": 1.0,
        "swing": swing,
        "contact": ~swing,
        "q": np.zeros((6, 3)),
        "load_nm": np.zeros((6, 3)),
        "feet": profile.rest_feet(),
        "T_odom_body": np.eye(4),
        "body_ref": np.eye(4),
        "T_world_odom": np.eye(4),
        "voltage": 11.0,
        "temperature": 30.0,
        "warnings": (),
    }
    return ActuatorState(**(values | changes))


def frame_of_version_0_1(profile: RobotProfile) -> bytes:
    """Return an actuator state under the schema that it had in version 0.1."""
    return codec.encode(actuator_state(profile)).replace(codec.schema_id(ActuatorState).encode(), b"ActuatorState:5576558f")
