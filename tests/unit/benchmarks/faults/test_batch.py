"""Batches of synthetic injections: none runs twice, and the table contains all."""

import json
from dataclasses import replace
from math import nan
from pathlib import Path

import pytest

from benchmarks.faults import table as tables
from benchmarks.faults.batch import FILE, Injection, read, run_faults
from benchmarks.faults.cases import BY_NAME, CAMERA_CASES, CASES, LIVE_CASES
from benchmarks.faults.walk_verdict import score
from sextant.evaluation import provenance
from sextant.evaluation.trials import results_store
from tests.support.timelines import PROFILE, timeline

KILLED, SAG, OFF = (BY_NAME[name] for name in ("planner-killed", "sag", "off-lost-10"))
CALM = replace(score(timeline(), SAG, PROFILE), margin_m=0.03)
GOOD = replace(CALM, decided_s=0.22, named=True, rest_s=0.6, again_s=0.4, stops=1)


class Runner:
    def __init__(self) -> None:
        self.asked: list[tuple[str, tuple[int, ...]]] = []

    def __call__(self, name: str, numbers: tuple[int, ...], robot: str) -> list[Injection]:
        self.asked.append((name, numbers))
        outcome = CALM if name == "sag" else GOOD
        return [Injection(name, number, 1000, 5.0 + number, 0.5, -1, outcome) for number in numbers]


def test_interrupted_batch_resumes(tmp_path: Path) -> None:
    first, second = Runner(), Runner()
    found = run_faults([KILLED, SAG], 8, 1, tmp_path, run=first)
    assert [(one.fault, one.number) for one in found] == [(name, k) for name in ("planner-killed", "sag") for k in range(8)]
    assert first.asked[:2] == [("planner-killed", tuple(range(6))), ("planner-killed", (6, 7))]
    path = tmp_path / FILE
    path.write_bytes(path.read_bytes()[:-20])
    again = run_faults([KILLED, SAG], 8, 1, tmp_path, run=second)
    assert second.asked == [("sag", (6, 7))]
    assert [one.outcome.decided_s for one in again[:8]] == [0.22] * 8
    assert again[8].outcome.decided_s != again[8].outcome.decided_s, "NaN comes back as it went"
    assert {one.commit for one in again} == {provenance.commit()}


def test_lines_of_other_program_are_skipped_and_invalid_ones_raise(tmp_path: Path) -> None:
    run_faults([SAG], 1, 1, tmp_path, run=Runner())
    path = tmp_path / FILE
    mark = json.loads(path.read_text())["fingerprint"]
    assert len(list(read(path, mark))) == 1
    assert not list(read(path, "another"))
    path.write_text(path.read_text() + "{}\n")
    with pytest.raises(results_store.ResultsError, match="line 2"):
        list(read(path, mark))


def test_row_passes_only_if_each_injection_keeps_all_limits() -> None:
    assert tables.row(KILLED, [GOOD] * 3).passed
    wrongs = (
        replace(GOOD, decided_s=0.29),
        replace(GOOD, decided_s=nan),
        replace(GOOD, rest_s=0.71),
        replace(GOOD, margin_m=0.009),
        replace(GOOD, again_s=2.1),
        replace(GOOD, falls=1),
        replace(GOOD, switched=True),
        replace(GOOD, outside=1),
        replace(GOOD, named=False),
        replace(GOOD, stuck="a walk within 20 s expected"),
    )
    for wrong in wrongs:
        row = tables.row(KILLED, [GOOD, wrong, GOOD])
        assert not row.passed
        assert len(row.missed) == 1
        assert "1 of 3" in row.missed[0]


def test_limits_of_uninterrupted_walk_and_torque_off() -> None:
    assert tables.row(SAG, [CALM]).passed
    assert not tables.row(SAG, [replace(CALM, stops=1)]).passed
    let_go = replace(CALM, off_s=0.05, switched=True, stops=1)
    assert tables.row(OFF, [let_go]).passed
    for wrong in (replace(let_go, off_s=0.07), replace(let_go, on_again=True), replace(let_go, goals_before_off=1)):
        assert not tables.row(OFF, [wrong]).passed


def test_recording_loss_above_one_second_fails() -> None:
    killed = BY_NAME["live-recorder-killed"]
    kept_one = tables.row(killed, [replace(CALM, lost_s=0.4)])
    assert kept_one.passed
    assert "the recording lacks 0.4 / 0.4 / 0.4 s" in tables.markdown([kept_one])
    for lost_s in (1.1, nan):
        assert tables.row(killed, [replace(CALM, lost_s=lost_s)]).missed == (
            "lost recording time at most 1 s: missed by 1 of 1",
        )
    (before,) = json.loads(tables.to_json([kept_one]))
    del before["lost_s"]
    assert tables.from_json(json.dumps([before]))[0].lost_s.n == 0, "a row of before that was measured"


def test_percentiles_are_nearest_rank_and_worst_margin_is_least() -> None:
    values = [float(k) for k in range(1, 201)]
    assert tables.figure(values) == tables.Figure(200, 100.0, 198.0, 200.0)
    assert tables.figure(values, worst_is_least=True) == tables.Figure(200, 101.0, 3.0, 1.0)
    assert tables.figure([nan, 2.0]).n == 1


def test_fault_table_shows_pass_and_fail_and_round_trips() -> None:
    made_by = ((KILLED, "bbbbbbb"), (SAG, "aaaaaaa"), (KILLED, "aaaaaaa"), (KILLED, "bbbbbbb"))
    found = [Injection(case.name, 0, 1000, 5.0, 0.5, -1, GOOD, commit) for case, commit in made_by]
    made = tables.rows(found)
    assert [row.commits for row in made] == [("aaaaaaa", "bbbbbbb"), ("aaaaaaa",)]
    text = tables.markdown(made)
    assert "| planner-killed | 3 | 220 / 220 / 220 | 600 / 600 / 600 |" in text
    assert "| pass | aaaaaaa, bbbbbbb |" in text
    assert "FAIL: walks on: missed by 1 of 1" in text
    assert "1 of 2 faults keep all limits" in text
    written = tables.to_json(made)
    assert [row["passed"] for row in json.loads(written)] == [True, False]
    again = tables.from_json(written)
    assert tables.markdown(again) == text
    assert tables.to_json(again) == written


def test_case_names_are_unique() -> None:
    assert len(BY_NAME) == len(CASES) + len(CAMERA_CASES) + len(LIVE_CASES)
    assert all(case.live for case in LIVE_CASES)
    assert not any(case.live for case in CASES)


def test_cpu_load_case_limits_cycle_time_and_missed_cycles() -> None:
    hogs = BY_NAME["live-hogs"]
    fine = replace(CALM, cycle_s=0.024, missed=2)
    assert tables.row(hogs, [fine]).passed
    assert not tables.row(hogs, [fine, replace(fine, cycle_s=0.026)]).passed
    assert not tables.row(hogs, [replace(fine, missed=5)]).passed
    assert tables.row(hogs, [replace(fine, missed=5, decided_s=0.3)]).passed
    assert "cycle p99 24.0 / 24.0 / 24.0 ms" in tables.markdown([tables.row(hogs, [fine])])


def test_camera_fault_must_end_on_its_feet_with_its_reason_and_in_its_place() -> None:
    passing, lasting = BY_NAME["camera-sun-steps"], BY_NAME["camera-sun-lasting-steps"]
    walks = replace(CALM, ended="walks", place_m=0.01)
    stands = replace(walks, ended="stands", stood=("only 0.0 % of the image is measured, 2 % needed",))
    assert tables.row(passing, [walks, replace(walks, ended="arrived")]).passed
    assert tables.row(lasting, [walks, stands]).passed
    for case, wrong in (
        (passing, stands),
        (lasting, replace(walks, ended="fell")),
        (lasting, replace(stands, unnamed="no fresh terrain map")),
        (lasting, replace(stands, place_m=0.11)),
        (passing, replace(walks, place_m=nan)),
    ):
        assert not tables.row(case, [wrong]).passed, wrong
    made = tables.row(lasting, [walks, stands, stands])
    assert "ended: stands 2, walks 1; place 10 / 10 / 10 mm" in tables.markdown([made])
    assert tables.from_json(tables.to_json([made]))[0].ended == {"stands": 2, "walks": 1}
