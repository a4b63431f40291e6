"""The benchmark of the actuator's cycle."""

import json
from pathlib import Path

import pytest

from benchmarks import cli


def test_cycle_command_times_standing_and_walking(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["cycle", "--scenario", "flat", "--seeds", "1000:1001", "--cycles", "40", "--out", str(tmp_path), "--json"]
    assert cli.main(words) == 0
    table = json.loads(capsys.readouterr().out)
    assert table == json.loads((tmp_path / "cycle.json").read_text(encoding="utf-8"))
    standing, walking = table["rows"]
    assert (standing["kind"], walking["kind"]) == ("standing", "walking")
    assert walking["cycles"] >= 40
    for row in (standing, walking):
        assert 0.0 < row["p50_ms"] <= row["p99_ms"]
        assert row["cores"] == pytest.approx(row["mean_ms"] * 0.05)  # 50 cycles a second
        assert 4.0 < row["bus_ms"] < 12.0  # by the emulated delays, which do not depend on this machine
