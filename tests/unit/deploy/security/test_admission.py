"""Limits of connections without a verified certificate.

They are the limit of each address, and the choice of the connection that makes room.
"""

import math

from hypothesis import given
from hypothesis import strategies as st

from sextant.deploy.security.admission import HandshakeLimit, Limits, Pending, source_of

LIMITS = Limits(handshakes_hz=10.0, handshakes_burst=5, pending=8, timeout_s=2.0, addresses=16)


def test_ipv6_source_is_its_network_and_mapped_address_is_ipv4() -> None:
    assert source_of("fe80::1%eth0") == source_of("fe80::2") != source_of("fe80:0:0:1::1")
    assert source_of("::ffff:10.0.0.7") == source_of("10.0.0.7") == "10.0.0.7"


@given(st.lists(st.floats(0.0, 0.5), min_size=1, max_size=200))
def test_handshakes_of_address_stay_within_rate_and_burst(waits_s: list[float]) -> None:
    limit, now_s, allowed = HandshakeLimit(LIMITS), 0.0, 0
    for wait_s in waits_s:
        now_s += wait_s
        allowed += limit.allows("10.0.0.1", now_s)
        assert allowed <= LIMITS.handshakes_burst + LIMITS.handshakes_hz * now_s + 1e-6


def test_addresses_are_limited_separately_and_verified_one_is_exempt() -> None:
    limit = HandshakeLimit(LIMITS)
    assert [limit.allows("a", 0.0) for _ in range(6)] == [True] * 5 + [False]
    assert limit.allows("b", 0.0)
    assert limit.allows("a", 0.1), "a tenth of a second later it has one more"
    limit.verify("a")
    assert all(limit.allows("a", 0.1) for _ in range(100))


def test_number_of_stored_addresses_is_bounded() -> None:
    limit = HandshakeLimit(LIMITS)
    for number in range(1000):
        limit.allows(f"stranger {number}", 0.0)
        limit.verify(f"verified {number}")
    assert len(limit._buckets) == len(limit._verified) == LIMITS.addresses


def test_oldest_silent_connection_of_busiest_address_is_dropped() -> None:
    pending = Pending[str](LIMITS)
    for number in range(6):
        assert pending.add(f"stranger {number}", "crowded", 0.0) is None
    assert pending.add("rightful", "other", 0.0) is None
    assert pending.add("rightful too", "other", 0.0) is None
    pending.speaks("stranger 0")
    assert pending.add("new", "third", 0.1) == "stranger 1"
    for number in range(2, 6):
        pending.speaks(f"stranger {number}")
    assert pending.add("newer", "third", 0.1) == "stranger 0", "where all have spoken, the oldest"
    assert len(pending) == LIMITS.pending


def test_overdue_connections_are_returned_once_in_order() -> None:
    pending = Pending[int](LIMITS)
    for number in range(4):
        pending.add(number, "a", float(number))
    pending.remove(0)
    pending.remove(0)
    assert pending.overdue(2.9) == []
    assert pending.overdue(4.0) == [1, 2]
    assert pending.overdue(math.inf) == [3]
    assert len(pending) == 0
    assert not pending._of
    assert not pending._silent


@given(st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from(["add", "speaks", "remove", "overdue"])), max_size=100))
def test_number_of_pending_connections_is_bounded(steps: list[tuple[str, str]]) -> None:
    pending, known, now_s = Pending[int](LIMITS), list[int](), 0.0
    for number, (source, what) in enumerate(steps):
        now_s += 0.1
        if what == "add":
            dropped = pending.add(number, source, now_s)
            known = [one for one in (*known, number) if one != dropped]
        elif what == "overdue":
            gone = pending.overdue(now_s)
            known = [one for one in known if one not in gone]
        elif known and what == "speaks":
            pending.speaks(known[len(known) // 2])
        elif known:
            pending.remove(known.pop(0))
        assert len(pending) == len(known) <= LIMITS.pending
