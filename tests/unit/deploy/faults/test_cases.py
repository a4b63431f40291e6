"""Limits that the robot can keep, whatever is drawn."""

import numpy as np
import pytest

from deploy.faults.cases import BY_NAME, CASES, OnBus

_KINDS = ("silent", "stuck", "garbage", "wrong", "slow", "intermittent")
_CYCLE_S, _WINDOW = 0.02, 10  # [cycles] of the watch on lost answers
_SHARE, _STOPS = 0.40, 0.30  # that are lost, and from which it stops


@pytest.mark.parametrize(
    ("after_s", "per_million", "within"), [(0.44, 4000.0, 0.1), (BY_NAME["lost-40"].limits.decided_s, 20.0, 0.5)]
)
def test_a_drawn_loss_is_as_bad_as_what_stops_the_robot_before_the_limit_is_over(
    after_s: float, per_million: float, within: float
) -> None:
    rng, walks, cycles = np.random.default_rng(0), 400_000, round(after_s / _CYCLE_S)
    lost = np.hstack([np.zeros((walks, 1)), rng.binomial(4, _SHARE, (walks, cycles))]).cumsum(axis=1)
    before = np.hstack([np.zeros((walks, _WINDOW - 1)), lost])[:, :cycles]
    late = ~((lost[:, 1:] - before) > _STOPS * 4 * _WINDOW + 1e-9).any(axis=1)
    assert late.mean() * 1e6 == pytest.approx(per_million, rel=within)


@pytest.mark.parametrize("target", ["bytes", "packets", "servo", "bus"])
@pytest.mark.parametrize("kind", _KINDS)
def test_every_cell_of_the_grid_is_injected(target: str, kind: str) -> None:
    faults = [deed.fault for case in CASES for deed in case.deeds if isinstance(deed, OnBus)]
    assert (target, kind) in {(fault.target, fault.kind) for fault in faults}
