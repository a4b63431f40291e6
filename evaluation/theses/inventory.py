"""Inventory of a thesis: each figure and table, how it is drawn, or why it cannot be."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from sextant.evaluation.theses.data import Data


@dataclass(frozen=True, slots=True)
class Printed:
    """A number that the thesis prints, and the place where."""

    quantity: str
    value: str


@dataclass(frozen=True, slots=True)
class Entry:
    """A figure or a table of a thesis."""

    number: str  # such as "8.2" or "Table 6.1"
    shows: str
    draw: Callable[[Any, Data], Sequence[str]] | None = None  # draws on a figure; returns our value of each printed number
    why_not: str = ""  # why it is not drawn
    printed: tuple[Printed, ...] = ()
    walks: tuple[str, ...] = ()  # scenarios that are walked for it
    trials: int = 1  # walks of each of them
    size: tuple[float, float] = (7.0, 3.6)  # [in] without the table of numbers
    ours: str = ""  # what our data is

    @property
    def name(self) -> str:
        """Return the name of its files."""
        words = self.number if self.number.startswith("Table") else f"figure {self.number}"
        return words.lower().replace(" ", "_").replace(".", "_")

    @property
    def title(self) -> str:
        """Return how it is called in text."""
        return self.number if self.number.startswith("Table") else f"Figure {self.number}"


@dataclass(frozen=True, slots=True)
class Thesis:
    """A thesis with its inventory."""

    name: str
    title: str
    entries: tuple[Entry, ...]

    def __post_init__(self) -> None:
        """Sort the entries: figures by chapter, then tables."""
        object.__setattr__(self, "entries", tuple(sorted(self.entries, key=_order)))


def numbers(*pairs: tuple[str, str]) -> tuple[Printed, ...]:
    """Return printed numbers from pairs of quantity and value."""
    return tuple(Printed(*pair) for pair in pairs)


def undrawn(why_not: str, *entries: tuple[str, str]) -> list[Entry]:
    """Return entries that are not drawn for one reason, from pairs of number and content."""
    return [Entry(number, shows, why_not=why_not) for number, shows in entries]


def _order(entry: Entry) -> tuple[bool, str, int]:
    """Return the place of an entry in the inventory."""
    chapter, _, number = entry.number.removeprefix("Table ").rpartition(".")
    return entry.number.startswith("Table"), chapter.zfill(2), int(number)
