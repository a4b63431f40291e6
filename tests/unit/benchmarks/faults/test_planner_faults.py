"""Faults between the planner and the wire."""

from collections.abc import Iterator

import numpy as np
import pytest

from benchmarks.faults.planner_faults import PLANS_PER_STEP, PlannerFaultInjector, fuzzed
from sextant.services.actuator.safety.plan_validation import PlanCheck
from sextant.shared.wire import codec
from sextant.shared.wire.messages import Message, PlannerStatus, StepPlan
from tests.support.timelines import PROFILE

STATUS = PlannerStatus(0, "stepping", "", 1, 0, -1)


def plan(stamp_ns: int) -> StepPlan:
    return StepPlan(
        stamp_ns=stamp_ns,
        epoch=0,
        step=1,
        revision=0,
        T_world_odom=np.eye(4),
        swing=np.array([True, False] * 3),
        touchdown=PROFILE.rest_feet(),
        clearance=np.full(6, 0.03),
        body_goal=np.eye(4),
        duration=1.0,
        stop=False,
    )


class Planner:
    def __init__(self) -> None:
        self.steps = 0

    def step(self) -> Iterator[Message]:
        self.steps += 1
        yield plan(self.steps)
        yield STATUS


def stamps(made: Iterator[Message]) -> list[int]:
    return [message.stamp_ns for message in made if isinstance(message, StepPlan)]


def test_injector_passes_repeats_or_mutes_planner_messages() -> None:
    meddler, planner = PlannerFaultInjector(np.random.default_rng(0)), Planner()
    said = [stamp for k in range(20) for stamp in stamps(meddler.speak(k, planner.step))]
    assert said == list(range(1, 21))
    meddler.how = "repeating"
    again = [stamp for k in range(30) for stamp in stamps(meddler.speak(100 + k, planner.step))]
    assert len(again) == 30
    assert set(again) == set(range(13, 21))
    meddler.how = "mute"
    alive = list(meddler.speak(200, planner.step))
    assert [type(message) for message in alive] == [PlannerStatus]
    assert alive[0].stamp_ns == 200
    assert planner.steps == 20
    meddler.how = ""
    assert stamps(meddler.speak(300, planner.step)) == [21]


@pytest.mark.slow
def test_fuzzed_plans_cover_all_refusals_and_few_are_walkable() -> None:
    rng, now_ns = np.random.default_rng(1), 10_000_000_000
    made = [fuzzed(plan(now_ns - 50_000_000), now_ns, rng) for _ in range(2000)]
    decoded = []
    for one in made:
        try:
            decoded.append(codec.decode(codec.encode(one), StepPlan)[0])
        except codec.DecodeError:
            continue
    assert 0.5 < len(decoded) / len(made) < 0.9, "some are not finite, and the codec knows"
    check = PlanCheck(PROFILE, 0.6)
    swing = np.array([True, False] * 3)
    refused = {check.untimely(one, now_ns, 0, True, swing, np.full(6, np.inf)).split(" ")[-1] for one in decoded}
    assert len(refused) > 4, "old, early, of another epoch, out of order, welcome"
    feet = PROFILE.rest_feet()
    walkable = sum(not PlanCheck(PROFILE, 0.6).unwalkable(one, np.eye(4), feet) for one in decoded)
    assert 0 < walkable < len(decoded)


def test_fuzzed_step_has_planner_message_and_many_fuzzed_plans() -> None:
    meddler, planner = PlannerFaultInjector(np.random.default_rng(0)), Planner()
    meddler.how = "fuzzed"
    made = list(meddler.speak(0, planner.step))
    assert made[0].stamp_ns == 1
    assert len(made) == PLANS_PER_STEP + 2
    assert meddler.fuzzed == PLANS_PER_STEP
    fuzzed_stamps = {one.stamp_ns for one in made[2:] if isinstance(one, StepPlan)} - {made[0].stamp_ns}
    assert meddler.stamps == fuzzed_stamps, "the planner's own is not among them"
    assert len(fuzzed_stamps) > PLANS_PER_STEP // 4
