"""Keys of a terminal: which bytes are which key, and which key is held.

A terminal sends a character when a key is pressed, and repeats it while the key is held. It does not report the release of a
key. A key therefore counts as held while its repetitions arrive.
"""

import re
from collections.abc import Mapping
from typing import TypeAlias

Wish: TypeAlias = tuple[float, float, float]  # forward, left, turn to the left, each from -1 to 1

# Largest time [ns] from the first character of a key to its first repetition. Terminals wait for 0.25 to 0.66 s.
FIRST_REPEAT_NS = 700_000_000
REPEAT_NS = 300_000_000  # [ns] without a repetition after which a held key counts as released, as the pad of the page does
_MOST_MOVES = 8  # keys of motion that one reading may return; more are typed text, or have waited in a stalled connection
MOVES: Mapping[str, Wish] = {
    "w": (1.0, 0.0, 0.0),
    "s": (-1.0, 0.0, 0.0),
    "a": (0.0, 1.0, 0.0),
    "d": (0.0, -1.0, 0.0),
    "q": (0.0, 0.0, 1.0),
    "e": (0.0, 0.0, -1.0),
}
UNKNOWN = ""  # a key without a meaning
_SEQUENCE = re.compile(rb"\x1b[\[O][0-9;]*[\x20-\x2f]*[\x40-\x7e]")
_BEGUN = re.compile(rb"\x1b(?:[\[O][0-9;]{0,8}[\x20-\x2f]?)?")  # beginning of a sequence
_ARROWS = {b"A": "w", b"B": "s", b"D": "q", b"C": "e"}  # final byte of a sequence


def split_keys(data: bytes) -> tuple[list[str], bytes]:
    """Split the bytes of a terminal into keys.

    Returns:
        The keys: characters, a letter for an arrow, `UNKNOWN` for any other sequence; and the beginning of a sequence whose
        rest has not arrived.
    """
    keys: list[str] = []
    at = 0
    while at < len(data):
        if data[at] != 0x1B:
            keys.append(chr(data[at]) if data[at] < 0x80 else UNKNOWN)
            at += 1
        elif found := _SEQUENCE.match(data, at):
            keys.append(_ARROWS.get(found[0][2:], UNKNOWN))
            at = found.end()
        elif _BEGUN.fullmatch(data, at):
            return keys, data[at:]
        else:
            keys.append(UNKNOWN)
            at += 1
    return keys, b""


class HeldKey:
    """The key of motion that is held, as its repetitions show.

    The first character of a key moves nothing: a key that is touched, or a typed text, is not held. While a key is held,
    another key of motion takes its place at once.
    """

    def __init__(self) -> None:
        self._key = ""
        self._until_ns = 0  # time by which the next repetition has to arrive
        self._held = False
        self._typed_ns = -REPEAT_NS  # time of the newest character of a key of motion

    def press(self, key: str, now_ns: int) -> None:
        """Process a character of a key of motion."""
        before, self._typed_ns = self.wish(now_ns), now_ns
        if key == self._key and now_ns <= self._until_ns:
            self._held, self._until_ns = True, now_ns + REPEAT_NS
        else:
            self._key, self._held, self._until_ns = key, before is not None, now_ns + FIRST_REPEAT_NS

    def release(self, now_ns: int) -> None:
        """Forget the key."""
        self._key, self._held, self._typed_ns = "", False, now_ns

    def is_released(self, now_ns: int) -> bool:
        """Return whether no key of motion is repeated any more."""
        return now_ns - self._typed_ns > REPEAT_NS

    def wish(self, now_ns: int) -> Wish | None:
        """Return the motion of the held key; None without one."""
        if not self._held or now_ns > self._until_ns:
            self._held = False
            return None
        return MOVES[self._key]


class Keyboard:
    """Keys from the bytes of a terminal: the held key of motion, and the other keys."""

    def __init__(self) -> None:
        self.motion = HeldKey()
        self._rest = b""  # beginning of a sequence

    def read(self, data: bytes, now_ns: int) -> list[str]:
        """Process the bytes of one reading, and return the keys that do not move the robot.

        A key without a meaning is `UNKNOWN`, and so are more keys of motion than a held key repeats in one reading.
        """
        incomplete, whole = self._rest, self._rest + data
        keys, self._rest = split_keys(whole)
        if incomplete and self._rest == incomplete:  # nothing has followed: the escape key
            keys, self._rest = [*keys, UNKNOWN], b""
        moves = [key.lower() for key in keys if key.lower() in MOVES]
        others = [key for key in keys if key.lower() not in MOVES]
        if len(moves) > _MOST_MOVES:
            return [*others, UNKNOWN]
        for key in moves:
            self.motion.press(key, now_ns)
        return others
