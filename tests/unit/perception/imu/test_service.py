"""IMU service: its messages in the body frame, and what it reports of an absent, unplugged, broken or frozen sensor."""

import threading
from dataclasses import dataclass, replace

import numpy as np
import pytest

from sextant.services.perception.imu.config import Settings
from sextant.services.perception.imu.reading import ImuError
from sextant.services.perception.imu.service import ImuService
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import Imu as ImuProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire.messages import Imu, Tick

S = 1_000_000_000
PROFILE = replace(load_profile("phantomx_mk2"), imu=ImuProfile("bno055", yaw_deg=90.0))


@dataclass
class Clock:
    now_ns: int = S

    def __call__(self) -> int:
        return self.now_ns


class Sensor:
    """A sensor that turns about its x axis, until it is unplugged or broken."""

    description = "test sensor"

    def __init__(self) -> None:
        self.plugged, self.frozen, self.fails, self.closed, self.openings = True, False, 0, 0, 0
        self.scale = 1.0
        self.rng = np.random.default_rng(0)
        self.last: tuple[Array, Array] = (np.zeros(3), np.zeros(3))

    def open(self) -> "Sensor":
        self.openings += 1
        if not self.plugged:
            raise ImuError("No I2C device at address: 0x28", "check cable and supply")
        return self

    def read(self) -> tuple[Array, Array]:
        if not self.plugged or self.fails > 0:
            self.fails -= 1
            raise ImuError("Remote I/O error", "check its cable and supply")
        if not self.frozen:
            self.last = self.rng.normal([0.5, 0.0, 0.0], 1e-3), self.scale * self.rng.normal([0.0, 0.0, 9.81], 1e-3)
        return self.last

    def close(self) -> None:
        self.closed += 1


class Rig:
    def __init__(self) -> None:
        self.clock, self.sensor = Clock(), Sensor()
        self.service = ImuService(PROFILE, Settings(), self.sensor.open, self.clock)

    def run(self, seconds: float) -> list[Imu]:
        inbox = Inbox((), self.service.stages)
        made: list[Imu] = []
        for _ in range(round(seconds * 100)):
            self.clock.now_ns += S // 100
            made += self.service.step(Tick(self.clock()), inbox)  # type: ignore[arg-type]
        return made


def test_readings_are_published_in_the_body_frame() -> None:
    rig = Rig()
    found = rig.run(2.0)
    assert len(found) == pytest.approx(200, abs=5)
    np.testing.assert_allclose(np.mean([m.gyro for m in found], axis=0), [0.0, 0.5, 0.0], atol=1e-3)
    np.testing.assert_allclose(found[-1].specific_force, [0.0, 0.0, 9.81], atol=0.01)
    assert rig.service.status().startswith("bno055 on /dev/i2c-1, ")


def test_absent_sensor_is_reported_and_found_once_it_is_plugged_in() -> None:
    rig = Rig()
    rig.sensor.plugged = False
    assert not rig.run(30.0)
    assert rig.service.status() == "no readings: No I2C device at address: 0x28; check cable and supply; opened 5 times so far"
    rig.sensor.plugged = True
    assert rig.run(16.0)
    assert "IMU messages" in rig.service.status()


def test_unplugged_sensor_is_closed_reported_and_opened_again() -> None:
    rig = Rig()
    rig.run(1.0)
    rig.sensor.plugged = False
    assert not rig.run(2.0)
    assert "no readings: " in rig.service.status()
    assert rig.sensor.closed == 1
    rig.sensor.plugged = True
    assert rig.run(4.0)
    assert "no readings" not in rig.service.status()


def test_single_failures_of_the_bus_are_bridged() -> None:
    rig = Rig()
    rig.run(1.0)
    rig.sensor.fails = 20
    assert len(rig.run(1.0)) == pytest.approx(80, abs=3)
    assert rig.sensor.openings == 1


@pytest.mark.parametrize("scale", [np.nan, 1e3])
def test_garbage_is_not_published_but_reported(scale: float) -> None:
    rig = Rig()
    rig.run(1.0)
    rig.sensor.scale = scale
    assert not rig.run(1.0)
    assert "the IMU sends garbage" in rig.service.status()
    rig.sensor.scale = 1.0
    assert rig.run(1.0)
    assert "no readings" not in rig.service.status()


def test_frozen_sensor_is_not_published_but_reported() -> None:
    rig = Rig()
    rig.run(1.0)
    rig.sensor.frozen = True
    assert len(rig.run(3.0)) < 110
    assert "the IMU is frozen" in rig.service.status()


def test_profile_without_such_an_imu_is_refused() -> None:
    profile = load_profile("phantomx_mk2")
    with pytest.raises(ValueError, match=r"bno055 or bno085 expected in the profile phantomx_mk2, found 'camera'"):
        ImuService(profile, Settings(), None, lambda: 0)


def test_service_never_waits_for_a_library_that_hangs() -> None:
    rig, release, called = Rig(), threading.Event(), threading.Event()

    def hang() -> tuple[Array, Array]:
        called.set()
        release.wait(10.0)
        raise ImuError("unplugged", "plug it in")

    rig.sensor.read = hang  # type: ignore[method-assign]
    with rig.service:
        assert called.wait(5.0)
        rig.run(31.0)  # simulated time; the library has not returned
        assert "has not answered for 31 s" in rig.service.status()
        release.set()


def test_error_in_the_thread_ends_the_process() -> None:
    rig, read = Rig(), threading.Event()

    def bug() -> tuple[Array, Array]:
        read.set()
        raise AssertionError("a bug")

    rig.sensor.read = bug  # type: ignore[method-assign]
    with rig.service:
        assert read.wait(5.0)
    with pytest.raises(AssertionError, match="a bug"):
        rig.run(0.1)
