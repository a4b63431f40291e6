"""The line that says that the robot is ready, and those that name what is missing."""

from sextant.deploy.live.readiness import CameraReport, Readiness, next_steps


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


def test_missing_camera_is_reported_soon_then_rarely_and_once_when_it_is_back() -> None:
    report, status = CameraReport(), {"camera": "no images: no camera at the bus; opened 3 times so far"}
    said = {second: [*report.lines(status, float(second))] for second in range(2000)}
    assert [second for second, lines in said.items() if lines] == [5, 65, 195, 585, 1755]
    assert said[5] == [
        "camera: no images: no camera at the bus; opened 3 times so far; the robot does not walk without images; "
        "`--camera none` starts without a camera"
    ]
    assert said[65] == ["camera: no images: no camera at the bus; opened 3 times so far"]
    working = {"camera": "Astra, 30 images"}
    assert [*report.lines(working, 2000.0)] == ["camera: images arrive after 2000 s"]
    assert [*report.lines(working, 2001.0)] == []


def test_camera_that_is_there_or_opens_within_seconds_is_not_reported() -> None:
    report = CameraReport()
    for second in range(4):
        assert [*report.lines({"camera": "no images: Astra has sent no image yet; opened 1 times so far"}, float(second))] == []
    assert [*report.lines({"camera": "Astra, 1 images"}, 4.0)] == []
    assert [*report.lines({"actuator": "hold: standing"}, 400.0)] == []
