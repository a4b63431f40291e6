"""Laws of the correction of horns: slow, bounded, only while feet rise, and nothing without an estimate."""

import numpy as np
import pytest

from sextant.services.actuator.estimation.horn_correction import HornCorrection
from sextant.services.actuator.estimation.stance_fit import JointOffsets, Stance

ALL, NONE = np.ones(6, dtype=np.bool_), np.zeros(6, dtype=np.bool_)
DT = 0.02  # [s] of a cycle
OFF = np.radians(np.random.default_rng(0).uniform(-10.0, 10.0, 18))


def test_correction_reaches_the_estimate_slowly_and_at_most_4_deg() -> None:
    horns, before = HornCorrection(), np.zeros((6, 3))
    for _ in range(round(5.0 / DT)):
        horns.follow(OFF, ALL, DT)
        assert np.abs(horns.offsets - before).max() <= np.radians(1.0) * DT + 1e-12
        before = horns.offsets
    np.testing.assert_allclose(before, np.clip(OFF, -np.radians(4.0), np.radians(4.0)).reshape(6, 3))
    assert not horns.follow(OFF, ALL, DT), "it is there"
    for _ in range(round(5.0 / DT)):
        horns.follow(np.zeros(18), ALL, DT)
    np.testing.assert_allclose(horns.offsets, 0.0, atol=1e-12)


def test_only_legs_whose_feet_rise_are_corrected() -> None:
    horns, rising = HornCorrection(), np.array([True, False, True, False, False, False])
    assert horns.follow(OFF, rising, DT)
    assert (horns.offsets[rising] != 0.0).all()
    assert (horns.offsets[~rising] == 0.0).all()
    assert not horns.follow(OFF, NONE, DT)


def test_correction_stays_while_the_estimate_is_in_doubt_and_is_zero_without_error_or_if_switched_off() -> None:
    horns = HornCorrection()
    assert not horns.follow(np.zeros(18), ALL, DT)
    horns.follow(OFF, ALL, DT)
    before = horns.offsets.copy()
    assert not horns.follow(None, ALL, DT)
    np.testing.assert_array_equal(horns.offsets, before)
    off = HornCorrection(corrects=False)
    assert not off.follow(OFF, ALL, DT)
    assert (off.offsets == 0.0).all()


def test_message_follows_each_stance_and_holds_what_to_add_to_the_horn_offsets() -> None:
    horns, found = HornCorrection(), JointOffsets()
    assert horns.news(1, found) is None
    constant = np.zeros((3, 18))
    constant[:, 4] = 0.1
    found.learn(Stance((0, 2, 4), np.full(3, -0.01), constant, constant))  # as if this link were ahead of its encoder
    horns.follow(found.mean, ALL, DT)
    message = horns.news(2, found)
    assert message is not None
    assert message.stamp_ns == 2
    assert message.estimate[1, 1] == pytest.approx(-found.mean[4])
    assert found.mean[4] > 0.0
    assert message.corrected[1, 1] == pytest.approx(-np.radians(1.0) * DT)
    assert 0.0 < message.sigma[1, 1] < message.sigma[0, 0]
    assert horns.news(3, found) is None
