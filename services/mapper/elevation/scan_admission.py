"""Admission of scans to the map: newer than the last one, and of the body's place."""

import numpy as np

from sextant.services.mapper.elevation.validated_scan import MAX_COORDINATE_M
from sextant.shared.geometry import Array, is_rigid
from sextant.shared.wire.messages import BodyPose, Scan

_OUT_OF_ORDER_NS = 1_000_000_000  # [ns] a scan older than the newest by less than this is late; by more, the clock has changed
_MAX_BODY_DISTANCE_M = 1.0  # [m] largest distance from body to camera; beyond it, pose and scan do not belong together
_MAX_ORIGIN_DISTANCE_M = 1.0  # [m] largest distance from camera to scan origin, which is a corner of the camera's cell
_WORST_COVARIANCE = 1e4  # [m^2] and [rad^2] largest valid covariance of a pose


class ScanAdmission:
    """Decides which scans are mapped."""

    def __init__(self) -> None:
        """Start without scans."""
        self._newest_ns = -_OUT_OF_ORDER_NS  # stamp of the newest mapped scan

    def accept(self, stamp_ns: int) -> None:
        """Note the stamp of a mapped scan."""
        self._newest_ns = stamp_ns

    def rejection_reason(self, scan: Scan, pose: BodyPose | None, centre: Array) -> str:
        """Return why a scan cannot be mapped, or an empty string.

        Args:
            scan: The scan.
            pose: Newest body pose, if any.
            centre: (3,) [m] {world} position of the body, or else of the camera.
        """
        if 0 <= self._newest_ns - scan.stamp_ns < _OUT_OF_ORDER_NS:  # an older stamp is from another clock
            return "the scan is not newer than the previous one"
        if not (np.abs(centre) < MAX_COORDINATE_M).all():
            return f"a body within {MAX_COORDINATE_M:g} m of the world's origin expected"
        if pose is not None and not is_rigid(pose.T_world_body):
            return f"a rotation and a translation expected for the body's pose, found {pose.T_world_body.tolist()}"
        worst = 0.0 if pose is None else float(np.abs(pose.covariance).max())
        if worst > _WORST_COVARIANCE:
            return f"a pose's covariance of at most {_WORST_COVARIANCE:g} m^2 and rad^2 expected, found {worst:.3g}"
        away = float(np.abs(scan.p_world_camera - centre).max())
        if away > _MAX_BODY_DISTANCE_M:
            return f"the scan was taken {away:.3g} m away from the body"
        off = float(np.abs(scan.origin - scan.p_world_camera).max())
        if off > _MAX_ORIGIN_DISTANCE_M:
            return f"the scan's origin is {off:.3g} m away from its camera"
        return ""
