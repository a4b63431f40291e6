"""Leg recovery: which legs hang, and when they may return to their footholds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.actuator.locomotion.joint_rate_limits import FETCHED, GENTLE
from sextant.services.actuator.locomotion.leg_recovery import LegRecovery

NONE = np.zeros(6, dtype=np.bool_)
ONE = np.array([True, False, False])
FREE = np.zeros((6, 3), dtype=np.bool_)
SETS = st.sets(st.integers(0, 5)).map(lambda legs: np.isin(np.arange(6), list(legs)))


def legs(*which: int) -> NDArray[np.bool_]:
    return np.isin(np.arange(6), which)


def joints(*which: int) -> NDArray[np.bool_]:
    """Flag one joint, the femur, of each given leg."""
    return legs(*which)[:, None] & [False, True, False]


def test_leg_without_torque_is_put_back_gently_after_torque_returns() -> None:
    recovery = LegRecovery()
    assert not recovery.update(joints(2), joints(2), NONE).any()
    assert not recovery.dangling.any(), "it stood"
    assert not recovery.update(FREE, joints(2), NONE).any(), "it is not yet where it was sent"
    np.testing.assert_array_equal(recovery.update(FREE, FREE, NONE), legs(2))
    np.testing.assert_array_equal(recovery.unrecovered, legs(2))
    np.testing.assert_array_equal(recovery.waiting, joints(2))
    assert recovery.start() == GENTLE
    assert not recovery.unrecovered.any()
    assert not recovery.update(FREE, FREE, legs(2)).any()
    np.testing.assert_array_equal(recovery.waiting, joints(2), "it is on its way")
    recovery.update(FREE, FREE, NONE)
    assert not recovery.waiting.any()


def test_silent_swing_leg_counts_as_hanging_and_returns_faster() -> None:
    recovery = LegRecovery()
    assert not recovery.update(FREE, joints(1, 4), legs(0, 2, 4)).any()
    np.testing.assert_array_equal(recovery.unrecovered, legs(4))
    np.testing.assert_array_equal(recovery.dangling, legs(4))
    recovery.update(FREE, joints(1, 4), NONE)
    np.testing.assert_array_equal(recovery.dangling, legs(4))
    np.testing.assert_array_equal(recovery.update(FREE, joints(1), NONE), legs(4))
    assert recovery.start() == FETCHED


def test_leg_without_torque_waits_while_another_is_put_back() -> None:
    recovery = LegRecovery()
    recovery.update(joints(0, 3), joints(0, 3), legs(0, 2, 4))
    np.testing.assert_array_equal(recovery.update(joints(3), joints(3), NONE), legs(0))
    assert recovery.start() == GENTLE
    np.testing.assert_array_equal(recovery.unrecovered, legs(3))
    assert not recovery.dangling.any()
    np.testing.assert_array_equal(recovery.update(FREE, FREE, NONE), legs(3))
    assert recovery.start() == GENTLE


def test_leg_without_torque_is_not_reported_as_waiting() -> None:
    recovery = LegRecovery()
    recovery.update(joints(3), joints(0, 3), legs(0, 2, 4))
    np.testing.assert_array_equal(recovery.update(joints(3), joints(3), NONE), legs(0))
    np.testing.assert_array_equal(recovery.waiting, joints(0), "of 3 no joint pulls")
    assert recovery.start() == FETCHED
    recovery.update(joints(3), joints(3, 5), legs(0, 5))
    np.testing.assert_array_equal(recovery.waiting, joints(0), "5 is hung by now, and not on its way")
    recovery.update(joints(3), joints(3), legs(0, 5))
    np.testing.assert_array_equal(recovery.waiting, joints(0, 5))


@pytest.mark.slow
@given(st.lists(st.tuples(SETS, SETS, SETS, st.booleans()), max_size=20))
def test_random_recovery_returns_only_torqued_legs_and_forgets_none(
    story: list[tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_], bool]],
) -> None:
    recovery, owed = LegRecovery(), NONE.copy()
    for torque_disabled, silent, flying, may in story:
        back = recovery.update(torque_disabled[:, None] & ONE, (torque_disabled | silent)[:, None] & ONE, flying)
        owed |= torque_disabled
        assert not (back & torque_disabled).any()
        assert not (recovery.dangling & ~recovery.unrecovered).any()
        assert not (owed & ~recovery.unrecovered).any()
        if may and back.any():
            recovery.start()
            owed &= ~back
            assert not (recovery.unrecovered & back).any()
