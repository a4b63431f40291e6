"""Posture control: standing feet press against sag, the others do not."""

import numpy as np
import pytest

from sextant.services.actuator.locomotion.params import PostureParams
from sextant.services.actuator.locomotion.posture_control import PostureControl
from sextant.shared.robot.profiles import load_profile

REST = load_profile("phantomx_mk2").rest_feet()
ALL = np.ones(6)
GAIN, DT = 6.0, 0.02
LOW, ROLLED, PITCHED = (0.005, 0.0, 0.0), (0.0, 0.005, 0.0), (0.0, 0.0, 0.005)  # [m, rad, rad] height, roll, pitch


@pytest.mark.parametrize("error", [LOW, ROLLED, PITCHED])
def test_feet_are_lowered_where_the_body_is_too_low(error: tuple[float, float, float]) -> None:
    control = PostureControl(PostureParams(gain=GAIN))
    control.update(DT, error, REST, ALL)
    down = REST[:, 2] - control.lowered(REST)[:, 2]
    height, roll, pitch = error
    low = height + roll * REST[:, 1] - pitch * REST[:, 0]
    np.testing.assert_allclose(down, GAIN * DT * low, atol=1e-12)


def test_offsets_are_bounded() -> None:
    control = PostureControl(PostureParams(gain=GAIN))
    for _ in range(1000):
        control.update(DT, LOW, REST, ALL)
    assert np.ptp(control.lowered(REST)[:, 2]) == 0.0
    assert 0.02 < (REST - control.lowered(REST))[0, 2] < 0.03


def test_the_offset_of_an_unloaded_foot_decays_and_that_of_a_loaded_one_stays() -> None:
    control, share = PostureControl(PostureParams(gain=GAIN)), ALL.copy()
    for _ in range(50):
        control.update(DT, LOW, REST, ALL)
    before = (REST - control.lowered(REST))[:, 2]
    share[0] = 0.0
    for _ in range(30):
        control.update(DT, (0.0, 0.0, 0.0), REST, share)
    after = (REST - control.lowered(REST))[:, 2]
    assert after[0] < 0.01 * before[0]
    np.testing.assert_array_equal(after[1:], before[1:])


def test_reset_discards_the_offset_of_some_legs() -> None:
    control = PostureControl(PostureParams(gain=GAIN))
    control.update(DT, LOW, REST, ALL)
    control.reset(np.arange(6) == 2)
    down = (REST - control.lowered(REST))[:, 2]
    assert down[2] == 0.0
    assert (down[[0, 1, 3, 4, 5]] > 0.0).all()
