"""Running step: time in the air, and the wait before lift-off."""

import numpy as np
import pytest

from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.services.actuator.locomotion.running_step import LiftOffWait, RunningStep
from tests.support.walker_steps import ALL, DT, DURATION, NOTHING, REST, SETTINGS, START, plan_to

FIRST = np.arange(6) == 0


def step() -> RunningStep:
    return RunningStep(plan_to(1, START), SETTINGS.unload_s, SETTINGS.load_s)


def test_a_step_ends_at_its_duration() -> None:
    running = step()
    while running.elapsed_s < DURATION:
        before = running.advance(0.03)
        assert before < running.elapsed_s <= DURATION
    assert running.air_s == 0.0


def test_a_hurried_step_lands_sooner() -> None:
    slow, fast = step(), step()
    fast.speedup = 1.5
    assert fast.air_s == pytest.approx(slow.air_s / 1.5)
    assert slow.air_s == pytest.approx(DURATION - SETTINGS.unload_s - SETTINGS.load_s)
    fast.advance(0.2)
    assert fast.elapsed_s == pytest.approx(0.3)


def test_the_swing_lies_between_unloading_and_loading() -> None:
    running = step()
    assert running.swing_share(SETTINGS.unload_s) == 0.0
    assert running.swing_share(running.touchdown_s) == 1.0
    shares = [running.swing_share(now_s) for now_s in np.linspace(0.0, DURATION, 50)]
    assert shares == sorted(shares)


@pytest.mark.parametrize(
    ("may_bear", "heard", "within_s"),
    [(NOTHING, ALL, (0.06, 0.10)), (FIRST, ALL, (0.11, 0.15)), (NOTHING, NOTHING, (0.26, 0.30))],
)
def test_a_step_waits_longer_for_legs_that_lean_or_were_not_read(
    may_bear: np.ndarray, heard: np.ndarray, within_s: tuple[float, float]
) -> None:
    wait, felt = LiftOffWait(), FootContact(NOTHING, NOTHING, REST, may_bear=may_bear, heard=heard)
    cycles = 1
    while not wait.is_over(FIRST, felt, DT):
        cycles += 1
    assert within_s[0] < cycles * DT <= within_s[1]
