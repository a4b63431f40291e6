"""Image quality: faulty pictures are named, and good ones pass."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sextant.services.perception.cameras.image_quality import ImageQualityCheck, is_noise, measured_share

PERIOD = 33_000_000


def look(kit, pictures) -> list[str]:  # type: ignore[no-untyped-def]
    watch = ImageQualityCheck(kit.profile.camera.sensor, (48, 64))
    return [watch.check(picture, PERIOD * k) for k, picture in enumerate(pictures)]


def first_complaint_s(words: list[str]) -> float:
    """Return the time [s] of the first complaint."""
    return next(k for k, said in enumerate(words) if said) * PERIOD * 1e-9


def test_good_images_raise_no_complaint(kit) -> None:  # type: ignore[no-untyped-def]
    assert not any(look(kit, (kit.ground(k) for k in range(100))))


@pytest.mark.parametrize("value", [0, 400, 65535])  # no return, nearer than the range, and the value that NaN becomes
def test_camera_without_measurements_is_reported_after_2_s(kit, value: int) -> None:  # type: ignore[no-untyped-def]
    words = look(kit, [kit.ground(0)] + [np.full((48, 64), value, np.uint16)] * 100)
    assert 1.9 < first_complaint_s(words) < 2.2
    assert "measured nothing" in words[-1]


def test_image_with_85_percent_missing_rows_is_reported_after_2_s(kit) -> None:  # type: ignore[no-untyped-def]
    def torn(k: int):  # type: ignore[no-untyped-def]
        picture = kit.ground(k)
        picture[: 48 * 85 // 100] = 0
        return picture

    words = look(kit, map(torn, range(100)))
    assert 1.9 < first_complaint_s(words) < 2.2
    assert "only" in words[-1]


@pytest.mark.parametrize(("lost", "named"), [(0.60, False), (0.80, True), (0.85, True)])
def test_random_pixel_loss_is_reported_by_its_mean(kit, lost: float, named: bool) -> None:  # type: ignore[no-untyped-def]
    def torn(k: int):  # type: ignore[no-untyped-def]
        return np.where(np.random.default_rng(k).random((48, 64)) < lost, 0, kit.ground(k)).astype(np.uint16)

    assert bool(look(kit, map(torn, range(200)))[-1]) == named


def test_short_dark_period_is_not_reported(kit) -> None:  # type: ignore[no-untyped-def]
    dark = np.zeros((48, 64), np.uint16)
    pictures = [dark if k % 30 < 25 else kit.ground(k) for k in range(150)]
    assert not any(look(kit, pictures))


def test_frozen_image_is_reported_until_it_changes(kit) -> None:  # type: ignore[no-untyped-def]
    words = look(kit, [kit.ground(0)] * 60 + [kit.ground(1)])
    assert 0.9 < first_complaint_s(words) < 1.1
    assert "frozen" in words[-2]
    assert words[-1] == ""


def test_noise_image_is_reported_immediately(kit) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(0)
    (said,) = look(kit, [rng.integers(0, 3500, (48, 64)).astype(np.uint16)])
    assert "noise" in said


def test_wrong_image_size_is_reported_with_expected_size(kit) -> None:  # type: ignore[no-untyped-def]
    (said,) = look(kit, [np.zeros((24, 32), np.uint16)])
    assert "48x64 uint16 expected" in said
    assert "24x32" in said


@given(arrays(np.uint16, st.tuples(st.integers(1, 40), st.integers(1, 40))))
def test_quality_measures_accept_any_pixels(depth) -> None:  # type: ignore[no-untyped-def]
    from sextant.shared.robot.camera import DepthSensor

    assert 0.0 <= measured_share(depth, DepthSensor()) <= 1.0
    is_noise(depth)
