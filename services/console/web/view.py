"""JSON messages to pages: state, health, log and summary of the robot.

They contain only the fields that a page draws.
"""

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from sextant.services.console.config import Settings
from sextant.services.console.web.control_arbiter import DEAD_MAN_NS, SEATS, ControlArbiter
from sextant.shared.geometry import Array, yaw_of
from sextant.shared.recording.event_log import Entry
from sextant.shared.robot.profile import JOINTS, LEGS, RobotProfile
from sextant.shared.wire.messages import (
    ActuatorState,
    BodyPose,
    CalibrationState,
    CameraState,
    Health,
    PassagePlan,
    PlannerStatus,
    StepPlan,
)

PROTOCOL = 1  # version of these messages, which the page must share
_SILENT_S = 3.0  # [s] age of a service's health after which the service counts as silent
_MAX_TEXT, _MAX_STAGES = 500, 32  # maximum number of characters per text, and of stages per service


def hello(profile: RobotProfile, settings: Settings, seat: int) -> dict[str, Any]:
    """Return the first message to a page: its seat and the model of the robot."""
    stance = profile.stance
    return {
        "type": "hello",
        "protocol": PROTOCOL,
        "seat": seat,
        "seats": SEATS,
        "dead_man_ms": DEAD_MAN_NS / 1e6,
        "robot": {
            "name": profile.name,
            "legs": [
                {"name": leg.name, "mount": leg.mount_xyz, "yaw": float(np.radians(leg.neutral_yaw_deg))}
                for leg in profile.legs
            ],
            "links": [profile.links.coxa, profile.links.femur, profile.links.tibia],
            "foot_radius": profile.foot.radius,
            "body": profile.body.size,
            "camera": _rounded(profile.camera.T_body_camera.ravel()),
            "servo_ids": profile.servo_ids.tolist(),
            "joints": JOINTS,
            "stall_torques": profile.servos.stall_torque.ravel().tolist(),
            "warm_temperature": min(one.warm_temperature for one in profile.servos.each),
            "warn_voltage": profile.battery.warn_voltage,
        },
        "walk": {
            "height": settings.body_height or stance.body_height,
            "heights": stance.body_height_range,
            "lift": settings.lift,
            "lifts": [0.01, stance.max_lift],
            "speed": stance.max_speed,
        },
    }


def state(
    arbiter: ControlArbiter,
    legs: ActuatorState | None,
    pose: BodyPose | None,
    plan: StepPlan | None,
    status: PlannerStatus | None,
    camera: CameraState | None,
) -> dict[str, Any]:
    """Return the current state of the robot; unknown values are null."""
    return {
        "type": "state",
        "seats": [{"seat": s.seat, "name": s.name, "leads": s.leads} for s in arbiter.seats],
        "pad": arbiter.at_the_pad,
        "goal": None if arbiter.goal is None else arbiter.goal.waypoints,
        "legs": None if legs is None else _legs(legs),
        "pose": _pose(legs, pose),
        "plan": None if plan is None or legs is None or plan.step < legs.step else _plan(plan),
        "planner": None if status is None else _status(status),
        "camera": None if camera is None else {"ok": camera.ok, "device": camera.device, "reason": camera.reason},
    }


def _legs(legs: ActuatorState) -> dict[str, Any]:
    return {
        "mode": legs.mode,
        "reason": legs.reason,
        "lease": legs.lease,
        "plan_refusal": legs.plan_refusal,
        "speed_scale": round(legs.speed_scale, 2),
        "step": legs.step,
        "q": _rounded(legs.q.ravel(), 3),
        "load": _rounded(legs.load_nm.ravel(), 2),
        "contact": legs.contact.astype(int).tolist(),
        "swing": legs.swing.astype(int).tolist(),
        "voltage": _known(legs.voltage),
        "temperature": _known(legs.temperature),
        "warnings": legs.warnings,
    }


def _pose(legs: ActuatorState | None, pose: BodyPose | None) -> dict[str, Any] | None:
    """Return the body pose {world}: leg odometry with the newest correction."""
    if legs is None:
        return None
    correction = legs.T_world_odom if pose is None else pose.T_world_odom
    T = correction @ legs.T_odom_body
    return {
        "T": _rounded(T.ravel()),
        "yaw": round(yaw_of(T), 3),
        "ok": pose is not None and pose.ok,
        "overlap": None if pose is None else round(pose.overlap, 2),
        "reason": "no pose from perception" if pose is None else pose.reason,
    }


def _plan(plan: StepPlan) -> dict[str, Any]:
    swing = [leg for leg, swings in enumerate(plan.swing.tolist()) if swings]
    return {"step": plan.step, "legs": swing, "touchdown": _rounded(plan.touchdown[swing].ravel())}


def _status(status: PlannerStatus) -> dict[str, Any]:
    return {
        "state": status.state,
        "reason": status.reason,
        "blocked_leg": LEGS[status.blocked_leg] if status.blocked_leg >= 0 else "",
        "path": _rounded(status.path.ravel()),
    }


def passage(plan: PassagePlan) -> dict[str, Any]:
    """Return a planned section of a gap crossing."""
    feet = plan.leg < len(LEGS)
    return {
        "type": "passage",
        "section": plan.section,
        "state": plan.state,
        "reason": plan.reason,
        "legs": plan.leg[feet].tolist(),
        "footholds": _rounded(plan.footholds[feet].ravel()),
        "failure_point": _rounded(plan.failure_point.ravel()),
    }


def calibration(newest: CalibrationState, silent: bool) -> dict[str, Any]:
    """Return the progress or the result of a calibration; one that runs and is silent has ended without a result."""
    lost = newest.running and silent
    return {
        "type": "calibration",
        "running": newest.running and not lost,
        "status": newest.status,
        "posture": newest.posture,
        "postures": newest.postures,
        "result": newest.result,
        "refusal": "its command has ended without a result" if lost else newest.refusal,
    }


def glance(
    robot: str,
    arbiter: ControlArbiter,
    legs: ActuatorState | None,
    status: PlannerStatus | None,
    silent_services: Iterable[str],
) -> dict[str, Any]:
    """Return the summary of the robot for the fleet page."""
    return {
        "type": "glance",
        "robot": robot,
        "mode": None if legs is None else legs.mode,
        "reason": "no message from the actuator" if legs is None else legs.reason,
        "leader": "" if legs is None else next((s.name for s in arbiter.seats if s.leads), legs.lease),
        "voltage": None if legs is None else _known(legs.voltage),
        "temperature": None if legs is None else _known(legs.temperature),
        "planner": "" if status is None else f"{status.state}: {status.reason}",
        "silent": list(silent_services),
    }


def silent(services: Mapping[str, tuple[Health, int]], now_ns: int) -> list[str]:
    """Return the names of silent services.

    Args:
        services: Service name -> newest health and its arrival time [ns].
        now_ns: Current time [ns].
    """
    return sorted(name for name, (_, arrival_ns) in services.items() if _is_silent(arrival_ns, now_ns))


def _is_silent(arrival_ns: int, now_ns: int) -> bool:
    return now_ns - arrival_ns > _SILENT_S * 1e9


def health(services: Mapping[str, tuple[Health, int]], now_ns: int, too_slow: str = "") -> dict[str, Any]:
    """Return the newest health of each service and its age.

    Args:
        services: Service name -> newest health and its arrival time [ns].
        now_ns: Current time [ns].
        too_slow: Warning that the robot's computer is too slow, "" if it is not.
    """
    return {
        "type": "health",
        "too_slow": f"{too_slow}; close programs there" if too_slow else "",
        "services": [
            {
                "name": name,
                "status": newest.status[:_MAX_TEXT],
                "age_s": round((now_ns - arrival_ns) * 1e-9, 1),
                "silent": _is_silent(arrival_ns, now_ns),
                "refused": newest.refused,
                "dropped": newest.dropped,
                "robot_clock_offset_s": round(newest.robot_clock_offset_s, 3),
                "stages": {
                    stage[:_MAX_TEXT]: round(float(p99), 1)
                    for stage, p99 in zip(newest.stages[:_MAX_STAGES], newest.stage_p99_ms[:_MAX_STAGES], strict=True)
                },
            }
            for name, (newest, arrival_ns) in sorted(services.items())
        ],
    }


def log(entries: Iterable[Entry], now_ns: int) -> dict[str, Any]:
    """Return entries of the event log.

    They have ages instead of times, because the clocks of browsers differ.
    """
    return {
        "type": "log",
        "entries": [
            {"ago_s": round((now_ns - e.at_ns) * 1e-9, 2), "who": e.who, "words": e.words, "bad": e.bad} for e in entries
        ],
    }


def answer(words: str) -> dict[str, Any]:
    """Return the message that a request was refused, with the reason."""
    return {"type": "refused", "words": words}


def text(message: dict[str, Any]) -> str:
    """Return a message as compact JSON."""
    return json.dumps(message, separators=(",", ":"), allow_nan=False)


def _rounded(values: Array, digits: int = 4) -> list[float]:
    return [round(v, digits) for v in values.tolist()]


def _known(value: float) -> float | None:
    return round(value, 1) if math.isfinite(value) else None
