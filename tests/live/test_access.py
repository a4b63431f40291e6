"""The bench of access: no unauthorized message passes, and replays move nothing."""

import json
from pathlib import Path

import pytest

from benchmarks import cli

pytestmark = [pytest.mark.live, pytest.mark.rare]


def test_access_command_writes_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["access", "--messages", "100", "--out", str(tmp_path)]) == 0
    assert "| what | tried | came through | |" in capsys.readouterr().out
    rows = {row["what"]: row for row in json.loads((tmp_path / "access.json").read_text())["rows"]}
    flood = rows.pop("flood on operator/mode, by an authorised client")
    assert flood["through"] < 100
    assert {row["through"] for row in rows.values()} == {0}
    assert [row["tried"] for row in rows.values()] == [100] * 6 + [10] + [100] * 4
    led, alone, anew, around = [row["note"] for row in rows.values()][-4:]
    for said in (led, alone, anew):  # the reason for rejection of each kind of replayed message
        assert "`walk` of operator refused: it is" in said
        assert "plan of step" in said
    assert "s old" in led.partition("plan of step")[2], "a client leads the robot, so the plan is refused for its age"
    assert around == "", "no process has received the peer"
