"""What a walk in lockstep knows of who breaks it."""

import math

import pytest

from deploy.faults.cases import BY_NAME
from deploy.faults.walk import gap_after

NOW_AND_THEN = ("bus-intermittent", "noise-bursts", "off-bus-intermittent", "off-noise-bursts")


@pytest.mark.parametrize("name", NOW_AND_THEN)
def test_a_bus_that_is_away_now_and_then_is_so_at_the_end_of_each_window(name: str) -> None:
    for round_ in range(4):
        begin = 0.25 * round_
        for into in (0.0, 0.10, 0.21, 0.24):
            assert gap_after(BY_NAME[name].deeds, begin + into) == pytest.approx((begin + 0.20, begin + 0.25))


def test_all_others_have_no_gaps() -> None:
    for name, case in BY_NAME.items():
        if name not in NOW_AND_THEN:
            assert gap_after(case.deeds, 0.24) == (math.inf, math.inf), name
