"""Validation of servo readings.

A jump is accepted once a second reading confirms it. Values that no servo can report are never accepted.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.actuator.servo_bus.packet_loss import LossRate
from sextant.services.actuator.servo_bus.reading_validation import Implausibility, ReadingValidator, State
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.models import AX_12A, MODELS
from sextant.shared.servo.servo_model import ServoModel

WILD = settings(deadline=None, derandomize=True)
MS = 1_000_000
USUAL = State(0, position=500, speed=5, load=100, voltage=120, temperature=40, error=0)


@dataclass
class Judge:
    """One servo that has reported its usual values, and a clock."""

    noisy: bool = False
    model: ServoModel = AX_12A

    def __post_init__(self) -> None:
        self.of = ReadingValidator([self.model])
        self.now_ns = 0
        assert self.of.accepts(0, USUAL, False)
        self.goal(500)

    def goal(self, ticks: int) -> None:
        self.of.sent(np.array([ticks]))

    def accepts(self, after_ms: float = 80.0, **said: int) -> bool:
        self.now_ns += round(after_ms * MS)
        return self.of.accepts(0, USUAL._replace(stamp_ns=self.now_ns, **said), self.noisy)


LEAPS = [
    ({"position": 511}, Implausibility.POSITION),
    ({"position": 489}, Implausibility.POSITION),
    ({"speed": 700}, Implausibility.SPEED),
    ({"voltage": 129}, Implausibility.VOLTAGE),
    ({"voltage": 111}, Implausibility.VOLTAGE),
    ({"temperature": 43}, Implausibility.TEMPERATURE),
    ({"temperature": 37}, Implausibility.TEMPERATURE),
    ({"error": 32}, Implausibility.ERROR),
]
IMPOSSIBLE = [{"position": 1024}, {"speed": 2048}, {"load": 2048}, {"error": 128}]


@pytest.mark.parametrize("said", [{"position": 510}, {"position": 490}, {"voltage": 128}, {"temperature": 42}, {"load": 1023}])
def test_small_change_is_accepted(said: dict[str, int]) -> None:
    judge = Judge()
    assert judge.accepts(**said)
    assert not judge.of.refused


@pytest.mark.parametrize(("said", "doubt"), LEAPS)
def test_jump_is_accepted_after_a_second_equal_reading(said: dict[str, int], doubt: Implausibility) -> None:
    judge = Judge()
    assert not judge.accepts(**said)
    assert judge.accepts(after_ms=1.2, **said)
    assert not judge.of.refused
    assert judge.accepts(after_ms=1.2, **said)  # and it is the usual value from now on


@pytest.mark.parametrize(("said", "doubt"), LEAPS)
def test_unconfirmed_jump_is_refused_with_reason(said: dict[str, int], doubt: Implausibility) -> None:
    judge = Judge()
    assert not judge.accepts(**said)
    assert judge.accepts(after_ms=1.2)
    assert judge.of.refused == {doubt: 1}


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
@pytest.mark.parametrize("after_ms", [20.0, 80.0])
def test_a_servo_may_move_at_the_no_load_speed_of_its_model_and_no_servo_at_twice_that(
    model: ServoModel, after_ms: float
) -> None:
    units = model.units
    way, slack = model.no_load_speed * after_ms * 1e-3 / units.tick_rad, 0.052 / units.tick_rad  # [ticks]
    for moved, accepted in ((round(way), True), (round(2.0 * way + slack), False)):
        judge = Judge(model=model)
        judge.goal(500 + moved)
        speed = min(round(model.no_load_speed / units.speed_rad_s), units.speed_sign.largest(model.table.present_speed.size))
        assert judge.accepts(after_ms, position=500 + moved, speed=speed) == accepted


@pytest.mark.parametrize("said", IMPOSSIBLE)
def test_out_of_range_values_are_never_accepted(said: dict[str, int]) -> None:
    judge = Judge()
    assert not any(judge.accepts(after_ms=1.2, **said) for _ in range(5))
    assert judge.of.refused == {Implausibility.RANGE: 5}
    assert judge.accepts()


def test_two_different_jumps_do_not_confirm_each_other() -> None:
    judge = Judge()
    assert not judge.accepts(position=900)
    assert not judge.accepts(after_ms=1.2, position=200)
    assert not judge.accepts(after_ms=1.2, position=900, error=4)
    assert judge.of.refused == {Implausibility.POSITION: 2}


def test_position_is_accepted_near_last_3_goals_within_speed_limit() -> None:
    judge = Judge()
    judge.goal(600)
    assert judge.accepts(position=590)
    judge.goal(500)
    assert judge.accepts(position=545)
    judge.goal(500)
    judge.goal(500)
    assert judge.accepts(position=500)
    assert not judge.accepts(position=560)  # no recent goal is near this position
    fast = Judge()
    fast.goal(1000)
    assert not fast.accepts(after_ms=20.0, position=900)  # 2 rad in 20 ms


def test_constant_offset_from_goal_stays_accepted_once_confirmed() -> None:
    judge = Judge()
    for ticks in (480, 480, 480):
        judge.goal(ticks)
    assert not judge.accepts(position=495)
    assert judge.accepts(after_ms=1.2, position=495)  # confirmed: the joint is blocked
    for ticks in (470, 460, 450):
        judge.goal(ticks)
    assert judge.accepts(position=485)  # 15 ticks off its goal, as before
    assert not judge.accepts(position=500)


def test_noisy_bus_requires_confirmation_of_load_and_speed_jumps() -> None:
    for said, doubt in (({"load": 510}, Implausibility.LOAD), ({"speed": 300}, Implausibility.SPEED)):
        assert Judge().accepts(**said)
        judge = Judge(noisy=True)
        assert not judge.accepts(**said)
        assert judge.accepts(after_ms=1.2)
        assert judge.of.refused == {doubt: 1}


def test_first_reading_on_noisy_bus_requires_confirmation() -> None:
    judge = ReadingValidator([AX_12A])
    assert not judge.accepts(0, USUAL, True)
    assert not judge.accepts(0, USUAL._replace(position=100), True)
    assert judge.accepts(0, USUAL._replace(position=101), True)
    assert judge.refused == {Implausibility.FIRST: 1}


def test_repeated_reading_is_refused_only_for_a_moving_joint() -> None:
    judge = Judge()
    assert all(judge.accepts() for _ in range(3))
    assert judge.accepts(position=505, speed=300)  # 3.5 rad/s
    assert not judge.accepts(position=505, speed=300)
    judge.goal(540)
    assert judge.accepts(after_ms=1.2, position=530, speed=290)
    assert judge.of.refused == {Implausibility.AGAIN: 1}
    assert judge.accepts(after_ms=1.2, position=530, speed=290)  # too soon for the joint to have moved


def test_confirmed_voltage_jump_applies_to_all_servos() -> None:
    judge = ReadingValidator([AX_12A] * 2)
    assert judge.accepts(0, USUAL, False)
    assert judge.accepts(1, USUAL, False)
    sagged = USUAL._replace(stamp_ns=80 * MS, voltage=100)
    assert not judge.accepts(0, sagged, False)
    assert judge.accepts(0, sagged, False)
    assert judge.accepts(1, sagged, False)  # already known from the other servo


SAID = st.builds(
    State,
    st.just(0),
    st.integers(0, 1100),
    st.integers(0, 2100),
    st.integers(0, 2100),
    st.integers(0, 255),
    st.integers(0, 255),
    st.sampled_from([0, 4, 32, 128]),
)


@WILD
@given(st.lists(st.tuples(SAID, st.integers(1, 200), st.booleans(), st.integers(0, 1023)), max_size=30))
def test_accepted_random_readings_are_near_or_confirmed(said: list[tuple[State, int, bool, int]]) -> None:
    judge, now_ns = ReadingValidator([AX_12A]), 0
    believed: State | None = None
    unborne: State | None = None  # last reading that is possible but was not accepted
    goals: list[int] = []
    aside = 0
    for state, after_ms, noisy, goal in said:
        now_ns += after_ms * MS
        one = state._replace(stamp_ns=now_ns)
        if judge.accepts(0, one, noisy):
            assert one.position <= dxl.TICK_MAX
            assert one.error < 128
            twice = unborne is not None and abs(unborne.position - one.position) <= 25 and unborne.error == one.error
            if believed is not None and not twice:
                recent = goals[-3:] or [believed.position]
                assert min(*recent, min(recent) + aside) - 10 <= one.position <= max(*recent, max(recent) + aside) + 10
                assert one.error == believed.error
            recent = goals[-3:] or [one.position]
            aside = one.position - min(max(one.position, min(recent)), max(recent))
            believed, unborne = one, None
        elif not judge.is_impossible(0):
            unborne = one
        judge.sent(np.array([goal]))
        goals.append(goal)


def test_packet_loss_covers_only_the_time_window() -> None:
    loss = LossRate(100 * MS)
    assert loss.share(0) == 0.0
    for k in range(20):
        loss.note(10 * k * MS, k < 10)
    assert loss.share(190 * MS) == 0.0
    assert loss.share(189 * MS) == 0.0
    loss.note(195 * MS, True)
    assert loss.share(195 * MS) == pytest.approx(1 / 11)
    assert loss.share(290 * MS) == 1.0  # the loss of the last request remains without new requests
    assert loss.share(9000 * MS) == 1.0
    assert loss.within(294 * MS, 100 * MS)
    assert not loss.within(295 * MS, 100 * MS)
    assert not LossRate(100 * MS).within(0, 100 * MS)


@WILD
@given(st.lists(st.tuples(st.integers(0, 50), st.booleans()), max_size=60))
def test_packet_loss_matches_direct_count(asked: list[tuple[int, bool]]) -> None:
    loss, now, noted = LossRate(100), 0, []
    for step, lost in asked:
        now += step
        loss.note(now, lost)
        noted.append((now, lost))
        recent = [lost for at, lost in noted if at > now - 100]
        assert loss.share(now) == pytest.approx(sum(recent) / len(recent))
