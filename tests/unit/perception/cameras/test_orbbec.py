"""Orbbec driver against a substitute of pyorbbecsdk 2, which has the calls and the errors of the library."""

import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sextant.services.perception.cameras import orbbec
from sextant.services.perception.cameras.camera import CameraError
from sextant.services.perception.cameras.orbbec import Orbbec


class OBError(Exception):
    """The library's error is no RuntimeError."""


class Picture:
    """Depth or colour image; its data are bytes, as the library returns them."""

    def __init__(self, data: Any, at_us: int = 0, unit_mm: float = 1.0):
        self.data, self.at_us, self.unit_mm = data, at_us, unit_mm

    def get_height(self) -> int:
        return int(self.data.shape[0])

    def get_width(self) -> int:
        return int(self.data.shape[1])

    def get_data(self) -> Any:
        return np.ascontiguousarray(self.data).view(np.uint8).ravel()

    def get_timestamp_us(self) -> int:
        return self.at_us

    def get_depth_scale(self) -> float:
        return self.unit_mm


class FrameSet:
    def __init__(self, depth: Any = None, color: Any = None):
        self.depth, self.color = depth, color

    def get_depth_frame(self) -> Any:
        return self.depth

    def get_color_frame(self) -> Any:
        return self.color

    def as_frame_set(self) -> "FrameSet":
        return self


class Library:
    """The part of pyorbbecsdk that the driver uses."""

    OBError = OBError
    OBFormat = SimpleNamespace(Y16="Y16", RGB="RGB")
    OBSensorType = SimpleNamespace(DEPTH_SENSOR="depth", COLOR_SENSOR="colour")
    OBStreamType = SimpleNamespace(DEPTH_STREAM="depth")
    OBFrameAggregateOutputMode = SimpleNamespace(FULL_FRAME_REQUIRE="all")

    def __init__(self, i: Any):
        self.present, self.has_color, self.busy = True, True, False
        self.lens = SimpleNamespace(fx=i.fx, fy=i.fy, cx=i.cx, cy=i.cy)
        self.frames: list[FrameSet] = []
        self.streams: list[Any] = []
        self.acts: list[str] = []
        self.error = ""
        self.Config = lambda: SimpleNamespace(
            enable_stream=self.streams.append, set_frame_aggregate_output_mode=lambda mode: self.acts.append(mode)
        )

    def AlignFilter(self, align_to_stream: str) -> Any:
        assert align_to_stream == "depth", "depth stays as the sensor measured it"
        return SimpleNamespace(process=lambda frames: frames)

    def Pipeline(self) -> Any:
        if not self.present:
            raise RuntimeError("No device found")
        return SimpleNamespace(
            get_device=lambda: SimpleNamespace(get_device_info=lambda: self.info),
            get_stream_profile_list=self._profiles,
            start=self._start,
            stop=self._stop,
            wait_for_frames=self._wait,
        )

    info = SimpleNamespace(
        get_name=lambda: "Orbbec Gemini 2", get_serial_number=lambda: "AY3", get_connection_type=lambda: "USB3.1"
    )

    def _profiles(self, sensor: str) -> Any:
        def get(width: int, height: int, format_: str, rate: int) -> Any:
            if self.busy or (sensor == "colour" and not self.has_color):
                raise OBError("Invalid input, no matched video stream profile found!")
            return SimpleNamespace(
                asked=(sensor, width, height, format_, rate),
                get_intrinsic=lambda: self.lens,
                get_width=lambda: width,
                get_height=lambda: height,
            )

        return SimpleNamespace(get_video_stream_profile=get)

    def _start(self, config: Any) -> None:
        self.acts.append("start")

    def _stop(self) -> None:
        self.acts.append("stop")
        if self.error:
            raise OBError(self.error)

    def _wait(self, timeout_ms: int) -> Any:
        if self.error:
            raise OBError(self.error)
        return self.frames.pop(0) if self.frames else None

    def Context(self) -> Any:
        devices = SimpleNamespace(
            get_count=lambda: int(self.present),
            get_device_name_by_index=lambda _: "Orbbec Gemini 2",
            get_device_serial_number_by_index=lambda _: "AY3",
        )
        return SimpleNamespace(query_devices=lambda: devices)


@pytest.fixture
def lib(kit, monkeypatch: pytest.MonkeyPatch) -> Library:  # type: ignore[no-untyped-def]
    made = Library(kit.profile.camera.intrinsics)
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", made)
    return made


def test_images_have_host_stamps_and_are_copies_of_the_newest(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    with Orbbec(kit.profile.camera, kit.clock) as camera:
        assert camera.description == "Orbbec Gemini 2, no. AY3, USB3.1"
        assert [stream.asked for stream in lib.streams] == [("depth", 64, 48, "Y16", 30)]
        assert camera.read(False) is None
        data = kit.ground(1)
        lib.frames = [FrameSet(Picture(data, 9_000_000))]
        first = camera.read(True)
        kit.clock.pass_s(0.080)
        lib.frames = [FrameSet(Picture(kit.ground(2), 9_033_000)), FrameSet(Picture(kit.ground(3), 9_066_000))]
        newest = camera.read(False)
        assert first is not None
        assert newest is not None
        assert first.rgb is None, "the profile has no colour"
        assert newest.stamp_ns - first.stamp_ns == 66_000_000
        np.testing.assert_array_equal(newest.depth, kit.ground(3))
        before = first.depth.copy()
        data[:] = 0
        np.testing.assert_array_equal(first.depth, before)
        lib.frames = [FrameSet()]
        assert camera.read(False) is None, "a set without depth"
    assert lib.acts == ["start", "stop"]
    camera.close()


def test_color_is_aligned_to_depth_if_available(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    rgb = np.full((48, 64, 3), (1, 2, 3), np.uint8)
    for has_color in (True, False):
        lib.has_color = has_color
        camera = Orbbec(replace(kit.profile.camera, color=True), kit.clock)
        assert camera.description.endswith("with colour") is has_color
        color = Picture(rgb) if has_color else None
        lib.frames = [FrameSet(Picture(kit.ground(1)), color)]
        frame = camera.read(True)
        lib.frames = [FrameSet(Picture(kit.ground(2)), color)]
        bare = camera.read(False)
        assert frame is not None
        assert bare is not None
        assert bare.rgb is None, "none was wanted"
        assert (frame.rgb is not None) is has_color
        if has_color:
            np.testing.assert_array_equal(frame.rgb, rgb)
            lib.frames = [FrameSet(Picture(kit.ground(3)), Picture(rgb[:24]))]
            odd = camera.read(True)
            assert odd is not None
            assert odd.rgb is None, "a colour image of another size is left out"


def test_missing_library_is_reported_with_remedy(kit, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", None)
    for act in (lambda: Orbbec(kit.profile.camera, kit.clock), orbbec.find):
        with pytest.raises(CameraError, match=r"pyorbbecsdk cannot be imported.*pip install --no-deps 'pyorbbecsdk2"):
            act()


def test_absent_or_busy_device_is_reported(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    assert orbbec.find() == ["Orbbec Gemini 2, no. AY3"]
    lib.busy = True
    with pytest.raises(CameraError, match=r"64x48 at 30 Hz in 16 bits expected.*no matched video stream.*end other programs"):
        Orbbec(kit.profile.camera, kit.clock)
    lib.present = False
    with pytest.raises(CameraError, match=r"No device found; plug it into a USB 3 port.*udev"):
        Orbbec(kit.profile.camera, kit.clock)
    assert orbbec.find() == []


def test_unplugged_device_is_reported_and_closed_without_error(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    camera = Orbbec(kit.profile.camera, kit.clock)
    lib.error = "Device is deactivated/disconnected!"
    with pytest.raises(CameraError, match=r"Gemini 2.*disconnected.*plug it into"):
        camera.read(False)
    camera.close()


def test_camera_that_does_not_fit_the_profile_is_refused(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    camera = Orbbec(kit.profile.camera, kit.clock)
    lib.frames = [FrameSet(Picture(kit.ground(1), unit_mm=0.1))]
    with pytest.raises(CameraError, match=r"1000 units per metre expected.*found 10000"):
        camera.read(False)
    lib.lens.fx = 70.0
    with pytest.raises(CameraError, match=r"fx 58\.5.*expected.*fx 70\.0"):
        Orbbec(kit.profile.camera, kit.clock)
    assert lib.acts[-1] == "stop"


@pytest.mark.parametrize("unit_mm", [0.0, -1.0, float("nan")])
def test_invalid_depth_unit_is_refused(kit, lib: Library, unit_mm: float) -> None:  # type: ignore[no-untyped-def]
    camera = Orbbec(kit.profile.camera, kit.clock)
    lib.frames = [FrameSet(Picture(kit.ground(1), unit_mm=unit_mm))]
    with pytest.raises(CameraError, match="1000 units per metre expected"):
        camera.read(False)


def test_garbage_of_the_device_is_refused(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    camera = Orbbec(kit.profile.camera, kit.clock)
    lib.frames = [FrameSet(Picture(np.zeros((48, 64), np.uint8)))]
    with pytest.raises(CameraError, match=r"depth \(48, 64\) of 16 bits expected, found 3072 bytes"):
        camera.read(False)
    for wrong in (0.0, float("nan")):
        lib.lens.fy = wrong
        with pytest.raises(CameraError, match="reports invalid intrinsics"):
            Orbbec(kit.profile.camera, kit.clock)
