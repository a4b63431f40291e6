"""The radio of lockstep: arrival times and losses of messages."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.evaluation.lockstep.simulated_radio import Radio
from sextant.shared.scenario.scenario import Link
from sextant.shared.wire import topics

MS = 1_000_000


def test_only_robot_to_base_messages_use_radio() -> None:
    radio = Radio(Link(delay_ms=20.0), 0)
    assert radio.crosses("perception", "mapper")
    assert radio.crosses("planner", "actuator")
    assert not radio.crosses("mapper", "planner")
    assert not radio.crosses("actuator", "perception")


def test_arrival_time_includes_delay_and_message_length() -> None:
    radio = Radio(Link(delay_ms=20.0, mbit=20.0), 0)
    alone = radio.arrival_ns(topics.SCAN, "perception", 50_000, 0)
    assert alone == pytest.approx(20 * MS + 50_080 * 8 / 20e6 * 1e9, abs=1)
    command = radio.arrival_ns(topics.STEP_PLAN, "planner", 400, 0)
    assert command is not None
    assert command < 21.5 * MS, "it goes between the packets of the scan"


def test_link_without_rate_limit_only_delays() -> None:
    radio = Radio(Link(delay_ms=5.0), 0)
    assert [radio.arrival_ns(topics.SCAN, "perception", 10**6, t * MS) for t in range(5)] == [(t + 5) * MS for t in range(5)]


def test_bulk_messages_beyond_capacity_are_dropped() -> None:
    radio = Radio(Link(delay_ms=20.0, mbit=2.0), 0)
    came = [radio.arrival_ns(topics.SCAN, "perception", 50_000, k * 66 * MS) for k in range(150)]
    taken = [(k, at) for k, at in enumerate(came) if at is not None]
    assert 2e6 / 8 * 10 / 50_000 * 0.9 < len(taken) < 2e6 / 8 * 10 / 50_000 * 1.1 + 4, "the number that the rate allows"
    assert max(at - k * 66 * MS for k, at in taken) < 900 * MS


@given(
    st.lists(st.tuples(st.booleans(), st.integers(10, 60_000), st.integers(0, 100)), min_size=1, max_size=100),
    st.floats(0.0, 0.5),
)
def test_lane_preserves_order_and_minimum_delay(words: list[tuple[bool, int, int]], loss: float) -> None:
    radio, now_ns = Radio(Link(20.0, 20.0, loss), 3), 0
    newest = {True: 0, False: 0}
    for bulk, size, wait_ms in words:
        now_ns += wait_ms * MS
        at = radio.arrival_ns(topics.SCAN if bulk else topics.ODOMETRY, "perception", size, now_ns)
        if at is not None:
            assert at >= now_ns + 20 * MS
            assert at >= newest[bulk]
            newest[bulk] = at


def test_lost_packets_are_delayed_at_given_rate() -> None:
    radio = Radio(Link(delay_ms=20.0, loss=0.05), 1)
    late = [radio.arrival_ns(topics.ODOMETRY, "actuator", 300, t * 1000 * MS) for t in range(4000)]
    took = np.array([0 if at is None else at - t * 1000 * MS for t, at in enumerate(late)])
    assert np.mean(took > 200 * MS) == pytest.approx(0.05, abs=0.012)
    again = Radio(Link(delay_ms=20.0, loss=0.05), 1)
    assert late[:50] == [again.arrival_ns(topics.ODOMETRY, "actuator", 300, t * 1000 * MS) for t in range(50)]
