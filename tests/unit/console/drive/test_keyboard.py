"""Keys from bytes, and the rule that a key is held while it is repeated."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.console.drive.keyboard import FIRST_REPEAT_NS, MOVES, REPEAT_NS, UNKNOWN, HeldKey, Keyboard, split_keys

MS = 1_000_000


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (b"wW \x03", ["w", "W", " ", "\x03"]),
        (b"\x1b[A\x1bOB\x1b[C\x1b[D", ["w", "s", "e", "q"]),
        (b"\x1b[1;5A", [UNKNOWN]),  # control and arrow
        (b"\x1b[200~w", [UNKNOWN, "w"]),  # the beginning of a pasted text
        ("ü".encode(), [UNKNOWN, UNKNOWN]),
        (b"\x1b\x1b[A", [UNKNOWN, "w"]),
    ],
)
def test_bytes_are_split_into_keys(data: bytes, keys: list[str]) -> None:
    assert split_keys(data) == (keys, b"")


@given(st.binary(max_size=40))
def test_any_bytes_are_split_without_loss(data: bytes) -> None:
    keys, rest = split_keys(data)
    assert data.endswith(rest)
    assert len(rest) <= 12
    assert len(keys) <= len(data) - len(rest)
    assert bool(keys) == (len(rest) < len(data))


@given(st.lists(st.sampled_from([b"w", b" ", b"\x1b[A", b"\x1bOD", b"\x1b[1;5A"]), max_size=6), st.data())
def test_sequence_may_arrive_in_two_parts(parts: list[bytes], data: st.DataObject) -> None:
    whole = b"".join(parts)
    cut = data.draw(st.integers(0, len(whole)))
    first, rest = split_keys(whole[:cut])
    second, none = split_keys(rest + whole[cut:])
    assert (first + second, none) == split_keys(whole)


def test_escape_key_alone_is_an_unknown_key_once_nothing_follows() -> None:
    keyboard = Keyboard()
    assert keyboard.read(b"\x1b", 0) == []
    assert keyboard.read(b"", 40 * MS) == [UNKNOWN]
    assert keyboard.read(b"", 80 * MS) == []


def test_first_character_of_a_key_moves_nothing() -> None:
    held = HeldKey()
    held.press("w", 0)
    assert held.wish(1) is None
    held.press("w", FIRST_REPEAT_NS + 1)  # too late for a repetition
    assert held.wish(FIRST_REPEAT_NS + 2) is None


def test_repeated_key_is_held_until_its_repetitions_end() -> None:
    held = HeldKey()
    held.press("w", 0)
    for now in range(500 * MS, 2000 * MS, 33 * MS):
        held.press("w", now)
        assert held.wish(now) == MOVES["w"]
    assert held.wish(now + REPEAT_NS) == MOVES["w"]
    assert held.wish(now + REPEAT_NS + 1) is None
    assert held.wish(now) is None, "it does not come back"
    held.press("w", now + REPEAT_NS + 2)
    assert held.wish(now + REPEAT_NS + 2) is None, "it has to be held again"


def test_another_key_takes_the_place_of_a_held_one_at_once() -> None:
    held = HeldKey()
    held.press("w", 0)
    held.press("w", 500 * MS)
    held.press("d", 600 * MS)
    assert held.wish(600 * MS) == MOVES["d"]
    assert held.wish(600 * MS + FIRST_REPEAT_NS) == MOVES["d"]
    assert held.wish(601 * MS + FIRST_REPEAT_NS) is None


def test_text_that_arrives_at_once_moves_nothing() -> None:
    keyboard = Keyboard()
    keyboard.read(b"w", 0)
    keyboard.read(b"w", 100 * MS)
    assert keyboard.motion.wish(100 * MS) is not None
    assert UNKNOWN in keyboard.read(b"w" * 30, 150 * MS), "it is an unknown key, which stops the robot"


def test_capital_letters_move_too_but_torque_off_needs_its_capital() -> None:
    keyboard = Keyboard()
    assert keyboard.read(b"W", 0) == []
    assert keyboard.read(b"W", 300 * MS) == []
    assert keyboard.motion.wish(300 * MS) == MOVES["w"]
    assert keyboard.read(b"oO", 320 * MS) == ["o", "O"]
