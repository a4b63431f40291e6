"""OpenNI2 driver against a substitute of the openni binding, version 2.3.

The substitute has the calls and the errors of the binding.
"""

import ctypes
import math
import sys
from dataclasses import replace
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sextant.services.perception.cameras import openni
from sextant.services.perception.cameras.camera import CameraError
from sextant.services.perception.cameras.openni import OpenNI

REGISTRATION = "depth to color"


class InitializationError(Exception):
    pass


class ClosedHandleError(Exception):
    pass


class OpenNIError(Exception):
    def __init__(self, code: int, message: bytes, logfile: object = None):
        super().__init__(code, message, logfile)


class Handle:
    def __init__(self) -> None:
        self.closed = 0

    def close(self) -> None:
        self.closed += 1

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class VideoFrame(Handle):
    def __init__(self, pixels: Any, timestamp: int):
        super().__init__()
        self.pixels, self.timestamp = pixels, timestamp
        self.height, self.width = pixels.shape[:2]

    def get_buffer_as_uint16(self) -> Any:
        return (ctypes.c_uint16 * self.pixels.size).from_buffer_copy(self.pixels.tobytes())

    def get_buffer_as_uint8(self) -> Any:
        return (ctypes.c_uint8 * self.pixels.size).from_buffer_copy(self.pixels.tobytes())


class Stream(Handle):
    def __init__(self, lib: "Library"):
        super().__init__()
        self.lib, self.frames, self.started, self.mode, self.mirrored = lib, [], False, None, True  # type: ignore[var-annotated]

    def configure_mode(self, *mode: Any) -> None:
        self.mode = mode

    def set_mirroring_enabled(self, enabled: bool) -> None:
        self.mirrored = enabled

    def get_horizontal_fov(self) -> float:
        return 2 * math.atan(32 / self.lib.focal)

    def get_vertical_fov(self) -> float:
        return 2 * math.atan(24 / self.lib.focal)

    def start(self) -> None:
        self.started = True

    def read_frame(self) -> VideoFrame:
        if not self.lib.present:
            raise OpenNIError(1, b"Stream readFrame() failed: device disconnected")
        frame: VideoFrame = self.frames.pop(0)
        self.lib.handed.append(frame)
        return frame


class Device(Handle):
    def __init__(self, lib: "Library"):
        super().__init__()
        self.lib, self.registered, self.synchronised = lib, None, False

    def get_device_info(self) -> Any:
        return SimpleNamespace(vendor=b"PrimeSense", name=b"PS1080")

    def create_depth_stream(self) -> Stream | None:
        return self.lib.depth

    def create_color_stream(self) -> Stream | None:
        return self.lib.color

    def is_image_registration_mode_supported(self, mode: str) -> bool:
        return mode == REGISTRATION

    def set_image_registration_mode(self, mode: str) -> None:
        self.registered = mode

    def set_depth_color_sync_enabled(self, enable: bool) -> None:
        self.synchronised = enable


class Library(ModuleType):
    """The part of openni.openni2 that the driver uses."""

    PIXEL_FORMAT_DEPTH_1_MM, PIXEL_FORMAT_DEPTH_100_UM, PIXEL_FORMAT_RGB888 = "1 mm", "100 um", "rgb"
    IMAGE_REGISTRATION_DEPTH_TO_COLOR = REGISTRATION

    def __init__(self) -> None:
        super().__init__("openni.openni2")
        self.present, self.installed, self.focal = True, True, 58.5
        self.depth: Stream | None = Stream(self)
        self.color: Stream | None = Stream(self)
        self.handed: list[VideoFrame] = []
        self.device = Device(self)

        def open_any() -> Device:
            if not self.present:
                raise OpenNIError(1, b"DeviceOpen using default: no devices found\n")
            return self.device

        self.Device = SimpleNamespace(open_any=open_any, enumerate_uris=lambda: [b"1d27/0601@1/5"] if self.present else [])

    def initialize(self, folders: list[str]) -> None:
        if not self.installed:
            raise InitializationError("OpenNI2 could not be loaded")

    def wait_for_any_stream(self, streams: list[Stream], timeout: float) -> Stream | None:
        assert timeout == 0, "it never waits"
        return next((stream for stream in streams if stream.frames or not self.present), None)


@pytest.fixture
def lib(monkeypatch: pytest.MonkeyPatch) -> Library:
    made, package, utils = Library(), ModuleType("openni"), ModuleType("openni.utils")
    package.openni2 = made  # type: ignore[attr-defined]
    for error in (InitializationError, ClosedHandleError, OpenNIError):
        setattr(utils, error.__name__, error)
    for name, module in (("openni", package), ("openni.openni2", made), ("openni.utils", utils)):
        monkeypatch.setitem(sys.modules, name, module)
    return made


def test_images_are_unmirrored_and_frames_are_released(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    assert lib.depth is not None
    with OpenNI(kit.profile.camera, kit.clock) as camera:
        assert camera.description == "PrimeSense PS1080"
        assert (lib.depth.mode, lib.depth.mirrored, lib.depth.started) == ((64, 48, 30, "1 mm"), False, True)
        assert lib.device.registered is None
        assert camera.read(True) is None
        lib.depth.frames = [VideoFrame(kit.ground(1), 100_000), VideoFrame(kit.ground(2), 133_000)]
        first = camera.read(True)
        kit.clock.pass_s(0.05)
        second = camera.read(True)
        assert first is not None
        assert second is not None
        assert first.rgb is None
        assert second.stamp_ns - first.stamp_ns == 33_000_000
        np.testing.assert_array_equal(second.depth, kit.ground(2))
    assert [frame.closed for frame in lib.handed] == [1, 1]
    camera.close()
    assert (lib.depth.closed, lib.device.closed) == (1, 1)


def test_depth_is_registered_to_color_when_color_is_enabled(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    assert lib.depth is not None
    assert lib.color is not None
    camera = OpenNI(replace(kit.profile.camera, color=True), kit.clock)
    assert (lib.device.registered, lib.device.synchronised) == (REGISTRATION, True)
    assert (lib.color.mode, lib.color.mirrored) == ((64, 48, 30, "rgb"), False)
    rgb = np.arange(48 * 64 * 3).reshape(48, 64, 3).astype(np.uint8)
    lib.color.frames = [VideoFrame(rgb, 101_000)]
    lib.depth.frames = [VideoFrame(kit.ground(1), 100_000), VideoFrame(kit.ground(2), 133_000)]
    paired, alone = camera.read(True), camera.read(True)
    assert paired is not None
    assert paired.rgb is not None
    np.testing.assert_array_equal(paired.rgb, rgb)
    assert alone is not None
    assert alone.rgb is None, "the colour is of an older moment"


def test_missing_color_stream_is_reported_with_remedy(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    lib.color = None
    with pytest.raises(CameraError, match=r"colour expected.*set color = false"):
        OpenNI(replace(kit.profile.camera, color=True), kit.clock)
    assert lib.device.closed == 1


def test_missing_library_or_binding_is_reported(kit, lib: Library, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    lib.installed = False
    with pytest.raises(CameraError, match=r"libOpenNI2\.so not found.*libopenni2-dev"):
        OpenNI(kit.profile.camera, kit.clock)
    monkeypatch.setitem(sys.modules, "openni", None)
    with pytest.raises(CameraError, match=r"openni binding.*\.\[openni\]"):
        openni.find()


def test_absent_device_is_reported(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    assert openni.find() == ["1d27/0601@1/5"]
    lib.present = False
    assert openni.find() == []
    with pytest.raises(CameraError, match=r"no devices found; plug the camera"):
        OpenNI(kit.profile.camera, kit.clock)


def test_disconnected_device_is_reported(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    camera = OpenNI(kit.profile.camera, kit.clock)
    lib.present = False
    with pytest.raises(CameraError, match=r"PrimeSense PS1080: .*device disconnected"):
        camera.read(False)


def test_intrinsics_or_scale_unlike_profile_are_refused(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    lib.focal = 70.0
    with pytest.raises(CameraError, match=r"fx 58\.5.*expected.*fx 70\.0"):
        OpenNI(kit.profile.camera, kit.clock)
    lib.focal = 57.6  # the data sheet's field of view; the profile has a calibrated one
    OpenNI(kit.profile.camera, kit.clock)
    sensor = replace(kit.profile.camera.sensor, depth_scale=500.0)
    with pytest.raises(CameraError, match="depth_scale of 1000 or 10000"):
        OpenNI(replace(kit.profile.camera, sensor=sensor), kit.clock)


def test_truncated_frame_is_reported(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    assert lib.depth is not None
    camera = OpenNI(kit.profile.camera, kit.clock)
    short = VideoFrame(kit.ground(1), 1)
    short.height = 50
    lib.depth.frames = [short]
    with pytest.raises(CameraError, match=r"\(50, 64\) expected, found 3072"):
        camera.read(False)
