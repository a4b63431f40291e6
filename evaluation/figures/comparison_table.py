"""Comparison of several runs in numbers."""

from collections.abc import Mapping, Sequence
from typing import Any

from sextant.evaluation.figures.recorded_run import RecordedRun

_ROWS = (  # label, path in the report, factor, digits, unit
    ("scenario", "scenario", None, 0, ""),
    ("seed", "seed", None, 0, ""),
    ("gait", "gait", None, 0, ""),
    ("success", "success", None, 0, ""),
    ("distance", "distance_m", 1.0, 2, "m"),
    ("duration", "duration_s", 1.0, 1, "s"),
    ("speed", "speed_mps", 100.0, 1, "cm/s"),
    ("steps", "steps", None, 0, ""),
    ("missteps", "missteps", None, 0, ""),
    ("falls", "falls", None, 0, ""),
    ("tilt off the command, 95 %", "tilt_deg.p95", 1.0, 2, "deg"),
    ("body height error, rms", "body_height_error_m.rms", 1000.0, 1, "mm"),
    ("slip per step, 95 %", "slip_m_per_step.p95", 1000.0, 1, "mm"),
    ("torque, 95 %", "torque_nm.p95", 1.0, 2, "N m"),
    ("torque, worst joint's rms", "torque_nm.rms_worst_joint", 1.0, 2, "N m"),
    ("least stability margin", "min_stability_margin_m", 1000.0, 1, "mm"),
    ("pose error at the end", "pose_error_m.final", 1000.0, 1, "mm"),
    ("map error, rmse", "map_error_m.rmse", 1000.0, 1, "mm"),
)
_NAME = 24  # characters of a run's name


def comparison(runs: Sequence[RecordedRun]) -> list[list[str]]:
    """Return a header of run names, and a row per quantity with its value per run.

    A dash means not measured. If a run had plug-ins, the first row has them.
    """
    names = [run.name if len(run.name) <= _NAME else f"…{run.name[1 - _NAME :]}" for run in runs]
    plugins = [", ".join(f"{kind} {name}" for kind, name in run.numbers.get("plugins", {}).items()) for run in runs]
    replaced = [["plug-ins", *(words or "none" for words in plugins)]] if any(plugins) else []
    return [["", *names], *replaced, *([words, *(_value(run.numbers, *how) for run in runs)] for words, *how in _ROWS)]


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Format rows as a Markdown table."""
    header, *rest = rows
    lines = [f"| {' | '.join(row)} |" for row in rest]
    return "\n".join([f"| {' | '.join(header)} |", "|" + "---|" * len(header), *lines])


def _value(numbers: Mapping[str, Any], place: str, factor: float | None, digits: int, unit: str) -> str:
    found: Any = numbers
    for key in place.split("."):
        found = found[key]
    if found is None:
        return "–"
    if isinstance(found, bool):
        return "yes" if found else "no"
    return str(found) if factor is None else f"{factor * found:.{digits}f} {unit}"
