"""Camera service: its messages and state; it never waits for the device."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from sextant.services.perception.cameras.camera import Camera, CameraError, Frame
from sextant.services.perception.cameras.config import Settings
from sextant.services.perception.cameras.devices import find, open_camera
from sextant.services.perception.cameras.service import CameraService
from sextant.services.perception.imu.reading import ImuReading
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import topics
from sextant.shared.wire.messages import CameraState, ColorImage, DepthImage, Imu, Message, Tick


class Device(Camera):
    """A camera with one picture per period, until it is unplugged."""

    description = "test camera"
    recorded = False

    def __init__(self, kit, rgb=None) -> None:  # type: ignore[no-untyped-def]
        self.kit, self.rgb, self.plugged, self.due_ns, self.asked = kit, rgb, True, 0, []  # type: ignore[var-annotated]

    def open(self) -> "Device":
        if not self.plugged:
            raise CameraError("no device found", "plug it in")
        return self

    def read(self, color: bool) -> Frame | None:
        self.asked.append(color)
        if not self.plugged:
            raise CameraError("the device is gone", "plug it in")
        if self.kit.clock() < self.due_ns:
            return None
        self.due_ns = self.kit.clock() + 33_000_000
        return Frame(self.kit.clock(), self.kit.ground(self.kit.clock() % 1000), self.rgb if color else None)

    def close(self) -> None:
        pass


def run(service: CameraService, kit, seconds: float, wanted: bool = False) -> list[Message]:  # type: ignore[no-untyped-def]
    inbox = Inbox((), service.stages, wanted=lambda topic: wanted or topic is not topics.COLOR)
    made: list[Message] = []
    for _ in range(round(seconds * 1e9 / service.trigger.period_ns)):
        kit.clock.now_ns += service.trigger.period_ns
        inbox.now_ns = kit.clock()
        made += service.step(Tick(kit.clock()), inbox)
    return made


def of(made: list[Message], kind: type[Message]) -> list:  # type: ignore[type-arg]
    return [message for message in made if isinstance(message, kind)]


def test_depth_is_published_at_device_rate_and_state_at_4_hz(kit) -> None:  # type: ignore[no-untyped-def]
    service = CameraService(kit.profile, Settings(), Device(kit).open, kit.clock)
    made = run(service, kit, 3.0)
    assert len(of(made, DepthImage)) == pytest.approx(90, abs=20)
    assert not of(made, ColorImage)
    states = of(made, CameraState)
    assert 10 <= len(states) <= 14
    assert states[-1].ok
    assert states[-1].device == "test camera"
    assert service.status().startswith("test camera, ")


def test_color_is_read_only_with_subscribers_and_has_depth_stamp(kit) -> None:  # type: ignore[no-untyped-def]
    device = Device(kit, np.zeros((48, 64, 3), np.uint8))
    service = CameraService(kit.profile, Settings(color_rate_hz=5.0), device.open, kit.clock)
    assert not of(run(service, kit, 1.0), ColorImage)
    assert not any(device.asked)
    made = run(service, kit, 2.0, wanted=True)
    colors, depths = of(made, ColorImage), of(made, DepthImage)
    assert 8 <= len(colors) <= 11
    assert {c.stamp_ns for c in colors} <= {d.stamp_ns for d in depths}


@pytest.mark.parametrize(("color", "sends", "expected"), [(True, True, 90), (True, False, 0), (False, True, 0)])
def test_a_camera_with_colour_sends_grey_images_with_depth(kit, color: bool, sends: bool, expected: int) -> None:  # type: ignore[no-untyped-def]
    profile = replace(kit.profile, camera=replace(kit.profile.camera, color=color))
    lens = profile.camera.intrinsics
    device = Device(kit, np.full((lens.height, lens.width, 3), 90, np.uint8))
    made = run(CameraService(profile, Settings(gray=sends), device.open, kit.clock), kit, 3.0)
    grays = [image.gray for image in of(made, DepthImage) if image.gray.size]
    assert len(grays) == pytest.approx(expected, abs=20 if expected else 0)
    assert all((gray == 90).all() for gray in grays)
    assert not of(made, ColorImage), "without a subscriber"


def test_unplugged_device_is_reported_immediately_and_reopened(kit) -> None:  # type: ignore[no-untyped-def]
    device = Device(kit)
    service = CameraService(kit.profile, Settings(), device.open, kit.clock)
    run(service, kit, 1.0)
    device.plugged = False
    made = run(service, kit, 0.1)
    assert not of(made, DepthImage)
    assert of(made, CameraState)[0].reason == "the device is gone; plug it in"
    made = run(service, kit, 5.0)
    assert not of(made, DepthImage)
    assert not any(state.ok for state in of(made, CameraState))
    assert of(made, CameraState)[-1].reason == "no device found; plug it in"
    assert "no images: no device found" in service.status()
    device.plugged = True
    made = run(service, kit, 5.0)
    assert of(made, DepthImage)
    assert of(made, CameraState)[-1].ok


def test_missing_camera_or_invalid_folder_is_reported(kit, tmp_path) -> None:  # type: ignore[no-untyped-def]
    for device, words in (("none", "names no camera"), (str(tmp_path), "camera.toml: no such file")):
        service = CameraService(kit.profile, Settings(device=device), None, kit.clock)
        (state,) = of(run(service, kit, 0.05), CameraState)
        assert words in state.reason
    with pytest.raises(CameraError, match="names no camera"):
        open_camera("none", kit.profile, Settings(), kit.clock)
    with pytest.raises(CameraError, match=r"camera\.toml: no such file"):
        find(str(tmp_path), kit.profile)


def test_hanging_driver_does_not_block_service_and_is_reported(kit) -> None:  # type: ignore[no-untyped-def]
    called, release = threading.Event(), threading.Event()

    def hang() -> Device:
        called.set()
        release.wait(10.0)
        raise CameraError("it woke up", "begin again")

    with CameraService(kit.profile, Settings(), hang, kit.clock) as service:
        assert called.wait(5.0)
        made = run(service, kit, 7.0)  # simulated time; the driver has not returned
        with pytest.raises(RuntimeError, match="this process ends, so that a new process can open the camera"):
            run(service, kit, 20.0)
        release.set()
    assert "has not answered for" in of(made, CameraState)[-1].reason


def test_reader_thread_error_is_raised_in_service_step(kit) -> None:  # type: ignore[no-untyped-def]
    read = threading.Event()

    class Broken(Device):
        def read(self, color: bool) -> Frame | None:
            read.set()
            raise AssertionError("a bug")

    with CameraService(kit.profile, Settings(), Broken(kit).open, kit.clock) as service:
        assert read.wait(5.0)
    with pytest.raises(AssertionError, match="a bug"):  # the thread has ended, because the service was entered and left
        run(service, kit, 0.1)


class DeviceWithImu(Device):
    """Its IMU reads 200 times a second, in the optical frame: x right, y down, z forward."""

    force = (0.0, -9.81, 0.0)
    read_ns = 0

    def read_imu(self) -> list[ImuReading]:
        since, self.read_ns = self.read_ns or self.kit.clock() - 5_000_000, self.kit.clock()
        stamps = range(since - since % 5_000_000 + 5_000_000, self.read_ns + 1, 5_000_000)
        rng = np.random.default_rng(since)
        return [ImuReading(at, rng.normal([0.0, -0.2, 0.0], 1e-3), np.array(self.force)) for at in stamps]


def test_imu_of_the_camera_is_published_in_the_body_frame(kit) -> None:  # type: ignore[no-untyped-def]
    device = DeviceWithImu(kit)
    service = CameraService(kit.profile, Settings(), device.open, kit.clock)
    found = of(run(service, kit, 2.0), Imu)
    assert len(found) == pytest.approx(200, abs=4)
    pitch = np.radians(kit.profile.camera.pitch_down_deg)
    np.testing.assert_allclose(found[-1].specific_force, 9.81 * np.array([np.sin(pitch), 0.0, np.cos(pitch)]), atol=1e-6)
    turning_left = np.mean([m.gyro for m in found], axis=0)  # about the image's y axis, which points down
    np.testing.assert_allclose(turning_left, 0.2 * np.array([np.sin(pitch), 0.0, np.cos(pitch)]), atol=1e-3)
    assert "IMU messages" in service.status()
    device.force = (np.nan, 0.0, 0.0)
    assert not of(run(service, kit, 0.5), Imu)
    assert "garbage" in service.status()
    device.force = (0.0, -9.81, 0.0)
    assert of(run(service, kit, 0.5), Imu)
    assert "garbage" not in service.status()


@pytest.mark.parametrize("wrong", [{"color_rate_hz": 0.0}, {"delay_s": -0.1}, {"delay_s": 2.0}])
def test_invalid_settings_are_refused(wrong) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match="expected, found"):
        Settings(**wrong)
