"""TOML text of a whole robot profile."""

from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

from sextant.shared.files import config, whole_files
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.robot.servo import Servo

_DIGITS = 9  # significant digits of a number: micrometres of a robot of any size
_COMMENTS = {
    "servo": "stall torque [N m] and no-load speed [rad/s] at the voltage of the robot",
    "links": "[m] coxa axis to femur axis, to tibia axis, to the foot's centre",
    "body": "[m] size of the trunk, [kg] mass without legs, [kg] masses of coxa, femur and tibia link",
    "stance": "[m], [s] and [m/s]; docs/your_robot.md has advice",
    "camera": '"none" has no driver; "openni2" or "realsense" has',
}


def profile_text(profile: RobotProfile, heading: Sequence[str] = ()) -> str:
    """Return a profile as TOML, from which `load_profile` makes the same profile.

    Args:
        profile: The robot.
        heading: Lines of a comment at the beginning.
    """
    table = config.as_table(profile)
    for key in _without_effect(profile.servo):
        del table["servo"][key]
    for key in ("inertia", "leg_link_inertias"):
        if not any(getattr(profile.body, key)):
            del table["body"][key]
    lines = [f"# {line}" for line in heading]
    lines += [f"{key} = {_value(value)}" for key, value in table.items() if value != [] and not _is_table(value)]
    for name, value in table.items():
        if isinstance(value, dict):
            lines += ["", *_table(name, value)]
    for name, value in table.items():
        if isinstance(value, list) and _is_table(value):
            for entry in value:
                nested = {key: item for key, item in entry.items() if _is_table(item)}
                lines += ["", f"[[{name}]]", *(f"{key} = {_value(item)}" for key, item in entry.items() if key not in nested)]
                for key, item in nested.items():
                    lines += ["", *_table(f"{name}.{key}", item)]
    return "\n".join(lines) + "\n"


def _without_effect(servo: Servo) -> list[str]:
    """Return settings of servos that these do not have, at their defaults."""
    unset = [key for key in ("compliance_slope", "position_gain") if not getattr(servo, key)]
    return unset if servo.servo_model.table.lock or not servo.lock_eeprom else [*unset, "lock_eeprom"]


def require_new_file(path: Path) -> None:
    """Raise ConfigError if a path is not that of a new TOML file."""
    if path.suffix != ".toml":
        raise config.ConfigError("--out", [f"a file that ends in .toml expected, found {path}"])
    if path.exists():
        raise config.ConfigError(str(path), ["it exists; give another file with --out"])


def write_new_profile(path: Path, profile: RobotProfile, heading: Sequence[str] = ()) -> None:
    """Write a profile to a new file, and read it again as later commands do.

    Raises:
        ConfigError: The path is not that of a new TOML file, or the file needs changes, such as another stance.
        WriteError: The file cannot be written.
    """
    require_new_file(path)
    whole_files.write_text(path, profile_text(profile, heading))
    load_profile(str(path))


def _table(name: str, table: Mapping[str, Any]) -> list[str]:
    """Return the lines of a table, then those of its own tables."""
    comment = f"  # {_COMMENTS[name]}" if name in _COMMENTS else ""
    lines = [f"[{name}]{comment}", *(f"{key} = {_value(item)}" for key, item in table.items() if not _is_table(item))]
    for key, item in table.items():
        if isinstance(item, dict):
            lines += ["", *_table(f"{name}.{key}", item)]
        elif _is_table(item):
            for entry in item:
                lines += ["", f"[[{name}.{key}]]", *(f"{word} = {_value(value)}" for word, value in entry.items())]
    return lines


def _is_table(value: object) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and bool(value) and isinstance(value[0], dict))


def _value(value: object) -> str:
    """Return a value in TOML notation."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in escaped) + '"'
    if isinstance(value, float):
        text = f"{value:.{_DIGITS}g}"
        return text if any(c in text for c in ".en") else f"{text}.0"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    return value.isoformat() if isinstance(value, date) else str(value)
