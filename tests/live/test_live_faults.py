"""Faults in processes over Zenoh, as `python -m benchmarks faults --live` injects them."""

import json
from pathlib import Path

import pytest

from tests.support.commands import Command

pytestmark = [pytest.mark.live, pytest.mark.rare]


def test_actuator_killed_during_walk_restarts_and_holds(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with Command("faults", "live-actuator-killed", "--phases", "1", "--out", str(out), cwd=tmp_path) as command:
        assert command.status() == 0, command.text()
        command.gone()
    (row,) = json.loads((out / "faults.json").read_text(encoding="utf-8"))
    assert (row["fault"], row["n"], row["passed"]) == ("live-actuator-killed", 1, True)
    assert (row["falls"], row["switched"], row["outside"], row["stopped"]) == (0, 0, 0, 1)
    assert 0.0 < row["decided_s"]["worst"] <= 1.5
    assert row["again_s"]["n"] == 1, "it walks on"
    (line,) = (out / "faults.jsonl").read_text(encoding="utf-8").splitlines()
    assert json.loads(line)["outcome"]["goals_before_off"] == 0


def test_hung_actuator_is_replaced_and_robot_holds(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with Command("faults", "live-actuator-stopped", "--phases", "1", "--out", str(out), cwd=tmp_path) as command:
        assert command.status() == 0, command.text()
        command.gone()
    (row,) = json.loads((out / "faults.json").read_text(encoding="utf-8"))
    assert (row["fault"], row["n"], row["passed"]) == ("live-actuator-stopped", 1, True)
    assert (row["falls"], row["switched"], row["outside"], row["stopped"]) == (0, 0, 0, 1)
    assert 1.0 < row["decided_s"]["worst"] <= 3.5
    assert row["again_s"]["n"] == 1, "it walks on"
