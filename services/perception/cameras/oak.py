"""Luxonis OAK-D cameras (OAK-D, Lite, Pro, S2) through depthai 3; the camera computes the depth itself."""

import contextlib
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.cameras.camera import (
    Camera,
    CameraError,
    DeviceClock,
    Frame,
    check_depth_scale,
    check_image,
    check_intrinsics,
    intrinsics_of,
)
from sextant.shared.robot.profile import Camera as CameraProfile

_NAME = "OAK-D"
_PLUG = (
    "plug it into a USB 3 port with its own cable, and give this user the right to use it: "
    """'SUBSYSTEM=="usb", ATTRS{idVendor}=="03e7", MODE="0666"' in /etc/udev/rules.d/80-movidius.rules"""
)
_UNITS_PER_M = 1000.0  # the camera's depth is in millimetres
_QUEUED = 4  # images that wait to be read; further ones replace the oldest
_MICROSECOND = timedelta(microseconds=1)


class Oak(Camera):
    """First OAK-D found: depth of its stereo pair, rectified.

    With colour in the profile, the camera aligns depth to its undistorted colour lens; otherwise to its left lens.
    """

    recorded = False

    def __init__(self, expected: CameraProfile, clock: Callable[[], int], delay_s: float = 0.0):
        """Start the streams, which takes some seconds.

        Args:
            expected: Camera of the robot's profile; with colour, the intrinsics are those of the colour lens.
            clock: [ns] clock that stamps the images.
            delay_s: [s] minimum time from exposure to arrival.

        Raises:
            CameraError: The library or the device is missing, or the profile does not fit it.
        """
        self._dai = dai = _library()
        self._errors = (RuntimeError, dai.MessageQueue.QueueException)
        self._expected, self._clock = expected, clock
        self._stamps = DeviceClock(delay_ns=round(delay_s * 1e9))
        self._pipeline: Any = None
        self._device: Any = None
        self._checked = False  # whether the first image fits the profile
        self.description = _NAME
        check_depth_scale(_NAME, expected.sensor.depth_scale, _UNITS_PER_M)
        try:
            self._device = dai.Device()
            self.description = _about(self._device) + (", with colour" if expected.color else "")
            self._start()
        except self._errors as error:
            self.close()
            raise CameraError(f"{self.description}: {error}", _PLUG) from error

    def close(self) -> None:
        """Stop the streams and close the device."""
        pipeline, device, self._pipeline, self._device = self._pipeline, self._device, None, None
        with contextlib.suppress(*self._errors):  # it may be unplugged
            if pipeline is not None:
                pipeline.stop()
        with contextlib.suppress(*self._errors):
            if device is not None:
                device.close()

    def read(self, color: bool) -> Frame | None:
        """Return the newest image, with depth and colour of the same instant, if any."""
        newest = None
        try:
            if not self._pipeline.isRunning():
                raise CameraError(f"{self.description}: the connection is interrupted", _PLUG)
            while (message := self._queue.tryGet()) is not None:
                newest = message
            if newest is None:
                return None
            depth = newest["depth"] if self._expected.color else newest
            pixels = np.array(depth.getFrame())
            rgb = np.array(newest["rgb"].getCvFrame()) if color and self._expected.color else None
            stamp_ns = self._stamps.host_ns(depth.getTimestampDevice() // _MICROSECOND * 1000, self._clock())
            self._check(depth, pixels)
        except self._errors as error:
            raise CameraError(f"{self.description}: {error}", _PLUG) from error
        return Frame(stamp_ns, pixels, rgb)

    def _start(self) -> None:
        """Make and start the pipeline: two grey cameras, stereo depth, and colour if the profile has it."""
        dai, i, rate = self._dai, self._expected.intrinsics, self._expected.sensor.rate_hz
        size = (i.width, i.height)
        pipeline = self._pipeline = dai.Pipeline(self._device)
        stereo = pipeline.create(dai.node.StereoDepth)
        for socket, side in ((dai.CameraBoardSocket.CAM_B, stereo.left), (dai.CameraBoardSocket.CAM_C, stereo.right)):
            pipeline.create(dai.node.Camera).build(socket).requestOutput(size, fps=rate).link(side)
        stereo.setLeftRightCheck(True)
        stereo.setSubpixel(True)
        out = stereo.depth
        if self._expected.color:
            lens = pipeline.create(dai.node.Camera).build(dai.CameraBoardSocket.CAM_A)
            color = lens.requestOutput(size, dai.ImgFrame.Type.RGB888i, fps=rate, enableUndistortion=True)
            out = self._aligned(stereo, color)
        self._queue = out.createOutputQueue(maxSize=_QUEUED, blocking=False)
        pipeline.start()

    def _aligned(self, stereo: Any, color: Any) -> Any:
        """Align depth to colour, and return an output with both of the same instant."""
        dai = self._dai
        sync = self._pipeline.create(dai.node.Sync)
        sync.setSyncThreshold(timedelta(seconds=0.5 / self._expected.sensor.rate_hz))
        color.link(sync.inputs["rgb"])
        if self._device.getPlatform() == dai.Platform.RVC4:
            align = self._pipeline.create(dai.node.ImageAlign)
            stereo.depth.link(align.input)
            color.link(align.inputAlignTo)
            align.outputAligned.link(sync.inputs["depth"])
        else:
            color.link(stereo.inputAlignTo)
            stereo.depth.link(sync.inputs["depth"])
        return sync.out

    def _check(self, depth: Any, pixels: NDArray[Any]) -> None:
        """Compare the first image with the profile; the camera states the intrinsics with its images."""
        i = self._expected.intrinsics
        check_image(self.description, "depth", pixels, np.uint16, (i.height, i.width))
        if self._checked:
            return
        matrix = np.array(depth.getTransformation().getIntrinsicMatrix(), dtype=np.float64)
        height, width = pixels.shape
        found = intrinsics_of(self.description, width, height, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
        check_intrinsics(self.description, self._expected.intrinsics, found)
        self._checked = True


def find() -> list[str]:
    """List the OAK-D cameras that are plugged in, as text.

    Raises:
        CameraError: The library is missing, or the search failed.
    """
    dai = _library()
    try:
        return [f"{_NAME}, no. {info.deviceId}" for info in dai.Device.getAllAvailableDevices()]
    except RuntimeError as error:
        raise CameraError(f"{_NAME}: {error}", _PLUG) from error


def _library() -> Any:
    try:
        import depthai
    except (ImportError, OSError) as error:
        raise CameraError(f"{_NAME}: depthai cannot be imported ({error})", "pip install -e '.[oak]'") from error
    if not hasattr(depthai.node, "Camera") or not hasattr(depthai, "MessageQueue"):  # depthai 2
        raise CameraError(f"{_NAME}: depthai 3 expected, found {depthai.__version__}", "pip install -e '.[oak]'")
    return depthai


def _about(device: Any) -> str:
    """Return name, serial number and USB speed."""
    return f"{device.getDeviceName() or _NAME}, no. {device.getDeviceId()}, USB {device.getUsbSpeed().name.lower()}"
