"""How much a role takes on a disk: the packages that its extra brings, as they are installed here."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

_NAME = "sextant"
_ROOT = Path(__file__).parents[2]
_OWN = ("shared", "services", "deploy")
LIMITS_MB: Mapping[str, float] = {"actuator": 150.0, "onboard": 550.0}  # wanted of the roles that the robot installs
ROLES = ("actuator", "perception", "onboard", "mapper", "planner", "console", "recording", "offboard", "simulator")


@dataclass(frozen=True, slots=True)
class Role:
    """An extra, and what it brings."""

    name: str
    packages_mb: Mapping[str, float]  # by name, the largest first
    missing: tuple[str, ...]  # that are not installed here, so not counted

    @property
    def size_mb(self) -> float:
        """[MB] of all of them."""
        return sum(self.packages_mb.values())


def measure(roles: Sequence[str] = ROLES) -> tuple[Role, ...]:
    """Look at what is installed where this runs; nothing is installed for it."""
    return tuple(_measured(role) for role in roles)


def _measured(role: str) -> Role:
    found: dict[str, float] = {_NAME: _own_mb()}
    missing: list[str] = []
    seen: set[tuple[str, frozenset[str]]] = set()
    waiting = [(_NAME, frozenset({role}))]
    while waiting:
        name, extras = waiting.pop()
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        try:
            package = distribution(name)
        except PackageNotFoundError:
            missing.append(name)
            continue
        if name not in found:
            found[name] = _mb(package)
        waiting += _needed(package, extras)
    largest_first = dict(sorted(found.items(), key=lambda item: -item[1]))
    return Role(role, largest_first, tuple(sorted(missing)))


def _needed(package: Distribution, extras: frozenset[str]) -> list[tuple[str, frozenset[str]]]:
    """(name, extras) of what a package needs on this machine."""
    needed = []
    for line in package.requires or ():
        one = Requirement(line)
        if one.marker is None or any(one.marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            needed.append((str(canonicalize_name(one.name)), frozenset(one.extras)))
    return needed


def _mb(package: Distribution) -> float:
    files = (Path(str(file.locate())) for file in package.files or ())
    return sum(path.stat().st_size for path in files if path.is_file()) / 1e6


def _own_mb() -> float:
    """Our own files, and as much again for the bytecode of those that are Python's."""
    files = [path for top in _OWN for path in (_ROOT / top).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    return sum(path.stat().st_size * (2 if path.suffix == ".py" else 1) for path in files) / 1e6


def in_words(roles: Sequence[Role]) -> str:
    """For people."""
    lines = ["| role | MB | wanted, MB | the largest |", "|---|---|---|---|"]
    for role in roles:
        largest = ", ".join(f"{name} {size:.0f}" for name, size in list(role.packages_mb.items())[:4])
        limit = f"{LIMITS_MB[role.name]:.0f}" if role.name in LIMITS_MB else ""
        without = f"; without {', '.join(role.missing)}, which are not here" if role.missing else ""
        lines.append(f"| `{role.name}` | {role.size_mb:.0f} | {limit} | {largest}{without} |")
    return "\n".join(lines)


def to_json(roles: Sequence[Role]) -> str:
    """For scripts."""
    table = {
        role.name: {
            "mb": round(role.size_mb, 1),
            "packages_mb": {name: round(size, 2) for name, size in role.packages_mb.items()},
            "missing": role.missing,
        }
        for role in roles
    }
    return json.dumps(table, indent=1)
