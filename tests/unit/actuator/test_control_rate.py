"""Rate of the control cycle on a computer that is too slow."""

import numpy as np
import pytest

from sextant.services.actuator.control_rate import SHARES, ControlRate
from sextant.shared.runtime.service import Every
from sextant.shared.wire.messages import Mode
from tests.support.actuator_rig import PERIOD, Rig


def run(rate: ControlRate, seconds: float, since_s: float, took_s: float) -> int:
    """Note cycles for some seconds; return how often the rate has changed."""
    return sum(rate.note(since_s, took_s) for _ in range(round(seconds / since_s)))


def test_fast_computer_keeps_the_nominal_rate() -> None:
    rate = ControlRate(50.0)
    assert run(rate, 60.0, 0.02, 0.012) == 0
    assert (rate.share, rate.period_ns, rate.warning) == (1.0, PERIOD, "")


@pytest.mark.parametrize(("since_s", "share"), [(0.031, 2.0 / 3.0), (0.045, 0.5), (0.055, 0.5), (0.09, 1.0)])
def test_rate_falls_to_what_the_computer_holds(since_s: float, share: float) -> None:
    rate = ControlRate(50.0)
    run(rate, 5.0, since_s, since_s - 0.004)
    assert rate.share == share
    words = f"the computer is too slow for 50 control cycles per second: it runs {50 * share:.0f}; walking slower"
    assert rate.warning == (words if share < 1.0 else "")


@pytest.mark.parametrize(("took_s", "share"), [(0.028, 2.0 / 3.0), (0.036, 0.5), (0.002, 0.5)])
def test_rate_fits_the_duration_of_cycles_that_skip_others(took_s: float, share: float) -> None:
    rate = ControlRate(50.0)
    run(rate, 5.0, 0.04, took_s)
    assert rate.share == share


@pytest.mark.parametrize(("late_of_100", "falls"), [(4, False), (50, True)])
def test_a_few_late_cycles_do_not_matter(late_of_100: int, falls: bool) -> None:
    rate, draw = ControlRate(50.0), np.random.default_rng(0)
    for late in draw.permutation(np.repeat(np.arange(100) < late_of_100, 20)):
        rate.note(0.035 if late else 0.02, 0.01)
    assert (rate.share < 1.0) == falls


def test_rate_rises_after_10_s_with_spare_time_and_not_without() -> None:
    rate = ControlRate(50.0)
    run(rate, 0.4, 0.035, 0.025)
    assert rate.share == SHARES[1]
    assert run(rate, 60.0, 0.03, 0.018) == 0, "18 of 20 ms are too near to the limit"
    assert run(rate, 9.0, 0.03, 0.012) == 0
    assert any(rate.note(0.03, 0.012) for _ in range(60))
    assert rate.share == 1.0


def test_actuator_runs_slower_and_says_so_in_place_of_holding() -> None:
    rig = Rig()
    state = rig.walking()
    rig.hear(rig.plan(state))
    rig.cycle(5)
    rig.period_ns = 33_000_000
    modes = {rig.cycle().mode for _ in range(12)}
    assert modes == {Mode.WALK}
    assert rig.actuator.trigger == Every(30_000_000)
    assert rig.state is not None
    assert rig.state.speed_scale == pytest.approx(2.0 / 3.0)
    assert "the computer is too slow for 50 control cycles per second: it runs 33; walking slower" in rig.state.warnings
    for _ in range(400):
        rig.period_ns = rig.actuator.trigger.period_ns
        rig.cycle()
    assert rig.actuator.trigger == Every(PERIOD)
    assert rig.state.speed_scale == 1.0
    assert not any("too slow" in warning for warning in rig.state.warnings)
