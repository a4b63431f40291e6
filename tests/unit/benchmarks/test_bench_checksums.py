"""The bench of checksums: no family accepts more wrong values than its checksum explains."""

import json
from pathlib import Path
from random import Random

import numpy as np
import pytest

from benchmarks import cli
from benchmarks.robot import checksum_rigs, checksums, spoilt_answers
from benchmarks.robot.spoilt_answers import OF_BEFORE, WAYS, Found
from sextant.services.actuator.servo_bus.bus_driver import ServoReading
from sextant.shared.servo import bridge_protocol, dynamixel2, lx16a
from sextant.shared.servo.bridge_protocol import Torque
from sextant.shared.servo.models import MODEL_NAMED
from sextant.shared.servo.servo_model import ServoError

SLOW = pytest.mark.slow
FAMILIES = [name for name in checksums.KINDS if name in MODEL_NAMED]


@SLOW
@pytest.mark.parametrize("kind", checksums.KINDS)
def test_accepted_wrong_values_keep_the_odds_of_the_checksum(kind: str) -> None:
    answers = 600 if kind in checksum_rigs.ONE_SENDER else 1500
    found = checksums.measure(answers, 1, (kind,))
    assert [one.way for one in found] == [way for way in WAYS if checksums.has_way(kind, way)]
    for one in found:
        assert one.answers >= answers
        assert 0.2 < one.spoilt / one.answers < 0.3
        assert one.readings + one.registers > 40
        assert one.passed, one
        if one.expected is not None:
            assert one.wrong_readings <= one.intact


def test_each_kind_of_bus_and_board_is_among_the_rigs() -> None:
    assert {MODEL_NAMED[name].protocol.NAME for name in FAMILIES} == {one.protocol.NAME for one in MODEL_NAMED.values()}
    others = set(checksums.KINDS) - set(FAMILIES)
    assert len(others) == 6, "combined answers, mixed servos, two buses, a bridge, two boards"
    assert others <= checksum_rigs.RIGS.keys()


@pytest.mark.parametrize("field", ["position", "speed", "load", "voltage", "temperature", "error"])
def test_each_wrong_value_of_a_reading_is_counted(field: str) -> None:
    found, model = Found("AX-12A", "none"), MODEL_NAMED["AX-12A"]
    servos = checksum_rigs._Servos([1, 2], [model] * 2, Random(1), found)
    for _ in range(5):
        servos.move()
    truth = servos._states[1][-1]
    right = ServoReading(1, 2, 0, 0, 0, *truth[:5], ServoError(truth.error))
    servos.compare(1, right)
    assert (found.readings, found.wrong) == (1, {})
    value = getattr(right, field)
    setattr(right, field, ServoError.OVERLOAD if field == "error" else value + 3.0)
    servos.compare(1, right)
    assert (found.readings, found.wrong_readings, found.wrong) == (2, 1, {field: 1})


def test_servos_move_warm_up_and_report_errors() -> None:
    """Values that stay the same would hide wrong ones."""
    servos = checksum_rigs._Servos([1, 2], [MODEL_NAMED["XL430-W250"]] * 2, Random(1), Found("XL430-W250", "none"), 4000)
    for _ in range(4000):
        servos.move()
    states = np.array(servos._states[0])
    assert (np.ptp(states, axis=0) > [1.0, 3.0, 0.5, 1.0, 1.0, 0.5]).all()


@pytest.mark.parametrize("kind", ["AX-12A", "XL430-W250", "XL430-W250, combined answers", "AX-12A behind a bridge"])
def test_nothing_wrong_is_believed_of_answers_that_are_not_spoilt(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spoilt_answers, "_SHARE", 0.0)
    found = checksums.run(kind, "two bits flipped", 200, Random(1))
    assert found.readings > 50
    assert (found.spoilt, found.wrong) == (0, {})


@SLOW
def test_old_answers_are_counted_and_allowed() -> None:
    found = checksums.run("AX-12A", OF_BEFORE, 1500, Random(1))
    assert found.wrong["position"] > 50
    assert found.passed


def test_spoilt_part_of_a_combined_answer_is_found() -> None:
    rows = [(k, 0, bytes((k, 7, 9))) for k in (1, 2, 3)]
    answer = dynamixel2.combined_status(rows)
    other = dynamixel2.combined_status([rows[0], (2, 0, bytes((2, 8, 9))), rows[2]])
    broken = dynamixel2.with_part(answer, 3, 1, lambda size: bytes(size))
    for noise in (b"", b"\xff\x00"):
        assert spoilt_answers.contains_other_part(3, answer, noise + other)
        assert not spoilt_answers.contains_other_part(3, answer, noise + answer)
        assert not spoilt_answers.contains_other_part(3, answer, noise + broken)


def test_other_message_of_a_bridge_is_found() -> None:
    one, other = (bridge_protocol.encode(bridge_protocol.Answer(1, k, bridge_protocol.Result.SILENT, 0, b"")) for k in (1, 2))
    assert spoilt_answers.contains_other_message(one, other)
    assert not spoilt_answers.contains_other_message(one, one)
    assert not spoilt_answers.contains_other_message(one, other[:-3] + other[-2:])
    assert not spoilt_answers.contains_other_message(one, bridge_protocol.encode(Torque(1, 2, 3, 1))), "of the host"


@pytest.mark.parametrize("name", FAMILIES)
def test_whole_packet_with_other_values_is_found_in_noise(name: str) -> None:
    model, rng = MODEL_NAMED[name], Random(3)
    protocol = model.protocol
    code, rest = (lx16a.Command.POS_READ, (3,)) if model.commands else (0, (3, 9, 12, 40))
    answer, other = (protocol.status(7, code, bytes((k, *rest))) for k in (1, 2))
    assert not spoilt_answers.contains_other(protocol, 7, answer, answer)
    assert spoilt_answers.contains_other(protocol, 7, answer, rng.randbytes(5) + other + rng.randbytes(4))
    assert not spoilt_answers.contains_other(protocol, 7, answer, protocol.status(8, code, bytes((2, *rest))))


def test_checksums_command_writes_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["checksums", "--answers", "100", "--servo", "XL430-W250", "--out", str(tmp_path)]
    assert cli.main(words) == 0
    assert "\n| servo | one bit flipped |" in capsys.readouterr().out
    assert cli.main([*words, "--json"]) == 0
    table = json.loads((tmp_path / "checksums.json").read_text())
    assert table == json.loads(capsys.readouterr().out)
    assert [row["way"] for row in table["rows"]] == list(WAYS)


def test_unknown_servo_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["checksums", "--servo", "AX-13"]) == 2
    assert "one of these expected: AX-12A" in capsys.readouterr().err
