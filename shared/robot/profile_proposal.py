"""Proposed values of a profile for what a user does not state: stance and camera.

The stance of a robot is that of the PhantomX, scaled with its legs, and moved to where the legs reach.
"""

from dataclasses import replace
from itertools import product

import numpy as np

from sextant.shared.geometry import Array
from sextant.shared.robot.camera import DepthSensor, Intrinsics
from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profile import JOINTS, MAX_CLEARANCE_M, MAX_TRAVEL_M, MIN_MARGIN_M, Camera, RobotProfile, Stance
from sextant.shared.robot.reach import height_range, longest_stride, steady_stride

REFERENCE_LEG_M = 0.199  # [m] femur and tibia of a PhantomX, to which the lengths of its stance belong
_REFERENCE_SPEED = 6.178  # [rad/s] of its servos
_REACH_SHARE, _HEIGHT_SHARE, _STRIDE_SHARE = 0.30, 0.52, 0.5  # of femur and tibia: coxa link to foot, body height, stride
_TRIED = (0.0, 0.04, -0.04, 0.08, -0.08, 0.12, -0.12, 0.16, -0.16, 0.2, 0.25, 0.3)  # deviations of the first two, in this order
_TIBIA = JOINTS.index("tibia")
_KEPT_SHARE = 0.84  # of a reach: standing legs travel up to 15 % further than the stride, while all feet are down
_LOW_SHARE, _HIGH_SHARE = 0.72, 1.4  # of the body height: ends of its range
_LEAST_STRIDE_SHARE = 0.3  # of the stride, at the ends of that range
_LEAST_BEND_RAD = 0.7  # of the knees of resting legs in that range

PLACEHOLDER_STANCE = Stance((0.1, 0.1, 0.1), 0.1, (0.1, 0.1), 0.1, 1.0, 0.1, 0.1)  # until a stance is proposed


def proposed_camera(size: Array) -> Camera:
    """Return a RealSense D435 over the front of a trunk of a size (3,) [m], without a driver."""
    length, _, height = size.tolist()
    lens = Intrinsics(width=640, height=480, fx=384.0, fy=384.0, cx=319.5, cy=239.5)
    sensor = DepthSensor(min_range=0.28, max_range=2.5, baseline=0.05, disparity_sigma=0.08, disparity_step=0.0)
    return Camera(lens, sensor, (round(0.45 * length, 4), 0.0, round(height / 2 + 0.11, 4)), 35.0)


def proposed_stance(profile: RobotProfile) -> Stance:
    """Return a stance for links, joint limits and servos of a profile, whose own stance does not matter.

    The foot's distance from the coxa and the body height are the nearest ones to those of a scaled PhantomX that allow its
    stride. If none do, they are those with the longest stride. A stride that leaves too little support margin is shortened.
    """
    links, leg = profile.links, profile.links.femur + profile.links.tibia
    scale = leg / REFERENCE_LEG_M
    wanted = min(_STRIDE_SHARE * leg, MAX_TRAVEL_M)
    best: tuple[float, Stance] | None = None
    for more, higher in sorted(product(_TRIED, _TRIED), key=lambda shift: abs(shift[0]) + abs(shift[1])):
        radius, height = links.coxa + (_REACH_SHARE + more) * leg, (_HEIGHT_SHARE + higher) * leg
        stance = _scaled(profile, radius, height, scale)
        robot = replace(profile, stance=stance)
        raised = robot.rest_feet() + np.array([0.0, 0.0, stance.rough_lift])
        if not within_limits(robot, body_inverse(robot, np.array([robot.rest_feet(), raised]))).all():
            continue
        stride = longest_stride(robot, height).length
        if best is None or stride > best[0]:
            best = stride, stance
        if _KEPT_SHARE * stride >= wanted:
            break
    if best is None:
        return _scaled(profile, links.coxa + _REACH_SHARE * leg, _HEIGHT_SHARE * leg, scale)
    steady = steady_stride(replace(profile, stance=best[1])) or wanted  # without any, the check says why
    stride = round(min(wanted, _KEPT_SHARE * best[0], steady), 3)
    stance = replace(best[1], stride=stride, max_speed=round(stride / best[1].step_s, 3))
    return replace(stance, body_height_range=_height_range(replace(profile, stance=stance)))


def _scaled(profile: RobotProfile, radius: float, height: float, scale: float) -> Stance:
    """Return the stance of a PhantomX times a scale, with feet at a radius from the coxa and a body height [m]."""
    radius, height = round(radius, 4), round(height, 4)
    lift = round(min(0.11 * scale, MAX_CLEARANCE_M), 3)
    speed = min(profile.servo.no_load_speed / _REFERENCE_SPEED, 1.0)
    return Stance(
        foot_radius_from_coxa=(radius, radius, radius),
        body_height=height,
        body_height_range=(height, height),
        max_speed=0.1,
        step_s=round(float(np.clip(np.sqrt(scale) / speed, 0.8, 2.0)), 2),
        stride=0.1,
        foot_speed=round(0.36 * scale * speed, 3),
        search_radius=round(0.06 * scale, 3),
        foot_distance=round(0.06 * scale, 3),
        support_margin=round(max(0.02 * scale, 1.5 * MIN_MARGIN_M), 4),
        max_climb=round(0.03 * scale, 3),
        rough_lift=min(round(0.04 * scale, 3), lift),
        max_lift=lift,
    )


def _height_range(robot: RobotProfile) -> tuple[float, float]:
    """Return the range of body heights in which a robot still takes short steps, with bent knees.

    The joints of a leg that is nearly straight turn fast when its foot moves.
    """
    height = robot.stance.body_height
    low, high = height_range(robot)
    least = _LEAST_STRIDE_SHARE * robot.stance.stride

    def steps(body_height: float) -> bool:
        bent = np.abs(body_inverse(robot, robot.rest_feet(body_height))[:, _TIBIA]) >= _LEAST_BEND_RAD
        return bool(bent.all()) and longest_stride(robot, body_height).length >= least

    lower = [h for h in np.linspace(max(low, _LOW_SHARE * height), height, 15).tolist() if steps(h)]
    upper = [h for h in np.linspace(min(high, _HIGH_SHARE * height), height, 15).tolist() if steps(h)]
    lowest = min([height, *(np.ceil(1e3 * h) / 1e3 for h in lower)])
    highest = max([height, *(np.floor(1e3 * h) / 1e3 for h in upper)])
    return float(lowest), float(highest)
