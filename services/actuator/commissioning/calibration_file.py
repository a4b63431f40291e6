"""Robot configuration file (TOML) with calibrations; all other content stays."""

import os
import re
import tempfile
from pathlib import Path
from typing import Any

from sextant.shared.files import config, input_file
from sextant.shared.robot.profile import Calibration, RobotProfile
from sextant.shared.robot.profiles import load_profile

_NEW = '# One particular robot: the values here override those of the profile that it extends.\nextends = "{base}"\n'
_BLOCK = re.compile(r"^\[\[calibration\]\][^\n]*\n(?:[ \t]*(?:leg|date|trims_deg)[ \t]*=[^\n]*(?:\n|\Z))*", re.MULTILINE)


def keep(path: Path, entry: Calibration, base: str) -> RobotProfile:
    """Write one leg's calibration atomically, replacing an earlier one.

    Args:
        path: The robot's own TOML; created if it does not exist.
        entry: The calibration.
        base: Profile that a new file extends.

    Returns:
        The robot as loaded from the new file.

    Raises:
        ConfigError: The file cannot be written, or not without damage to its content.
    """
    path = path.resolve()
    if path.exists():
        before, old = config.read(path), input_file.read_text(path).replace("\r\n", "\n")
    else:
        before, old = {"extends": base}, _NEW.format(base=base)
    text = with_entry(old, entry)
    if not _is_added(before, entry, text):
        words = "calibration: `[[calibration]]` tables of leg, date and trims_deg expected, found another notation"
        raise config.ConfigError(str(path), [f"{words}; nothing was changed"])
    try:
        return _replace(path, text)
    except OSError as error:
        words = f"cannot be written: {error.strerror}; give another file with --out"
        raise config.ConfigError(str(path), [words]) from None


def with_entry(text: str, entry: Calibration) -> str:
    """Return a profile's text with a leg's calibration replaced, at the end."""

    def kept(block: re.Match[str]) -> str:
        return "" if re.search(rf"""^\s*leg\s*=\s*["']{entry.leg}["']""", block[0], re.MULTILINE) else block[0]

    rest = _BLOCK.sub(kept, text).rstrip("\n")
    trims = ", ".join(f"{trim:.2f}" for trim in entry.trims_deg)
    return (
        f'{rest}\n\n[[calibration]]\nleg = "{entry.leg}"\ndate = {entry.date.isoformat()}\n'
        f"trims_deg = [{trims}]  # coxa, femur, tibia\n"
    )


def _is_added(before: dict[str, Any], entry: Calibration, text: str) -> bool:
    """Return whether only the calibration of the entry's leg has changed."""
    try:
        after = input_file.parse_toml(Path(), text.encode())
    except input_file.FileError:
        return False
    others = [one for one in before.get("calibration", []) if one.get("leg") != entry.leg]
    return after == {**before, "calibration": [*others, config.as_table(entry)]}


def _replace(path: Path, text: str) -> RobotProfile:
    """Replace a file atomically, once the new text loads as a robot."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=".toml", text=True)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        Path(name).chmod(path.stat().st_mode if path.exists() else 0o644)
        robot = load_profile(name)
        Path(name).replace(path)
    finally:
        Path(name).unlink(missing_ok=True)  # if it was not renamed
    return robot
