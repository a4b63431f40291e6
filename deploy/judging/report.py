"""What a run comes to: `report.json`, the contract for scripts.

Floats are rounded to six digits, NaN (nothing to measure) becomes null, keys stand in the order of the declarations.
"""

import dataclasses
import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from sextant.shared.files import whole_files

_NAN = float("nan")
_DIGITS = 6
FILE = "report.json"
ARRIVED = "goal reached"  # the reason of a run that is a success by arriving


@dataclass(frozen=True, slots=True)
class Spread:
    """The usual and the worst."""

    p95: float = _NAN
    max: float = _NAN


@dataclass(frozen=True, slots=True)
class Torque:
    """Motor torque [N m] over all joints, and the root mean square of the joint where that is highest."""

    p95: float = _NAN
    max: float = _NAN
    rms_worst_joint: float = _NAN


@dataclass(frozen=True, slots=True)
class HeightError:
    """True height of the body less the one commanded [m]."""

    mean: float = _NAN
    rms: float = _NAN


@dataclass(frozen=True, slots=True)
class Slip:
    """How far a planted foot moves sideways in a step [m]."""

    p50: float = _NAN
    p95: float = _NAN


@dataclass(frozen=True, slots=True)
class PoseError:
    """Estimated less true position of the body [m]."""

    rms: float = _NAN
    final: float = _NAN


@dataclass(frozen=True, slots=True)
class MapError:
    """Mapped less true height [m] within a metre of the robot, and the known share of the ground just ahead [1]."""

    rmse: float = _NAN
    bias: float = _NAN
    p95: float = _NAN
    coverage: float = _NAN


@dataclass(frozen=True, slots=True)
class CourseMap:
    """The maps of a run laid over each other, the newest measurement of each cell on top, less the true ground [m].

    In the words of `sextant bench accuracy`; assumed cells are left out.
    """

    rmse: float = _NAN
    off_edges: float = _NAN  # rmse of cells further than 2 cm from an edge
    bias: float = _NAN
    edge: float = _NAN  # median distance from a true edge of more than 2 cm to the mapped one
    coverage: float = _NAN  # [1] known share of the cells that the camera had in view


@dataclass(frozen=True, slots=True)
class FootholdEdge:
    """How far the footholds on pillars, and on whatever else is as narrow, are from the nearest true edge [m]."""

    p05: float = _NAN
    median: float = _NAN


@dataclass(frozen=True, slots=True)
class Section:
    """What planning at one stop of a passage came to, in the words of `sextant.shared.wire.messages.PassagePlan`."""

    state: str
    reason: str
    generated: int  # nodes, Masri's n_g
    expanded: int  # expansions, in vain or not, his n_e
    planning_ms: float  # timing
    steps: int  # of legs, that are planned to be walked: none where there is no way


@dataclass(frozen=True, slots=True)
class Passage:
    """How a gap was crossed on pillars; without any there is nothing of it but the feet."""

    pillar_touchdowns: int = 0
    foothold_edge_m: FootholdEdge = FootholdEdge()
    feet_off: int = 0  # times a foot that should stand was over nothing, beside a pillar, or in the gap
    passable: bool | None = None  # by an exhaustive search offline; null where nobody has looked, or it cannot tell
    sections: tuple[Section, ...] = ()  # in their order: one for each time it stopped to plan


@dataclass(frozen=True, slots=True)
class StageTime:
    """How long a stage of the work took [ms]."""

    p50: float
    p99: float


@dataclass(frozen=True, slots=True)
class InputAges:
    """How old an input of a service was at its uses [s]."""

    max: float
    limit: float  # beyond which it is of no use
    late: float  # [1] share of the uses beyond the limit


@dataclass(frozen=True, slots=True)
class Report:
    """One run, judged by the truth. Metrics of the walk are NaN when it took no step."""

    scenario: str
    seed: int
    robot: str
    gait: str
    blind: bool  # the baseline without a map
    success: bool  # goal truly reached, or refused where that is right; no fall, no servo shut down, on a route no collision
    reason: str  # in words
    distance_m: float  # true progress along the starting direction
    duration_s: float  # from the first step to the goal, or to the end of a run that did not reach it
    speed_mps: float  # true mean over that time
    falls: int
    shutdowns: int  # servos that latched an error
    steps: int
    tilt_deg: Spread = Spread()  # against the commanded attitude
    commanded_tilt_deg: Spread = Spread()
    torque_nm: Torque = Torque()
    touchdowns: int = 0
    raised_touchdowns: int = 0  # on ground more than 5 mm over the start's: blocks and stairs
    raised_block_touchdowns: int = 0  # of those, on blocks
    body_height_error_m: HeightError = HeightError()
    body_height_oscillation_m: float = _NAN  # 5th to 95th percentile of the true height, telling on level ground only
    slip_m_per_step: Slip = Slip()
    missteps: int = 0  # touchdowns where there truly is no foothold
    collisions: int = 0  # times a foot or the body ran into what is higher than a step, or a foot hung in a hole
    min_stability_margin_m: float = _NAN
    pose_error_m: PoseError = PoseError()
    map_error_m: MapError = MapError()
    course_map_m: CourseMap = CourseMap()
    passage: Passage = Passage()
    real_time_factor: float = _NAN  # simulated over elapsed time; timing, so not the same twice
    stages_ms: dict[str, StageTime] = field(default_factory=dict)  # timing too
    too_slow: str = ""  # that the computer was too slow, in words; empty when it was not
    late_s: float = 0.0  # [s] of the run for which services had inputs that were too old, through a slow computer or link
    input_ages_s: dict[str, InputAges] = field(default_factory=dict)  # "service input", its topic key or "beat"
    missed_beats: dict[str, int] = field(default_factory=dict)  # of each service with a clock of its own, left out


def without_timing(report: Report) -> Report:
    """The part of a report that one seed determines."""
    sections = tuple(replace(section, planning_ms=_NAN) for section in report.passage.sections)
    passage = replace(report.passage, sections=sections)
    return replace(report, passage=passage, real_time_factor=_NAN, stages_ms={}, too_slow="")


def as_table(report: Report) -> dict[str, Any]:
    """Plain nested tables, rounded, stages in alphabetical order."""
    table: dict[str, Any] = plain(report)
    table["stages_ms"] = dict(sorted(table["stages_ms"].items()))
    return table


def to_json(report: Report) -> str:
    """The report as JSON text that ends in a line break."""
    return json.dumps(as_table(report), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write(report: Report, folder: Path) -> None:
    """Write `report.json` into a folder, made where it is missing; a half-written file is never seen.

    Raises:
        WriteError: It cannot be written.
    """
    whole_files.make_folder(folder)
    whole_files.write_text(folder / FILE, to_json(report), durable=True)


def check(table: object, kind: type = Report) -> list[str]:
    """What a table lacks to be a report, or of another kind, in words and with its place; nothing when it is one.

    Further keys are allowed.
    """
    problems: list[str] = []
    _check(table, kind, "", problems)
    return problems


def passage_of(table: dict[str, Any]) -> Passage:
    """A passage of its table, in which `check` finds nothing wrong."""
    sections = tuple(Section(**_numbered(section)) for section in table["sections"])
    edge = FootholdEdge(**_numbered(table["foothold_edge_m"]))
    return Passage(**{**table, "foothold_edge_m": edge, "sections": sections})


def _numbered(table: dict[str, Any]) -> dict[str, Any]:
    return {name: _NAN if value is None else value for name, value in table.items()}


def plain(value: Any) -> Any:
    """A value as JSON has it: tables of dataclasses, lists of tuples, floats rounded, null for NaN."""
    if dataclasses.is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return round(value, _DIGITS) + 0.0 if math.isfinite(value) else None  # adding zero takes the sign off -0.0
    return value


def _check(value: object, hint: Any, where: str, problems: list[str]) -> None:
    place = where or "report"
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            problems.append(f"{place}: a table expected, found {_shown(value)}")
            return
        hints = get_type_hints(hint)
        for name, kind in hints.items():
            path = f"{where}.{name}" if where else name
            if name in value:
                _check(value[name], kind, path, problems)
            else:
                problems.append(f"{path}: missing")
    elif get_origin(hint) is dict:
        if not isinstance(value, dict):
            problems.append(f"{place}: a table expected, found {_shown(value)}")
            return
        for name, item in value.items():
            _check(item, get_args(hint)[1], f"{place}.{name}", problems)
    elif get_origin(hint) is tuple:
        if not isinstance(value, list):
            problems.append(f"{place}: a list expected, found {_shown(value)}")
            return
        for k, item in enumerate(value):
            _check(item, get_args(hint)[0], f"{place}[{k}]", problems)
    elif hint == bool | None:
        if value is not None and not isinstance(value, bool):
            problems.append(f"{place}: true, false or null expected, found {_shown(value)}")
    elif hint is float:
        if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
            problems.append(f"{place}: a number or null expected, found {_shown(value)}")
    elif type(value) is not hint:
        problems.append(f"{place}: {hint.__name__} expected, found {_shown(value)}")


def _shown(value: object) -> str:
    return f"{type(value).__name__} {str(value)[:40]!r}"
