"""Warm-up of the mapper on synthetic scans, which compiles all its functions.

The scans show a block on level ground and a passage, before the first real scan arrives.
"""

import numpy as np

from sextant.services.mapper.config import Settings
from sextant.services.mapper.service import Mapper
from sextant.shared.color import codes
from sextant.shared.geometry import from_xyz_rpy, to_millimetres
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.warmup import Rehearsal
from sextant.shared.wire.messages import ActuatorState, BodyPose, Mode, PassageRequest, Scan
from sextant.shared.wire.topics import SCAN

_AHEAD, _ASIDE, _CELL = (0.5, 1.2), 0.35, 0.01  # [m] visible ground, one point per cell
_BLOCK, _HIGH = (0.8, 1.0), 0.05  # [m] extent of the block along x, and its height
_BEYOND = np.array([0.3, 0.0, 0.1])  # [m] from a seen point to the end of a free ray
_STEP = 0.03  # [m] distance walked per scan


def compile_functions(profile: RobotProfile, settings: Settings) -> None:
    """Compile all functions that the mapper calls for a robot's camera."""
    stage = Rehearsal(Mapper(profile, settings))
    period_ns = round(1e9 / SCAN.rate_hz)
    for k in range(2 * max(settings.passage_every, settings.publish_every) + 1):
        stamp_ns, x = (k + 1) * period_ns, k * _STEP
        stage.hear(_legs(profile, stamp_ns, x))
        T = from_xyz_rpy((x, 0.0, profile.stance.body_height), (0.0, 0.0, 0.0))
        stage.hear(BodyPose(stamp_ns, T, np.eye(4), 1e-6 * np.eye(6), 1.0, True, "", np.zeros((0, 6))))
        stage.hear(PassageRequest(stamp_ns, np.array([0.5, 0.0]), 0.0, 0.6, 0.6))
        stage.hear(_scan(profile, stamp_ns, x))


def _scan(profile: RobotProfile, stamp_ns: int, x: float) -> Scan:
    """Return the scan of the ground from a position [m] along x."""
    ahead, aside = np.meshgrid(
        np.arange(*_AHEAD, _CELL) + _CELL / 2, np.arange(-_ASIDE, _ASIDE, _CELL) + _CELL / 2, indexing="ij"
    )
    z = np.where((ahead > _BLOCK[0]) & (ahead < _BLOCK[1]), _HIGH, 0.0)
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
        free_rays_mm=to_millimetres(points[::50] + _BEYOND, np.zeros(3)),
    )


def _legs(profile: RobotProfile, stamp_ns: int, x: float) -> ActuatorState:
    """Return six stance feet that touch the ground at the body's position."""
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
