"""Yielded ground: places where feet found nothing carry no foot again."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.planner.gap_crossing.yielded_ground import YieldedGround
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.robot.profile import LEGS
from sextant.shared.robot.profiles import load_profile
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
FIELD = StripMap(
    np.zeros((100, 100), dtype=np.float32),
    np.full((100, 100), -9, dtype=np.int8),
    0.01,
    from_xyz_rpy((1.0, 0.0, 0.0), np.zeros(3)),
)
FEET = np.column_stack([np.linspace(0.1, 0.9, 6), np.zeros(6), np.full(6, PROFILE.foot.radius)])  # {strip}
STATE = actuator_state(PROFILE)


def ground(*places: Array) -> YieldedGround:
    return YieldedGround(list(places), PROFILE.foot.radius)


def evaluation_at(field: StripMap, x: float, y: float = 0.0) -> int:
    i, j = np.rint((np.array([x, y]) - field.first_cell) / field.resolution).astype(int)
    return int(field.evaluation[i, j])


def missing(leg: int, place: Array, at_ns: int) -> dict[str, Array]:
    touch, touch_ns = np.zeros((6, 3)), np.full(6, -1, dtype=np.int64)
    touch[leg], touch_ns[leg] = place, at_ns
    return {"touchdown_point": touch, "touchdown_ns": touch_ns, "touchdown_contact": np.zeros(6, dtype=np.bool_)}


def test_ground_that_carries_is_unchanged() -> None:
    assert ground().excluded_from(FIELD, FEET) is FIELD


def test_foot_without_ground_excludes_its_place() -> None:
    yielded = ground()
    yielded.record(STATE)
    yielded.record(replace(STATE, **missing(4, np.array([1.5, 0.2, -0.05]), 5)))
    assert yielded.reason == f"no ground under the {LEGS[4]} foot"
    (place,) = yielded.in_strip(FIELD)
    np.testing.assert_allclose(place, (0.5, 0.2, -0.05))
    field = yielded.excluded_from(FIELD, FEET)
    assert evaluation_at(field, 0.5, 0.2) > 0
    assert evaluation_at(field, 0.5, 0.3) < 0


def test_touches_before_the_crossing_do_not_count() -> None:
    yielded = ground()
    yielded.record(replace(STATE, **missing(4, np.array([1.5, 0.2, -0.05]), 5)))
    assert yielded.reason == ""
    assert yielded.in_strip(FIELD) == []


@pytest.mark.parametrize(("depth", "gave_way"), [(0.005, False), (0.02, True)])
def test_ground_mapped_above_a_standing_foot_has_given_way(depth: float, gave_way: bool) -> None:
    places: list[Array] = []
    yielded = YieldedGround(places, PROFILE.foot.radius)
    field = yielded.excluded_from(FIELD, FEET - [0.0, 0.0, depth] * (np.arange(6) == 2)[:, None])
    assert (evaluation_at(field, float(FEET[2, 0])) > 0) is gave_way
    assert len(places) == gave_way, "the place is kept for later crossings"
