"""A lockstep walk with faults."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.faults.cases import BY_NAME, Late
from benchmarks.faults.lockstep_walk import FaultWalk, gap_after, of_same_angle
from benchmarks.faults.walk_verdict import score
from sextant.services.simulator.servo_bus.bus_faults import row_of
from sextant.shared.servo.bus_fault import BusFault
from sextant.shared.servo.models import AX_12A, MODELS
from sextant.shared.servo.servo_model import ServoModel

NOW_AND_THEN = ("bus-intermittent", "noise-bursts", "off-bus-intermittent", "off-noise-bursts")


@pytest.mark.parametrize("name", NOW_AND_THEN)
def test_intermittent_bus_gap_is_at_end_of_each_window(name: str) -> None:
    for round_ in range(4):
        begin = 0.25 * round_
        for into in (0.0, 0.10, 0.21, 0.24):
            assert gap_after(BY_NAME[name].deeds, begin + into) == pytest.approx((begin + 0.20, begin + 0.25))


def test_other_cases_have_no_bus_gap() -> None:
    for name, case in BY_NAME.items():
        if name not in NOW_AND_THEN:
            assert gap_after(case.deeds, 0.24) == (math.inf, math.inf), name


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_faults_in_ticks_are_the_same_angle_with_each_servo(model: ServoModel) -> None:
    for fault in (BusFault("servo", "wrong", 0.0, servo=1), BusFault("servo", "bit", 0.0, servo=1)):
        scaled = of_same_angle(fault, model)
        tick, ax_tick = model.units.tick_rad, AX_12A.units.tick_rad
        assert scaled.offset_ticks * tick == pytest.approx(fault.offset_ticks * ax_tick, rel=0.01) or fault.kind == "bit"
        assert 2.0**scaled.bit * tick == pytest.approx(2.0**fault.bit * ax_tick, rel=0.2) or fault.kind == "wrong"
        assert row_of(scaled, {1: model}) == 0
        assert scaled.bit == (fault.bit if fault.kind == "wrong" else fault.bit + round(math.log2(ax_tick / tick)))
        assert (scaled.offset_ticks == fault.offset_ticks) == (tick == pytest.approx(ax_tick, rel=0.004) or fault.kind == "bit")


@pytest.mark.slow
def test_torque_off_runs_in_copy_and_original_walk_is_unchanged() -> None:
    case = BY_NAME["off"]
    with FaultWalk(case, 1000) as walk, FaultWalk(case, 1000) as undisturbed:
        for one in (walk, undisturbed):
            one.walk_for(0.2)
        line = walk.what_happens(np.random.default_rng(0))
        assert not line.pulls.any()
        assert score(line, case, walk.profile).off_s < 0.06
        for one in (walk, undisturbed):
            one.walk_for(0.5)
        assert walk.words == undisturbed.words
        assert [goals.ticks.tolist() for goals in walk.recorder.goals] == [g.ticks.tolist() for g in undisturbed.recorder.goals]


@pytest.mark.slow
def test_late_actuator_cycles_are_reported_and_walk_resumes() -> None:
    case = BY_NAME["actuator-late"]
    with FaultWalk(case, 1000) as walk:
        walk.walk_for(0.5)
        line = walk.what_happens(np.random.default_rng(0))
    found = score(line, case, walk.profile)
    assert (found.decided_s, found.cycle_s) == pytest.approx((0.4, 0.08), abs=0.02)
    assert found.missed >= 10
    assert found.named
    assert found.again_s < 2.0


@pytest.mark.slow
def test_robot_walks_on_with_cycles_of_40_ms() -> None:
    case = replace(BY_NAME["actuator-slow"], deeds=(Late(0.04, 3.0),))
    with FaultWalk(case, 1000) as walk:
        walk.walk_for(0.5)
        line = walk.what_happens(np.random.default_rng(0))
    found = score(line, case, walk.profile)
    assert (found.falls, found.stops, found.missed >= 50) == (0, 0, True)
    assert found.margin_m > 0.010


@pytest.mark.slow
def test_service_exception_is_reported_by_injection(monkeypatch: pytest.MonkeyPatch) -> None:
    case = BY_NAME["lost-1"]
    with FaultWalk(case, 1000) as walk:
        walk.walk_for(0.2)

        def crash(*_: object) -> None:
            raise IndexError("index 5 is out of bounds")

        monkeypatch.setattr("sextant.services.planner.service.Planner.step", crash)
        line = walk.what_happens(np.random.default_rng(0))
        assert not walk.walks
    stuck = score(line, case, walk.profile).stuck
    assert stuck.startswith("planner failed: IndexError: index 5 is out of bounds")
