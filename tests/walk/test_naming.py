"""Benchmark of errors that the robot names."""

import json
from pathlib import Path

import pytest

from benchmarks import cli as benchmarks


def test_horn_that_is_off_is_named_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    walks = ["--scenarios", "flat", "--errors", "horn", "--seeds", "1008:1009", "--out", "bench"]
    assert benchmarks.main(["naming", *walks]) == 0
    (walk,) = json.loads(Path("bench/naming.json").read_text())["rows"]
    assert walk["sentence"] == "the coxa servo of the left front leg (id 1): its horn is off by about"
    assert walk["named_at"] <= 15
    assert walk["others"] == []


def test_error_that_the_benchmark_does_not_know_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmarks.main(["naming", "--errors", "pitch,hat"]) == 2
    assert "some of none, pitch, roll, yaw, height, depth, delay, horn expected, found 'hat'" in capsys.readouterr().err
