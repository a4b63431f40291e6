"""Refusal memory: a refused crossing is tried again later, or elsewhere."""

import numpy as np

from sextant.services.planner.gap_crossing.params import GapApproachParams
from sextant.services.planner.gap_crossing.refusal_memory import RefusalMemory

S = 1_000_000_000
HERE, ELSEWHERE = np.zeros(2), np.array([1.0, 0.0])


def memory() -> RefusalMemory:
    return RefusalMemory(GapApproachParams(refusal_s=10.0, retry_distance_m=0.3))


def test_refusal_holds_at_its_place_for_its_lifetime() -> None:
    refusals = memory()
    refusals.refuse("too wide", HERE, 0)
    assert refusals.reason_at(HERE + 0.1, 9 * S) == "too wide"
    assert refusals.reason_at(HERE, 10 * S) == ""


def test_refusal_ends_where_the_robot_leaves_its_place() -> None:
    refusals = memory()
    refusals.refuse("too wide", HERE, 0)
    assert refusals.reason_at(ELSEWHERE, S) == ""
    assert refusals.reason_at(HERE, 2 * S) == "", "it came back after another place"


def test_lifetime_doubles_at_one_place_alone() -> None:
    refusals = memory()
    refusals.refuse("too wide", HERE, 0)
    refusals.refuse("too wide", HERE, 10 * S)
    assert refusals.reason_at(HERE, 29 * S) == "too wide"
    assert refusals.reason_at(HERE, 30 * S) == ""
    refusals.refuse("too wide", ELSEWHERE, 30 * S)
    assert refusals.reason_at(ELSEWHERE, 40 * S) == ""


def test_refusal_of_straight_sections_is_kept_at_its_place_until_another_goal() -> None:
    refusals = memory()
    assert refusals.straight_refusal_at(HERE) == ""
    refusals.refuse("too wide", HERE, 0, "out of reach")
    refusals.refuse("no map", HERE, 10 * S)
    assert refusals.straight_refusal_at(HERE + 0.1) == "out of reach", "it holds when the refusal is over"
    assert refusals.straight_refusal_at(ELSEWHERE) == ""
    refusals.refuse("no map", ELSEWHERE, 20 * S)
    assert refusals.straight_refusal_at(HERE) == refusals.straight_refusal_at(ELSEWHERE) == ""
    refusals.refuse("too wide", HERE, 30 * S, "out of reach")
    refusals.forget()
    assert refusals.straight_refusal_at(HERE) == ""


def test_place_without_a_gap_is_remembered_until_a_gap_is_crossed() -> None:
    refusals = memory()
    assert not refusals.found_nothing_at(HERE)
    refusals.complete(HERE)
    assert refusals.found_nothing_at(HERE)
    assert not refusals.found_nothing_at(ELSEWHERE)
    refusals.complete(None)
    assert not refusals.found_nothing_at(HERE)


def test_another_goal_forgets_all() -> None:
    refusals = memory()
    refusals.refuse("too wide", HERE, 0)
    refusals.complete(HERE)
    refusals.forget()
    assert refusals.reason_at(HERE, S) == ""
    assert not refusals.found_nothing_at(HERE)
