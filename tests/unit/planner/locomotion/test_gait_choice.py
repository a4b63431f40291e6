"""The rule that chooses gait and speed: worse ground, hotter servos and failures never give a faster walk."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.planner.locomotion.gait_choice import (
    GaitChooser,
    GroundClass,
    Situation,
    allowed_duty,
    classify,
    fastest_walk,
)
from sextant.services.planner.locomotion.ground_ahead import GroundAhead
from sextant.services.planner.locomotion.params import GaitChoiceParams, StepParams
from sextant.shared.robot.profiles import load_profile, profile_names
from sextant.shared.wire.messages import GaitName, VelocityCommand

PROFILE = load_profile("phantomx_mk2")
PROFILES = [load_profile(name) for name in profile_names()]
STEPS, PARAMS = StepParams(), GaitChoiceParams()
AUTO = VelocityCommand(0, np.array([PROFILE.stance.max_speed, 0.0]), 0.1, 0.11, 0.025, "auto", auto_speed=True)
EVEN, UNEVEN = GroundAhead(0.0, 1.0, 0.001, 0.0), GroundAhead(0.0, 0.62, 0.03, 3.0)

shares = st.floats(0.0, 1.0)
grounds = st.builds(GroundAhead, shares, shares, st.floats(0.0, 0.2), st.floats(0.0, 40.0))
situations = st.builds(
    Situation,
    grounds,
    st.sampled_from(["", "registration failed"]),
    st.integers(0, 5).map(lambda n: ("a foot slipped",) * n),
    st.floats(0.0, 90.0),
    st.floats(0.0, 1.0),
)


def speed(at: Situation, command: VelocityCommand = AUTO) -> float:
    return GaitChooser(PROFILE, STEPS, PARAMS).choose(0, at, command).walk.speed


def worse(a: Situation, b: Situation) -> Situation:
    """Return a situation in which each observation is the worse one of both."""
    one, other = a.ground, b.ground
    ground = GroundAhead(
        max(one.unseen, other.unseen),
        min(one.carrying, other.carrying),
        max(one.step_m, other.step_m),
        max(one.slope_deg, other.slope_deg),
    )
    failures = max(a.failures, b.failures, key=len)
    return Situation(ground, a.pose_fault or b.pose_fault, failures, max(a.temperature, b.temperature), max(a.duty, b.duty))


@given(situations, situations, st.sampled_from(["auto", "tripod", "ripple", "wave"]))
def test_worse_observation_never_gives_a_faster_walk(a: Situation, b: Situation, gait: GaitName) -> None:
    both, command = worse(a, b), replace(AUTO, gait=gait)
    assert classify(both, PARAMS)[0] == max(classify(a, PARAMS)[0], classify(b, PARAMS)[0])
    assert speed(both, command) <= min(speed(a, command), speed(b, command)) + 1e-12


@pytest.mark.parametrize("profile", PROFILES, ids=lambda one: one.name)
def test_each_class_is_at_most_as_fast_as_the_better_one(profile) -> None:  # type: ignore[no-untyped-def]
    command = replace(AUTO, body_height=profile.stance.body_height)
    walks = [fastest_walk(profile, STEPS, PARAMS, ground, PARAMS.max_duty, command) for ground in GroundClass]
    speeds = [walk.speed for walk in walks]
    assert speeds == sorted(speeds, reverse=True)
    assert walks[GroundClass.EVEN].lift <= command.lift
    assert walks[GroundClass.DOUBTFUL].pace.foot_speed <= profile.stance.foot_speed
    assert [walk.gait for walk in walks[:3]] == ["tripod"] * 3
    assert walks[GroundClass.DIFFICULT].gait == "ripple"


@given(situations)
def test_chosen_walk_is_within_the_limits_of_the_servos_if_any_is(at: Situation) -> None:
    walk, duty = GaitChooser(PROFILE, STEPS, PARAMS).choose(0, at, AUTO).walk, allowed_duty(PROFILE, at, PARAMS)
    slowest = fastest_walk(PROFILE, STEPS, PARAMS, GroundClass.DIFFICULT, 0.0, AUTO)
    if slowest.load.duty <= duty:
        assert walk.load.duty <= duty
        assert walk.load.speed <= STEPS.max_joint_speed


def test_hot_and_loaded_servos_slow_the_walk() -> None:
    cool = speed(Situation(EVEN))
    warm = PROFILE.servo.warm_temperature
    assert speed(Situation(EVEN, temperature=warm)) < cool
    assert speed(Situation(EVEN, temperature=warm + 10.0)) < speed(Situation(EVEN, temperature=warm))
    assert speed(Situation(EVEN, duty=0.45)) < cool
    assert speed(Situation(EVEN, duty=0.3)) == cool


def test_servos_that_bear_no_tripod_walk_in_the_gait_that_loads_them_least() -> None:
    assert GaitChooser(PROFILE, STEPS, PARAMS).choose(0, Situation(EVEN, duty=0.9), AUTO).walk.gait == "wave"


def test_unseen_ground_and_an_uncertain_pose_are_walked_on_at_the_pace_of_the_profile() -> None:
    for at in (Situation(replace(EVEN, unseen=0.6)), Situation(EVEN, "registration failed")):
        choice = GaitChooser(PROFILE, STEPS, PARAMS).choose(0, at, AUTO)
        assert choice.walk.pace.foot_speed <= PROFILE.stance.foot_speed
        assert choice.walk.lift == AUTO.lift
        assert choice.walk.speed < speed(Situation(UNEVEN)) < speed(Situation(EVEN))


def test_reason_names_the_class_and_the_observation_that_decided() -> None:
    chooser = GaitChooser(PROFILE, STEPS, PARAMS)
    assert chooser.choose(0, Situation(UNEVEN), AUTO).reason == "uneven ground: 62% of its cells carry a foot"
    slips = Situation(UNEVEN, failures=("there was no step", "there was no step", "a foot slipped"))
    words = chooser.choose(1, slips, AUTO).words
    assert words.startswith("ripple at ")
    assert words.endswith(" cm/s, difficult ground: 3 failures in 10 s, the last: a foot slipped")


def test_worse_ground_counts_at_once_and_better_ground_after_a_while() -> None:
    chooser, calm_ns = GaitChooser(PROFILE, STEPS, PARAMS), round(PARAMS.calm_s * 1e9)
    even, uneven = Situation(EVEN), Situation(UNEVEN)
    assert chooser.choose(0, even, AUTO).reason.startswith("even")
    assert chooser.choose(1, uneven, AUTO).reason.startswith("uneven")
    assert chooser.choose(calm_ns, even, AUTO).reason.startswith("uneven")
    assert chooser.choose(calm_ns + 2, even, AUTO).reason.startswith("even")


def test_ground_that_alternates_gives_one_choice() -> None:
    chooser = GaitChooser(PROFILE, STEPS, PARAMS)
    ways = [Situation(EVEN, temperature=30.0), Situation(UNEVEN, temperature=31.0)]
    choices = [chooser.choose(k * 200_000_000, ways[k % 2], AUTO) for k in range(1, 60)]
    assert len({(choice.walk, choice.reason) for choice in choices}) == 1


def test_explicit_gait_and_speed_stay() -> None:
    chooser = GaitChooser(PROFILE, STEPS, PARAMS)
    difficult = Situation(EVEN, failures=("there was no step",) * 3)
    wave = chooser.choose(0, difficult, replace(AUTO, gait="wave")).apply_to(replace(AUTO, gait="wave"), 0.12)
    assert wave.gait == "wave"
    asked = replace(AUTO, auto_speed=False)
    given_speed = chooser.choose(0, difficult, asked).apply_to(asked, 0.12)
    assert (given_speed.gait, given_speed.lift) == ("ripple", asked.lift)
    np.testing.assert_array_equal(given_speed.velocity, asked.velocity)


@pytest.mark.parametrize("share", [1.5, 1.0, 0.5])
def test_smaller_velocity_asks_for_a_share_of_the_chosen_speed(share: float) -> None:
    command = replace(AUTO, velocity=share * AUTO.velocity)
    choice = GaitChooser(PROFILE, STEPS, PARAMS).choose(0, Situation(EVEN), command)
    applied = choice.apply_to(command, PROFILE.stance.max_speed)
    assert applied.velocity == pytest.approx([min(share, 1.0) * choice.walk.speed, 0.0])
    assert (applied.yaw_rate, applied.body_height) == (command.yaw_rate, command.body_height)


def test_turn_on_the_spot_stays_one() -> None:
    turn = replace(AUTO, velocity=np.zeros(2))
    applied = GaitChooser(PROFILE, STEPS, PARAMS).choose(0, Situation(EVEN), turn).apply_to(turn, PROFILE.stance.max_speed)
    assert not applied.velocity.any()
