"""Failure reasons as text: the gap if there is one, and the leg whose test fails."""

import numpy as np
import pytest

from sextant.evaluation.scoring.passage_truth import stance_at
from sextant.evaluation.whole_maps.strip import strip_of
from sextant.services.planner.roadmap import roadmap_search
from sextant.services.planner.roadmap.failure_reasons import (
    TEST_NAMES,
    WHOLE_ROBOT,
    FailureReason,
    describe_fault,
    explain_failure,
)
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.robot.profile import LEGS
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import UNKNOWN

STANCE = stance_at(load_profile("phantomx_mk2"), 0.44, 0.11)
STROKES = np.full(6, 0.20)
EDGE = float(STANCE.feet[:, 0].max()) + 0.03  # [m] {strip} x at which a gap begins


def failure_reason(
    bare: list[tuple[float, float]], test: int = roadmap_search.FOOTHOLD, leg: int = 0, length: float = 2.0
) -> FailureReason:
    """Return the reason when a leg fails a test and the ground has bare stretches [m].

    The stretches are given along x {strip}.
    """
    ground = np.zeros((round(length / 0.01), 120), dtype=np.float32)
    x = 0.01 * (np.arange(len(ground)) + 0.5)
    plain = strip_of(ground)
    evaluation = np.full_like(plain.evaluation, -5)
    for begin, end in bare:
        evaluation[(x > begin) & (x < end)] = 5
    fails = np.zeros((roadmap_search.TESTS, 7), dtype=np.int64)
    fails[test, leg], fails[roadmap_search.MARGIN, WHOLE_ROBOT] = 7, 2
    return explain_failure(fails, STANCE.body, STANCE.feet, STROKES, StripMap(ground, evaluation, 0.01, np.eye(4)))


@pytest.mark.parametrize("leg", range(7))
def test_most_frequently_failed_leg_and_test_are_named(leg: int) -> None:
    why = failure_reason([], roadmap_search.TORQUE, leg)
    assert why.leg == leg
    who = "" if leg == WHOLE_ROBOT else f"{LEGS[leg]} leg: "
    assert why.words.startswith(f"no step from (0.44, 0.00) m: {who}{TEST_NAMES[roadmap_search.TORQUE]} (7 of 9")
    assert not why.unseen


@pytest.mark.parametrize("width", [0.0, 0.02, 0.09])
def test_narrow_bare_stretch_is_not_reported(width: float) -> None:
    assert "without a foothold" not in failure_reason([(EDGE, EDGE + width)]).words


def test_wide_bare_stretch_is_reported_with_width_and_leg_reach() -> None:
    assert "front foot 15 cm of ground without a foothold, the leg reaches 20 cm" in failure_reason([(EDGE, EDGE + 0.15)]).words
    assert (
        "front foot 80 cm of ground without a foothold, 60 cm more than the leg's reach of 20 cm"
        in failure_reason([(EDGE, EDGE + 0.80)]).words
    )


def test_wider_bare_stretch_within_reach_is_reported() -> None:
    assert (
        "front foot 30 cm of ground without a foothold, 10 cm more"
        in failure_reason([(EDGE, EDGE + 0.02), (EDGE + 0.07, EDGE + 0.37)]).words
    )
    assert "without a foothold" not in failure_reason([(EDGE + 0.4, EDGE + 0.9)]).words


def test_bare_stretch_at_strip_end_is_reported_as_or_more() -> None:
    assert "front foot 40 cm or more of ground without a foothold" in failure_reason([(EDGE, 9.0)], length=EDGE + 0.4).words


def test_foot_outside_strip_is_handled() -> None:
    ground = np.zeros((60, 60), dtype=np.float32)
    field = StripMap(ground, np.full((60, 60), -5, dtype=np.int8), 0.01, np.eye(4))
    fails = np.ones((roadmap_search.TESTS, 7), dtype=np.int64)
    for off in ([0.0, -3.0, 0.0], [5.0, 0.0, 0.0], [-5.0, 0.0, 0.0], [0.0, 3.0, 0.0]):
        assert explain_failure(fails, STANCE.body, STANCE.feet + off, STROKES, field).words.startswith("no step from (")


def test_unknown_cells_are_reported_as_unseen() -> None:
    assert failure_reason([], roadmap_search.UNKNOWN).unseen
    assert "cells ahead are unknown" in failure_reason([], roadmap_search.UNKNOWN).words
    assert not failure_reason([], roadmap_search.REACH).unseen


def test_no_failed_test_names_no_leg() -> None:
    field = StripMap(np.zeros((9, 9), np.float32), np.full((9, 9), UNKNOWN, np.int8), 0.01, np.eye(4))
    fails = np.zeros((roadmap_search.TESTS, 7), dtype=np.int64)
    why = explain_failure(fails, STANCE.body, STANCE.feet, STROKES, field)
    assert (why.words, why.unseen, why.leg) == ("no step is possible at (0.44, 0.00) m", False, WHOLE_ROBOT)


def test_invalid_start_stance_is_described_per_leg() -> None:
    found = np.array([0, roadmap_search.REACH, 0, 0, 0, roadmap_search.UNDER, roadmap_search.MARGIN])
    words = describe_fault(found, 0.03)
    assert words.endswith(f"{LEGS[1]} leg: out of reach; {LEGS[5]} leg: foot under the body; support margin too small")
    assert "3 cm" in words
