"""Reads of several servos by one request, and when to use a fast sync read of Dynamixel Protocol 2.0.

Its one answer is shorter than the answers to a sync read, but each servo continues the answer of the one before it. Behind a
silent servo, and behind a broken byte, the rest of the answer is lost.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from sextant.shared.servo.servo_model import Block, ServoModel

_PLAIN_NS = 1_000_000_000  # [ns] of sync reads after an incomplete answer
_TRIES = 3  # consecutive incomplete answers after which no fast sync read is sent any more


class FastRead:
    """Decides between a fast sync read and a sync read, by the answers so far."""

    def __init__(self, models: Iterable[ServoModel]) -> None:
        """Begin with fast sync reads if each of these models has a firmware that answers them."""
        since = [model.fast_firmware for model in models]
        self._since = None if None in since else max(filter(None, since), default=None)
        self._tries = 0 if self._since is None else _TRIES
        self._plain_until_ns = 0

    def set_firmware(self, oldest: int) -> None:
        """Allow fast sync reads by the oldest firmware on the bus."""
        self._tries = _TRIES if self._since is not None and oldest >= self._since else 0

    def is_usable(self, now_ns: int) -> bool:
        """Return whether to send a fast sync read at a time [ns] to servos that have all answered their last request."""
        return self._tries > 0 and now_ns >= self._plain_until_ns

    def note(self, now_ns: int, *, complete: bool) -> None:
        """Note an answer, and whether all servos were in it."""
        if complete:
            self._tries = _TRIES
        else:
            self._tries -= 1
            self._plain_until_ns = now_ns + _PLAIN_NS


class CommonRead(NamedTuple):
    """Servos that one request can read, because they have the same registers."""

    block: Block  # what is read
    indices: frozenset[int]  # of the servos
    fast: FastRead


def common_reads(models: Sequence[ServoModel]) -> list[CommonRead]:
    """Return the groups of servos (n,) that one request can read."""
    places: dict[tuple[int, int], list[int]] = {}
    for index, model in enumerate(models):
        places.setdefault((model.table.state.address, model.table.state.size), []).append(index)
    return [CommonRead(models[of[0]].table.state, frozenset(of), FastRead(models[k] for k in of)) for of in places.values()]
