"""Laws of the relief: only of feet that something holds, as far as needed, gradually."""

import numpy as np
import pytest

from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.services.actuator.locomotion.foot_relief import FootRelief
from sextant.shared.geometry import Array

DT = 0.02
ALL, NONE = np.ones(6, dtype=bool), np.zeros(6, dtype=bool)
FEET = np.zeros((6, 3))
LEG = 2


def goals_off(by: float) -> Array:
    """Goals of feet at `FEET`; those of one leg are `by` [m] away, obliquely."""
    goals = FEET.copy()
    goals[LEG] = by * np.array([0.6, 0.0, -0.8])
    return goals


def relieve(by: float, seconds: float, standing: Array = ALL, known: Array = ALL) -> tuple[Array, list[float]]:
    """Return the goals at the end, and how far the leg's goal moved in each cycle."""
    relief, goals, moves = FootRelief(), goals_off(by), []
    for _ in range(round(seconds / DT)):
        moved = relief.update(standing, goals, FootContact(NONE, ALL, FEET, known=known), DT)
        if moved is not None:
            goals = goals + moved
        moves.append(0.0 if moved is None else float(np.linalg.norm(moved[LEG])))
    return goals, moves


@pytest.mark.parametrize("by", [0.035, 0.08])
def test_goal_of_held_foot_moves_towards_the_foot_until_the_load_is_low(by: float) -> None:
    goals, moves = relieve(by, 2.0)
    assert np.linalg.norm(goals[LEG]) == pytest.approx(0.015, abs=1e-9)
    np.testing.assert_allclose(goals[LEG] / 0.015, [0.6, 0.0, -0.8], atol=1e-9, err_msg="straight towards the foot")
    np.testing.assert_array_equal(np.delete(goals, LEG, axis=0), np.delete(FEET, LEG, axis=0))
    assert not any(moves[: round(0.28 / DT)]), "a short push is not answered"
    assert max(moves) <= 0.1 * DT + 1e-12


def test_servos_are_relieved_before_they_shut_down() -> None:
    """1.5 s at full torque end in a shutdown; the softest servos show it from 24 mm on."""
    goals, _ = relieve(0.12, 1.4)
    assert np.linalg.norm(goals[LEG]) < 0.024


def test_foot_that_bends_under_its_load_keeps_its_goal() -> None:
    _, moves = relieve(0.028, 5.0)
    assert not any(moves)


@pytest.mark.parametrize("why", ["swings", "unknown"])
def test_other_feet_keep_their_goals(why: str) -> None:
    others = np.arange(6) != LEG
    _, moves = relieve(0.08, 2.0, **{"standing" if why == "swings" else "known": others})
    assert not any(moves)


def test_time_starts_again_when_the_foot_was_near_its_goal() -> None:
    relief, felt = FootRelief(), FootContact(NONE, ALL, FEET)
    for far in [True] * 14 + [False] + [True] * 14:
        assert relief.update(ALL, goals_off(0.05 if far else 0.02), felt, DT) is None
    assert relief.update(ALL, goals_off(0.05), felt, DT) is not None
