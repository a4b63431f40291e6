"""Compute the metrics of a report from a walk as arrays."""

from dataclasses import replace

import numpy as np

from sextant.evaluation.metrics.walk_metrics import angle_between, rubbing, slip_per_step
from sextant.evaluation.report import (
    CameraFound,
    CaptureToPlan,
    ChosenGait,
    HeightError,
    HornsFound,
    PoseError,
    Report,
    Slip,
    Spread,
    Torque,
)
from sextant.evaluation.trace.course import Course
from sextant.evaluation.trace.recorded_walk import Walk
from sextant.evaluation.trace.run_log import RunLog
from sextant.evaluation.trace.trace import Trace
from sextant.shared.geometry import Array


def add_walk_metrics(report: Report, walk: Walk, trace: Trace, course: Course) -> Report:
    """Return the report with the metrics of a walk that took steps."""
    walking, downs = walk.walking, trace.touchdowns
    height = walk.p[walking, 2]
    error = (walk.p[:, 2] - walk.height_reference)[walking]
    commanded = angle_between(walk.up_reference, np.array([0.0, 0.0, 1.0]))[walking]
    return replace(
        report,
        steps=len(np.unique(walk.step[walking])),
        tilt_deg=_spread(np.degrees(trace.tilt[walking])),
        commanded_tilt_deg=_spread(np.degrees(commanded)),
        torque_nm=_torque(walk.torque[walking]),
        touchdowns=len(downs.t),
        raised_touchdowns=int(downs.raised.sum()),
        raised_block_touchdowns=course.on_blocks(downs.p[:, :2]),
        body_height_error_m=HeightError(float(error.mean()), float(np.sqrt(np.mean(error**2)))),
        body_height_oscillation_m=float(np.subtract(*np.percentile(height, [95, 5]))),
        slip_m_per_step=_slip(walk, trace.profile.foot.radius),
        missteps=int(downs.misstep.sum()),
        min_stability_margin_m=_least_margin(walk),
    )


def pose_error(trace: Trace) -> PoseError:
    """Return the error of the estimate from the first step on.

    Before that, both poses agree by construction.
    """
    error = trace.pose_error[np.isfinite(trace.pose_error)]
    return PoseError(float(np.sqrt(np.mean(error**2))), float(error[-1])) if len(error) else PoseError()


def camera_found(heard: RunLog) -> CameraFound:
    """Return what the robot found out about its camera."""
    errors = heard.camera_errors
    if errors is None:
        return CameraFound()
    *rpy, height, depth, offset = errors.estimate.tolist()
    *rpy_sigma, height_sigma, depth_sigma, offset_sigma = errors.sigma.tolist()
    roll, pitch, yaw = np.degrees(rpy).tolist()
    sigmas = np.degrees(rpy_sigma).tolist()
    return CameraFound(
        rpy_deg=(roll, pitch, yaw),
        rpy_sigma_deg=(sigmas[0], sigmas[1], sigmas[2]),
        height_m=height,
        height_sigma_m=height_sigma,
        depth_error=depth,
        depth_error_sigma=depth_sigma,
        time_offset_s=offset,
        time_offset_sigma_s=offset_sigma,
        finding=errors.finding,
    )


def horns_found(heard: RunLog) -> HornsFound:
    """Return what the robot found out about its horns."""
    errors = heard.horn_errors
    if errors is None:
        return HornsFound()
    return HornsFound(*(tuple(np.degrees(of).ravel().tolist()) for of in (errors.estimate, errors.sigma, errors.corrected)))


def gait_choices(heard: RunLog) -> tuple[ChosenGait, ...]:
    """Return the gaits and speeds that the planner chose, in order."""
    return tuple(
        ChosenGait((status.stamp_ns - heard.begin_ns) * 1e-9, status.gait, status.speed, status.gait_reason)
        for status in heard.choices
    )


def capture_to_plan(heard: RunLog) -> CaptureToPlan:
    """Return the times from depth images to the plans in execution."""
    times = heard.capture_to_plan_ns
    if not times:
        return CaptureToPlan()
    p50, p90, p99 = (1e-6 * np.percentile(times, [50, 90, 99])).tolist()
    return CaptureToPlan(p50, p90, p99, len(times))


def _torque(torque: Array) -> Torque:
    return Torque(
        p95=float(np.percentile(torque, 95)),
        max=float(torque.max()),
        rms_worst_joint=float(np.sqrt(np.mean(torque**2, axis=0)).max()),
    )


def _slip(walk: Walk, radius: float) -> Slip:
    planted = walk.contact & ~walk.swing & walk.walking[:, None]
    slip = slip_per_step(rubbing(walk.feet[..., :2], walk.shanks, radius), planted, walk.step)
    return Slip(*np.percentile(slip, [50, 95]).tolist()) if len(slip) else Slip()


def _least_margin(walk: Walk) -> float:
    margin = walk.margin[walk.walking]
    return float(np.nanmin(margin)) if np.isfinite(margin).any() else float("nan")


def _spread(values: Array) -> Spread:
    p95, highest = np.percentile(values, [95, 100]).tolist()
    return Spread(p95, highest)
