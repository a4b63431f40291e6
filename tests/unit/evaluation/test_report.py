import json
from dataclasses import fields, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.evaluation import report as reports
from sextant.evaluation.report import MapError, Report, Spread, StageTime

CONTRACT = {
    "scenario": None,
    "seed": None,
    "robot": None,
    "gait": None,
    "success": None,
    "reason": None,
    "distance_m": None,
    "duration_s": None,
    "speed_mps": None,
    "falls": None,
    "steps": None,
    "tilt_deg": {"p95", "max"},
    "commanded_tilt_deg": {"p95", "max"},
    "torque_nm": {"p95", "max", "rms_worst_joint"},
    "raised_touchdowns": None,
    "body_height_error_m": {"mean", "rms"},
    "slip_m_per_step": {"p50", "p95"},
    "missteps": None,
    "min_stability_margin_m": None,
    "pose_error_m": {"rms", "final"},
    "map_error_m": {"rmse", "bias", "p95", "coverage"},
    "course_map_m": {"rmse", "off_edges", "bias", "edge", "coverage"},
    "real_time_factor": None,
    "stages_ms": set(),
}


def _report(**changes):
    made = Report("flat", 3, "phantomx_mk2", "tripod", False, True, "goal reached", 2.5, 25.0, 0.1, 0, 0, 40)
    return replace(made, **changes)


def test_report_table_matches_contract():
    table = reports.as_table(_report())
    for key, inner in CONTRACT.items():
        assert key in table
        if inner is not None:
            assert set(table[key]) == inner
    order = [key for key in table if key in CONTRACT]
    assert order == list(CONTRACT)


@given(st.floats(), st.floats(allow_nan=False, allow_infinity=False))
def test_report_json_is_strict_and_rounded(wild, finite):
    text = reports.to_json(_report(speed_mps=wild, map_error_m=MapError(rmse=finite)))
    table = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert table["map_error_m"]["rmse"] == pytest.approx(finite, abs=5.1e-7)
    assert "-0.0," not in text
    assert table["map_error_m"]["bias"] is None
    assert reports.check(table) == []


def test_stages_are_sorted_and_without_timing_drops_times():
    a = _report(real_time_factor=3.1, stages_ms={"mapper": StageTime(1.0, 2.0), "actuator": StageTime(0.1, 0.2)})
    b = _report(real_time_factor=2.9, stages_ms={"actuator": StageTime(0.3, 0.4)})
    assert list(reports.as_table(a)["stages_ms"]) == ["actuator", "mapper"]
    assert reports.to_json(a) != reports.to_json(b)
    assert reports.to_json(reports.without_timing(a)) == reports.to_json(reports.without_timing(b))
    assert reports.to_json(reports.without_timing(_report(tilt_deg=Spread(1.0, 2.0)))) != reports.to_json(
        reports.without_timing(a)
    )


def test_write_creates_complete_report_file(tmp_path):
    folder = tmp_path / "runs" / "one"
    reports.write(_report(), folder)
    assert [p.name for p in folder.iterdir()] == ["report.json"]
    assert json.loads((folder / "report.json").read_text()) == reports.as_table(_report())


@pytest.mark.parametrize("name", [f.name for f in fields(Report)])
def test_check_names_missing_key(name):
    table = reports.as_table(_report())
    del table[name]
    assert reports.check(table) == [f"{name}: missing"]


def test_check_names_fields_of_wrong_type():
    table = reports.as_table(_report(stages_ms={"mapper": StageTime(1.0, 2.0)}))
    del table["tilt_deg"]["max"]
    del table["stages_ms"]["mapper"]["p99"]
    table |= {"steps": "many", "success": 1, "speed_mps": True, "torque_nm": 3, "more": "is allowed"}
    assert sorted(reports.check(table)) == [
        "speed_mps: a number or null expected, found bool 'True'",
        "stages_ms.mapper.p99: missing",
        "steps: int expected, found str 'many'",
        "success: bool expected, found int '1'",
        "tilt_deg.max: missing",
        "torque_nm: a table expected, found int '3'",
    ]
    assert reports.check([]) == ["report: a table expected, found list '[]'"]
