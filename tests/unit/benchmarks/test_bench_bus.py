"""The bench of the servo bus driver on a faulty bus.

Its figures are consistent, and its command writes them.
"""

import json
from pathlib import Path

import pytest

from benchmarks import cli
from benchmarks.robot import servo_bus

DEGREES = 12.0  # largest position error: 3 from the goal, 6 between the goals of three cycles at 2.7 rad/s, 3 for a late answer


@pytest.mark.slow
@pytest.mark.parametrize("only", servo_bus.CASES)
def test_accepted_readings_are_correct_or_close(only: str) -> None:
    (found,) = [one for one in servo_bus.measure(800, 1, only) if one.case == only]
    assert found.questions >= 800
    assert 0 <= found.wrong <= found.believed <= found.questions
    assert found.unanswered + found.implausible + found.believed <= found.questions + servo_bus._N
    assert found.cycles > 100
    if "answer before" not in only:  # which is correct but old
        assert found.position_off_deg < DEGREES
    if only == "nothing":
        assert (found.believed, found.wrong, found.wrong_goals, found.by_reason) == (found.questions, 0, 0, {})
    else:
        assert found.by_reason


@pytest.mark.slow
def test_unanswered_share_matches_loss_rate() -> None:
    found = {one.case: one for one in servo_bus.measure(2000, 2, "are lost")}
    assert found["1 % of the answers are lost"].unanswered / 2000 == pytest.approx(0.01, abs=0.008)
    assert found["10 % of the answers are lost"].unanswered / 2000 == pytest.approx(0.1, abs=0.03)


def test_bus_faults_are_deterministic_for_seed() -> None:
    case = "10 % have two bits"
    assert servo_bus.measure(500, 3, case) == servo_bus.measure(500, 3, case) != servo_bus.measure(500, 4, case)


def test_bus_command_writes_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["bus", "--questions", "200", "--only", "have two b", "--out", str(tmp_path)]
    assert cli.main(words) == 0
    printed = capsys.readouterr().out
    assert "\n| fault | questions |" in printed
    assert printed.count("\n| ") == 1 + 3
    assert cli.main([*words, "--json"]) == 0
    table = json.loads((tmp_path / "bus.json").read_text())
    assert table == json.loads(capsys.readouterr().out)
    assert [row["case"] for row in table["rows"]] == [case for case in servo_bus.CASES if "have two b" in case]


def test_unknown_case_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bus", "--only", "three bits"]) == 2
    assert "part of one of these names expected: nothing; 1 % of the answers are lost" in capsys.readouterr().err
