"""Read scenarios, troubles and families of scenarios, by name or from TOML files."""

import re
from dataclasses import replace
from importlib import resources
from pathlib import Path

from sextant.shared.files import config
from sextant.shared.plugins.loading import Plugins
from sextant.shared.scenario.family import Family, NamedFamily, point_name
from sextant.shared.scenario.scale import scale_of
from sextant.shared.scenario.scenario import Scenario, Trouble
from sextant.shared.spelling import hint, nearest

_SCENARIOS, _TROUBLES, _FAMILIES = (f"sextant.shared.scenario.{name}" for name in ("scenarios", "troubles", "families"))
_NUMBER = re.compile(r"-?\d{1,30}(?:\.\d{1,30})?")
_OF_FILE = re.compile(r"(.*\.toml)([@+][^/]*)?")


def load_scenario(name_or_path: str) -> Scenario:
    """Read a bundled scenario by name, or another one by the path of its TOML file.

    The name of a trouble may follow: `steps+sun` is the scenario `steps` with the trouble `sun` added. So may a scale:
    `steps+x0.85` has 0.85 of its lengths and speeds. A family, by name or path, is a scenario at a value of its parameter:
    `riser@0.05`.

    Raises:
        ConfigError: The scenario does not exist, or is invalid; the text lists all errors.
    """
    course, plus, added = name_or_path.rpartition("+")
    if plus and course and "/" not in added and ".toml" not in added:
        scenario, scale = load_scenario(course), scale_of(added)
        if scale is not None:
            return scenario.scaled(scale)
        return scenario.with_trouble(load_trouble(added), f"{scenario.name}+{added}")
    if name_or_path.endswith(".toml"):
        return _of_file(Path(name_or_path))
    family, at, value = name_or_path.rpartition("@")
    if at and "/" not in value:
        return _point(family, value)
    known, families = scenario_names(), family_names()
    if name_or_path not in known:
        if name_or_path in families:
            raise _no_point(name_or_path, point_names(name_or_path)[1])
        near = hint(name_or_path, [*known, *families])
        ways = f"{near}; or give a point of a family, such as riser@0.05, or a path that ends in .toml"
        raise config.ConfigError("scenario", [f"no scenario {name_or_path[:60]!r}; {ways}"])
    with resources.as_file(resources.files(_SCENARIOS) / f"{name_or_path}.toml") as path:
        return _with_folder(config.load(path, Scenario), path.parent)


def absolute(name_or_path: str) -> str:
    """Return a scenario for `load_scenario`, with the path of its file made absolute; a name stays as it is."""
    found = _OF_FILE.fullmatch(name_or_path)
    return f"{Path(found[1]).resolve()}{found[2] or ''}" if found else name_or_path


def load_trouble(name: str) -> Trouble:
    """Read a bundled trouble by its name.

    Raises:
        ConfigError: The trouble does not exist, or is invalid; the text lists all errors.
    """
    known = trouble_names()
    if name not in known:
        near = nearest(name, known)
        meant = f"did you mean {near!r}? " if near else ""
        words = f"no trouble {name[:60]!r}; {meant}known: {', '.join(known)}; or a scale such as x0.85"
        raise config.ConfigError("trouble", [words])
    with resources.as_file(resources.files(_TROUBLES) / f"{name}.toml") as path:
        return config.load(path, Trouble)


def load_family(name_or_path: str) -> NamedFamily:
    """Read a bundled family by name, or another one by the path of its TOML file.

    Raises:
        ConfigError: The family does not exist, or it or one of its scenarios is invalid.
    """
    found = _family(name_or_path)
    for value in found.family.values:
        found.at(value)
    return found


def scenario_names() -> list[str]:
    """Return the names of the bundled scenarios."""
    return _names(_SCENARIOS)


def trouble_names() -> list[str]:
    """Return the names of the bundled troubles."""
    return _names(_TROUBLES)


def family_names() -> list[str]:
    """Return the names of the bundled families."""
    return _names(_FAMILIES)


def point_names(family: str) -> list[str]:
    """Return the names of the scenarios of a bundled family at its values: `riser@0.03` and so on."""
    return [point_name(family, value) for value in _family(family).family.values]


def _of_file(path: Path) -> Scenario:
    table = config.read(path)
    if {"scenario", "depends"} <= table.keys():
        family = config.build(table, Family, str(path))
        raise _no_point(str(path), f"{path}@{family.values[0]:g}")
    return _with_folder(config.build(table, Scenario, str(path)), path.parent)


def _no_point(family: str, point: str) -> config.ConfigError:
    """Return the error about a family that was given in place of a scenario."""
    words = f"{family!r} is a family of scenarios; a point of it expected, such as {point}"
    return config.ConfigError("scenario", [f"{words}; `sextant trials {family} --curve` walks all of them"])


def _point(family: str, value: str) -> Scenario:
    """Return the scenario of a family at a value of its parameter."""
    if _NUMBER.fullmatch(value) is None:
        words = f"a value of the family's parameter after the @ expected, such as riser@0.05, found {value[:60]!r}"
        raise config.ConfigError("scenario", [words])
    return _family(family).at(float(value))


def _family(name_or_path: str) -> NamedFamily:
    path = Path(name_or_path)
    if not name_or_path.endswith(".toml"):
        known = family_names()
        if name_or_path not in known:
            ways = f"{hint(name_or_path, known)}; or give a path that ends in .toml"
            raise config.ConfigError("family", [f"no family of scenarios {name_or_path[:60]!r}; {ways}"])
        path = Path(str(resources.files(_FAMILIES) / f"{name_or_path}.toml"))
    return NamedFamily(path.stem, config.load(path, Family), path.parent)


def _names(package: str) -> list[str]:
    files = resources.files(package).iterdir()
    return sorted(p.name.removesuffix(".toml") for p in files if p.name.endswith(".toml"))


def _with_folder(scenario: Scenario, folder: Path) -> Scenario:
    if scenario.plugins != Plugins():
        words = "no [plugins] expected, because a scenario is data and a plug-in is code; name plug-ins on the command line"
        raise config.ConfigError(scenario.name, [words])
    return replace(scenario, folder=str(folder.resolve()))
