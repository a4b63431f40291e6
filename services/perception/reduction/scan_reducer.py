"""Scan messages of registered frames."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.config import Settings
from sextant.services.perception.reduction.free_space_rays import compute_free_rays
from sextant.services.perception.reduction.scan_reduction import reduce_scan
from sextant.services.perception.registration.camera_correction import CameraCorrection
from sextant.services.perception.registration.registration_result import RegistrationResult
from sextant.shared.geometry import Array, to_millimetres
from sextant.shared.robot.profile import Camera
from sextant.shared.wire.messages import DepthImage, Scan

_EMPTY_EVERY = 3  # [scans] interval at which pixels without a return count as free rays, because these are less reliable


class ScanReducer:
    """Reduces registered frames of one camera to scans."""

    def __init__(self, camera: Camera, settings: Settings, correction: CameraCorrection):
        """Initialize for a camera."""
        self._camera, self._settings, self._correction = camera, settings, correction
        self._count = 0  # number of scans, which selects their free rays

    def reduce(self, image: DepthImage, found: RegistrationResult, share_of_points: float) -> Scan:
        """Return the scan of a frame.

        Args:
            image: The frame.
            found: Its pose.
            share_of_points: Share of the settings' maximum number of points.
        """
        settings = self._settings
        self._count += 1
        reduced = reduce_scan(
            image.depth,
            self._camera.intrinsics,
            self._camera.sensor,
            found.T_world_camera,
            resolution=settings.scan_resolution,
            max_range=settings.scan_range,
            max_points=max(1, round(share_of_points * settings.scan_points)),
            ceiling=settings.scan_ceiling,
            params=settings.reduction,
        )
        return Scan(
            stamp_ns=image.stamp_ns,
            origin=reduced.origin,
            points_mm=reduced.points,
            pixel_count=reduced.count,
            height_range_mm=reduced.spread,
            p_world_camera=np.array(found.T_world_camera[:3, 3]),
            pose_covariance=np.asarray(found.covariance, dtype=np.float64),
            ground_change=self._correction.ground_change,
            free_rays_mm=self._free_rays(image, found, reduced.origin),
        )

    def _free_rays(self, image: DepthImage, found: RegistrationResult, origin: Array) -> NDArray[np.int16]:
        """Return free rays of an image that end beyond the scan, [mm] from its origin."""
        points = compute_free_rays(
            image.depth,
            self._camera.intrinsics,
            self._camera.sensor,
            found.T_world_camera,
            max_range=self._settings.scan_range,
            image_number=self._count,
            # An image without any return may come from a covered camera.
            count_empty=found.ok and self._count % _EMPTY_EVERY == 0,
        )
        return to_millimetres(points, origin)
