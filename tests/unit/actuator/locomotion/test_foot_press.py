"""A press of feet: how deep, what is kept of it, and how the rest is taken back."""

import numpy as np
import pytest

from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.services.actuator.locomotion.foot_press import PRESS_M, FootPress

DT = 0.02
FEET = np.zeros((6, 3))
LEGS = np.array([True, False, True, False, False, False])
NONE = np.zeros(6, dtype=np.bool_)


def felt(*touching: int) -> FootContact:
    touches = NONE.copy()
    touches[list(touching)] = True
    return FootContact(touches, NONE, FEET)


def test_feet_press_slowly_until_they_touch_and_keep_what_is_more_than_the_delay() -> None:
    press = FootPress()
    press.begin(LEGS)
    depths = []
    for _ in range(5):
        found, lower = press.update(DT, felt())
        assert not found.any()
        assert not lower.any()
        depths.append(-press.lowered(FEET, DT)[:, 2])
    np.testing.assert_allclose(np.diff(depths, axis=0)[:, LEGS], 0.04 * DT)
    assert not np.array(depths)[:, ~LEGS].any()
    found, lower = press.update(DT, felt(0))
    np.testing.assert_array_equal(np.flatnonzero(found), [0])
    assert lower[0] == pytest.approx(depths[-1][0] - 0.0025)
    assert not lower[1:].any()
    np.testing.assert_array_equal(np.flatnonzero(press.legs), [2])
    before = -press.lowered(FEET, DT)[0, 2]
    for _ in range(8):
        after = -press.lowered(FEET, DT)[0, 2]
        assert before - 0.04 * DT - 1e-9 <= after <= before
        before = after
    assert after == 0.0


def test_press_in_vain_hands_its_depth_to_the_search() -> None:
    press = FootPress()
    press.begin(LEGS)
    cycles = 0
    while not press.is_in_vain:
        press.update(DT, felt())
        cycles += 1
    assert cycles * DT * 0.04 == pytest.approx(PRESS_M, abs=0.001)
    np.testing.assert_allclose(press.hand_over(press.legs)[LEGS], PRESS_M, atol=0.001)
    assert not press.legs.any()
    np.testing.assert_array_equal(press.lowered(FEET, DT), FEET)


def test_stopped_press_is_taken_back_and_other_feet_are_never_moved() -> None:
    press = FootPress()
    np.testing.assert_array_equal(press.lowered(FEET, DT), FEET)
    press.begin(LEGS)
    for _ in range(4):
        press.update(DT, felt())
    press.stop()
    assert press.lowered(FEET, DT)[0, 2] < 0.0
    for _ in range(10):
        lowered = press.lowered(FEET, DT)
    np.testing.assert_array_equal(lowered, FEET)
    assert not press.is_in_vain
