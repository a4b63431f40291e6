"""Arguments and output of `python -m benchmarks faults`, without any fault."""

import pytest

from benchmarks.cli import main
from benchmarks.faults.cases import CAMERA_CASES, CASES, LIVE_CASES
from sextant.deploy.commands.common import SUCCESS, WRONG_INPUT


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
