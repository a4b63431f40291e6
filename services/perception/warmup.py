"""Warm-up of perception on synthetic frames, which compiles all its functions.

The frames show a short walk past blocks and a displacement, before the first real frame arrives.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.config import Settings
from sextant.services.perception.registration.params import TextureParams
from sextant.services.perception.registration.texture_tracking import TextureTracker
from sextant.services.perception.service import Perception
from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.robot.profile import Camera, RobotProfile
from sextant.shared.runtime.warmup import WarmupRunner
from sextant.shared.wire.messages import ColorImage, DepthImage, Odometry

_TICK_NS = 20_000_000  # [ns] period of the odometry
_BLOCKS = np.array(  # [m] {world} opposite corners; farther apart than one body that may move in front of a resting robot
    [[[0.85, -0.5, 0.0], [1.15, -0.2, 0.06]], [[0.9, 0.2, 0.0], [1.2, 0.5, 0.06]]]
)
_AWAY = 0.15  # [m] distance walked, and then displaced without odometry
_LOOKS = 10  # frames used per place: enough to settle, and to search while in doubt


def compile_functions(profile: RobotProfile, settings: Settings) -> None:
    """Compile all functions that perception calls for a robot's camera."""
    camera = profile.camera
    if camera.color and settings.texture.use:
        _compile_tracking(camera, replace(settings.texture, min_texture=0.1))  # the random image always has points
    warmup = WarmupRunner(Perception(profile, settings))
    frames = _LOOKS * settings.frames_per_scan(camera.sensor.rate_hz)
    frame_ns = round(1e9 / camera.sensor.rate_hz)
    stamp_ns = 0
    for walked, seen_from in ((0.0, 0.0), (_AWAY, _AWAY), (_AWAY, -_AWAY)):
        depth = _picture(camera, from_xyz_rpy((seen_from, 0.0, profile.stance.body_height), (0.0, 0.0, 0.0)))
        rgb = np.full((*depth.shape, 3), 90, dtype=np.uint8)
        for _ in range(frames):
            for told_ns in range(stamp_ns, stamp_ns + frame_ns, _TICK_NS):
                warmup.deliver(
                    Odometry(told_ns, from_xyz_rpy((walked, 0.0, 0.0), (0.0, 0.0, 0.0)), walked, 0.0, np.ones(6, bool), True)
                )
            stamp_ns += frame_ns
            warmup.deliver(DepthImage(stamp_ns, depth))
            warmup.deliver(ColorImage(stamp_ns, rgb))


def _compile_tracking(camera: Camera, params: TextureParams) -> None:
    """Compile the tracking of texture, on a random image of level ground in front of the camera."""
    lens = camera.intrinsics.gray
    x, y = (np.arange(lens.width) - lens.cx) / lens.fx, (np.arange(lens.height) - lens.cy) / lens.fy
    planes = np.zeros((lens.height, lens.width, 4), dtype=np.float32)
    planes[..., 2:] = 1.0
    tracker = TextureTracker(lens, x, y, 1, params)
    tracker.load(np.random.default_rng(0).integers(0, 256, planes.shape[:2], dtype=np.uint8))
    tracker.store(0, planes)
    tracks = tracker.track(np.eye(4), np.zeros(1, dtype=np.int64), np.eye(4)[None])
    assert tracks is not None
    tracks.equations(np.eye(4))


def _picture(camera: Camera, T_world_body: Array) -> NDArray[np.uint16]:
    """Render the raw depth (h, w) of level ground with the blocks."""
    intrinsics, sensor = camera.intrinsics, camera.sensor
    T = T_world_body @ camera.T_body_camera
    rays = intrinsics.points(np.ones((intrinsics.height, intrinsics.width))) @ T[:3, :3].T  # (h, w, 3) {world} at unit depth
    rays[np.abs(rays) < 1e-9] = 1e-9
    floor = np.where(rays[..., 2] < 0.0, -T[2, 3] / rays[..., 2], np.inf)
    depth = floor
    for block in _BLOCKS:
        one, other = ((corner - T[:3, 3]) / rays for corner in block)  # depths where the rays cross its three pairs of sides
        enters, leaves = np.minimum(one, other).max(axis=-1), np.maximum(one, other).min(axis=-1)
        depth = np.minimum(depth, np.where((enters < leaves) & (enters > 0.0), enters, np.inf))
    raw = np.where(depth <= sensor.max_range, np.rint(depth * sensor.depth_scale), 0.0)
    return np.asarray(np.minimum(raw, 65535.0), dtype=np.uint16)
