"""Commands of a Maestro: the examples of its manual, and laws of its parser."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.shared.servo import maestro
from sextant.shared.servo.maestro import BoardError, Command, CommandParser, Packet

CHANNELS, TARGETS = st.integers(0, 23), st.integers(0, maestro.MAX_TARGET)


@pytest.mark.parametrize(
    ("encoded", "said"),
    [
        (maestro.set_target(2, 6000), "84 02 70 2e"),
        (maestro.set_target(0, 6000), "84 00 70 2e"),
        (maestro.set_target(0, 6000, device=12), "aa 0c 04 00 70 2e"),
        (maestro.set_multiple_targets(3, [0, 6000]), "9f 02 03 00 00 70 2e"),
        (maestro.set_multiple_targets(3, [0, 6000], device=12), "aa 0c 1f 02 03 00 00 70 2e"),
        (maestro.set_speed(5, 140), "87 05 0c 01"),
        (maestro.set_speed(5, 140, device=12), "aa 0c 07 05 0c 01"),
        (maestro.set_acceleration(5, 10), "89 05 0a 00"),
        (maestro.get_position(7), "90 07"),
        (maestro.get_position(7, device=12), "aa 0c 10 07"),
        (maestro.get_errors(), "a1"),
        (maestro.get_errors(device=12), "aa 0c 21"),
        (maestro.go_home(), "a2"),
        (maestro.go_home(device=12), "aa 0c 22"),
    ],
)
def test_commands_are_those_of_the_manual(encoded: bytes, said: str) -> None:
    assert encoded.hex(" ") == said


@given(st.lists(st.tuples(CHANNELS, TARGETS), max_size=5), st.sampled_from([None, 12]), st.data())
def test_commands_are_parsed_in_any_pieces(targets: list[tuple[int, int]], device: int | None, data: st.DataObject) -> None:
    stream = b"".join(maestro.set_target(*one, device=device) + maestro.get_errors(device) for one in targets)
    cut = data.draw(st.integers(0, len(stream)))
    parser = CommandParser()
    found = parser.feed(stream[:cut]) + parser.feed(stream[cut:])
    assert parser.errors is BoardError.NONE
    assert [one.command for one in found] == [Command.SET_TARGET, Command.GET_ERRORS] * len(targets)
    assert [maestro.targets(one) for one in found[::2]] == [dict([one]) for one in targets]
    assert not any(maestro.targets(one) for one in found[1::2])


@given(st.integers(0, 23), st.data())
def test_several_targets_are_one_command(first: int, data: st.DataObject) -> None:
    targets = data.draw(st.lists(TARGETS, min_size=1, max_size=24 - first))
    (found,) = CommandParser().feed(maestro.set_multiple_targets(first, targets))
    assert maestro.targets(found) == {first + k: target for k, target in enumerate(targets)}
    assert maestro.targets(Packet(Command.GO_HOME)) == dict.fromkeys(range(24), maestro.OFF)


def test_commands_to_another_board_are_ignored() -> None:
    parser = CommandParser(device=13)
    assert parser.feed(maestro.set_target(0, 6000, device=12)) == []
    assert parser.feed(maestro.go_home(device=13)) == [Packet(Command.GO_HOME)]
    assert parser.errors is BoardError.NONE


@given(st.binary(max_size=60))
def test_a_valid_command_after_any_bytes_is_executed(noise: bytes) -> None:
    parser = CommandParser()
    parser.feed(noise)
    found = parser.feed(maestro.set_target(1, 5000) * 2)
    assert Packet(Command.SET_TARGET, maestro.set_target(1, 5000)[1:]) in found


def test_incomplete_and_unknown_commands_are_errors() -> None:
    for wrong in (b"\x84\x01\xa1", b"\x05", b"\xc0"):
        parser = CommandParser()
        parser.feed(wrong)
        assert parser.errors is BoardError.PROTOCOL
        assert maestro.error_words(parser.errors) == "serial protocol error"


def test_values_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="0 to 16383 expected, found 16384"):
        maestro.set_target(0, maestro.MAX_TARGET + 1)
    with pytest.raises(ValueError, match="1 to 4 targets from channel 20 on expected, found 5"):
        maestro.set_multiple_targets(20, [0] * 5)
