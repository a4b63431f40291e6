"""The bench of the servo bus: both libraries send the same bytes.

Its figures are those of the requested jobs.
"""

import json
from pathlib import Path

import pytest

from benchmarks import cli
from benchmarks.peers import servo_packets
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.dynamixel import PacketParser
from tests.support.desk import PHANTOMX, Desk

IDS = list(PHANTOMX.servo_names)


class Recorder(MemoryPort):
    """A port that records the bytes that a library writes."""

    port, baudrate = "memory", 1_000_000

    def __init__(self, desk: Desk) -> None:
        super().__init__(desk.bench, lambda: 0)
        self.sent = b""

    def write(self, data: bytes) -> int:
        self.sent += bytes(data)
        return super().write(data)


@pytest.mark.parametrize("library", [servo_packets.Ours, servo_packets.Sdk], ids=["sextant", "dynamixel-sdk"])
@pytest.mark.parametrize("job", servo_packets.JOBS)
def test_each_library_sends_same_packets_for_job(library: type[servo_packets.Ours], job: str) -> None:
    if library is servo_packets.Sdk:
        pytest.importorskip("dynamixel_sdk", reason="pip install -e '.[bench]' installs it")
    port = Recorder(Desk())
    method = library(port, IDS)
    port.timeout = 0.006  # virtual time advances while a read waits
    assert servo_packets._do(job, method, IDS, 1) == 0
    asked = [(packet.servo_id, packet.code, packet.parameters) for packet in PacketParser().feed(port.sent)]
    turn = IDS[servo_packets.READS : 2 * servo_packets.READS]
    reads = turn if job == "cycle" else turn[:1] if job == "read 8 bytes" else []
    expected = [(i, dxl.Instruction.READ, bytes((36, 8))) for i in (reads or [servo_packets.ABSENT])]
    if job == "read 8 bytes":
        expected = expected[:1]
    if job == "cycle":
        rows = b"".join(bytes((i, 513 & 0xFF, 513 >> 8, 100, 0)) for i in IDS)
        expected.insert(0, (dxl.BROADCAST_ID, dxl.Instruction.SYNC_WRITE, bytes((30, 4)) + rows))
    assert asked == expected


@pytest.mark.slow
def test_servos_command_writes_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["servos", "--rounds", "4", "--out", str(tmp_path), "--json"]) == 0
    table = json.loads((tmp_path / "servos.json").read_text())
    assert table == json.loads(capsys.readouterr().out)
    ours = {row["job"]: row for row in table["rows"] if row["method"] == "sextant"}
    assert set(ours) == set(servo_packets.JOBS)
    assert ours["read 8 bytes"]["asked"] == 4
    assert ours["cycle"]["asked"] == 4 * servo_packets.READS
    assert ours["read 8 bytes"]["wall_ms"]["median"] > 1.2  # least time of the wire and the adapter
    assert ours["no answer"]["wall_ms"]["p10"] >= 6.0
    assert {row["method"] for row in table["rows"]} | {words.split(":")[0] for words in table["missing"]} == {
        "sextant",
        "dynamixel-sdk",
    }
