"""The bench of checksums: no family accepts more wrong values than its checksum explains."""

import json
from pathlib import Path
from random import Random

import numpy as np
import pytest

from benchmarks import cli
from benchmarks.robot import checksums
from sextant.services.actuator.servo_bus.command_bus import bus_of
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.shared.servo import dynamixel2, lx16a
from sextant.shared.servo.models import MODEL_NAMED
from tests.support.families import Bench


@pytest.mark.slow
@pytest.mark.parametrize("name", checksums.MODEL_NAMES)
def test_accepted_wrong_values_keep_the_odds_of_the_checksum(name: str) -> None:
    found = checksums.measure(1500, 1, (name,))
    assert [one.way for one in found] == list(checksums.WAYS)
    for one in found:
        assert one.answers >= 1500
        assert 0.2 < one.spoilt / one.answers < 0.3
        assert one.passed, one
        if one.expected is None:
            continue
        assert one.wrong_positions <= one.intact
        assert one.wrong_errors == 0


@pytest.mark.parametrize("way", [name for name, way in checksums.WAYS.items() if way.odds and "another servo" not in name])
def test_spoilt_combined_answer_gives_no_wrong_position(way: str) -> None:
    """Each exchange has a new driver, because one that has lost a combined answer does not ask for the next one."""
    bench, rng, combined, believed = Bench("XL430-W250", 6), Random(f"1 {way}"), 0, 0
    receive = bench.emulator.receive

    def spoil(data: bytes, now_ns: int) -> list[Reply]:
        nonlocal combined
        replies = receive(data, now_ns)
        if [reply.servo_id for reply in replies] != [dynamixel2.BROADCAST_ID]:
            return replies
        combined += 1
        return [replies[0]._replace(data=checksums.WAYS[way].spoil(replies[0].data, b"", rng))]

    bench.emulator.receive = spoil  # type: ignore[method-assign]
    tick = bench.model.units.tick_rad
    for _ in range(400):
        q = np.array([rng.uniform(-1.2, 1.2) for _ in bench.ids])
        bench.pass_time(0.02, q)
        driver = bus_of(bench.model)(bench.port, bench.ids, bench.port.now_ns, model=bench.model)
        readings = driver.poll(12_000_000)
        believed += len(readings)
        assert all(abs(one.position - q[one.index]) <= tick for one in readings)
    assert combined == 400
    assert believed > 400, "the parts before the spoilt byte are used, and the others asked again"


@pytest.mark.parametrize("name", checksums.MODEL_NAMES)
def test_whole_packet_with_other_values_is_found_in_noise(name: str) -> None:
    model, rng = MODEL_NAMED[name], Random(3)
    protocol = model.protocol
    code, rest = (lx16a.Command.POS_READ, (3,)) if model.commands else (0, (3, 9, 12, 40))
    answer, other = (protocol.status(7, code, bytes((k, *rest))) for k in (1, 2))
    assert not checksums.contains_other(protocol, 7, answer, answer)
    assert checksums.contains_other(protocol, 7, answer, rng.randbytes(5) + other + rng.randbytes(4))
    assert not checksums.contains_other(protocol, 7, answer, protocol.status(8, code, bytes((2, *rest))))


def test_checksums_command_writes_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["checksums", "--answers", "100", "--servo", "XL430-W250", "--out", str(tmp_path)]
    assert cli.main(words) == 0
    assert "\n| servo | one bit flipped |" in capsys.readouterr().out
    assert cli.main([*words, "--json"]) == 0
    table = json.loads((tmp_path / "checksums.json").read_text())
    assert table == json.loads(capsys.readouterr().out)
    assert [row["way"] for row in table["rows"]] == list(checksums.WAYS)


def test_unknown_servo_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["checksums", "--servo", "AX-13"]) == 2
    assert "one of these models expected: AX-12A" in capsys.readouterr().err
