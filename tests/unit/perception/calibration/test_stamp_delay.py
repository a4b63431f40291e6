"""Laws of the delay of stamps: what changes of speed show, and what does not show it."""

from collections.abc import Callable

import numpy as np
import pytest

from sextant.services.perception.calibration.motion_calibration import SCALE, MotionCalibration, Registered
from sextant.services.perception.calibration.stamp_delay import StampDelay
from sextant.shared.geometry import Array, exp_so3, transform

DT_S = 1.0 / 15.0
PRIOR = np.diag([0.002, 0.002, 0.01, 0.01, 0.01, 0.002]) ** 2
SHARP = np.diag([1e-4, 1e-4, 1e-4, 3e-4, 3e-4, 3e-4]) ** 2  # covariance of a pose by images that show everything
HEADING = exp_so3([0.0, 0.0, 0.7])  # of the walk in {world}


def steps(t: float) -> float:
    """Return the way [m] of a robot that slows down at each step."""
    return 0.07 * t + 0.006 * np.sin(2.0 * np.pi * t / 1.2)


def speeding_up(t: float) -> float:
    return 0.02 * t + 0.01 * t**2


def evenly(t: float) -> float:
    return 0.07 * t


def frames(
    way: Callable[[float], float], delay_s: float, number: int = 150, covariance: Array = SHARP, noise_m: float = 0.0
) -> list[Registered]:
    """Return the frames of a walk whose images are stamped `delay_s` late; the registered poses are those of the images."""
    rng = np.random.default_rng(1)
    t = 1.0 + DT_S * np.arange(number)
    shown = np.array([way(at - delay_s) for at in t]) + rng.normal(scale=noise_m, size=number)
    made = []
    for k in range(1, number):
        moved = transform(np.eye(3), [way(t[k]) - way(t[k - 1]), 0.0, 0.0])
        T_prior = transform(HEADING, HEADING @ [shown[k - 1] + moved[0, 3], 0.0, 0.0])
        twist = np.concatenate([HEADING @ [shown[k] - shown[k - 1] - moved[0, 3], 0.0, 0.0], np.zeros(3)])
        made.append(Registered(T_prior, PRIOR, twist, covariance, moved, round(DT_S * 1e9)))
    return made


def found(of: list[Registered]) -> StampDelay:
    delay = StampDelay()
    for frame in of:
        delay.add(frame)
    return delay


@pytest.mark.parametrize("delay_s", [-0.05, -0.01, 0.0, 0.02, 0.05])
def test_changes_of_speed_show_the_delay(delay_s: float) -> None:
    delay = found(frames(steps, delay_s, noise_m=0.0003))
    assert delay.value == pytest.approx(delay_s, abs=0.005)
    assert delay.sigma < 0.013


def test_one_step_shows_the_delay_roughly() -> None:
    assert found(frames(steps, 0.05, number=30)).value == pytest.approx(0.05, abs=0.012)


def test_even_speed_shows_nothing() -> None:
    delay, fresh = found(frames(evenly, 0.05)), StampDelay()
    assert delay.value == pytest.approx(0.0, abs=1e-3)
    assert delay.sigma == pytest.approx(fresh.sigma, rel=0.01)


def test_motion_without_any_change_of_speed_is_left_out() -> None:
    moved = transform(np.eye(3), [2.0**-8, 0.0, 0.0])  # exact in floating point, as are the times
    delay = found([Registered(np.eye(4), PRIOR, np.zeros(6), SHARP, moved, 62_500_000)] * 60)
    assert np.isfinite(delay.value)
    assert delay.sigma == pytest.approx(StampDelay().sigma, rel=1e-6)


def test_robot_at_rest_teaches_nothing() -> None:
    assert found(frames(lambda t: 0.001 * np.sin(5.0 * t), 0.05)).sigma == StampDelay().sigma


def test_direction_that_images_do_not_show_teaches_nothing() -> None:
    """On a bare floor the pose follows the legs, whose stamps are right."""
    assert found(frames(steps, 0.0, covariance=PRIOR)).sigma == StampDelay().sigma


def test_stretch_in_which_the_body_lurches_counts_less() -> None:
    rough = frames(steps, 0.0, number=60, noise_m=0.004)
    smooth = frames(steps, 0.04, number=60, noise_m=0.0003)
    assert found(rough + smooth).value == pytest.approx(0.04, abs=0.01)


def test_interrupted_stretches_teach_nothing() -> None:
    delay = StampDelay()
    for number, frame in enumerate(frames(steps, 0.05)):
        if number % 20 == 0:
            delay.interrupt()
        delay.add(frame)
    assert delay.sigma == StampDelay().sigma


def test_known_delay_changes_no_other_number() -> None:
    """The way of a robot that speeds up looks too short if its images are stamped late."""
    exact, known, unknown = (MotionCalibration(np.array([0.12, 0.0, 0.08])) for _ in range(3))
    for frame in frames(speeding_up, 0.0):
        exact.add(frame, np.zeros(10))
    for frame in frames(speeding_up, 0.05):
        known.add(frame, np.zeros(10), 0.05)
        unknown.add(frame, np.zeros(10))
    assert unknown.values[SCALE] < -0.002
    assert abs(known.values[SCALE] - exact.values[SCALE]) < 0.1 * abs(unknown.values[SCALE])
