"""Measurements of a known robot during a calibration, by other formulas than those of the estimate."""

from dataclasses import dataclass, replace

import numpy as np

from sextant.services.perception.calibration.floor_view import block_centres
from sextant.services.perception.calibration.kinematic_calibration import JointTrack, Recording
from sextant.services.perception.calibration.survey import postures
from sextant.shared.geometry import Array, apply, from_xyz_rpy, interpolate, inverse
from sextant.shared.robot.body import Foot
from sextant.shared.robot.kinematics import body_inverse
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import FloorView

PROFILE = replace(load_profile("phantomx_mk2"), foot=Foot(0.001))  # feet that hardly roll
MS = 1_000_000
STILL, MOVING = 4, 8  # images of a posture at rest and on the way to it


@dataclass(frozen=True)
class Truth:
    """A robot and the floor on which it measures itself."""

    robot: RobotProfile = PROFILE
    trims_deg: float = 0.0
    tilt_deg: float = 0.0  # of the floor in view
    uneven_m: float = 0.0  # heights of the floor below the feet
    share: float = 1.0  # of the motion


def recording(truth: Truth, seed: int = 0) -> tuple[Recording, Array]:
    """Return what a robot measures, and its trims (6, 3) [rad]."""
    rng = np.random.default_rng(seed)
    camera = truth.robot.camera
    trims = np.radians(rng.uniform(-truth.trims_deg, truth.trims_deg, (6, 3)))
    rest = apply(from_xyz_rpy((0.0, 0.0, PROFILE.stance.body_height), np.zeros(3)), PROFILE.rest_feet())
    feet = rest + [0.0, 0.0, 1.0] * rng.normal(0.0, truth.uneven_m, (6, 1))
    targets = [from_xyz_rpy([0.0, 0.0, PROFILE.stance.body_height], np.zeros(3))]
    targets += [targets[0] @ from_xyz_rpy(truth.share * p[:3], truth.share * p[3:]) for p in postures(PROFILE)]
    views, numbers, stamps, angles = [], [], [], []
    now_ns = 1_000 * MS
    for number in range(len(targets) - 1):
        shares = [*np.linspace(0.0, 1.0, MOVING, endpoint=False), *[1.0] * STILL]
        for s in shares:
            T = interpolate(targets[number], targets[number + 1], s)
            slid = feet + rng.normal(0.0, 0.0005, (6, 3)) * [1.0, 1.0, 0.0]
            q = body_inverse(PROFILE, apply(inverse(T), slid)) + trims + rng.normal(0.0, np.radians(0.08), (6, 3))
            stamps.append(now_ns)
            angles.append(q)
            depth = inverse_depth(truth, T) + rng.normal(0.0, 3e-4, len(block_centres(camera.intrinsics)[0]))
            views.append(FloorView(now_ns + round(1e9 * camera.time_offset_s), depth))
            numbers.append(number)
            now_ns += 60 * MS
    track = JointTrack(np.array(stamps), np.array(angles), np.ones((len(stamps), 6), dtype=np.bool_))
    return Recording(views, np.array(numbers), track), trims


def inverse_depth(truth: Truth, T_floor_body: Array) -> Array:
    """Return the measured inverse depth (blocks,) [1/m]: rays of the true camera meet the floor."""
    camera, lens = truth.robot.camera, truth.robot.camera.intrinsics
    u, v = block_centres(PROFILE.camera.intrinsics)
    T = T_floor_body @ camera.T_body_camera
    normal = from_xyz_rpy(np.zeros(3), np.radians([0.0, truth.tilt_deg, 0.0]))[:3, 2]
    rays = T[:3, :3] @ np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones(len(u))])
    depth = -(normal @ T[:3, 3]) / (normal @ rays)
    seen = (depth > camera.sensor.min_range) & (depth < camera.sensor.max_range)
    return np.where(seen, 1.0 / (depth * (1.0 + camera.depth_error)), np.nan)
