"""Changes of a robot's own profile file (TOML); comments and all other content stay."""

import os
import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sextant.shared.files import config, input_file
from sextant.shared.robot.profile import Calibration, RobotProfile
from sextant.shared.robot.profiles import load_profile

Values = Mapping[str, float | tuple[float, ...]]

_NEW = '# One particular robot: the values here override those of the profile that it extends.\nextends = "{base}"\n'
_BLOCK = re.compile(r"^\[\[calibration\]\][^\n]*\n(?:[ \t]*(?:leg|date|trims_deg)[ \t]*=[^\n]*(?:\n|\Z))*", re.MULTILINE)


def change(path: Path, base: str, tables: Mapping[str, Values] | None = None, legs: Sequence[Calibration] = ()) -> RobotProfile:
    """Set values and calibrations in a robot's own file, atomically.

    Args:
        path: The file; created if it does not exist.
        base: Profile that a new file extends.
        tables: New values by table, such as "camera.sensor".
        legs: Calibrations, which replace earlier ones of these legs.

    Returns:
        The robot as loaded from the new file.

    Raises:
        ConfigError: The file cannot be written, or not without damage to its content.
    """
    path, tables = path.resolve(), tables or {}
    if path.exists():
        before, text = config.read(path), input_file.read_text(path).replace("\r\n", "\n")
    else:
        before, text = {"extends": base}, _NEW.format(base=base)
    for name, values in tables.items():
        text = with_values(text, name, values)
    for entry in legs:
        text = with_calibration(text, entry)
    if not _is_changed(before, tables, legs, text):
        expected = "tables with one value per line, and `[[calibration]]` tables of leg, date and trims_deg"
        raise config.ConfigError(str(path), [f"{expected} expected, found another notation; nothing was changed"])
    try:
        return _replace(path, text)
    except OSError as error:
        words = f"cannot be written: {error.strerror}; give another file with --out"
        raise config.ConfigError(str(path), [words]) from None


def with_values(text: str, table: str, values: Values) -> str:
    """Return a profile's text with new values of a table, one per line."""
    header = re.search(rf"^\[{re.escape(table)}\][^\n]*\n", text, re.MULTILINE)
    if header is None:
        lines = "".join(f"{key} = {_toml(value)}\n" for key, value in values.items())
        first_array = re.search(r"^\[\[", text, re.MULTILINE)
        place = first_array.start() if first_array else len(text)
        return f"{text[:place].rstrip()}\n\n[{table}]\n{lines}" + (f"\n{text[place:]}" if first_array else "")
    following = re.search(r"^\[", text[header.end() :], re.MULTILINE)
    end = header.end() + following.start() if following else len(text)
    body = text[header.end() : end]
    for key, value in values.items():
        line, new = re.compile(rf"^{key}[ \t]*=[^\n#]*", re.MULTILINE), f"{key} = {_toml(value)}"
        if found := line.search(body):
            body = line.sub(f"{new}  " if found.end() < len(body) and body[found.end()] == "#" else new, body, count=1)
        else:
            body = f"{new}\n{body}"
    return text[: header.end()] + body + text[end:]


def with_calibration(text: str, entry: Calibration) -> str:
    """Return a profile's text with a leg's calibration replaced, at the end."""

    def kept(block: re.Match[str]) -> str:
        return "" if re.search(rf"""^\s*leg\s*=\s*["']{entry.leg}["']""", block[0], re.MULTILINE) else block[0]

    rest = _BLOCK.sub(kept, text).rstrip("\n")
    trims = ", ".join(f"{trim:.2f}" for trim in entry.trims_deg)
    return (
        f'{rest}\n\n[[calibration]]\nleg = "{entry.leg}"\ndate = {entry.date.isoformat()}\n'
        f"trims_deg = [{trims}]  # coxa, femur, tibia\n"
    )


def _is_changed(before: dict[str, Any], tables: Mapping[str, Values], legs: Sequence[Calibration], text: str) -> bool:
    """Return whether a text has the new values and calibrations, and else the content of before."""
    try:
        after = input_file.parse_toml(Path(), text.encode())
    except input_file.FileError:
        return False
    wanted = dict(before)
    for name, values in tables.items():
        table = wanted
        for part in name.split("."):
            table[part] = dict(table.get(part, {}))
            table = table[part]
        table.update({key: list(value) if isinstance(value, tuple) else value for key, value in values.items()})
    if legs:
        names = {entry.leg for entry in legs}
        others = [one for one in before.get("calibration", []) if one.get("leg") not in names]
        wanted["calibration"] = [*others, *(config.as_table(entry) for entry in legs)]
    return after == wanted


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


def _toml(value: float | tuple[float, ...]) -> str:
    return f"[{', '.join(map(repr, value))}]" if isinstance(value, tuple) else repr(value)
