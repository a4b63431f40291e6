"""`python -m benchmarks faults` as a user runs it: real faults in walks, and a table.

No injection runs twice.
"""

import json
from pathlib import Path

import pytest

from benchmarks.cli import main
from sextant.deploy.commands.common import SUCCESS

FAULTS = ("planner-hung", "overload", "off-bytes-garbage")


def test_faults_command_checks_limits_and_skips_completed_injections(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["faults", *FAULTS, "--phases", "1", "--out", str(tmp_path)]) == SUCCESS, (tmp_path / "faults.md").read_text()
    table = json.loads((tmp_path / "faults.json").read_text())
    assert [(row["fault"], row["n"], row["passed"], row["falls"]) for row in table] == [(name, 1, True, 0) for name in FAULTS]
    hung, overload, off = table
    assert 0.1 < hung["decided_s"]["worst"] < hung["rest_s"]["worst"] < 0.7
    assert 0.0 < overload["lunge_dps"]["worst"] <= 30.0
    assert off["switched"] == 1
    assert off["off_s"]["worst"] <= 0.06
    lines = (tmp_path / "faults.jsonl").read_bytes()
    capsys.readouterr()
    assert main(["faults", *FAULTS, "--phases", "1", "--out", str(tmp_path)]) == SUCCESS
    assert "3 of 3 injections are already done" in capsys.readouterr().out
    assert (tmp_path / "faults.jsonl").read_bytes() == lines


def test_camera_faults_end_walking_or_standing_with_the_reason(tmp_path: Path) -> None:
    lasting, wet = faults = ("camera-zoomed-lasting-steps", "camera-wet-steps")
    assert main(["faults", *faults, "--phases", "1", "--out", str(tmp_path)]) == SUCCESS, (tmp_path / "faults.md").read_text()
    found = {
        entry["fault"]: entry["outcome"] for entry in map(json.loads, (tmp_path / "faults.jsonl").read_text().splitlines())
    }
    assert found[lasting]["ended"] == "stands"
    assert any("the camera shows the ground" in words for words in found[lasting]["stood"])
    assert found[wet]["ended"] == "walks"
    assert max(outcome["place_m"] for outcome in found.values()) < 0.10
