"""Cycle clock: elapsed time, its share for motion, suspension, and the age of goals."""

import pytest

from sextant.services.actuator.cycle_clock import CycleClock
from sextant.services.actuator.safety.health_monitor import GAP_S

PERIOD_NS = 20_000_000


class Machine:
    """Clock of a machine that may be suspended."""

    now_ns = 5_000_000_000
    suspended_ns = 7_000_000_000

    def clock(self) -> CycleClock:
        return CycleClock(lambda: self.now_ns, lambda: self.suspended_ns, PERIOD_NS)


def test_first_cycle_lasts_one_period() -> None:
    assert Machine().clock().begin(123) == (0.02, 0.02)


@pytest.mark.parametrize(("elapsed_ms", "motion_ms"), [(20, 20), (39, 39), (300, 40)])
def test_motion_advances_by_at_most_two_periods(elapsed_ms: int, motion_ms: int) -> None:
    clock = Machine().clock()
    clock.begin(1_000_000_000)
    assert clock.begin(1_000_000_000 + elapsed_ms * 1_000_000) == pytest.approx((elapsed_ms * 1e-3, motion_ms * 1e-3))


def test_only_a_long_suspension_since_the_last_call_counts() -> None:
    machine = Machine()
    clock = machine.clock()
    assert clock.suspended_s() == 0.0, "suspended before the start"
    machine.suspended_ns += round(GAP_S * 0.9e9)
    assert clock.suspended_s() == 0.0
    machine.suspended_ns += 3_000_000_000
    assert clock.suspended_s() == pytest.approx(3.0)
    assert clock.suspended_s() == 0.0


def test_goals_of_a_cycle_become_too_old() -> None:
    machine = Machine()
    clock = machine.clock()
    clock.begin(machine.now_ns)
    machine.now_ns += round(GAP_S * 0.9e9)
    assert clock.is_current
    machine.now_ns += round(GAP_S * 0.2e9)
    assert not clock.is_current
