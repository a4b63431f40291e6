"""Whole walks in lockstep on the courses that come with Sextant."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.deploy import cli
from sextant.evaluation.lockstep.lockstep_run import LockstepRun, run_lockstep
from sextant.evaluation.report import check
from sextant.shared.recording.reader import Recording
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Goal, Walk
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ActuatorState, GroundTruth, Mode, ModeCommand
from tests.support.walks import LOOK_NS, Heard, S, flat

BODY_HEIGHT = 0.11  # [m] commanded


def contacts_in_the_air(recording: Recording) -> NDArray[np.bool_]:
    """Return the reported contact of each foot that is in the air, by the nearest ground truth."""
    messages = [message for _, message, _ in recording.messages((topics.TRUTH, topics.ACTUATOR_STATE))]
    truth = [message for message in messages if isinstance(message, GroundTruth)]
    states = [message for message in messages if isinstance(message, ActuatorState) and message.mode is Mode.WALK]
    nearest = np.abs(np.array([[t.stamp_ns] for t in truth]) - np.array([s.stamp_ns for s in states])).argmin(axis=0)
    return np.concatenate([state.contact[~truth[k].contact] for state, k in zip(states, nearest, strict=True)])


def test_walk_on_flat_ground_keeps_body_level_and_localized(tmp_path: Path) -> None:
    scenario = replace(load_scenario("flat"), goal=Goal(1.5))
    assert scenario.walk.body_height == BODY_HEIGHT
    report = run_lockstep(scenario, 1000, tmp_path)
    assert report.success, report.reason
    assert (report.falls, report.shutdowns, report.missteps) == (0, 0, 0)
    assert report.tilt_deg.p95 <= 0.4
    assert report.body_height_oscillation_m <= 0.04 * BODY_HEIGHT
    assert report.body_height_error_m.rms <= 0.005
    assert report.slip_m_per_step.p50 <= 0.003
    assert report.torque_nm.rms_worst_joint <= 0.5  # what an AX-12A bears for hours
    assert report.speed_mps >= 0.095
    assert report.pose_error_m.final <= 0.015 * report.distance_m
    assert report.distance_m >= scenario.goal.distance
    assert report.min_stability_margin_m >= 0.03
    assert (report.too_slow, report.late_s) == ("", 0.0)
    assert all(ages.late == 0.0 for ages in report.input_ages_s.values())
    contacts = contacts_in_the_air(Recording(tmp_path / "recording.mcap"))
    assert len(contacts) > 500
    assert contacts.mean() < 0.01, "no foot in the air is reported to carry load"


def test_sixth_order_reference_arc_walks() -> None:
    report = run_lockstep(flat(0.3, walk=Walk(arc="sixth_order")), 1000)
    assert report.success, report.reason
    assert (report.falls, report.shutdowns) == (0, 0)


def test_walk_over_low_blocks_and_two_stairs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "steps", "--lockstep", "--seed", "1002", "--out", str(tmp_path), "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    assert table == json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert not check(table)
    assert table["success"] is True
    assert (table["falls"], table["shutdowns"]) == (0, 0)
    assert table["raised_touchdowns"] >= 12
    assert table["speed_mps"] >= 0.06
    assert table["map_error_m"]["rmse"] < 0.01
    unknown = [name for name, value in table.items() if value is None]
    assert not unknown, "everything was measured"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["recording.mcap", "report.json", "summary.png", "walk.png"]


def test_walk_between_pillars_with_scanner_and_kiss_icp() -> None:
    scenario = replace(load_scenario("pillars_scanner"), goal=Goal(0.3))
    assert scenario.variation.registration == "kiss-icp"
    report = run_lockstep(scenario, 1000)
    assert report.success, report.reason
    assert (report.falls, report.shutdowns) == (0, 0)
    assert report.pose_error_m.final < 0.05


def test_trials_command_runs_seeds_in_parallel(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    course = tmp_path / "short.toml"
    course.write_text('name = "short"\n[goal]\ndistance = 0.1\n[[terrain]]\nkind = "plane"\n', encoding="utf-8")
    words = ["trials", str(course), "--seeds", "1000:1002", "--jobs", "2", "--out", str(tmp_path / "out"), "--json"]
    assert cli.main(words) == 0
    table = json.loads(capsys.readouterr().out)
    assert (table["success"]["successes"], table["success"]["n"]) == (2, 2)
    assert len((tmp_path / "out" / "trials.jsonl").read_text(encoding="utf-8").splitlines()) == 2


def test_order_to_stand_keeps_feet_on_blocks_where_they_are() -> None:
    scenario = replace(load_scenario("steps"), goal=Goal(1.3))
    heard = Heard((topics.TRUTH,))
    run = LockstepRun(scenario, 1000, load_profile(scenario.robot), heard.tap)
    while not run.attendance.over():
        run.run(run.now_ns() + LOOK_NS)
    before = heard.of(topics.TRUTH)[-1]
    assert np.ptp(before.feet[:, 2]) > 0.02, "the feet stand on blocks and between them"
    run.say(ModeCommand(run.now_ns(), "stand", run.now_ns(), "operator", take_over=True))
    run.run(run.now_ns() + 4 * S)
    after = heard.of(topics.TRUTH)[-1]
    np.testing.assert_allclose(after.feet[:, 2], before.feet[:, 2], atol=0.002)
    assert after.contact.all()
