"""Laws of the fit of success over difficulty."""

import numpy as np
import pytest

from sextant.evaluation.trials.logistic_fit import fit_success

X = np.array([0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08])


def _fit(good, n=50, x=X, at=X):
    return fit_success(x, np.array(good), np.full(len(x), n), at)


def test_place_and_scale_of_drawn_successes_are_found():
    rng = np.random.default_rng(1)
    inside, centres = 0, []
    for _ in range(100):
        rate = 1.0 / (1.0 + np.exp((X - 0.047) / 0.004))
        middle, low, high = _fit(rng.binomial(50, rate)).half
        inside += low <= 0.047 <= high
        centres.append(middle)
    assert inside >= 90, "a 95 % interval"
    assert np.mean(centres) == pytest.approx(0.047, abs=3e-4)


def test_interval_of_a_jump_lies_between_its_points():
    middle, low, high = _fit([4, 4, 4, 0, 0, 0, 0], n=4).half
    assert 0.038 < low < middle < high < 0.052


def test_more_trials_narrow_the_interval():
    widths = [np.ptp(_fit([n, n, n * 3 // 4, n // 4, 0, 0, 0], n).half[1:]) for n in (4, 20, 100)]
    assert widths[0] > widths[1] > widths[2]


@pytest.mark.parametrize("good", [4, 0])
def test_half_success_beyond_the_points_is_said_to_be_there(good):
    middle, low, high = _fit([good] * 7, n=4).half
    assert low > X[-1] if good else high < X[0]
    assert low < middle < high


def test_order_and_unit_of_the_difficulty_do_not_matter():
    forward = _fit([50, 48, 40, 20, 5, 1, 0])
    falling = _fit([50, 48, 40, 20, 5, 1, 0], x=-X, at=-X)
    scaled = _fit([50, 48, 40, 20, 5, 1, 0], x=1000 * X, at=1000 * X)
    np.testing.assert_allclose([-value for value in falling.half], [forward.half[0], forward.half[2], forward.half[1]])
    np.testing.assert_allclose(scaled.half, [1000 * value for value in forward.half])
    np.testing.assert_allclose(falling.rate, forward.rate)


def test_band_contains_the_rate_and_falls_with_the_difficulty():
    fit = _fit([50, 48, 40, 20, 5, 1, 0])
    assert np.all((fit.low <= fit.rate) & (fit.rate <= fit.high))
    assert np.all(np.diff(fit.rate) < 0)
