"""Ground contacts: where feet have met ground, and which of them have proven that they stand."""

from dataclasses import replace

import numpy as np

from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.services.actuator.locomotion.ground_contacts import GroundContacts
from sextant.services.actuator.locomotion.ground_search import SEARCH_DEPTH_M, GroundSearch
from sextant.services.actuator.locomotion.held_feet import HeldFeet
from sextant.shared.robot.profiles import load_profile

FEET = load_profile("phantomx_mk2").rest_feet()
NONE, ALL = np.zeros(6, dtype=np.bool_), np.ones(6, dtype=np.bool_)
FIRST = np.arange(6) == 0
DT = 0.02
UP = np.array([0.0, 0.0, 1.0])


def contacts() -> GroundContacts:
    return GroundContacts(FEET, FEET[:, 2])


def felt(**changes: object) -> FootContact:
    return replace(FootContact(NONE, NONE, FEET), **changes)  # type: ignore[arg-type]


def test_a_leg_proves_that_it_stands_after_each_swing_once() -> None:
    ground = contacts()
    ground.lift_off(FIRST)
    ground.prove(felt(bears=ALL), ~FIRST)
    assert not ground.proven[0], "it is no candidate in the air"
    ground.prove(felt(bears=ALL), ALL)
    ground.prove(felt(bears=ALL), ALL)
    found = ground.take_findings()
    assert [(one.leg, one.carries) for one in found] == [(0, True)]
    assert ground.take_findings() == []


def test_a_leg_with_unknown_position_yields_no_finding() -> None:
    ground = contacts()
    ground.lift_off(FIRST)
    ground.prove(felt(bears=ALL, known=~FIRST), ALL)
    assert ground.proven.all()
    assert ground.take_findings() == []


def test_a_foot_stops_only_well_over_its_target() -> None:
    ground, met = contacts(), FEET + 0.02 * UP
    met[1] = FEET[1] + 0.001 * UP
    ground.stop_early(np.arange(6) < 2, FEET, met, met + 1.0)
    assert ground.stopped.tolist() == FIRST.tolist()
    assert ground.ground[0] == met[0, 2] + 1.0
    np.testing.assert_allclose(ground.stop_height, np.where(FIRST, 0.02, 0.0))
    assert [one.leg for one in ground.take_findings()] == [0]


def test_commands_of_stopped_feet_move_to_where_they_met_ground() -> None:
    ground, met, feet = contacts(), FEET + 0.02 * UP, FEET.copy()
    ground.stay(FIRST, met, met)
    for _ in range(50):
        ground.settle(feet, DT)
    np.testing.assert_allclose(feet[0], met[0], atol=1e-6)
    np.testing.assert_array_equal(feet[1:], FEET[1:])
    ground.release(FIRST)
    assert not ground.stopped.any()


def test_the_height_of_a_new_foothold_is_corrected_by_a_limited_amount() -> None:
    ground = contacts()
    ground.lift_off(FIRST)
    ground.stay(FIRST, FEET, FEET)
    for _ in range(100):
        ground.survey(DT, felt(feet=FEET - 0.004 * UP))
    np.testing.assert_allclose(ground.ground - FEET[:, 2], np.where(FIRST, -0.004, 0.0), atol=1e-6)
    for _ in range(100):
        ground.survey(DT, felt(feet=FEET - 0.05 * UP))
    np.testing.assert_allclose(ground.ground - FEET[:, 2], np.where(FIRST, -0.01, 0.0), atol=1e-6)


def test_missing_ground_is_reported_once() -> None:
    ground = contacts()
    ground.lift_off(FIRST)
    ground.report_missing(FIRST, FEET - 0.04 * UP)
    ground.prove(felt(bears=ALL), ALL)
    assert [(one.leg, one.carries) for one in ground.take_findings()] == [(0, False)]


def test_search_ends_on_contact_and_each_leg_has_its_own_depth() -> None:
    search = GroundSearch(np.arange(6) < 2, np.where(FIRST, 0.02, 0.0))
    assert search.update(felt()).tolist() == NONE.tolist()
    while not search.lost.any():
        search.deepen(DT, felt())
    assert search.lost.tolist() == [False, True, False, False, False, False]
    assert SEARCH_DEPTH_M - 1e-9 <= search.depth < SEARCH_DEPTH_M + 0.002
    assert search.update(felt(touches=FIRST)).tolist() == FIRST.tolist()
    assert search.legs.tolist() == [False, True, False, False, False, False]


def test_the_load_of_a_leg_counts_only_after_some_millimetres_of_search() -> None:
    search = GroundSearch(FIRST, np.zeros(6))
    assert not search.update(felt(pushes=ALL)).any()
    while search.depth < 0.006:
        search.deepen(DT, felt())
    assert search.update(felt(pushes=ALL)).tolist() == FIRST.tolist()


def test_searching_feet_move_no_further_between_two_readings_in_a_slow_cycle() -> None:
    steps = [GroundSearch(FIRST, np.zeros(6)).deepen(dt, felt()) for dt in (DT, 2.0 * DT, 5.0 * DT)]
    assert steps == [0.0008, 0.001, 0.001]


def test_searching_feet_wait_for_a_lost_reading_but_not_for_a_silent_leg() -> None:
    search = GroundSearch(FIRST, np.zeros(6))
    others, lost = felt(heard=FIRST), felt(heard=~FIRST)
    assert search.deepen(DT, others) > 0.0
    assert [search.deepen(DT, lost) for _ in range(5)] == [0.0] * 5
    assert search.deepen(DT, lost) > 0.0
    assert search.deepen(DT, felt()) > 0.0
    assert search.deepen(DT, lost) == 0.0
    assert GroundSearch(FIRST, np.zeros(6)).deepen(DT, felt(heard=~FIRST, known=~FIRST)) > 0.0


def test_searching_feet_that_are_heard_in_turn_move_once_for_each_reading() -> None:
    for count in (2, 3):
        search, unheard_m = GroundSearch(np.arange(6) < count, np.zeros(6)), np.zeros(count)
        for cycle in range(60):
            heard = np.arange(6) == cycle % count
            unheard_m[heard[:count]] = 0.0
            unheard_m += search.deepen(DT, felt(heard=heard))
            assert unheard_m.max() <= 0.001
        assert search.depth > 0.015


def test_only_feet_that_lag_far_and_long_in_the_air_are_held() -> None:
    held, far = HeldFeet(), FEET + 0.06 * UP
    lag = [held.update(FIRST, far, felt(), DT).tolist() for _ in range(8)]
    assert lag[:-1] == [NONE.tolist()] * 7
    assert lag[-1] == FIRST.tolist()
    held.reset(FIRST)
    assert not held.update(FIRST, far, felt(), DT).any()
    assert not any(HeldFeet().update(FIRST, FEET + 0.025 * UP, felt(), DT).any() for _ in range(50))
    assert not any(HeldFeet().update(FIRST, far, felt(known=NONE), DT).any() for _ in range(50))
