"""Step execution while something holds a foot, in the air or on the ground."""

import numpy as np
import pytest

from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.shared.robot.profile import LEGS
from tests.support.walker_steps import ALL, DT, body_at, cycle, new_walker, plan_to


@pytest.mark.parametrize("leg", [0, 2, 4])
def test_blocked_foot_reverses_the_step(leg: int) -> None:
    """Check that the step is taken back: the servo would push with full torque.

    It would drag the robot over its standing feet.
    """
    walker = new_walker()
    stood = walker.feet_odom
    walker.accept(plan_to(1, body_at(0.08), ahead=0.08, duration=2.0))
    held, taken_back_at = stood[leg] + [0.0, 0.0, 0.02], 0.0
    cycle(walker)
    while not walker.resting:
        feet = walker.feet_odom
        if not taken_back_at and walker.flying[leg]:
            feet[leg] = held
        felt = FootContact(~ALL, ALL, feet)
        walker.update(DT, walker.body_ref, felt)
        if walker.is_returning and not taken_back_at:
            taken_back_at = walker.body_ref[0, 3]
            assert walker.plan_ns < 0
            assert np.linalg.norm(walker.feet_odom[leg] - held) < 0.01, "its target is no longer behind what holds it"
    assert 0.0 < taken_back_at < 0.05
    assert walker.trouble == f"an obstacle blocks the {LEGS[leg]} foot; the step is reversed"
    np.testing.assert_allclose(walker.feet_odom, stood, atol=2e-3)
    assert walker.body_ref[0, 3] == pytest.approx(0.0, abs=2e-3)
    assert walker.step == 1


@pytest.mark.parametrize(("behind", "for_s"), [(0.025, 9.0), (0.08, 0.14)])
def test_small_or_brief_foot_lag_does_not_reverse_the_step(behind: float, for_s: float) -> None:
    walker = new_walker()
    walker.accept(plan_to(1, body_at(0.06), duration=2.0))
    flown = 0.0
    cycle(walker)
    while not walker.resting:
        feet = walker.feet_odom
        flown += DT * walker.flying[0]
        if flown < for_s and walker.flying[0]:
            feet[0] -= [behind, 0.0, 0.0]
        walker.update(DT, walker.body_ref, FootContact(~ALL, ALL, feet))
        assert not walker.is_returning
    assert flown > 0.5
    assert not walker.trouble


def test_standing_foot_that_is_held_far_off_gets_its_command_there() -> None:
    """Check that a foot that was dragged aside is neither pulled back with full torque nor swung from where it is not."""
    walker, leg = new_walker(), 3
    held = walker.feet_odom[leg] + [-0.05, 0.03, 0.02]
    for _ in range(100):
        feet = walker.feet_odom
        feet[leg] = held
        walker.update(DT, walker.body_ref, FootContact(~ALL, ALL, feet))
    assert np.linalg.norm(walker.feet_odom[leg] - held) == pytest.approx(0.015, abs=1e-3)
    others = np.arange(6) != leg
    np.testing.assert_allclose(walker.feet_odom[others], new_walker().feet_odom[others], atol=1e-3)


def test_leg_at_joint_limits_is_not_taken_for_blocked() -> None:
    """Check that a foot far from the plan is free if its servos are at their goals."""
    walker = new_walker()
    walker.accept(plan_to(1, body_at(0.06), duration=2.0))
    flown = 0.0
    cycle(walker)
    while not walker.resting:
        flown += DT * walker.flying[0]
        feet = walker.feet_odom
        feet[0] -= [0.0, 0.0, 0.08 if walker.flying[0] else 0.0]
        walker.update(DT, walker.body_ref, FootContact(~ALL, ALL, feet, goals=feet))
        assert not walker.is_returning
    assert flown > 0.5
    assert not walker.trouble
