"""Ages of inputs, and the conditions under which the computer is too slow."""

import numpy as np
import pytest

from sextant.shared.runtime.lateness import BEAT, STALL, InputAge, InputAges, SlowComputer, ages_of
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Health

MS = 1_000_000
S = 1000 * MS
TERRAIN, POSE, SCAN = topics.TERRAIN.key, topics.BODY_POSE.key, topics.SCAN.key
NOTHING = np.zeros(0)


def health(service: str, *ages: InputAge) -> Health:
    columns = [
        np.array([getattr(age, name) for age in ages], dtype=np.float64) for name in ("age_s", "arrived_s", "limit_s", "late")
    ]
    names = tuple(age.what for age in ages)
    return Health(0, service, "at work", 1, 0, 0, "", (), NOTHING, NOTHING, 0.0, names, *columns)


def maps(age_s: float = 1.6, arrived_s: float = 1.2, late: float = 0.5) -> InputAge:
    return InputAge(TERRAIN, age_s, arrived_s, 0.8, late)


def after(computer: SlowComputer, *reports: Health, seconds: float = 1.0) -> str:
    """Return the warning after consecutive reports."""
    for k, report in enumerate(reports):
        computer.update({report.service: (report, round(k * seconds * S))})
    return computer.words(round((len(reports) - 1) * seconds * S))


def test_worst_age_of_each_input_is_reported_once() -> None:
    ages = InputAges({TERRAIN: 0.8, POSE: 0.4})
    ages.note(TERRAIN, 300 * MS, 100 * MS)
    ages.note(TERRAIN, 1600 * MS, 1200 * MS)
    ages.note(TERRAIN, 400 * MS, 1300 * MS)
    ages.note(SCAN, 9 * S)  # without a limit
    assert ages.report() == (InputAge(TERRAIN, 1.6, 1.3, 0.8, 1 / 3),)
    assert ages.report() == ()


def test_remaining_time_counts_inputs_of_one_step() -> None:
    ages = InputAges({TERRAIN: 0.8, POSE: 0.4, BEAT: 0.2})
    assert ages.left_ns() is None
    ages.note(TERRAIN, 400 * MS)
    ages.note(BEAT, 190 * MS)
    assert ages.left_ns() == pytest.approx(80 * MS)
    ages.note(POSE, 200 * MS)
    assert ages.left_ns() == pytest.approx(40 * MS)
    ages.forget_uses()
    assert ages.left_ns() is None
    legs = InputAges({topics.ACTUATOR_STATE.key: 0.45})
    legs.note(topics.ACTUATOR_STATE.key, 20 * MS)
    assert legs.left_ns() == pytest.approx(80 * MS), "legs do not wait that time for a plan"


def test_maps_stale_on_arrival_are_attributed_to_computer() -> None:
    report = health("planner", maps())
    assert after(SlowComputer(), report, report) == "this computer is too slow: maps are 1.6 s old, 0.8 s allowed"


def test_link_and_lockstep_are_distinguished_from_computer() -> None:
    report = health("planner", maps())
    said = "the link between the machines is too slow: maps are 1.6 s old, 0.8 s allowed"
    assert after(SlowComputer(real_time=False, linked=True), report, report) == said
    assert after(SlowComputer(linked=True), report, report) == f"this computer or {said}"
    assert after(SlowComputer(real_time=False), report, report) == "", "no computer is too slow for simulated time"
    named = SlowComputer(computer="the robot's computer")
    assert after(named, report, report).startswith("the robot's computer is too slow: maps")
    named.linked = True
    assert named.words(S).startswith("the robot's computer or the link between the machines is too slow: maps")


@pytest.mark.parametrize(
    "reports",
    [
        (health("planner", maps()),),  # only once: a service restarted
        (health("planner", maps(arrived_s=0.2)),) * 5,  # they were new when they arrived: their publisher has stopped
        (health("planner", maps(late=0.05)),) * 5,  # only occasionally
        (health("planner", InputAge("any/thing", 9.0, 9.0, 0.1, 1.0)),) * 5,  # no input of any service
        (health("planner", InputAge(TERRAIN, 9.0, 9.0, 0.0, 1.0)),) * 5,
        (health("planner", InputAge(TERRAIN, 1e300, 9.0, 0.8, 1.0)),) * 5,  # no clock measures such an age
        (health("planner", InputAge(TERRAIN, 9.0, 9.0, 0.8, 7.0)),) * 5,
    ],
)
def test_other_causes_are_not_reported_as_slow_computer(reports: tuple[Health, ...]) -> None:
    assert after(SlowComputer(), *reports) == ""


def test_late_cycle_is_reported_after_inputs() -> None:
    report = health("planner", InputAge(BEAT, 2.0, 2.0, 0.2, 0.5), maps(arrived_s=0.1))
    words = after(SlowComputer(), report, report)
    assert words == "this computer is too slow: maps are 1.6 s old, 0.8 s allowed; the planner cycle takes 2.0 s, 0.2 s allowed"


def test_stalled_process_is_attributed_to_computer() -> None:
    report = health("mapper", InputAge(STALL, 1.5, 1.5, 0.5, 0.2))
    words = "this computer is too slow: the mapper process did not run for 1.5 s, 0.5 s allowed"
    assert after(SlowComputer(), report, report) == words


def test_two_worst_inputs_are_named_in_processing_order() -> None:
    scans, poses = InputAge(SCAN, 3.0, 3.0, 0.6, 0.5), InputAge(POSE, 0.5, 0.5, 0.4, 0.5)
    words = "this computer is too slow: maps are 1.6 s old, 0.8 s allowed; scans are 3.0 s old, 0.6 s allowed"
    computer = SlowComputer()
    report = health("planner", poses, scans, maps())
    assert after(computer, report, report) == words
    assert computer.severity == (True, pytest.approx(5.0))


def test_report_ends_seconds_after_last_late_input() -> None:
    computer, report = SlowComputer(), health("planner", maps())
    assert after(computer, report, report)
    assert computer.words(4 * S)
    assert computer.words(7 * S) == ""


def test_repeated_health_report_is_counted_once() -> None:
    computer, report = SlowComputer(), health("planner", maps())
    assert computer.update({"planner": (report, 0)}) == [("planner", report)]
    for _ in range(5):
        assert computer.update({"planner": (report, 0)}) == []
    assert computer.words(0) == ""
    assert ages_of(report) == (maps(),)
