"""A registration of another package, in place of Sextant's own."""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.registration_result import RegistrationResult, refused_result
from sextant.shared.plugins import registration as plugin
from sextant.shared.plugins.loading import Plugin
from sextant.shared.robot.profile import RobotProfile


class PluginRegistration:
    """Passes each frame to a plug-in, and checks its pose."""

    def __init__(self, profile: RobotProfile, name: str):
        """Load the plug-in.

        Raises:
            PluginError: It cannot be loaded.
        """
        self._intrinsics, self._sensor = profile.camera.intrinsics, profile.camera.sensor
        self._plugin = Plugin.make("registration", name, profile)

    def update(
        self,
        depth_raw: NDArray[np.uint16],
        stamp_ns: int,
        T_world_camera_prior: NDArray[np.float64],
        prior_covariance: NDArray[np.float64],
    ) -> RegistrationResult:
        """Register one frame; arguments, result and errors as in `Registration.update`."""
        self._intrinsics.check_raw(depth_raw)
        low, high = self._sensor.raw_bounds
        measured = (depth_raw >= low) & (depth_raw <= high)
        depth = np.where(measured, depth_raw * np.float32(1.0 / self._sensor.depth_scale), np.float32(0.0))
        frame = plugin.Frame(stamp_ns, depth, T_world_camera_prior.copy(), prior_covariance.copy())
        pose = self._plugin.call(lambda registration: plugin.checked_pose(registration.register(frame)))
        if isinstance(pose, plugin.NoPose):
            return refused_result(stamp_ns, T_world_camera_prior, prior_covariance, None, pose.reason)
        return RegistrationResult(
            stamp_ns, pose.T_world_camera, pose.covariance, pose.overlap, math.nan, np.zeros((0, 6)), True, ""
        )
