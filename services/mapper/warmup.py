"""Warm-up of the mapper on synthetic scans, which compiles all its functions.

The scans show a block on level ground and a passage, before the first real scan arrives.
"""

import numpy as np

from sextant.services.mapper.config import Settings
from sextant.services.mapper.service import Mapper
from sextant.shared.color import codes
from sextant.shared.geometry import Array, from_xyz_rpy, to_millimetres
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.warmup import WarmupRunner
from sextant.shared.wire.messages import ActuatorState, BodyPose, Mode, PassageRequest, Scan
from sextant.shared.wire.topics import SCAN

_AHEAD_M, _ASIDE_M, _CELL_M = (0.5, 1.2), 0.35, 0.01  # [m] visible ground ahead and to both sides, one point per cell
_BLOCK_M, _BLOCK_HEIGHT_M = (0.8, 1.0), 0.05  # [m] extent of the block along x, and its height
_FREE_RAY_M = np.array([0.3, 0.0, 0.1])  # [m] from a seen point to the end of a free-space ray
_STEP_M = 0.03  # [m] distance walked per scan


def compile_functions(profile: RobotProfile, settings: Settings) -> None:
    """Compile all functions that the mapper calls for a robot's camera."""
    warmup = WarmupRunner(Mapper(profile, settings))
    period_ns = round(1e9 / SCAN.rate_hz)
    for k in range(2 * max(settings.passage_every, settings.publish_every) + 1):
        stamp_ns, x = (k + 1) * period_ns, k * _STEP_M
        warmup.deliver(_actuator_state(profile, stamp_ns, x))
        T = from_xyz_rpy((x, 0.0, profile.stance.body_height), (0.0, 0.0, 0.0))
        warmup.deliver(_body_pose(stamp_ns, T))
        warmup.deliver(PassageRequest(stamp_ns, np.array([0.5, 0.0]), 0.0, 0.6, 0.6))
        warmup.deliver(_scan(profile, stamp_ns, x))


def _body_pose(stamp_ns: int, T_world_body: Array) -> BodyPose:
    return BodyPose(
        stamp_ns=stamp_ns,
        T_world_body=T_world_body,
        T_world_odom=np.eye(4),
        covariance=1e-6 * np.eye(6),
        overlap=1.0,
        ok=True,
        reason="",
        degenerate=np.zeros((0, 6)),
    )


def _scan(profile: RobotProfile, stamp_ns: int, x: float) -> Scan:
    """Return the scan that the robot takes at a position x [m]."""
    ahead, aside = np.meshgrid(
        np.arange(*_AHEAD_M, _CELL_M) + _CELL_M / 2, np.arange(-_ASIDE_M, _ASIDE_M, _CELL_M) + _CELL_M / 2, indexing="ij"
    )
    z = np.where((ahead > _BLOCK_M[0]) & (ahead < _BLOCK_M[1]), _BLOCK_HEIGHT_M, 0.0)
    points = np.column_stack([ahead.ravel(), aside.ravel(), z.ravel()])
    n = len(points)
    p_world_camera = profile.camera.T_body_camera[:3, 3] + [x, 0.0, profile.stance.body_height]
    colored = profile.camera.color
    return Scan(
        stamp_ns=stamp_ns,
        origin=np.zeros(3),
        points_mm=to_millimetres(points, np.zeros(3)),
        pixel_count=np.full(n, 20, dtype=np.uint8),
        height_range_mm=np.zeros(n, dtype=np.uint8),
        p_world_camera=p_world_camera,
        pose_covariance=1e-6 * np.eye(6),
        color=codes(np.full((n if colored else 0, 3), 90.0)),
        free_rays_mm=to_millimetres(points[::50] + _FREE_RAY_M, np.zeros(3)),
    )


def _actuator_state(profile: RobotProfile, stamp_ns: int, x: float) -> ActuatorState:
    """Return the state of a robot that stands at a position x [m] with all feet on the ground."""
    feet = profile.rest_feet(profile.stance.body_height)
    T = from_xyz_rpy((x, 0.0, profile.stance.body_height), (0.0, 0.0, 0.0))
    underside = feet + T[:3, 3] - [0.0, 0.0, profile.foot.radius]
    return ActuatorState(
        stamp_ns=stamp_ns,
        mode=Mode.WALK,
        reason="",
        lease="",
        epoch=0,
        speed_scale=1.0,
        plan_refusal="",
        refused_plan_ns=-1,
        plan_ns=-1,
        step=0,
        phase=1.0,
        swing=np.zeros(6, dtype=bool),
        contact=np.ones(6, dtype=bool),
        q=np.zeros((6, 3)),
        load_nm=np.zeros((6, 3)),
        feet=feet,
        T_odom_body=T,
        body_ref=T,
        T_world_odom=np.eye(4),
        voltage=12.0,
        temperature=30.0,
        warnings=(),
        touchdown_ns=np.full(6, stamp_ns, dtype=np.int64),
        touchdown_point=underside,
        touchdown_contact=np.ones(6, dtype=bool),
    )
