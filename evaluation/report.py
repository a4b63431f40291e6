"""The result of a run: `report.json`, the contract for scripts.

Floats are rounded to six digits. NaN (nothing to measure) becomes null. Keys are in the order of the declarations.
"""

import dataclasses
import json
import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

from sextant.shared.files import whole_files

_NAN = float("nan")
_DIGITS = 6
_OF_CAMERA = "the camera "
FILE = "report.json"
ARRIVED = "goal reached"  # the reason of a run that succeeds by arriving


@dataclass(frozen=True, slots=True)
class Spread:
    """Angle between two attitudes over a walk."""

    p95: float = _NAN  # [deg] 95th percentile
    max: float = _NAN  # [deg] maximum


@dataclass(frozen=True, slots=True)
class Torque:
    """Motor torque over a walk."""

    p95: float = _NAN  # [N m] 95th percentile over all joints
    max: float = _NAN  # [N m] maximum over all joints
    rms_worst_joint: float = _NAN  # [N m] RMS of the joint with the highest one


@dataclass(frozen=True, slots=True)
class HeightError:
    """True minus commanded height of the body."""

    mean: float = _NAN  # [m] mean; positive: the body is too high
    rms: float = _NAN  # [m] root mean square


@dataclass(frozen=True, slots=True)
class Slip:
    """Horizontal motion of a planted foot in a step."""

    p50: float = _NAN  # [m] median
    p95: float = _NAN  # [m] 95th percentile


@dataclass(frozen=True, slots=True)
class PoseError:
    """Distance of the estimated position of the body from the true one."""

    rms: float = _NAN  # [m] root mean square over the walk
    final: float = _NAN  # [m] at the end of the walk


@dataclass(frozen=True, slots=True)
class CameraFound:
    """Errors of the camera's profile as the robot estimates them at the end: those of the profile minus the true ones."""

    rpy_deg: tuple[float, float, float] = (_NAN, _NAN, _NAN)  # [deg] of the mount, in axes of the body
    rpy_sigma_deg: tuple[float, float, float] = (_NAN, _NAN, _NAN)  # [deg] their standard deviations
    height_m: float = _NAN  # [m] of the mount
    height_sigma_m: float = _NAN  # [m] its standard deviation
    depth_error: float = _NAN  # [1] relative, positive if the measured depth is too large
    depth_error_sigma: float = _NAN  # [1] its standard deviation
    time_offset_s: float = _NAN  # [s] from an exposure to its stamp
    time_offset_sigma_s: float = _NAN  # [s] its standard deviation
    finding: str = ""  # sentence about the camera in the status at the end of the run, or empty


@dataclass(frozen=True, slots=True)
class HornsFound:
    """Errors of the horns as the robot estimates them at the end, to add to the profile's; (18,) coxa, femur, tibia per leg."""

    estimate_deg: tuple[float, ...] = ()  # [deg] most likely errors
    sigma_deg: tuple[float, ...] = ()  # [deg] their standard deviations
    corrected_deg: tuple[float, ...] = ()  # [deg] what the actuator added


@dataclass(frozen=True, slots=True)
class ChosenGait:
    """A choice of gait and speed by the planner; it holds until the next one."""

    time_s: float  # [s] since the start of the run
    gait: str  # tripod, ripple or wave
    speed_mps: float  # [m/s] over level ground; 0 where the operator gives the speed
    reason: str  # class of the ground, a colon, and what decided, as text


@dataclass(frozen=True, slots=True)
class Warned:
    """A warning of the robot about itself, as it was first given; with other numbers it is the same warning."""

    time_s: float  # [s] since the start of the run
    step: int  # [1] step of a group of legs
    words: str  # the warning, as text


@dataclass(frozen=True, slots=True)
class MapError:
    """Mapped minus true height within 1 m of the robot."""

    rmse: float = _NAN  # [m] root mean square error
    bias: float = _NAN  # [m] mean error; positive: the map is too high
    p95: float = _NAN  # [m] 95th percentile of the absolute error
    coverage: float = _NAN  # [1] known share of the ground just ahead


@dataclass(frozen=True, slots=True)
class CourseMap:
    """Mosaic of a run's maps, the newest measurement of each cell, minus the true ground; assumed cells are excluded."""

    rmse: float = _NAN  # [m] root mean square error
    off_edges: float = _NAN  # [m] root mean square error of cells further than 2 cm from an edge
    bias: float = _NAN  # [m] mean error; positive: the map is too high
    edge: float = _NAN  # [m] median distance from a true edge higher than 2 cm to the mapped edge
    coverage: float = _NAN  # [1] known share of the cells in the camera's view


@dataclass(frozen=True, slots=True)
class FootholdEdge:
    """Distance of footholds on narrow tops from the nearest edge."""

    p05: float = _NAN  # [m] 5th percentile
    median: float = _NAN  # [m] median


@dataclass(frozen=True, slots=True)
class Section:
    """Result of planning at one stop of a passage; fields are those of `sextant.shared.wire.messages.PassagePlan`."""

    state: str  # result of the search
    reason: str  # why there is no way; empty if there is one
    generated: int  # [1] number of nodes, n_g of Masri
    expanded: int  # [1] number of expansions, successful or not, n_e of Masri
    planning_ms: float  # [ms] duration of the search; timing, so not reproducible
    steps: int  # [1] planned steps of legs: 0 where there is no way


@dataclass(frozen=True, slots=True)
class Passage:
    """How a gap was crossed on pillars; without pillars only `feet_off` applies."""

    pillar_touchdowns: int = 0  # [1] touchdowns of feet on pillars
    foothold_edge_m: FootholdEdge = FootholdEdge()  # distance of footholds from the nearest edge
    feet_off: int = 0  # [1] times that a standing foot was over nothing, next to a pillar, or in the gap
    # Whether there is a way across, by an exhaustive search offline; null if no search was made or its result is unknown
    passable: bool | None = None
    sections: tuple[Section, ...] = ()  # results of planning in order: one for each stop to plan
    tipped: int = 0  # [1] times that a foot stood on a pillar that tipped or sank under it by more than 8 mm


@dataclass(frozen=True, slots=True)
class CaptureToPlan:
    """Time from a depth image to the plan that the legs execute, for images whose map reached the legs.

    It begins with the stamp of the image. It ends with the actuator's cycle that first executes a plan based on its map, or on
    a newer one. A plan that was compared with a map and left unchanged is based on it.
    """

    p50: float = _NAN  # [ms] median
    p90: float = _NAN  # [ms] 90th percentile
    p99: float = _NAN  # [ms] 99th percentile
    images: int = 0  # [1] number of such images


@dataclass(frozen=True, slots=True)
class StageTime:
    """Duration of a stage of a service's work."""

    p50: float  # [ms] median
    p99: float  # [ms] 99th percentile


@dataclass(frozen=True, slots=True)
class InputAges:
    """Age of a service's input when it is used."""

    max: float  # [s] maximum of all uses
    limit: float  # [s] above which the input is unusable
    late: float  # [1] share of the uses above the limit


@dataclass(frozen=True, slots=True)
class Report:
    """One run, evaluated by ground truth.

    Metrics of the walk are NaN if no step was taken.
    """

    scenario: str  # name of the course
    seed: int  # [1] of everything random
    robot: str  # name of the profile
    gait: str  # of the walk: tripod, ripple or wave; auto: see `gait_choices`
    blind: bool  # whether it is the baseline without a map
    success: bool  # goal truly reached, or correctly refused; no fall, no servo shutdown, on a route no collision
    reason: str  # why it ended, as text
    distance_m: float  # [m] true progress along the initial heading; length of the way of a route with waypoints
    duration_s: float  # [s] from the first step to the goal, or to the end of a run that did not reach it
    speed_mps: float  # [m/s] true mean over that time
    falls: int  # [1] times that the body fell
    shutdowns: int  # [1] servos that latched an error
    steps: int  # [1] steps of a group of legs
    tilt_deg: Spread = Spread()  # angle between true and commanded attitude of the body
    commanded_tilt_deg: Spread = Spread()  # angle between commanded attitude and upright
    torque_nm: Torque = Torque()  # of the motors
    touchdowns: int = 0  # [1] touchdowns of all feet
    raised_touchdowns: int = 0  # [1] those on ground more than 5 mm above the start: blocks and stairs
    raised_block_touchdowns: int = 0  # [1] those on blocks
    body_height_error_m: HeightError = HeightError()  # true minus commanded height of the body
    body_height_oscillation_m: float = _NAN  # [m] 5th to 95th percentile of the true height, meaningful on level ground only
    slip_m_per_step: Slip = Slip()  # horizontal motion of planted feet
    missteps: int = 0  # [1] touchdowns where the true ground is no foothold
    collisions: int = 0  # [1] times that a foot or the body hit an obstacle higher than a step, or a foot hung in a hole
    min_stability_margin_m: float = _NAN  # [m] least margin of the body inside the feet that carry load
    pose_error_m: PoseError = PoseError()  # of the estimated pose
    map_error_m: MapError = MapError()  # of the map around the robot
    camera: CameraFound = CameraFound()  # errors of the camera's profile, estimated by the robot
    horns: HornsFound = HornsFound()  # errors of the horns, estimated by the robot; empty without a step
    warnings: tuple[Warned, ...] = ()  # of servos, battery, legs and camera, in order
    hottest_servo_c: float = _NAN  # [deg C] highest temperature of any servo
    gait_choices: tuple[ChosenGait, ...] = ()  # of gait or kind of ground, if the planner chooses gait or speed
    course_map_m: CourseMap = CourseMap()  # of all maps of the run together
    passage: Passage = Passage()  # how a gap was crossed
    capture_to_plan_ms: CaptureToPlan = CaptureToPlan()  # time from a depth image to the plan in execution
    real_time_factor: float = _NAN  # [1] simulated over elapsed time; timing, so not reproducible
    stages_ms: dict[str, StageTime] = field(default_factory=dict)  # duration of each `service.stage`; timing, too
    too_slow: str = ""  # why the computer was too slow, as text; empty if it was not
    late_s: float = 0.0  # [s] of the run in which services had inputs that were too old, because of a slow computer or link
    # Ages of each "service input"; the input is a topic key or "beat"
    input_ages_s: dict[str, InputAges] = field(default_factory=dict)
    missed_beats: dict[str, int] = field(default_factory=dict)  # [1] missed cycles of each service with its own clock
    params: dict[str, Any] = field(default_factory=dict)  # all parameters of the services; empty if they were started elsewhere
    # Deviations of the real robot from its profile, see `[mismatch]` of the scenario; empty if it has none
    deviation: dict[str, Any] = field(default_factory=dict)
    plugins: dict[str, str] = field(default_factory=dict)  # planner, foothold and registration in place of Sextant's own

    @property
    def manner(self) -> str:
        """Gait of the walk, and what else was chosen for it: no map, plug-ins."""
        named = (f"{kind} {name}" for kind, name in self.plugins.items())
        return ", ".join((self.gait, *["blind"] * self.blind, *named))


def without_figures(words: str) -> str:
    """Replace the numbers of a reason or warning, so that similar ones count together."""
    return re.sub(r"\d+(\.\d+)?", "#", words)


def camera_errors_named(finding: str) -> tuple[str, ...]:
    """Return the statements of a sentence about the camera, such as `the camera looks 2 deg (1 to 3) lower`."""
    said = finding.removeprefix(_OF_CAMERA).partition(" than its profile")[0]
    return tuple(_OF_CAMERA + part for part in said.split(" and ") if part)


def without_timing(report: Report) -> Report:
    """Return the part of a report that the seed determines."""
    sections = tuple(replace(section, planning_ms=_NAN) for section in report.passage.sections)
    passage = replace(report.passage, sections=sections)
    return replace(report, passage=passage, real_time_factor=_NAN, stages_ms={}, too_slow="")


def as_table(report: Report) -> dict[str, Any]:
    """Return the report as nested dictionaries, rounded, with sorted stages."""
    table: dict[str, Any] = plain(report)
    table["stages_ms"] = dict(sorted(table["stages_ms"].items()))
    table["params"] = report.params  # exact
    return table


def to_json(report: Report) -> str:
    """Return the report as JSON text with a final newline."""
    return json.dumps(as_table(report), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write(report: Report, folder: Path) -> None:
    """Write `report.json` atomically into a folder, which is created if missing.

    Raises:
        WriteError: It cannot be written.
    """
    whole_files.make_folder(folder)
    whole_files.write_text(folder / FILE, to_json(report), durable=True)


def check(table: object, kind: type = Report) -> list[str]:
    """Return the problems of a table as a report (or another kind); empty if valid.

    Each problem names its path. Further keys are allowed.
    """
    problems: list[str] = []
    _check(table, kind, "", problems)
    return problems


def passage_of(table: dict[str, Any]) -> Passage:
    """Build a passage from its table, which `check` has accepted."""
    sections = tuple(Section(**_numbered(section)) for section in table["sections"])
    edge = FootholdEdge(**_numbered(table["foothold_edge_m"]))
    return Passage(**{**table, "foothold_edge_m": edge, "sections": sections})


def _numbered(table: dict[str, Any]) -> dict[str, Any]:
    return {name: _NAN if value is None else value for name, value in table.items()}


def plain(value: Any) -> Any:
    """Convert a value to JSON types.

    Dataclasses become dictionaries, tuples lists, NaN null; floats are rounded.
    """
    if dataclasses.is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return round(value, _DIGITS) + 0.0 if math.isfinite(value) else None  # adding zero turns -0.0 into 0.0
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
    elif NoneType in get_args(hint):
        if value is not None:
            _check(value, get_args(hint)[0], where, problems)
    elif hint is Any:
        return
    elif hint is float:
        if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
            problems.append(f"{place}: a number or null expected, found {_shown(value)}")
    elif type(value) is not hint:
        problems.append(f"{place}: {hint.__name__} expected, found {_shown(value)}")


def _shown(value: object) -> str:
    return f"{type(value).__name__} {str(value)[:40]!r}"
