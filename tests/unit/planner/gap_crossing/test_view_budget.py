"""View budget: the number of views at one stop, and what each must reveal."""

from dataclasses import replace

import numpy as np

from sextant.services.planner.gap_crossing.view_budget import ViewBudget
from sextant.shared.wire.messages import PassageMap

NOTHING = np.zeros((20, 20), dtype=np.float32)
MAP = PassageMap(
    0, 0.01, np.zeros(2), 0.0, NOTHING, np.zeros((20, 20, 3), np.int16), NOTHING, NOTHING > 0, NOTHING.astype(np.int8), 0.1, "",
    np.eye(4), NOTHING > 0,
)  # fmt: skip


def revealing(cells: int) -> PassageMap:
    return replace(MAP, next_view_cells=(np.arange(400) < cells).reshape(20, 20))


def test_view_must_reveal_enough() -> None:
    views = ViewBudget()
    assert views.allows(revealing(60))
    assert not views.allows(revealing(59))


def test_less_is_accepted_once_at_one_stop() -> None:
    views = ViewBudget()
    assert views.accept_less()
    assert views.allows(revealing(20))
    assert not views.accept_less()
    views.renew()
    assert not views.allows(revealing(20))


def test_views_at_one_stop_are_limited() -> None:
    views = ViewBudget()
    for _ in range(3):
        assert views.allows(revealing(400))
        views.spend()
    assert not views.allows(revealing(400))
    assert not views.accept_less()
    views.renew()
    assert views.allows(revealing(400))


def test_exhausted_budget_allows_no_view() -> None:
    views = ViewBudget()
    views.exhaust()
    assert not views.allows(revealing(400))
