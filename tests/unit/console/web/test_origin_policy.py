"""The log of refused connections; the server's test covers accepted ones."""

import re
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from sextant.services.console.web.origin_policy import RejectionLog

REFUSAL = "the token is wrong"


@given(st.lists(st.integers(0, 24), max_size=60))
def test_refusals_are_logged_once_per_second_and_all_counted(waits: list[int]) -> None:
    log, now = RejectionLog(), 0.0
    said: list[tuple[float, str]] = []
    for wait in [*waits, 8]:
        now += wait / 8  # [s]
        if words := log.words(REFUSAL, now):
            said.append((now, words))
    assert said[0][1] == f"a page was refused: {REFUSAL}", "the first is reported at once"
    assert all(b - a >= 1.0 for (a, _), (b, _) in pairwise(said))
    left_out = [int(found[1]) for _, words in said if (found := re.search(r"and (\d+) more", words))]
    assert len(said) + sum(left_out) == len(waits) + 1
