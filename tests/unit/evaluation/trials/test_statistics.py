import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.evaluation.trials.statistics import difference, wilson

TRIALS = st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))


@given(TRIALS)
def test_wilson_interval_contains_rate_and_solves_score_equation(trials):
    successes, n = trials
    r = wilson(successes, n)
    assert 0.0 <= r.low <= r.rate <= r.high <= 1.0
    for bound in (r.low, r.high):
        # At Wilson's bounds the observed rate is 1.96 standard errors away.
        if 1e-9 < bound < 1 - 1e-9:
            assert abs(r.rate - bound) == pytest.approx(1.959963984540054 * math.sqrt(bound * (1 - bound) / n), rel=1e-6)


@given(TRIALS)
def test_wilson_interval_is_symmetric_in_failures_and_successes(trials):
    successes, n = trials
    a, b = wilson(successes, n), wilson(n - successes, n)
    assert (a.low, a.high) == (pytest.approx(1 - b.high, abs=1e-12), pytest.approx(1 - b.low, abs=1e-12))


@given(TRIALS, TRIALS)
def test_difference_is_in_its_interval_and_antisymmetric(a, b):
    ab, ba = difference(wilson(*a), wilson(*b)), difference(wilson(*b), wilson(*a))
    assert -1.0 - 1e-12 <= ab.low <= ab.difference + 1e-12 <= ab.high + 2e-12
    assert (ab.low, ab.high) == (pytest.approx(-ba.high, abs=1e-12), pytest.approx(-ba.low, abs=1e-12))
    assert ab.disjoint == ba.disjoint
    if ab.disjoint:
        assert ab.low > 0 or ab.high < 0


def test_intervals_match_published_values():
    # Newcombe 1998, Statistics in Medicine 17, 857-872 (81 of 263) and 873-890 (56 of 70 against 48 of 80).
    r = wilson(81, 263)
    assert (round(r.low, 4), round(r.high, 4)) == (0.2553, 0.3662)
    d = difference(wilson(56, 70), wilson(48, 80))
    assert (round(d.low, 4), round(d.high, 4)) == (0.0524, 0.3339)


def test_invalid_counts_are_refused():
    with pytest.raises(ValueError, match="5 of 4"):
        wilson(5, 4)
    assert math.isnan(wilson(0, 0).rate)
    with pytest.raises(ValueError, match="0 and 4 trials"):
        difference(wilson(0, 0), wilson(1, 4))
