"""The scenario of a run as its recording keeps it."""

import hashlib
import json
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sextant.shared.files import config
from sextant.shared.files.config import ConfigError
from sextant.shared.files.input_file import FileError, parse_json
from sextant.shared.plugins.loading import Plugins
from sextant.shared.recording.layout import SCENARIO
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Scenario
from sextant.shared.scenario.terrain import HeightMap

if TYPE_CHECKING:
    from sextant.shared.recording.reader import Recording

_OF_THE_COMMAND = ("robot", "walk", "bridge", "link", "params", "time_limit_s", "plugins", "folder")  # its options change them


def named_files(scenario: Scenario) -> dict[str, Path]:
    """Return the height maps and the robot's TOML file that a scenario names: name -> path.

    Raises:
        ConfigError: The environment variable that names a folder is not set.
    """
    found = {part.file: part.path(Path(scenario.folder)) for part in scenario.terrain if isinstance(part, HeightMap)}
    return found | ({scenario.robot: Path(scenario.robot)} if scenario.robot.endswith(".toml") else {})


def as_text(scenario: Scenario) -> str:
    """Return a scenario as JSON for its recording, with a digest of each file that it names."""
    files = named_files(scenario)
    table = config.as_table(replace(scenario, plugins=Plugins(), folder=scenario.folder if files else "."))
    return json.dumps({"scenario": table, "files": {name: _digest(path) for name, path in files.items()}}, ensure_ascii=False)


def walked_scenario(recording: "Recording", given: str = "") -> Scenario | None:
    """Return the scenario that a recorded run has walked; None if its recording, an older one, does not hold it.

    Args:
        recording: The recording, of which something has been read.
        given: The same scenario by name or TOML file; files that it names are then searched next to it.

    Raises:
        ConfigError: The given scenario is another one or invalid, the recorded one cannot be read, or a file that it names is
            missing or has changed since the run.
    """
    text = recording.about.get(SCENARIO)
    if text is None:
        return None
    try:
        table = parse_json(recording.path, text.encode())
        scenario = config.build(table["scenario"], Scenario, f"{recording.path}: the recorded scenario")
        digests = dict(table["files"])
    except (FileError, KeyError, TypeError, ValueError) as error:
        cause = str(error) if isinstance(error, ConfigError | FileError) else "the recorded scenario is damaged"
        raise ConfigError(str(recording.path), [f"{cause}; read it with the version that wrote it"]) from None
    if given:
        other = load_scenario(given)
        names = [field.name for field in fields(Scenario) if field.name not in _OF_THE_COMMAND]
        if differing := [name for name in names if getattr(scenario, name) != getattr(other, name)]:
            found = f"{given} differs from the scenario that {recording.path} holds in {', '.join(differing)}"
            raise ConfigError("--scenario", [f"{found}; leave --scenario out"])
        scenario = replace(scenario, folder=other.folder)
    for name, path in named_files(scenario).items():
        if _digest(path) != digests.get(name):
            state = "has changed since the run" if path.is_file() else "is missing"
            raise ConfigError(str(path), [f"this file of the recorded scenario {state}; restore it"])
    return scenario


def _digest(path: Path) -> str:
    return hashlib.blake2s(path.read_bytes(), digest_size=16).hexdigest() if path.is_file() else ""
