"""Map from full depth frames: every pixel is fused at the same poses.

The comparison shows the effect of the scan reduction.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.services.mapper.elevation.fusion import FusionModel
from sextant.services.mapper.elevation.validated_scan import ValidatedScan
from sextant.services.perception.reduction.params import ReductionParams
from sextant.shared.geometry import Array, apply
from sextant.shared.robot.profile import Camera
from sextant.shared.runtime.service import AnyTopic, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import BodyPose, DepthImage, Message

_EVERY = 2  # interval between mapped frames: mapping all would take twice as long

_PARAMS = ReductionParams()


class FullFrames:
    """Mapper of unreduced depth frames, without rounding or transport."""

    name = "full frames"
    trigger: AnyTopic = topics.BODY_POSE
    subscribes: tuple[AnyTopic, ...] = (topics.DEPTH,)
    publishes: tuple[AnyTopic, ...] = ()

    def __init__(self, camera: Camera, size: tuple[int, int], resolution: float, max_range: float):
        """Start with an unknown map of a size [cells] and resolution [m].

        Pixels are used up to a range [m].
        """
        self.stages = Stages()
        self.grid = ElevationGrid(size, resolution, FusionModel.of_sensor(camera.sensor, camera.intrinsics.fx))
        self._camera, self._max_range = camera, max_range
        self._poses = 0

    def status(self) -> str:
        """Return its purpose."""
        return "mapping full frames"

    def step(self, pose: BodyPose, inbox: Inbox) -> Iterator[Message]:
        """Fuse the depth frame of a pose, if it is due."""
        image = inbox.latest(topics.DEPTH)
        self.grid.move_to(pose.T_world_body[:2, 3])
        if self._poses % _EVERY == 0 and pose.ok and image is not None and image.stamp_ns == pose.stamp_ns:
            self._fuse(image, pose)
        self._poses += 1
        yield from ()

    def _fuse(self, image: DepthImage, pose: BodyPose) -> None:
        T = pose.T_world_body @ self._camera.T_body_camera
        z = steady_depth(image.depth, self._camera)
        points = apply(T, self._camera.intrinsics.points(z)[np.isfinite(z)])
        points = points[np.hypot(*(points[:, :2] - T[:2, 3]).T) <= self._max_range]
        ones = np.ones(len(points))
        self.grid.fuse(ValidatedScan.of(points, ones, 0.0 * ones, T[:3, 3], pose_covariance=pose.covariance))


def steady_depth(raw: NDArray[np.uint16], camera: Camera) -> Array:
    """Return the depth (h, w) [m] of a frame.

    NaN out of range, and for flying pixels between two surfaces, by the rule of the scan reduction.
    """
    sensor = camera.sensor
    z = raw / sensor.depth_scale
    limit = _PARAMS.jump_m + _PARAMS.noise_sigmas * sensor.sigma(z, camera.intrinsics.fx)
    steady = np.ones(z.shape, dtype=np.bool_)
    for axis in (0, 1):
        near, far = np.roll(z, 2, axis), np.roll(z, -2, axis)
        goes_on = ((near > 0) & (np.abs(z - near) <= limit)) | ((far > 0) & (np.abs(far - z) <= limit))
        border = np.arange(z.shape[axis])
        inner = (border >= 2) & (border < len(border) - 2)  # pixels at the border are never flying pixels
        steady &= goes_on | ~(inner[:, None] if axis == 0 else inner)
    return np.where(steady & (z >= sensor.min_range) & (z <= sensor.max_range), z, np.nan)
