"""The robot that is simulated: its profile with the deviations of a run."""

from dataclasses import replace

import numpy as np

from sextant.shared.robot.body import Body
from sextant.shared.robot.profile import Camera, RobotProfile
from sextant.shared.scenario.mismatch import Deviation

_PAYLOAD_HEIGHT_M = 0.03  # [m] of a payload's centre above the trunk's upper face; a small battery or computer


def real_profile(profile: RobotProfile, deviation: Deviation) -> RobotProfile:
    """Return the profile that describes the real robot: its true camera and its true masses.

    The other deviations have no place in a profile.

    Raises:
        ConfigError: A true value is outside of what a profile allows.
    """
    return replace(profile, camera=_camera(profile.camera, deviation), body=_body(profile.body, deviation))


def _camera(camera: Camera, deviation: Deviation) -> Camera:
    roll, pitch, yaw = deviation.camera_rpy_deg.tolist()
    x, y, z = (np.array(camera.mount_xyz) + deviation.camera_xyz).tolist()
    lens, (right, down) = camera.intrinsics, deviation.principal_point.tolist()
    scale = 1.0 + deviation.focal_length
    depth_error = camera.depth_error + deviation.depth_scale + camera.depth_error * deviation.depth_scale
    return replace(
        camera,
        mount_xyz=(x, y, z),
        roll_deg=camera.roll_deg + roll,
        pitch_down_deg=camera.pitch_down_deg + pitch,
        yaw_deg=camera.yaw_deg + yaw,
        time_offset_s=camera.time_offset_s + deviation.stamp_offset_s,
        depth_error=depth_error,
        distortion=camera.distortion + deviation.distortion,
        intrinsics=replace(lens, fx=lens.fx * scale, fy=lens.fy * scale, cx=lens.cx + right, cy=lens.cy + down),
    )


def _body(body: Body, deviation: Deviation) -> Body:
    mass = body.mass + deviation.payload
    top = np.array([0.0, 0.0, body.size[2] / 2 + _PAYLOAD_HEIGHT_M])
    x, y, z = (body.mass * np.array(body.centre_of_mass) + deviation.payload * top) / mass + deviation.centre_of_mass
    return replace(body, mass=mass, centre_of_mass=(float(x), float(y), float(z)))
