"""Arguments and output of `python -m benchmarks faults`, without any fault."""

from pathlib import Path

import pytest

from benchmarks.cli import main
from benchmarks.faults.cases import CAMERA_CASES, CASES, LIVE_CASES
from sextant.deploy.commands.common import SUCCESS, WRONG_INPUT
from sextant.shared.robot.profile_text import profile_text
from tests.support.families import two_bus_robot


def listed_faults(capsys: pytest.CaptureFixture[str], *words: str) -> list[str]:
    assert main(["faults", "--list", *words]) == SUCCESS
    return [line.split()[0] for line in capsys.readouterr().out.splitlines()]


def test_list_option_names_all_or_only_live_faults(capsys: pytest.CaptureFixture[str]) -> None:
    assert listed_faults(capsys) == [case.name for case in (*CASES, *CAMERA_CASES, *LIVE_CASES)]
    assert listed_faults(capsys, "--live") == [case.name for case in LIVE_CASES]
    assert listed_faults(capsys, "sag", "live-hogs") == ["sag", "live-hogs"]
    assert listed_faults(capsys, "camera-dirt*-steps") == ["camera-dirt-steps", "camera-dirt-lasting-steps"]


def test_mixed_and_unknown_faults_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["faults", "sag", "live-hogs"]) == WRONG_INPUT
    assert "run the command once for each" in capsys.readouterr().err
    assert main(["faults", "live-hog"]) == WRONG_INPUT
    assert "did you mean 'live-hogs'?" in capsys.readouterr().err


def test_live_faults_of_another_robot_and_unknown_robots_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["faults", "live-hogs", "--robot", "printed_sts3215"]) == WRONG_INPUT
    assert "phantomx_mk2 expected with live faults" in capsys.readouterr().err
    assert main(["faults", "sag", "--robot", "printed_sts"]) == WRONG_INPUT
    assert "printed_sts3215" in capsys.readouterr().err


def test_faults_that_hobby_servos_do_not_report_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["faults", "sag", "servo-wrong", "--robot", "printed_ds3218"]) == WRONG_INPUT
    assert "sag, servo-wrong: the servos of printed_ds3218 do not report this" in capsys.readouterr().err


def test_robot_with_two_buses_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "two.toml"
    path.write_text(profile_text(two_bus_robot()), encoding="utf-8")
    assert main(["faults", "sag", "--robot", str(path)]) == WRONG_INPUT
    assert "a robot with one servo bus or a Maestro expected" in capsys.readouterr().err
