"""Environment of a run: all that determines it except its scenario's values and its seed.

It is the program, the libraries that compute, the files that the scenario names, and its plug-ins.
"""

import hashlib
import importlib.metadata
import json
import platform
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

from sextant.evaluation import provenance
from sextant.evaluation.walked_scenario import named_files
from sextant.shared.errors import SextantError
from sextant.shared.files import config
from sextant.shared.plugins.loading import KINDS, PluginError, load
from sextant.shared.scenario.scenario import Scenario

_PACKAGES = ("shared", "services", "evaluation", "deploy")
_LIBRARIES = ("numpy", "numba", "llvmlite", "mujoco", "opencv-python-headless", "kiss-icp")  # that compute in a run


class ChangedError(SextantError, ValueError):
    """The program on disk has changed since this process started."""


def fingerprint(scenario: Scenario) -> str:
    """Return a digest of all that determines a run except its seed.

    It covers the scenario, the files that the scenario names, its plug-ins, and the program.
    """
    digest = hashlib.blake2s(as_json(replace(scenario, folder=".")).encode() + _begun_by()[0], digest_size=6)
    for path in named_files(scenario).values():
        if path.is_file():
            digest.update(path.read_bytes())
    for path in scenario.plugins.sources():
        digest.update(path.read_bytes())
    return digest.hexdigest()


def as_json(scenario: Scenario) -> str:
    """Return a scenario as JSON."""
    return json.dumps(config.as_table(scenario), sort_keys=True)


def environment(scenario: Scenario) -> dict[str, str]:
    """Return the environment of a scenario's runs in this process: what -> version, digest, or what is wrong with it."""
    found = _program_and_libraries()
    found |= {f"file {path}": _digest(path) for path in named_files(scenario).values()}
    for kind in KINDS:
        if name := str(getattr(scenario.plugins, kind)):
            try:
                load(kind, name)
                found[f"{kind} {name}"] = _digest(*scenario.plugins.sources())
            except PluginError as error:
                found[f"{kind} {name}"] = str(error)
    return found


def check_environment(expected: dict[str, str], scenario: str) -> str:
    """Return how the environment of this process differs from the expected one, as text, or "".

    Args:
        expected: The expected environment.
        scenario: The scenario as JSON, which is read only by the same program.
    """
    here = _program_and_libraries()
    found = differences({part: expected[part] for part in here if part in expected}, here)
    return found or differences(expected, environment(config.build(json.loads(scenario), Scenario, "scenario")))


def differences(expected: Mapping[str, str], found: Mapping[str, str]) -> str:
    """Return in which parts an environment differs from the expected one, as text, or ""."""
    parts = sorted(expected.keys() | found.keys(), key=[*expected, *found].index)
    unlike = [part for part in parts if expected.get(part) != found.get(part)]
    return "; ".join(f"{part}: {expected.get(part, 'none')} expected, found {found.get(part, 'none')}" for part in unlike)


def refuse_another_program() -> None:
    """Remember the program at the first call; later check that it is unchanged.

    Raises:
        ChangedError: The program on disk has changed.
    """
    begun_by, commit = _begun_by()
    if _program() != begun_by:
        raise ChangedError(f"the program has changed since this campaign began; start a new one, or restore commit {commit}")


@cache
def _begun_by() -> tuple[bytes, str]:
    """Return the program's digest and commit as this process first found them."""
    return _program(), provenance.commit()


def _program() -> bytes:
    """Return a digest of Sextant's code, profiles and scenarios on disk."""
    digest = hashlib.blake2s()
    root = Path(__file__).parents[2]
    for package in _PACKAGES:
        for path in sorted((root / package).rglob("*")):
            if path.suffix in (".py", ".toml"):
                digest.update(f"{path.relative_to(root).as_posix()}\0".encode() + path.read_bytes())
    return digest.digest()


def _program_and_libraries() -> dict[str, str]:
    try:
        refuse_another_program()
        program = _begun_by()[0].hex()[:12]
    except ChangedError as error:
        program = str(error)
    found = {"program": program, "Python": platform.python_version(), "architecture": platform.machine()}
    return found | {name: _version(name) for name in _LIBRARIES}


def _version(library: str) -> str:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _digest(*paths: Path) -> str:
    """Return a digest of files, or which of them is missing."""
    digest = hashlib.blake2s(digest_size=6)
    for path in paths:
        if not path.is_file():
            return "missing"
        digest.update(path.read_bytes())
    return digest.hexdigest()
