"""RealSense driver against a substitute of pyrealsense2.

The substitute has the calls and the errors of the library.
"""

import re
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sextant.services.perception.cameras import realsense
from sextant.services.perception.cameras.camera import CameraError
from sextant.services.perception.cameras.realsense import RealSense

INFO = {"name": "Intel RealSense D435I", "serial_number": "0123", "usb_type_descriptor": "3.2"}


class Device:
    def __init__(self, lib: "Library"):
        self.lib = lib

    def supports(self, kind: str) -> bool:
        return kind in INFO

    def get_info(self, kind: str) -> str:
        return INFO[kind]

    def first_depth_sensor(self) -> Any:
        return SimpleNamespace(get_depth_scale=lambda: self.lib.depth_scale)

    def query_sensors(self) -> list[Any]:
        depth = SimpleNamespace(is_motion_sensor=lambda: False)
        return [depth, self.lib.motion] if self.lib.motion else [depth]


class MotionSensor:
    """Gyroscope and accelerometer of a camera."""

    def __init__(self, kinds: tuple[str, ...] = ("accel", "gyro")):
        rates = {"accel": (63, 100, 200), "gyro": (200, 400)}
        self.profiles = [
            SimpleNamespace(stream_type=lambda kind=kind: kind, fps=lambda hz=hz: hz) for kind in kinds for hz in rates[kind]
        ]
        self.opened: list[tuple[str, int]] = []
        self.acts: list[str] = []
        self.queue: list[Any] = []
        self.error = ""

    def is_motion_sensor(self) -> bool:
        return True

    def get_stream_profiles(self) -> list[Any]:
        return self.profiles

    def open(self, profiles: list[Any]) -> None:
        if self.error:
            raise RuntimeError(self.error)
        self.opened = [(profile.stream_type(), profile.fps()) for profile in profiles]

    def start(self, queue: "Queue") -> None:
        queue.readings = self.queue
        self.acts.append("start")

    def stop(self) -> None:
        self.acts.append("stop")

    def close(self) -> None:
        self.acts.append("close")

    def send(self, kind: str, x: float, y: float, z: float, at_ms: float) -> None:
        frame = SimpleNamespace(
            as_motion_frame=lambda: SimpleNamespace(get_motion_data=lambda: SimpleNamespace(x=x, y=y, z=z)),
            get_timestamp=lambda: at_ms,
            get_profile=lambda: SimpleNamespace(stream_type=lambda: kind),
        )
        self.queue.append(frame)


class Queue:
    readings: list[Any] = []  # noqa: RUF012

    def poll_for_frame(self) -> Any:
        return self.readings.pop(0) if self.readings else None


class Picture:
    def __init__(self, data: Any = None, number: int = 0, timestamp: float = 0.0):
        self.data, self.number, self.timestamp = data, number, timestamp

    def __bool__(self) -> bool:
        return self.data is not None

    def get_data(self) -> Any:
        return memoryview(self.data)

    def get_frame_number(self) -> int:
        return self.number

    def get_timestamp(self) -> float:
        return self.timestamp


class FrameSet:
    def __init__(self, depth: Picture | None = None, color: Picture | None = None):
        self.depth, self.color = depth, color

    def size(self) -> int:
        return (self.depth is not None) + (self.color is not None)

    def get_depth_frame(self) -> Picture:
        return self.depth or Picture()

    def get_color_frame(self) -> Picture:
        return self.color or Picture()


class Pipeline:
    def __init__(self, lib: "Library"):
        self.lib, self.started = lib, False

    def start(self, config: "Config") -> Any:
        if not self.lib.present:
            raise RuntimeError("No device connected")
        if self.lib.busy:
            raise RuntimeError("failed to set power state")
        self.started, self.lib.streams = True, config.streams
        i = self.lib.intrinsics
        video = SimpleNamespace(get_intrinsics=lambda: i)
        return SimpleNamespace(
            get_device=lambda: Device(self.lib),
            get_stream=lambda stream: SimpleNamespace(as_video_stream_profile=lambda: video),
        )

    def poll_for_frames(self) -> FrameSet:
        if not self.started:
            raise RuntimeError("poll_for_frames cannot be called before start()")
        return self.lib.frames.pop(0) if self.lib.frames else FrameSet()

    def stop(self) -> None:
        if not self.started:
            raise RuntimeError("stop() cannot be called before start()")
        self.started = False
        self.lib.stops += 1


class Config:
    def __init__(self, lib: "Library"):
        self.lib, self.streams = lib, []  # type: ignore[var-annotated]

    def enable_stream(self, *wanted: Any) -> None:
        self.streams.append(wanted)

    def can_resolve(self, wrapper: Any) -> bool:
        return self.lib.has_color or all(stream[0] != "color" for stream in self.streams)


class Library:
    """The part of pyrealsense2 that the driver uses."""

    stream = SimpleNamespace(depth="depth", color="color", accel="accel", gyro="gyro")
    format = SimpleNamespace(z16="z16", rgb8="rgb8")
    camera_info = SimpleNamespace(**{key: key for key in INFO})

    def __init__(self, i: Any):
        self.present, self.busy, self.has_color, self.depth_scale = True, False, True, 0.001
        self.intrinsics = SimpleNamespace(width=i.width, height=i.height, fx=i.fx, fy=i.fy, ppx=i.cx, ppy=i.cy)
        self.frames: list[FrameSet] = []
        self.streams: list[Any] = []
        self.stops = 0
        self.motion: MotionSensor | None = None

    def frame_queue(self, capacity: int) -> Queue:
        return Queue()

    def pipeline(self) -> Pipeline:
        return Pipeline(self)

    def pipeline_wrapper(self, pipeline: Pipeline) -> Pipeline:
        return pipeline

    def config(self) -> Config:
        return Config(self)

    def align(self, to: str) -> Any:
        assert to == "depth", "depth stays as the sensor measured it"
        return SimpleNamespace(process=lambda frames: frames)

    def context(self) -> Any:
        return SimpleNamespace(query_devices=lambda: [Device(self)] if self.present else [])


@pytest.fixture
def lib(kit, monkeypatch: pytest.MonkeyPatch) -> Library:  # type: ignore[no-untyped-def]
    made = Library(kit.profile.camera.intrinsics)
    monkeypatch.setitem(sys.modules, "pyrealsense2", made)
    return made


def colored(kit):  # type: ignore[no-untyped-def]
    from dataclasses import replace

    return replace(kit.profile.camera, color=True)


def test_images_have_host_stamps_and_are_copies(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    with RealSense(kit.profile.camera, kit.clock) as camera:
        assert camera.description == "Intel RealSense D435I, no. 0123, USB 3.2"
        assert lib.streams == [("depth", 64, 48, "z16", 30)]
        assert camera.read(False) is None
        data = kit.ground(1)
        lib.frames = [FrameSet(Picture(data, 1, 9000.0)), FrameSet(Picture(kit.ground(2), 2, 9033.0))]
        first = camera.read(True)
        kit.clock.pass_s(0.040)
        second = camera.read(True)
        assert first is not None
        assert second is not None
        assert first.rgb is None, "the profile has no colour"
        assert second.stamp_ns - first.stamp_ns == 33_000_000
        before = first.depth.copy()
        data[:] = 0
        np.testing.assert_array_equal(first.depth, before)
    assert lib.stops == 1
    camera.close()


def test_color_is_returned_with_depth_if_available(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    rgb = np.full((48, 64, 3), (1, 2, 3), np.uint8)
    for has_color in (True, False):
        lib.has_color = has_color
        camera = RealSense(colored(kit), kit.clock)
        assert camera.description.endswith("with colour") is has_color
        lib.frames = [FrameSet(Picture(kit.ground(n), n, 33.0 * n), Picture(rgb, n) if has_color else None) for n in (1, 2)]
        frame, bare = camera.read(True), camera.read(False)
        assert frame is not None
        assert bare is not None
        assert bare.rgb is None, "none was wanted"
        assert (frame.rgb is not None) is has_color
        if has_color:
            np.testing.assert_array_equal(frame.rgb, rgb)
        camera.close()


def test_repeated_frame_number_is_returned_once(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    camera = RealSense(kit.profile.camera, kit.clock)
    lib.frames = [FrameSet(Picture(kit.ground(1), 7, 1.0)), FrameSet(Picture(kit.ground(1), 7, 1.0))]
    assert camera.read(False) is not None
    assert camera.read(False) is None


def test_missing_library_is_reported_with_remedy(kit, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    for act in (lambda: RealSense(kit.profile.camera, kit.clock), realsense.find):
        with pytest.raises(CameraError, match=r"pyrealsense2 cannot be imported.*\.\[realsense\]"):
            act()


def test_absent_or_busy_device_is_reported(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    assert realsense.find() == ["Intel RealSense D435I, no. 0123, USB 3.2"]
    lib.busy = True
    with pytest.raises(CameraError, match=r"64x48 at 30 Hz expected.*D435I.*failed to set power state.*end other programs"):
        RealSense(kit.profile.camera, kit.clock)
    lib.present = False
    with pytest.raises(CameraError, match=r"no device found.*plug it into a USB 3 port"):
        RealSense(kit.profile.camera, kit.clock)
    assert realsense.find() == []


def test_mismatched_device_is_refused_and_stopped(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    lib.intrinsics.fx = 70.0
    with pytest.raises(CameraError, match=r"fx 58\.5.*expected.*fx 70\.0"):
        RealSense(kit.profile.camera, kit.clock)
    lib.intrinsics.fx, lib.depth_scale = 58.5, 0.0001
    with pytest.raises(CameraError, match=r"1000 units per metre expected.*found 10000"):
        RealSense(kit.profile.camera, kit.clock)
    assert lib.stops == 2


def test_device_disconnected_while_reading_is_reported(kit, lib: Library, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    camera = RealSense(kit.profile.camera, kit.clock)

    def raise_disconnected(_: Pipeline) -> FrameSet:
        raise RuntimeError("Device disconnected")

    monkeypatch.setattr(Pipeline, "poll_for_frames", raise_disconnected)
    with pytest.raises(CameraError, match=r"D435I.*Device disconnected"):
        camera.read(False)


@pytest.mark.parametrize(("owner", "call"), [(Library, "align"), (Library, "pipeline"), (Config, "can_resolve")])
def test_device_disconnected_while_opening_is_reported(  # type: ignore[no-untyped-def]
    kit, lib: Library, monkeypatch: pytest.MonkeyPatch, owner: type, call: str
) -> None:
    def raise_disconnected(*_: object) -> None:
        raise RuntimeError("Device disconnected")

    monkeypatch.setattr(owner, call, raise_disconnected)
    with pytest.raises(CameraError, match="Device disconnected"):
        RealSense(colored(kit), kit.clock)


@pytest.mark.parametrize(
    ("depth", "rgb", "at_ms", "reason"),
    [
        (np.zeros((48, 64), np.uint8), None, 1.0, r"depth of uint16 \(48, 64\) expected, found uint8 \(48, 64\)"),
        (np.zeros((24, 32), np.uint16), None, 1.0, r"found uint16 \(24, 32\)"),
        (np.zeros((48, 64, 3), np.uint16), None, 1.0, r"found uint16 \(48, 64, 3\)"),
        (np.zeros((48, 64), np.uint16), np.zeros((48, 64), np.uint8), 1.0, r"colour of uint8 \(48, 64, 3\) expected"),
        (np.zeros((48, 64), np.uint16), None, float("nan"), "a finite time stamp expected, found nan"),
        (np.zeros((48, 64), np.uint16), None, float("inf"), "a finite time stamp expected, found inf"),
    ],
)
def test_garbage_of_the_device_is_refused(  # type: ignore[no-untyped-def]
    kit, lib: Library, depth: Any, rgb: Any, at_ms: float, reason: str
) -> None:
    camera = RealSense(colored(kit), kit.clock)
    lib.frames = [FrameSet(Picture(depth, 1, at_ms), None if rgb is None else Picture(rgb, 1))]
    with pytest.raises(CameraError, match=reason):
        camera.read(True)


@pytest.mark.parametrize("unit_m", [0.0, -0.001, float("nan")])
def test_invalid_depth_unit_is_refused(kit, lib: Library, unit_m: float) -> None:  # type: ignore[no-untyped-def]
    lib.depth_scale = unit_m
    with pytest.raises(CameraError, match="1000 units per metre expected"):
        RealSense(kit.profile.camera, kit.clock)
    assert lib.stops == 1


def test_garbage_of_the_imu_is_left_out(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    motion = lib.motion = MotionSensor()
    camera = RealSense(kit.profile.camera, kit.clock, imu=True)
    motion.send("accel", 0.0, -9.8, 0.0, 1000.0)
    motion.send("accel", float("nan"), -9.8, 0.0, 1001.0)
    motion.send("gyro", 0.1, float("inf"), 0.3, 1002.0)
    motion.send("gyro", 0.1, 0.2, 0.3, float("nan"))
    motion.send("gyro", 0.1, 0.2, 0.3, 1003.0)
    (reading,) = camera.read_imu()
    np.testing.assert_array_equal(reading.specific_force, [0.0, -9.8, 0.0])


def test_imu_gives_each_rate_with_the_newest_force(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    motion = lib.motion = MotionSensor()
    camera = RealSense(kit.profile.camera, kit.clock, imu=True)
    assert camera.description.endswith("USB 3.2, with IMU")
    assert motion.opened == [("gyro", 200), ("accel", 100)]
    assert not camera.read_imu()
    motion.send("gyro", 0.1, 0.2, 0.3, 1000.0)  # no force yet
    motion.send("accel", 0.0, -9.8, 0.0, 1001.0)
    motion.send("gyro", 0.1, 0.2, 0.3, 1005.0)
    (first,) = camera.read_imu()
    kit.clock.pass_s(0.007)
    motion.send("gyro", 0.4, 0.5, 0.6, 1010.0)
    motion.send("gyro", 0.4, 0.5, 0.6, 1200.0)  # the accelerometer has stopped
    (second,) = camera.read_imu()
    np.testing.assert_array_equal(first.gyro, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(second.specific_force, [0.0, -9.8, 0.0])
    assert second.stamp_ns - first.stamp_ns == 5_000_000
    assert second.stamp_ns <= kit.clock()
    camera.close()
    assert motion.acts == ["start", "stop", "close"]


def test_camera_without_imu_or_with_a_broken_one_still_gives_depth(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    broken = MotionSensor()
    broken.error = "hid device: Permission denied"
    half = MotionSensor(("gyro",))
    for lib.motion, words in ((None, "without IMU"), (broken, "without IMU.*Permission denied"), (half, "accel expected")):
        camera = RealSense(kit.profile.camera, kit.clock, imu=True)
        assert re.search(words, camera.description)
        lib.frames = [FrameSet(Picture(kit.ground(1), 1, 1.0))]
        assert camera.read(False) is not None
        assert not camera.read_imu()
        camera.close()
    lib.motion = MotionSensor()
    assert "IMU" not in RealSense(kit.profile.camera, kit.clock).description
    assert not lib.motion.acts, "the profile has no IMU"
