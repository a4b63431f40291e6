"""Disk size of a role: the installed packages that its extra requires."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from benchmarks.peers import kept

_NAME = "sextant"
_ROOT = Path(__file__).parents[2]
_OWN = ("shared", "services", "evaluation", "deploy")
LIMITS_MB: Mapping[str, float] = {"actuator": 150.0, "onboard": 550.0}  # limits of the roles that are installed on the robot
ROLES = ("actuator", "perception", "onboard", "mapper", "planner", "console", "recording", "offboard", "simulator")


@dataclass(frozen=True, slots=True)
class Role:
    """An extra and its packages."""

    name: str
    packages_mb: dict[str, float]  # name -> size, the largest first
    missing: tuple[str, ...]  # packages that are not installed here, and not counted

    @property
    def size_mb(self) -> float:
        """Total size [MB]."""
        return sum(self.packages_mb.values())


def measure(roles: Sequence[str] = ROLES) -> tuple[Role, ...]:
    """Measure the packages installed in this environment; nothing is installed."""
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
    """Return (name, extras) of the requirements of a package on this machine."""
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
    """Return the size of Sextant's own files.

    The bytecode is assumed to be as large as the Python files.
    """
    files = [path for top in _OWN for path in (_ROOT / top).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    return sum(path.stat().st_size * (2 if path.suffix == ".py" else 1) for path in files) / 1e6


def in_words(roles: Sequence[Role]) -> str:
    """Return the sizes as Markdown."""
    lines = ["| role | MB | wanted, MB | the largest |", "|---|---|---|---|"]
    for role in roles:
        largest = ", ".join(f"{name} {size:.0f}" for name, size in list(role.packages_mb.items())[:4])
        limit = f"{LIMITS_MB[role.name]:.0f}" if role.name in LIMITS_MB else ""
        without = f"; without {', '.join(role.missing)}, which are not installed" if role.missing else ""
        lines.append(f"| `{role.name}` | {role.size_mb:.0f} | {limit} | {largest}{without} |")
    return "\n".join(lines)


def to_json(roles: Sequence[Role]) -> str:
    """Return the sizes as JSON."""
    return kept.rows_to_json(roles)


def from_json(text: str) -> list[Role]:
    """Read sizes written by `to_json`."""
    return kept.rows_from_json(text, Role)
