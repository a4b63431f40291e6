"""The bench of the actuator's start-up.

The real process starts on emulated servos that hold a standing robot.
"""

import json
from pathlib import Path

import pytest

from benchmarks import cli
from benchmarks.robot import start
from sextant.shared.servo import dynamixel as dxl
from tests.support.desk import PHANTOMX


@pytest.mark.slow
@pytest.mark.live  # its servos answer in real time, from this process
def test_start_command_writes_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["start", "--rounds", "2", "--out", str(tmp_path), "--json"]) == 0
    table = json.loads((tmp_path / "start.json").read_text())
    assert table == json.loads(capsys.readouterr().out)
    assert len(table["rows"]) == 2
    for one in table["rows"]:
        assert one["moved_deg"] < 2.0  # limit of a joint's motion during the start
        assert one["mode"] in ("hold", "fault"), "where this machine is too busy to answer, it holds for that"
        assert 0.0 < one["asked_ms"] < one["told_ms"]  # it reads the servos' positions before it writes to them


def test_only_first_read_and_write_times_are_stored() -> None:
    watched = start.Watched(PHANTOMX)
    watched.look()
    assert (watched.asked_ns, watched.told_ns, watched.goals) == (-1, -1, {})
    standing = watched.standing
    watched.receive(dxl.ping(1), 10)
    for at, ticks in ((20, 500), (30, 501)):
        rows = [(i, dxl.GOAL_POSITION.encode(ticks) + dxl.MOVING_SPEED.encode(0)) for i in PHANTOMX.servo_names]
        watched.receive(dxl.sync_write(dxl.GOAL_POSITION.address, 4, rows), at)
    assert (watched.asked_ns, watched.told_ns) == (10, 20)
    assert watched.goals == dict.fromkeys(standing, 500)
    assert watched.standing == dict.fromkeys(standing, 501) != standing
