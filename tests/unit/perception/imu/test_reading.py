"""Readings of inertial sensors: mean, frame, and refusal of garbage and frozen sensors."""

import numpy as np
import pytest

from sextant.services.perception.imu.reading import BodyImu, ImuReading
from sextant.shared.geometry import rotation_z

MS = 1_000_000
UP = np.array([0.0, 0.0, 9.81])


def noisy(count: int, every_ms: float, start_ms: float = 0.0) -> list[ImuReading]:
    rng = np.random.default_rng(0)
    stamps = [round((start_ms + every_ms * k) * MS) for k in range(1, count + 1)]
    return [ImuReading(at, rng.normal(0, 1e-3, 3), UP + rng.normal(0, 1e-2, 3)) for at in stamps]


@pytest.mark.parametrize(("rate_hz", "expected"), [(100, 100), (200, 100), (400, 100), (60, 60)])
def test_messages_average_readings_to_about_100_hz(rate_hz: int, expected: int) -> None:
    readings = noisy(rate_hz, 1000.0 / rate_hz)
    found = list(BodyImu(np.eye(3)).update(readings))
    assert len(found) == pytest.approx(expected, abs=1)
    step = 1_000 / rate_hz
    turned = sum(m.gyro * (m.stamp_ns - before) for m, before in zip(found[1:], [m.stamp_ns for m in found], strict=False))
    rates = sum(r.gyro for r in readings if found[0].stamp_ns < r.stamp_ns <= found[-1].stamp_ns)
    np.testing.assert_allclose(turned * 1e-9, rates * step * 1e-3, atol=1e-12)


def test_readings_are_turned_into_the_body_frame() -> None:
    reading = ImuReading(1, np.array([1.0, 0.0, 0.0]), np.array([0.0, 2.0, 9.0]))
    (found,) = BodyImu(rotation_z(np.pi / 2)).update([reading])
    np.testing.assert_allclose(found.gyro, [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(found.specific_force, [-2.0, 0.0, 9.0], atol=1e-12)


def test_late_readings_are_left_out() -> None:
    imu = BodyImu(np.eye(3))
    first, second = noisy(2, 10.0)
    assert [m.stamp_ns for m in imu.update([second, first, second])] == [second.stamp_ns]


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e6])
@pytest.mark.parametrize("axis", range(6))
def test_garbage_is_refused_until_readings_are_plausible_again(value: float, axis: int) -> None:
    imu = BodyImu(np.eye(3))
    both = np.concatenate([np.zeros(3), UP])
    both[axis] = value
    assert not list(imu.update([ImuReading(10 * MS, both[:3], both[3:])]))
    assert "at most 40 rad/s and 160 m/s^2 expected, found (" in imu.problem
    assert list(imu.update([ImuReading(20 * MS, np.zeros(3), UP)]))
    assert not imu.problem


def test_frozen_sensor_is_refused_after_a_second() -> None:
    imu = BodyImu(np.eye(3))
    same = [ImuReading(10 * MS * k, np.full(3, 0.01), UP) for k in range(1, 300)]
    assert len(list(imu.update(same))) == pytest.approx(100, abs=2)
    assert "frozen" in imu.problem
    assert list(imu.update(noisy(2, 10.0, 3000.0)))
    assert not imu.problem
