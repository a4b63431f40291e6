"""What a page is told of the robot, many times a second: as little as it needs to draw it, as JSON. Pure."""

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from sextant.services.console.config import Settings
from sextant.services.console.web.control_arbiter import SEATS, Desk
from sextant.shared.geometry import Array, yaw_of
from sextant.shared.recording.event_log import Entry
from sextant.shared.robot.profile import JOINTS, LEGS, RobotProfile
from sextant.shared.wire.messages import ActuatorState, BodyPose, CameraState, Health, PassagePlan, PlannerStatus, StepPlan

PROTOCOL = 1
_SILENT_S = 3.0  # without a word, after which something is wrong with a service
_WORDS, _STAGES = 500, 32  # characters, and stages, of a service that a page is sent


def hello(profile: RobotProfile, settings: Settings, seat: int) -> dict[str, Any]:
    """What a page is told first: who it is, and what the robot looks like."""
    stance = profile.stance
    return {
        "type": "hello",
        "protocol": PROTOCOL,
        "seat": seat,
        "seats": SEATS,
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
            "stall_torque": profile.servo.stall_torque,
            "temperature_limit": profile.servo.temperature_limit,
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
    desk: Desk,
    legs: ActuatorState | None,
    pose: BodyPose | None,
    plan: StepPlan | None,
    status: PlannerStatus | None,
    camera: CameraState | None,
) -> dict[str, Any]:
    """How the robot is now; what is not known is null."""
    return {
        "type": "state",
        "seats": [{"seat": s.seat, "name": s.name, "leads": s.leads} for s in desk.seats],
        "pad": desk.at_the_pad,
        "goal": None if desk.goal is None else desk.goal.waypoints,
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
        "refused": legs.refused,
        "pace": round(legs.pace, 2),
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
    """Where the body is: by the newest correction, moved on by the legs since."""
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
    """A section of a passage as it was planned."""
    feet = plan.leg < len(LEGS)
    return {
        "type": "passage",
        "section": plan.section,
        "state": plan.state,
        "reason": plan.reason,
        "legs": plan.leg[feet].tolist(),
        "footholds": _rounded(plan.footholds[feet].ravel()),
        "stopped": _rounded(plan.stopped.ravel()),
    }


def glance(
    robot: str, desk: Desk, legs: ActuatorState | None, status: PlannerStatus | None, silent_services: Iterable[str]
) -> dict[str, Any]:
    """How the robot fares, for who looks at several at once."""
    return {
        "type": "glance",
        "robot": robot,
        "mode": None if legs is None else legs.mode,
        "reason": "no word from the actuator" if legs is None else legs.reason,
        "leader": "" if legs is None else next((s.name for s in desk.seats if s.leads), legs.lease),
        "voltage": None if legs is None else _known(legs.voltage),
        "temperature": None if legs is None else _known(legs.temperature),
        "planner": "" if status is None else f"{status.state}: {status.reason}",
        "silent": list(silent_services),
    }


def silent(services: Mapping[str, tuple[Health, int]], now_ns: int) -> list[str]:
    """Services that have not said for a while that they are well."""
    return sorted(name for name, (_, at_ns) in services.items() if now_ns - at_ns > _SILENT_S * 1e9)


def health(services: Mapping[str, tuple[Health, int]], now_ns: int, too_slow: str = "") -> dict[str, Any]:
    """How each service fares, and how long ago it last said so."""
    return {
        "type": "health",
        "too_slow": f"{too_slow}; close programs there" if too_slow else "",
        "services": [
            {
                "name": name,
                "doing": word.doing[:_WORDS],
                "silent_s": round((now_ns - at_ns) * 1e-9, 1),
                "refused": word.refused,
                "dropped": word.dropped,
                "robot_ahead_s": round(word.robot_ahead_s, 3),
                "stages": {
                    stage[:_WORDS]: round(float(p99), 1)
                    for stage, p99 in zip(word.stages[:_STAGES], word.stage_p99_ms[:_STAGES], strict=True)
                },
            }
            for name, (word, at_ns) in sorted(services.items())
        ],
    }


def log(entries: Iterable[Entry], now_ns: int) -> dict[str, Any]:
    """What has come about; times as seconds before now, for pages have clocks of their own."""
    return {
        "type": "log",
        "entries": [
            {"ago_s": round((now_ns - e.at_ns) * 1e-9, 2), "who": e.who, "words": e.words, "bad": e.bad} for e in entries
        ],
    }


def answer(words: str) -> dict[str, Any]:
    """Why a request was refused."""
    return {"type": "refused", "words": words}


def text(message: dict[str, Any]) -> str:
    """As it crosses the socket."""
    return json.dumps(message, separators=(",", ":"), allow_nan=False)


def _rounded(values: Array, digits: int = 4) -> list[float]:
    return [round(v, digits) for v in values.tolist()]


def _known(value: float) -> float | None:
    return round(value, 1) if math.isfinite(value) else None
