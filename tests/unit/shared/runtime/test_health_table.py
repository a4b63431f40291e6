"""The health table: bounded for any names, and separate names for each role."""

import numpy as np

from sextant.services.console.web import view
from sextant.shared.recording.event_log import EventLog
from sextant.shared.runtime.health_table import FORGOTTEN_NS, MOST_SERVICES, HealthTable
from sextant.shared.runtime.service import Inbox, Stages
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import MAX_ITEMS, MAX_TEXT, Health

SEC = 1_000_000_000


def health(service: str, doing: str = "well", refusal: str = "") -> Health:
    nothing = np.zeros(0)
    return Health(1, service, doing, 0, 0, 0, refusal, (), nothing, nothing)


def test_many_names_of_one_role_displace_no_known_service() -> None:
    table = HealthTable()
    for role, name in (("robot", "actuator"), ("base", "planner"), ("console", "console")):
        table.add(role, health(name), 0)
    for number in range(20_000):
        table.add("console", health(f"{number}" + "x" * 900), SEC)
    table.add("console", health("console", "still there"), 2 * SEC)
    named = table.named()
    assert len(named) == 2 + MOST_SERVICES
    assert {"actuator", "planner (base)", "console (console)"} <= named.keys()
    assert named["console (console)"][0].status == "still there"
    assert max(map(len, named)) < 100


def test_service_of_other_role_is_shown_with_role() -> None:
    table = HealthTable()
    table.add("robot", health("actuator", "holds"), 0)
    table.add("console", health("actuator", "a claim"), SEC)
    assert table.named()["actuator"][0].status == "holds"
    assert table.named()["actuator (console)"][0].status == "a claim"


def test_long_silent_service_is_removed() -> None:
    table, at_ns = HealthTable(), 0
    for number in range(MOST_SERVICES):
        table.add("base", health(f"{number}"), at_ns)
    table.add("base", health("planner"), SEC)
    assert "planner (base)" not in table.named()
    table.forget(FORGOTTEN_NS + 1)
    table.add("base", health("planner"), FORGOTTEN_NS + 1)
    assert list(table.named()) == ["planner (base)"]


def test_role_is_present_while_its_health_arrives() -> None:
    table = HealthTable()
    table.add("viewer", health("router of viewer"), 0)
    assert table.roles(4 * SEC) == {"viewer"}
    assert table.roles(6 * SEC) == set()


def test_health_is_read_from_keys_of_all_roles() -> None:
    inbox = Inbox(tuple(topics.HEALTH_OF.values()), Stages())
    for role, topic in topics.HEALTH_OF.items():
        inbox.receive(topic, codec.encode(health(f"one of {role}")), 0)
    table = HealthTable()
    table.drain(inbox, 0)
    assert {name.partition(" (")[0] for name in table.named()} == {f"one of {role}" for role in topics.ROLE_NAMES}


def test_page_and_log_bound_largest_health() -> None:
    stages = tuple(f"{number}" * 200 for number in range(MAX_ITEMS))
    times = np.full(MAX_ITEMS, 1e308)
    large = Health(1, "x" * MAX_TEXT, "y" * MAX_TEXT, 1, 1, 1, "z" * MAX_TEXT, stages, times, times)
    table, event_log = HealthTable(), EventLog()
    table.add("console", large, 0)
    assert len(view.text(view.health(table.named(), 0))) < 40_000
    for number in range(2_000):
        table.add("console", health(f"{number % 50}", refusal=f"refused {number}"), number)
        event_log.services(number, table.named())
    table.forget(FORGOTTEN_NS + 3_000)
    event_log.services(FORGOTTEN_NS + 3_000, table.named())
    assert event_log._refusals == {}
    assert event_log._silent == set()
