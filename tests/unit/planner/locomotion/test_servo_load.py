"""Predicted load of the servos: next to the check of profiles, which is more detailed."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.evaluation.robot_check import gait_cycle
from sextant.services.planner.locomotion.gait import GAITS
from sextant.services.planner.locomotion.params import StepParams
from sextant.services.planner.locomotion.servo_load import pace_at, predict_load
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import GaitName

STEPS = StepParams()
PROFILES = [load_profile(name) for name in ("phantomx_mk2", "jethexa_hx35h", "lotriet_rx64", "printed_ds3218")]
LIFT_M = 0.025  # that of the check


@pytest.mark.parametrize("factor", [1.0, 1.25])
@pytest.mark.parametrize("gait", ["tripod", "ripple", "wave"])
@pytest.mark.parametrize("profile", PROFILES, ids=lambda one: one.name)
def test_load_agrees_with_the_check_of_profiles(profile, gait: GaitName, factor: float) -> None:  # type: ignore[no-untyped-def]
    pace = pace_at(profile, STEPS, gait, LIFT_M, factor)
    stance = replace(profile.stance, foot_speed=pace.foot_speed, step_s=pace.step_s, max_speed=1.0)
    cycle = gait_cycle.walk_cycle(replace(profile, stance=stance), gait)
    load = predict_load(profile, STEPS, gait, pace, LIFT_M, profile.stance.body_height)
    assert load.duty == pytest.approx(float((cycle.rms_torque / profile.servos.stall_torque).max()), rel=0.22)
    fifth = round((cycle.step_s - STEPS.handover_s) / 5 / 0.02)  # samples of the cycle
    turned = np.cumsum(np.abs(np.concatenate([cycle.rate, cycle.rate])), axis=0)
    fastest = ((turned[fifth:] - turned[:-fifth]).max(axis=0) / fifth / profile.servos.no_load_speed).max()
    assert load.speed == pytest.approx(fastest, rel=0.3)


@pytest.mark.parametrize("gait", ["tripod", "ripple", "wave"])
def test_faster_feet_load_the_servos_more(gait: GaitName) -> None:
    profile = PROFILES[0]
    paces = [pace_at(profile, STEPS, gait, LIFT_M, factor) for factor in (0.6, 0.8, 1.0, 1.2, 1.4)]
    loads = [predict_load(profile, STEPS, gait, pace, LIFT_M, 0.11) for pace in paces]
    assert np.all(np.diff([load.duty for load in loads]) > 0.0)
    assert np.all(np.diff([load.speed for load in loads]) > 0.0)


def test_full_swing_at_the_foot_speed_of_the_profile_takes_the_step_of_the_check() -> None:
    profile = PROFILES[0]
    pace = pace_at(profile, STEPS, "tripod", LIFT_M, 1.0)
    assert pace.foot_speed == profile.stance.foot_speed
    assert pace.step_s == pytest.approx(gait_cycle.walk_cycle(profile, "tripod").step_s, abs=1e-9)


def test_more_standing_legs_bear_less_each() -> None:
    profile = PROFILES[0]
    duties = [
        predict_load(profile, STEPS, gait, pace_at(profile, STEPS, gait, LIFT_M, 1.0), LIFT_M, 0.11).duty for gait in GAITS
    ]
    assert duties == sorted(duties, reverse=True)
