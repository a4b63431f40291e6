"""Rate control: the data rate follows the link's capacity before scans are late."""

from collections import deque

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.perception.rate_control import RateControl

MS, SEC = 1_000_000, 1_000_000_000
FRAME_NS = 66_666_667
FULL = 56_000  # [bytes] of a full scan
BUFFER = 100_000  # [bytes] queued for the link at most; further scans are dropped


class Link:
    """A queue in front of a slow link, and a mapper that sends receipts at once.

    At most one scan is sent per 1/15 s.
    """

    def __init__(self, bytes_per_s: float, delay_ns: int = 20 * MS):
        self.care, self.rate, self.delay_ns = RateControl(), bytes_per_s, delay_ns
        self.now_ns, self.free_ns = SEC, 0.0
        self.arrive: deque[tuple[float, int]] = deque()  # times at which receipts return, and their scans
        self.latencies_ms: list[float] = []
        self.sent = 0
        self.cut = False

    def run(self, seconds: float) -> None:
        self.latencies_ms, self.sent = [], 0
        for _ in range(round(seconds * 15)):
            self.now_ns += FRAME_NS
            while self.arrive and self.arrive[0][0] <= self.now_ns:
                self.care.record_receipt(self.arrive.popleft()[1], self.now_ns)
            self.care.check_overdue(self.now_ns)
            if self.care.should_send():
                self.care.sent(self.now_ns, self.now_ns)
                self.sent += 1
                if not self.cut and (self.free_ns - self.now_ns) * 1e-9 * self.rate < BUFFER:
                    size = FULL * self.care.budget.points
                    self.free_ns = max(self.free_ns, self.now_ns) + 1e9 * size / self.rate
                    self.latencies_ms.append((self.free_ns + self.delay_ns - self.now_ns) * 1e-6)
                    self.arrive.append((self.free_ns + 2 * self.delay_ns, self.now_ns))


def test_fast_link_carries_all_scans() -> None:
    link = Link(20e6 / 8)
    link.run(20.0)
    assert link.sent == 300
    assert link.care.share == 1.0
    assert max(link.latencies_ms) < 60.0


@pytest.mark.parametrize("mbit", [0.8, 1.0, 2.0, 4.0])
def test_slow_link_is_used_without_queueing_delay(mbit: float) -> None:
    link = Link(mbit * 1e6 / 8)
    link.run(10.0)
    link.run(30.0)
    own_ms = FULL * 0.25 / link.rate * 1e3  # [ms] that the smallest scan takes on this link
    assert np.percentile(link.latencies_ms, 95) < 200.0 + 2.0 * own_ms
    assert link.sent / 30.0 >= 4.0, "a fresh map needs that"
    used = link.care.share * FULL * 15 / link.rate
    assert 0.4 < used < 1.5


def test_rate_rises_when_link_capacity_grows() -> None:
    link = Link(1e6 / 8)
    link.run(20.0)
    assert link.care.share < 0.3
    link.rate = 20e6 / 8
    link.run(30.0)
    assert link.care.share == 1.0


def test_link_outage_does_not_reduce_rate_afterwards() -> None:
    link = Link(20e6 / 8)
    link.run(5.0)
    link.cut = True
    link.run(10.0)
    link.cut = False
    link.run(5.0)
    assert max(link.latencies_ms) < 60.0
    link.run(5.0)
    assert link.care.share == 1.0


def test_occasional_mapper_delay_does_not_reduce_rate() -> None:
    care, now_ns = RateControl(), 0
    for k in range(300):
        now_ns += FRAME_NS
        care.check_overdue(now_ns)
        care.sent(now_ns, now_ns)
        care.record_receipt(now_ns, now_ns + (180 if k % 5 in (3, 4) else 10) * MS)
    assert care.share == 1.0


def test_full_rate_is_sent_without_receipts() -> None:
    care = RateControl()
    for k in range(200):
        care.check_overdue(k * FRAME_NS)
        assert care.should_send()
        care.sent(k, k * FRAME_NS)
    care.record_receipt(-5, SEC)  # of a scan that was never sent
    assert care.share == 1.0


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 2000)), max_size=200))
def test_budget_stays_within_limits_for_any_receipts(words: list[tuple[bool, int]]) -> None:
    care, now_ns = RateControl(), 0
    for answered, wait_ms in words:
        now_ns += wait_ms * MS
        care.check_overdue(now_ns)
        care.sent(now_ns, now_ns)
        if answered:
            care.record_receipt(now_ns, now_ns + wait_ms * MS)
        allowed = care.budget
        assert 0.067 <= care.share <= 1.0
        assert 4.0 / 15.0 <= allowed.scans <= 1.0
        assert 0.25 <= allowed.points <= 1.0
        assert allowed.scans * allowed.points == pytest.approx(care.share, abs=0.002)
