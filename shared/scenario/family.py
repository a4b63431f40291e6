"""Families of scenarios: one parameter leads from an easy to an impossible course.

A family is read from TOML. Its scenario is complete; at each point, the values that depend on the parameter are replaced.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sextant.shared.files import config
from sextant.shared.scenario.scenario import Scenario

_MOST_POINTS = 100


@dataclass(frozen=True, slots=True)
class Dependence:
    """A value of the scenario that depends on the parameter p: offset + factor * p."""

    key: str  # place in the scenario, such as terrain.1.riser; numbers count from 0
    factor: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, slots=True)
class Family:
    """Scenarios that differ in one parameter."""

    about: str  # what the robot has to pass
    parameter: str  # name of the parameter, for tables and pictures
    values: tuple[float, ...]  # from easy to impossible, rising or falling
    depends: tuple[Dependence, ...]
    scenario: dict[str, object]  # table of a scenario without a name
    unit: str = ""  # unit in tables and pictures
    scale: float = 1.0  # factor from the parameter to that unit
    limit: Literal["", "riser", "drop", "gap", "slope"] = ""  # limit of `sextant robot check` that is comparable

    def __post_init__(self) -> None:
        check_values(self.values)
        if not self.depends:
            raise ValueError("at least one value that depends on the parameter expected, found none; add [[depends]]")
        if self.scale == 0:
            raise ValueError("a scale other than 0 expected, found 0")

    def at(self, value: float, name: str, folder: Path) -> Scenario:
        """Return the scenario at a value of the parameter.

        Args:
            value: Value of the parameter.
            name: Name of the family.
            folder: Folder of the files that the scenario names.

        Raises:
            ConfigError: The scenario is invalid, or has no such values; the text lists all errors.
        """
        table = deepcopy(self.scenario)
        for one in self.depends:
            _put(table, one.key, one.offset + one.factor * value, name)
        made = config.build({"name": point_name(name, value)} | table, Scenario, f"family {name} at {value:g}")
        return replace(made, folder=str(folder.resolve()))


@dataclass(frozen=True, slots=True)
class NamedFamily:
    """A family, its name and the folder of its file."""

    name: str
    family: Family
    folder: Path

    def at(self, value: float) -> Scenario:
        """Return the scenario at a value of the parameter; see `Family.at`."""
        return self.family.at(value, self.name, self.folder)


def point_name(family: str, value: float) -> str:
    """Return the name of the scenario of a family at a value of its parameter, without loss of digits: `riser@0.05`."""
    return f"{family}@{np.format_float_positional(value + 0.0, trim='-')}"  # + 0.0: no -0


def check_values(values: Sequence[float]) -> None:
    """Check values of a parameter.

    Raises:
        ValueError: They are fewer than two or too many, or neither rise nor fall.
    """
    rising, falling = sorted(set(values)), sorted(set(values), reverse=True)
    if not 2 <= len(values) <= _MOST_POINTS or list(values) not in (rising, falling):
        raise ValueError(f"2 to {_MOST_POINTS} rising or falling values expected, found {list(values)}")


def _put(table: dict[str, Any], key: str, value: float, name: str) -> None:
    """Replace the value at a place of nested tables and arrays.

    Raises:
        ConfigError: There is no such place.
    """
    place: Any = table
    *parents, last = [int(word) if word.isdigit() else word for word in key.split(".")]
    try:
        for word in parents:
            place = place[word]
        place[last]  # it exists
        place[last] = value
    except (KeyError, IndexError, TypeError):
        words = f"depends: {key}: the place of a value in the scenario expected, found none; the scenario has it with any value"
        raise config.ConfigError(f"family {name}", [words]) from None
