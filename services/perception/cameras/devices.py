"""Cameras by their names in a profile."""

import importlib
from collections import deque
from collections.abc import Callable
from pathlib import Path

from sextant.services.perception.cameras.camera import Camera, CameraError
from sextant.services.perception.cameras.config import Settings
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import ExternalDepth

EXTERNAL = "external"  # another program reads the camera
_DRIVERS = {"openni2": "openni", "realsense": "realsense", "oak": "oak", "orbbec": "orbbec"}  # device -> module


def open_camera(
    device: str,
    profile: RobotProfile,
    settings: Settings,
    clock: Callable[[], int],
    external: deque[ExternalDepth] | None = None,
) -> Camera:
    """Open a camera by its name.

    Args:
        device: One of `CAMERA_DEVICES`, or the path of a recorded folder.
        profile: Profile of the robot with its camera.
        settings: Settings of the camera service.
        clock: [ns] clock that stamps the images.
        external: Frames of another program, for the device "external".

    Raises:
        CameraError: It cannot be opened; the error gives the cause.
    """
    camera, delay_s = profile.camera, settings.delay_s
    match device:
        case "openni2":
            from sextant.services.perception.cameras.openni import OpenNI

            return OpenNI(camera, clock, delay_s)
        case "realsense":
            from sextant.services.perception.cameras.realsense import RealSense

            return RealSense(camera, clock, delay_s, imu=profile.imu.device == "camera")
        case "oak":
            from sextant.services.perception.cameras.oak import Oak

            return Oak(camera, clock, delay_s)
        case "orbbec":
            from sextant.services.perception.cameras.orbbec import Orbbec

            return Orbbec(camera, clock, delay_s)
        case "external":
            from sextant.services.perception.cameras.external import ExternalCamera

            return ExternalCamera(camera, deque(maxlen=1) if external is None else external, clock)
        case "none":
            raise CameraError(
                f"the profile {profile.name} names no camera",
                f"set device to one of {', '.join((*_DRIVERS, EXTERNAL))} in its [camera], or give --camera DIR",
            )
    from sextant.services.perception.cameras.folder import FolderCamera

    return FolderCamera(Path(device), camera, clock, settings.loop)


def find(device: str, profile: RobotProfile) -> list[str]:
    """List what a camera name refers to, as text; empty if no device is plugged in.

    Raises:
        CameraError: The search failed, or a recording does not match the profile.
    """
    if device in _DRIVERS:
        driver = importlib.import_module(f"sextant.services.perception.cameras.{_DRIVERS[device]}")
        return list(driver.find())
    with open_camera(device, profile, Settings(), lambda: 0) as camera:
        return [camera.description]
