"""The line that says that the robot is ready, and those that name what is missing."""

from sextant.deploy.live.readiness import Readiness, next_steps


def test_ready_is_announced_once_when_every_service_has_reported() -> None:
    readiness = Readiness(["actuator", "mapper"], "robot", "next")
    assert [*readiness.lines((), 100.0)] == []
    assert [*readiness.lines(("actuator",), 102.0)] == []
    assert [*readiness.lines(("actuator", "mapper", "client"), 105.2)] == ["ready after 5 s: next"]
    assert [*readiness.lines((), 200.0)] == []


def test_missing_services_are_named_after_ten_seconds_and_rarely_again() -> None:
    readiness = Readiness(["actuator", "mapper", "planner"], "robot", "next")
    said = {second: [*readiness.lines(("actuator",), float(second))] for second in range(300)}
    assert [second for second, lines in said.items() if lines] == [10, 30, 90, 270]
    assert said[10][0].startswith("not ready after 10 s: no health message of mapper, planner yet; the first start compiles")
    assert said[270][0].endswith("`sextant doctor` checks what they need")


def test_services_of_a_base_report_under_its_role() -> None:
    readiness = Readiness(["mapper"], "base", "next")
    assert [*readiness.lines(("mapper",), 0.0)] == [], "another machine's mapper"
    assert [*readiness.lines(("mapper (base)",), 1.0)] == ["ready after 1 s: next"]


def test_next_steps_are_page_order_and_client() -> None:
    usual = next_steps(["actuator", "console"], True, "http://127.0.0.1:8080/", "tcp/127.0.0.1:7447", "sextant", "")
    assert usual == (
        "the simulated robot takes commands: hold the pad or click a goal on http://127.0.0.1:8080/, or `sextant order stand`, "
        'or sextant.Client("tcp/127.0.0.1:7447") in Python (docs/api.md)'
    )
    other = next_steps(["actuator"], False, "", "tcp/127.0.0.1:1", "alpha", "--connect tcp/127.0.0.1:1 --namespace alpha")
    assert other == (
        "the robot takes commands: `sextant order stand --connect tcp/127.0.0.1:1 --namespace alpha`, or "
        'sextant.Client("tcp/127.0.0.1:1", namespace="alpha") in Python (docs/api.md)'
    )


def test_base_station_names_its_services() -> None:
    words = next_steps(["mapper", "console"], False, "http://127.0.0.1:8080/", "tcp/127.0.0.1:1", "sextant", "")
    assert words == "mapper, console run; the operator's page is http://127.0.0.1:8080/"
