"""Results that are kept as JSON: read again they give the same table, and what does not fit is refused."""

import json
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from benchmarks.access import access
from benchmarks.peers import kept, servo_packets
from benchmarks.peers.timing import Spread
from benchmarks.robot import (
    actuator_cycle,
    calibration,
    checksums,
    naming,
    recording,
    servo_bus,
    size,
    slow_core,
    spoilt_answers,
    start,
)
from sextant.shared.files.config import ConfigError

SPREAD = Spread(1.5, 1.4, 1.75)
RESULTS: dict[str, tuple[Any, Any]] = {
    "access": (access, (access.Row("no certificate", 20, 0, "refused within 3 ms: asks | for one"), access.Row("flood", 9, 1))),
    "calibration": (
        calibration,
        [
            calibration.Calibration("flat+harsh", 7, "", {"yaw_deg": -0.25, "x": 0.002}, {"yaw_deg": 0.2, "x": 0.0005}, 6),
            calibration.Calibration("flat+harsh", 8, "one slope | is another", {}, {}, 0),
        ],
    ),
    "checksums": (
        checksums,
        [spoilt_answers.Found("AX-12A", way, 100, 25, 2, odds, odds, 90) for way, odds in (("a", 0.5), ("b", None))],
    ),
    "cycle": (
        actuator_cycle,
        [actuator_cycle.CycleTime(kind, 60, 1.1, 1.6, 1.2, 0.06, 8.5) for kind in ("standing", "walking")],
    ),
    "naming": (
        naming,
        [
            naming.Walk("none", "steps", 1, 20, "", ()),
            naming.Walk("pitch", "steps", 1, 20, "looks lower", ("leans",), 8),
            naming.Walk("pitch", "steps", 2, 20, "looks higher", (), 12),
        ],
    ),
    "recording": (recording, [recording.Summary(what, 3, 20.0, 23.0, 31.5, (0.4,), 1, ()) for what in ("nobody", "recording")]),
    "servo bus": (
        servo_bus,
        [servo_bus.Found("nothing", 50, 1, 2, 47, 3, 1.25, 0.5, age, 1, 7, {"timeout": 1}) for age in (56.4, None)],
    ),
    "servos": (
        servo_packets,
        servo_packets.Comparison(
            (
                servo_packets.Row("cycle", "sextant", SPREAD, SPREAD, 1, 60),
                servo_packets.Row("no answer", "sextant", SPREAD, SPREAD, 0, 0),
            ),
            ("dynamixel-sdk: not installed",),
        ),
    ),
    "size": (
        size,
        [size.Role("actuator", {"numpy": 61.25, "sextant": 4.0}, ("pyserial",)), size.Role("planner", {"a": 1.0}, ())],
    ),
    "slow core": (slow_core, slow_core.SlowWalk(0.2, False, "it fell", 20.0, 21.3, 2, 0.125)),
    "start": (start, [start.Start(401.5, 600.25, 610.0, mode, "no answer", 0.5) for mode in ("hold", "fault")]),
}


@pytest.mark.parametrize("name", RESULTS)
def test_results_read_again_are_the_same(name: str) -> None:
    bench, found = RESULTS[name]
    text = bench.to_json(found)
    again = bench.from_json(text)
    assert again == found
    assert bench.in_words(again) == bench.in_words(found)
    assert set(json.loads(text)["machine"]) >= {"processor", "cores", "python", "load"}


@pytest.mark.parametrize("name", RESULTS)
def test_results_are_a_table_in_markdown(name: str) -> None:
    bench, found = RESULTS[name]
    rows = [line for line in bench.in_words(found).splitlines() if line.startswith("|")]
    assert rows[1].replace("-", "").replace("|", "") == ""
    assert len({len(row.replace("\\|", "").split("|")) for row in rows}) == 1, "each row has a cell for each heading"


READ: Sequence[tuple[Callable[[str], object], str, str]] = (
    (start.from_json, '{"rows": []}', r"rows: a list of rows expected, found \[\]"),
    (start.from_json, "[]", "a table expected, found list"),
    (start.from_json, "{", "JSON expected"),
    (
        start.from_json,
        '{"rows": [{"asked_ms": "soon"}]}',
        "row 0:\n  - asked_ms: a number expected, found 'soon'",
    ),
    (slow_core.from_json, '{"share": 0.2, "cores": NaN}', "finite numbers"),
    (size.from_json, '{"rows": [{"name": "a", "packages_mb": {"numpy": true}, "missing": []}]}', "packages_mb.numpy: a number"),
)


@pytest.mark.parametrize(("read", "text", "words"), READ)
def test_what_does_not_fit_is_refused(read: Callable[[str], object], text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        read(text)


def test_origin_names_machine_and_load() -> None:
    text = slow_core.to_json(slow_core.SlowWalk(0.2, True, "", 20.0, 21.3, 2, 0.125))
    about = json.loads(text)["machine"]
    assert kept.origin(text) == (
        f"on {about['processor']}, {about['cores']} cores, Python {about['python']}, at a load of {about['load']}"
    )
    assert kept.origin('{"machine": {"processor": "x"}}') == kept.origin("[]") == ""
