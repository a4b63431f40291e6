"""Difficulty curves of synthetic walks."""

import json
from collections import Counter

import pytest

from sextant.deploy import cli
from sextant.evaluation.report import Report
from sextant.evaluation.trials import curve as curves
from sextant.evaluation.trials.curve_picture import draw_curves
from sextant.shared.scenario.loading import load_family

RISER = load_family("riser")
AT = (0.02, 0.04, 0.06, 0.08)
STUCK = "the planner has been blocked for 20 s: {}: no foothold (stopped at 1.{} of 2.50 m)"


def _walk(scenario, seed):
    """Return a report: each seed passes risers up to its own height, and a blind robot lower ones."""
    riser = scenario.terrain[1].riser
    good = riser < 0.035 + 0.01 * (seed % 4) - 0.02 * scenario.walk.blind
    leg = ("left front leg", "right rear leg")[seed % 2]
    reason = "goal reached" if good else STUCK.format(leg, seed % 10) if riser < 0.07 else f"fell 0.{seed % 10} m along"
    return Report(scenario.name, seed, scenario.robot, "tripod", scenario.walk.blind, good, reason, 2.5, 25.0, 0.1, 0, 0, 40)


class Runner:
    def __init__(self, until=10**6):
        self.ran = []
        self.until = until

    def __call__(self, scenario, seed):
        if len(self.ran) == self.until:
            raise KeyboardInterrupt
        self.ran.append((scenario.name, seed))
        return _walk(scenario, seed)


def _curve(out, run=_walk, **options):
    return curves.run_curve(RISER, range(1000, 1004), 1, out, AT, run=run, **options)


def test_success_falls_along_the_curve_with_half_success_and_legs_limit(tmp_path):
    curve = _curve(tmp_path)
    assert [point.trials.success.successes for point in curve.points] == [4, 3, 1, 0]
    middle, low, high = curve.fit().half
    assert 0.03 < low < middle < high < 0.08
    assert middle == pytest.approx(0.05, abs=0.006)
    assert curve.legs.passed == pytest.approx(0.11)
    text = curves.words(curve)
    assert "success falls to half at" in text
    assert "the legs alone pass 110 mm (robot check); at 120 mm: left rear leg: no foothold" in text
    assert "     20 mm" in text


def test_mirrored_failures_have_one_cause(tmp_path):
    found = [curves.causes(point.trials) for point in _curve(tmp_path).points]
    assert found == [{}, {"a leg: no foothold": 1}, {"a leg: no foothold": 3}, {"fell": 4}]


def test_cause_of_a_joint_keeps_the_joint():
    reason = "the standing foot of the left front leg exceeds the reach of its tibia joint"
    assert curves.common_cause(reason) == "the standing foot of a leg exceeds the reach of its tibia joint"
    cells = "# too steep or too near an edge, # out of reach or too tight for the leg"
    reason = f"right front leg: no foothold within # cm of its nominal place (# cells: {cells}); perception reports: no frame"
    assert curves.common_cause(reason) == "a leg: no foothold, most cells too steep or too near an edge"
    assert curves.common_cause("planner, # to # s: no fresh terrain map; the mapper refuses scans") == "no fresh terrain map"
    assert curves.common_cause("servo shut down: right middle tibia") == "servo shut down: a tibia"


def test_interrupted_curve_goes_on_and_takes_further_points(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        _curve(tmp_path, run=Runner(until=6))
    runner = Runner()
    found = _curve(tmp_path, run=runner)
    assert len(runner.ran) == 10
    more = Runner()
    curves.run_curve(RISER, range(1000, 1004), 1, tmp_path, (0.02, 0.05, 0.08), run=more)
    assert Counter(name for name, _ in more.ran) == {"riser@0.05": 4}
    assert [point.value for point in found.points] == list(AT)


def test_pictures_and_json_of_curves_with_and_without_a_map(tmp_path):
    both = [_curve(tmp_path), _curve(tmp_path, blind=True)]
    curves.write(both, tmp_path)
    table = json.loads((tmp_path / "curve.json").read_text(encoding="utf-8"))
    assert [one["blind"] for one in table["curves"]] == [False, True]
    seeing, blind = (one["half"]["value"] for one in table["curves"])
    assert blind < seeing
    assert table["curves"][0]["points"][3]["causes"] == {"fell": 4}
    for name in ("once", "twice"):
        draw_curves(both, tmp_path / name)
    assert (tmp_path / "once.svg").read_bytes() == (tmp_path / "twice.svg").read_bytes()
    assert (tmp_path / "once.png").stat().st_size > 10_000


def test_falling_parameter_is_drawn_from_easy_to_impossible(tmp_path):
    stones = load_family("stone_size")

    def walk(scenario, seed):
        good = scenario.terrain[1].stretches[1].size > 0.05
        reason = "goal reached" if good else "fell 0.5 m along"
        return Report(scenario.name, seed, scenario.robot, "tripod", False, good, reason, 2.5, 25.0, 0.1, 0, 0, 40)

    curve = curves.run_curve(stones, range(1000, 1004), 1, tmp_path, run=walk)
    assert 0.05 <= curve.fit().half[0] <= 0.06
    assert curve.legs is None
    draw_curves([curve], tmp_path / "curve")
    assert "success falls to half at 5" in curves.words(curve)


@pytest.mark.slow
def test_curve_command_writes_curve_and_pictures(tmp_path, monkeypatch, capsys):
    from sextant.evaluation.lockstep import lockstep_run

    monkeypatch.setattr(lockstep_run, "run_lockstep", _walk)
    words = ["trials", "riser", "--curve", "--at", "0.02,0.05,0.08", "--seeds", "1000:1004", "--blind", "--out", str(tmp_path)]
    assert cli.main(words) == 0
    printed = capsys.readouterr().out
    assert "riser: three steps up, phantomx_mk2, height of a riser" in printed
    assert "riser: three steps up, phantomx_mk2, without a map, height of a riser" in printed
    for name in ("curve.json", "curve.png", "curve.svg", "campaign.jsonl"):
        assert (tmp_path / name).is_file()
