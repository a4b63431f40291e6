"""Successive injections in one walk, and a new walk when the robot stops."""

from dataclasses import replace
from typing import Self

import numpy as np
import pytest

from benchmarks.faults.cases import BY_NAME, Case
from benchmarks.faults.fault_run import FaultRun, NoWalkError, Observed, in_walks
from benchmarks.faults.timeline import Timeline
from sextant.shared.wire import codec
from sextant.shared.wire.messages import Mode
from tests.support.states import actuator_state
from tests.support.timelines import timeline


class Walk(FaultRun):
    """A walk that goes on for a given number of injections, then stands or is stuck."""

    start_s = 1.0
    lasts: list[int]  # numbers of injections of the coming walks
    stuck: bool
    seeds: list[int]

    def __init__(self, case: Case, seed: int):
        super().__init__(case)
        self.seeds.append(seed)
        self._left = self.lasts.pop(0)

    @property
    def now_s(self) -> float:
        return 0.0

    @property
    def walks(self) -> bool:
        return self._left > 0 or self.stuck

    def break_and_watch(self, begin: float, rng: np.random.Generator) -> Observed:
        raise AssertionError("nothing is broken")

    def look(self, until_s: float = float("inf")) -> None:
        raise AssertionError("nobody looks")

    def inject(self, number: int) -> Timeline:
        if self._left == 0:
            raise NoWalkError("it stands")
        self._left -= 1
        return timeline()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass


@pytest.mark.parametrize("stuck", [True, False])
def test_each_injection_runs_once_in_fewest_walks(stuck: bool) -> None:
    Walk.lasts, Walk.stuck, Walk.seeds = [2, 1, 3], stuck, []
    found = in_walks(BY_NAME["planner-killed"], (4, 5, 6, 7, 8), Walk)
    assert [number for number, *_ in found] == [4, 5, 6, 7, 8]
    assert [seed for _, seed, *_ in found] == [1004, 1004, 1006, 1007, 1007]
    assert Walk.seeds == [1004, 1006, 1007]
    assert [line.stuck for _, _, line, _ in found] == ["", "it stands" * stuck, "it stands" * stuck, "", ""]


def test_robot_that_never_walks_raises_error() -> None:
    Walk.lasts, Walk.stuck, Walk.seeds = [0], True, []
    with pytest.raises(NoWalkError, match="it stands"):
        in_walks(BY_NAME["planner-killed"], (0,), Walk)


def test_robot_without_actuator_messages_is_not_walking() -> None:
    now = [1.0]

    class Silent(Walk):
        @property
        def now_s(self) -> float:
            return now[0]

        @property
        def walks(self) -> bool:
            return FaultRun.walks.fget(self)  # type: ignore[attr-defined,no-any-return]

    Walk.lasts, Walk.stuck, Walk.seeds = [0], False, []
    walk = Silent(BY_NAME["planner-killed"], 0)
    assert not walk.walks
    walking = replace(actuator_state(walk.profile), mode=Mode.WALK, reason="walking", stamp_ns=1_000_000_000)
    walk.hear_state(codec.encode(walking))
    assert walk.walks
    now[0] = 1.3
    assert not walk.walks
