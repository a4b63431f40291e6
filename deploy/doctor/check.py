"""Result of a check of this machine: severity, finding and advice."""

from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    """Severity of a check."""

    OK = "OK"
    WARN = "WARN"  # works, but not as it should
    FAIL = "FAIL"


@dataclass(frozen=True, slots=True)
class Check:
    """Result of one check."""

    name: str
    level: Level
    found: str  # as text
    advice: str = ""  # what to do; empty if the level is OK
