"""Backtracking through previous stances, except onto ground that gave way."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.planner.roadmap.backtracking import StepHistory
from sextant.services.planner.roadmap.roadmap import PassageStep, Stance
from sextant.shared.geometry import Array


def random_section(seed: int, n: int) -> tuple[Stance, tuple[PassageStep, ...], list[tuple[Array, Array]]]:
    """Return a section of n steps, and body and feet before each step and at the end.

    Some of the steps move the body only.
    """
    rng = np.random.default_rng(seed)
    feet, body, steps = rng.uniform(-0.2, 0.2, (6, 3)), np.zeros(3), list[PassageStep]()
    root, seen = Stance(body, feet.copy()), [(body, feet.copy())]
    for _ in range(n):
        leg = int(rng.integers(-1, 6))
        body = body + np.array([rng.uniform(0.0, 0.05), 0.0, 0.0])
        if leg >= 0:
            feet[leg] += rng.uniform(0.0, 0.2, 3)
        steps.append(PassageStep(leg, feet[leg].copy() if leg >= 0 else body, 0.04, body, 0.05))
        seen.append((body, feet.copy()))
    return root, tuple(steps), seen


@given(st.integers(0, 2**32 - 1), st.integers(1, 30), st.integers(0, 30))
def test_backtracking_visits_previous_stances(seed: int, n: int, done: int) -> None:
    root, steps, seen = random_section(seed, n)
    trail, done = StepHistory(), min(done, n)
    trail.begin(root, steps)
    trail.ended(done)
    body, feet = seen[done]
    feet = feet.copy()
    back = trail.back([], 0.05)
    for k, step in enumerate(back):
        if step.leg >= 0:
            feet[step.leg] = step.touchdown
        np.testing.assert_array_equal(step.body, seen[done - k - 1][0])
        np.testing.assert_array_equal(feet, seen[done - k - 1][1])
    if back:
        far_enough = back[-1].body[0] <= body[0] - 0.12
        assert far_enough or len(back) == done
        assert all(step.body[0] > body[0] - 0.12 for step in back[:-1])
    else:
        assert done == 0
    assert trail.back([], 0.05) == (), "it is gone once"


def test_backtracking_stops_before_ground_that_gave_way() -> None:
    root, steps, _ = random_section(3, 8)
    trail = StepHistory()
    trail.begin(root, steps)
    whole = trail.back([], 0.05)
    assert len(whole) > 2
    leg = next(k for k, step in enumerate(whole) if k > 0 and step.leg >= 0)
    trail.begin(root, steps)
    assert len(trail.back([whole[leg].touchdown], 0.01)) <= leg


def test_number_of_backtracks_is_limited() -> None:
    root, steps, _ = random_section(5, 8)
    trail = StepHistory()
    for times in range(5):
        trail.begin(root, steps)
        assert bool(trail.back([], 0.05)) == (times < 3)
