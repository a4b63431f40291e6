"""Stored runs are read as they were written, and no others are."""

import contextlib
import json
import math
from dataclasses import fields, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.evaluation import report as reports
from sextant.evaluation.report import (
    CourseMap,
    FootholdEdge,
    HeightError,
    Passage,
    PoseError,
    Report,
    Section,
    Slip,
    Spread,
    Torque,
    Warned,
)
from sextant.evaluation.trials import results_store
from sextant.evaluation.trials.results_store import Run

REPORT = Report(
    "steps",
    7,
    "phantomx_mk2",
    "tripod",
    False,
    True,
    "goal reached",
    2.5,
    25.0,
    0.1,
    0,
    0,
    33,
    tilt_deg=Spread(0.25, 1.0),
    commanded_tilt_deg=Spread(1.5, 2.0),
    torque_nm=Torque(0.8, 1.4, 0.47),
    raised_block_touchdowns=12,
    body_height_error_m=HeightError(0.001, 0.002),
    body_height_oscillation_m=0.003,
    slip_m_per_step=Slip(0.0007, 0.004),
    missteps=1,
    collisions=2,
    min_stability_margin_m=0.040,
    pose_error_m=PoseError(0.01, 0.02),
    course_map_m=CourseMap(0.004, 0.0008, 0.0002, 0.0075, 0.975),
    real_time_factor=2.0,
)


COMPARED = "compared as text: what was not measured is NaN"


def _entry(report=REPORT):
    return {"fingerprint": "mark", "commit": "abc1234", "time": "2024-05-01T10:00:00+00:00", "report": reports.as_table(report)}


def test_stored_line_is_shorter_and_preserves_run(tmp_path):
    run = Run.read(_entry())
    results_store.keep(tmp_path / "campaign.jsonl", [run])
    assert repr(results_store.read(tmp_path / "campaign.jsonl")) == repr([run]), COMPARED
    assert (run.tilt_p95_deg, run.height_rms_m, run.torque_rms_nm, run.slip_p50_m) == (0.25, 0.002, 0.47, 0.0007)
    assert (run.stability_margin_m, run.final_pose_error_m, run.map_coverage, run.seed) == (0.04, 0.02, 0.975, 7)
    line = (tmp_path / "campaign.jsonl").read_text()
    assert len(line) < len(json.dumps(_entry()))


def test_line_without_passage_fields_round_trips(tmp_path):
    run = Run.read(_entry())
    results_store.keep(tmp_path / "campaign.jsonl", [run])
    line = json.loads((tmp_path / "campaign.jsonl").read_text())
    assert not {"passage", "machine"} & set(line)
    assert repr(Run.read(line)) == repr(run), COMPARED


def test_passage_and_machine_are_stored(tmp_path):
    passage = Passage(12, FootholdEdge(0.02, 0.04), 0, None, (Section("complete", "", 900, 80, 12.5, 40),))
    run = Run.read({**_entry(replace(REPORT, passage=passage)), "machine": "a fast one"})
    results_store.keep(tmp_path / "campaign.jsonl", [run])
    assert results_store.read(tmp_path / "campaign.jsonl") == [run]
    assert (run.passage, run.machine) == (passage, "a fast one")


@pytest.mark.parametrize("warnings", [(), (Warned(3.5, 4, "the camera looks 2.9 deg lower"), Warned(5.25, 6, "battery low"))])
def test_warnings_are_stored_also_if_there_are_none(tmp_path, warnings):
    run = Run.read(_entry(replace(REPORT, warnings=warnings)))
    results_store.keep(tmp_path / "campaign.jsonl", [run])
    (read,) = results_store.read(tmp_path / "campaign.jsonl")
    assert read.warnings == run.warnings == warnings


def test_line_without_warnings_does_not_record_them(tmp_path):
    entry = _entry()
    del entry["report"]["warnings"]
    run = Run.read(entry)
    results_store.keep(tmp_path / "campaign.jsonl", [run])
    (read,) = results_store.read(tmp_path / "campaign.jsonl")
    assert read.warnings is run.warnings is None


@pytest.mark.parametrize("warnings", ["none", [1], [{"time_s": 1.0, "step": 2}]])
def test_invalid_warnings_are_refused(warnings):
    entry = _entry()
    entry["report"]["warnings"] = warnings
    with pytest.raises(ValueError, match="warnings"):
        Run.read(entry)
    with pytest.raises(ValueError, match="warnings"):
        Run.read(Run.read(_entry()).line() | {"warnings": warnings})


@given(st.dictionaries(st.sampled_from([f.name for f in fields(Run) if f.type is float]), st.floats(-1e3, 1e3) | st.none()))
def test_stored_figures_round_trip(tmp_path_factory, figures):
    path = tmp_path_factory.mktemp("kept") / "campaign.jsonl"
    given_run = replace(
        Run.read(_entry()), **{name: math.nan if f is None else round(f, 6) + 0.0 for name, f in figures.items()}
    )
    results_store.keep(path, [given_run])
    assert repr(results_store.read(path)) == repr([given_run]), COMPARED


def test_truncated_last_line_is_ignored(tmp_path):
    path = tmp_path / "campaign.jsonl"
    results_store.keep(path, [Run.read(_entry())])
    path.write_text(path.read_text() + path.read_text()[:-9])
    assert len(results_store.read(path)) == 1
    results_store.keep(path, [Run.read(_entry(replace(REPORT, seed=8)))])
    assert [run.seed for run in results_store.read(path)] == [7, 8]


def test_last_line_without_newline_is_read(tmp_path):
    path = tmp_path / "campaign.jsonl"
    path.write_text(json.dumps(_entry()))
    for mark in (None, "mark"):
        assert repr(results_store.read(path, mark)) == repr([Run.read(_entry())]), COMPARED
    assert results_store.read(path, "another") == []
    results_store.keep(path, [Run.read(_entry(replace(REPORT, seed=8)))])
    assert [run.seed for run in results_store.read(path)] == [7, 8]


@given(st.lists(st.binary(max_size=40) | st.sampled_from([json.dumps(_entry()).encode(), b'{"fingerp']), max_size=4))
def test_read_never_writes_and_keep_drops_only_truncated_line(tmp_path_factory, lines):
    path = tmp_path_factory.mktemp("kept") / "any"
    before = b"\n".join(lines)
    path.write_bytes(before)
    with contextlib.suppress(results_store.ResultsError):
        results_store.read(path)
    assert path.read_bytes() == before
    try:
        results_store.keep(path, [Run.read(_entry())])
    except results_store.ResultsError:
        assert path.read_bytes() == before
    else:
        end = before.rfind(b"\n") + 1
        cut_off = b'{"fingerprint":'.startswith(before[end:][:15])
        assert path.read_bytes().startswith(before[:end] if cut_off else before)


@pytest.mark.parametrize("before", [b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", b"no run", b"[1]\n[2]\n{", b"1\n2"])
def test_keep_refuses_foreign_file(tmp_path, before):
    path = tmp_path / "other"
    path.write_bytes(before)
    with pytest.raises(results_store.ResultsError, match=r"other, line 1"):
        results_store.keep(path, [Run.read(_entry())])
    assert path.read_bytes() == before


def test_unreadable_results_file_is_reported(tmp_path, monkeypatch):
    (tmp_path / "campaign.jsonl").mkdir()
    with pytest.raises(
        results_store.ResultsError, match=r"campaign\.jsonl: a file expected, found a folder.*readable file of stored runs"
    ):
        results_store.read(tmp_path / "campaign.jsonl")

    def forbidden(path):
        raise PermissionError(13, "Permission denied", str(path))

    for name, reading in (("is_file", lambda path: results_store.files([path])), ("exists", results_store.read)):
        monkeypatch.setattr(type(tmp_path), name, forbidden)
        with pytest.raises(results_store.ResultsError, match=r"mine: cannot be read \(Permission denied\)"):
            reading(tmp_path / "mine")


@pytest.mark.parametrize(
    "line",
    ["[]", "{}", "no JSON", '{"scenario": "flat", "seed": 3}', '{"report": {"seed": 3}}', "[" * 100_000],
    ids=lambda line: line[:30],
)
def test_invalid_line_is_reported_with_its_number(tmp_path, line):
    path = tmp_path / "campaign.jsonl"
    results_store.keep(path, [Run.read(_entry())])
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(results_store.ResultsError, match=r"line 2.*remove the line"):
        results_store.read(path)


def test_folder_argument_resolves_to_its_results_file(tmp_path):
    (tmp_path / "trials.jsonl").write_text(json.dumps(_entry()) + "\n")
    assert results_store.files([tmp_path]) == [tmp_path / "trials.jsonl"]
    assert repr(results_store.read(tmp_path / "trials.jsonl")) == repr([Run.read(_entry())]), COMPARED
    results_store.keep(tmp_path / "campaign.jsonl", [])
    assert results_store.files([tmp_path, tmp_path / "trials.jsonl"]) == [
        tmp_path / "campaign.jsonl",
        tmp_path / "trials.jsonl",
    ]
    with pytest.raises(results_store.ResultsError, match=r"campaign\.jsonl or trials\.jsonl, expected"):
        results_store.files([tmp_path / "nothing"])
