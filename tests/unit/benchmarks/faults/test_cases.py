"""Fault cases and their limits.

The limits are the documented ones, and the robot can keep them for any random draw.
"""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from benchmarks.faults.cases import BY_NAME, CAMERA_CASES, CASES, COURSES, Limits, Off, OnBus, OnCamera
from sextant.shared.scenario.scenario import CameraFaultKind

_KINDS = ("silent", "stuck", "garbage", "wrong", "slow", "intermittent")
_CYCLE_S, _WINDOW = 0.02, 10  # [s]; [cycles] window of the check for lost answers
_SHARE, _STOPS = 0.40, 0.30  # share of lost answers, and the share at which the robot stops


@pytest.mark.slow
@pytest.mark.parametrize(
    ("after_s", "per_million", "within"), [(0.44, 4000.0, 0.1), (BY_NAME["lost-40"].limits.decided_s, 20.0, 0.5)]
)
def test_random_packet_loss_stops_robot_within_limit(after_s: float, per_million: float, within: float) -> None:
    rng, walks, cycles = np.random.default_rng(0), 400_000, round(after_s / _CYCLE_S)
    lost = np.hstack([np.zeros((walks, 1)), rng.binomial(4, _SHARE, (walks, cycles))]).cumsum(axis=1)
    before = np.hstack([np.zeros((walks, _WINDOW - 1)), lost])[:, :cycles]
    late = ~((lost[:, 1:] - before) > _STOPS * 4 * _WINDOW + 1e-9).any(axis=1)
    assert late.mean() * 1e6 == pytest.approx(per_million, rel=within)


@pytest.mark.parametrize("target", ["bytes", "packets", "servo", "bus"])
@pytest.mark.parametrize("kind", _KINDS)
def test_each_target_and_kind_has_a_case(target: str, kind: str) -> None:
    faults = [deed.fault for case in CASES for deed in case.deeds if isinstance(deed, OnBus)]
    assert (target, kind) in {(fault.target, fault.kind) for fault in faults}


STOPS = Limits(decided_s=0.28, rest_s=0.7, margin_m=0.010, again_s=2.0)
BACK, HUNG = Limits(decided_s=1.5, jump_deg=2.0), Limits(decided_s=3.5, jump_deg=2.0)
NAMED = Limits(decided_s=0.25, again_s=3.0)
PROMISED: dict[str, Limits] = {
    **dict.fromkeys(("planner-killed", "planner-hung", "planner-repeating"), STOPS),
    **dict.fromkeys(("actuator-killed", "live-actuator-killed"), BACK),
    **dict.fromkeys(("actuator-stopped", "live-actuator-stopped"), HUNG),
    **dict.fromkeys(("servo-silent", "bus-silent", "bus-gone", "live-servo-silent", "live-bus-silent", "live-bus-gone"), NAMED),
    "overload": Limits(rest_s=1.0, again_s=10.0, lunge_dps=30.0),
    **dict.fromkeys(("heat", "drain"), Limits(seated=True, torque_stays=False)),
    **dict.fromkeys(("lost-1", "corrupted-1", "sag", "clock-stepped"), Limits(walks_on=True)),
    "actuator-slow": Limits(margin_m=0.010),
    "fuzzed-plans": Limits(goal_dps=354.0),
    "actuator-late": Limits(decided_s=0.5, margin_m=0.010, again_s=2.0),
    "live-hogs": Limits(cycle_s=0.025),
    **{case.name: Limits(off_s=0.060, torque_stays=False) for case in CASES if case.lets_go},
    "off-actuator-late": Limits(off_s=0.100, torque_stays=False),
}


@pytest.mark.parametrize("name", PROMISED)
def test_case_limits_match_documented_limits(name: str) -> None:
    promised, held = PROMISED[name], BY_NAME[name].limits
    assert replace(held, named="") == promised


def test_servo_bus_and_overload_cases_require_specific_reason() -> None:
    for name in ("servo-silent", "servo-garbage", "overload", "bus-silent", "bus-gone", "actuator-late"):
        assert BY_NAME[name].limits.named != Limits.named


def test_each_fault_has_a_torque_off_case() -> None:
    offs = {case.name.removeprefix("off-") for case in CASES if case.lets_go} - {"off"}
    assert offs == {case.name for case in CASES if not case.lets_go}
    for case in CASES:
        if case.lets_go:
            assert sum(isinstance(deed, Off) for deed in case.deeds) == 1, case.name
            assert len(case.deeds) == 2, case.name


def test_each_camera_fault_is_on_each_course_and_ends_well() -> None:
    by_course = {course: [case for case in CAMERA_CASES if case.course == course] for course in COURSES}
    names = [[case.name.removesuffix(f"-{course}") for case in cases] for course, cases in by_course.items()]
    assert names[0] == names[1] == names[2]
    kinds = {deed.what for case in CAMERA_CASES for deed in case.deeds if isinstance(deed, OnCamera)}
    assert set(get_args(CameraFaultKind)) <= kinds
    for case in CAMERA_CASES:
        assert case.ends_the_walk, "it is injected into a copy"
        assert case.limits.reasons
        assert case.limits.place_m <= 0.10
        assert case.limits.stands is ("lasting" in case.name)
