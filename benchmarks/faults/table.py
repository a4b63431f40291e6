"""Compare many injections with the limits: numbers in, a table out."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from math import ceil, isfinite, isinf, nan
from typing import Any

from benchmarks.faults.batch import Injection
from benchmarks.faults.cases import BY_NAME, Case
from benchmarks.faults.walk_verdict import Outcome
from sextant.evaluation.trials.statistics import wilson
from sextant.services.actuator.safety.health_monitor import LATE_CYCLES


@dataclass(frozen=True, slots=True)
class Figure:
    """Percentiles of one quantity over the injections in which it was measured.

    They use the nearest rank, and are NaN without a measurement.
    """

    n: int
    p50: float
    p99: float
    worst: float


@dataclass(frozen=True, slots=True)
class Row:
    """Results of one fault."""

    fault: str
    n: int
    decided_s: Figure
    rest_s: Figure
    margin_m: Figure  # the worst is the minimum
    again_s: Figure
    jump_deg: Figure
    lunge_dps: Figure
    off_s: Figure
    seated_s: Figure
    cycle_s: Figure  # p99 of each injection
    falls: int
    switched: int  # number of injections in which torque was switched
    stopped: int  # number of injections in which the robot stopped
    outside: int  # goals outside the joints' limits
    plans: int  # number of fuzzed plans
    missed: tuple[str, ...]  # violated limits, each with its number of injections
    lost_s: Figure = Figure(0, nan, nan, nan)
    misheard: int = 0  # injections in which a servo switched torque without a command
    goal_dps: Figure = Figure(0, nan, nan, nan)
    walked: int = 0  # minimum number of executed fuzzed plans
    named_s: Figure = Figure(0, nan, nan, nan)  # of a lie
    named_as: dict[str, int] = field(default_factory=dict)  # how it was named, and how often
    commits: tuple[str, ...] = ()  # commits of the program, in alphabetical order
    place_m: Figure = Figure(0, nan, nan, nan)
    ended: dict[str, int] = field(default_factory=dict)  # how the injections on a course ended, and how often

    @property
    def passed(self) -> bool:
        """Whether all limits are kept."""
        return not self.missed


def rows(found: Iterable[Injection], cases: Mapping[str, Case] = BY_NAME) -> list[Row]:
    """Return a row for each fault, in order, by the limits of these cases."""
    by_fault: dict[str, list[Injection]] = {}
    for one in found:
        by_fault.setdefault(one.fault, []).append(one)
    return [
        row(cases[fault], [one.outcome for one in each], tuple(sorted({one.commit for one in each} - {""})))
        for fault, each in by_fault.items()
    ]


def row(case: Case, outcomes: Sequence[Outcome], commits: tuple[str, ...] = ()) -> Row:
    """Compute the row of one fault."""

    def of(name: str, worst_is_least: bool = False) -> Figure:
        return figure([getattr(one, name) for one in outcomes], worst_is_least)

    return Row(
        fault=case.name,
        n=len(outcomes),
        decided_s=of("decided_s"),
        rest_s=of("rest_s"),
        margin_m=of("margin_m", worst_is_least=True),
        again_s=of("again_s"),
        jump_deg=of("jump_deg"),
        lunge_dps=of("lunge_dps"),
        off_s=of("off_s"),
        seated_s=of("seated_s"),
        cycle_s=of("cycle_s"),
        falls=sum(one.falls for one in outcomes),
        switched=sum(one.switched for one in outcomes),
        stopped=sum(one.stops > 0 for one in outcomes),
        outside=sum(one.outside for one in outcomes),
        plans=sum(one.plans for one in outcomes),
        missed=_missed(case, outcomes),
        lost_s=of("lost_s"),
        misheard=sum(one.misheard for one in outcomes),
        goal_dps=of("goal_dps"),
        walked=sum(one.walked for one in outcomes),
        named_s=of("named_s"),
        named_as=dict(sorted(Counter(one.named_as for one in outcomes if one.named_as).items())),
        commits=commits,
        place_m=of("place_m"),
        ended=dict(sorted(Counter(one.ended for one in outcomes if one.ended).items())),
    )


def figure(values: Sequence[float], worst_is_least: bool = False) -> Figure:
    """Return p50, p99 and worst of values by nearest rank.

    With `worst_is_least`, 99 % of the values are above p99.
    """
    known = sorted((value for value in values if isfinite(value)), reverse=worst_is_least)
    if not known:
        return Figure(0, nan, nan, nan)
    p50, p99 = (known[ceil(share * len(known)) - 1] for share in (0.50, 0.99))
    return Figure(len(known), p50, p99, known[-1])


def _missed(case: Case, outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    """Return the violated limits with their counts."""
    counts = [(words, sum(not keeps(one) for one in outcomes)) for words, keeps in _laws(case)]
    return tuple(f"{words}: missed by {count} of {len(outcomes)}" for words, count in counts if count)


def _laws(case: Case) -> Iterable[tuple[str, Callable[[Outcome], bool]]]:
    """Yield the requirements for every injection of a fault, each with its text."""
    limits = case.limits
    for name, rounding, words, unit, factor in _AT_MOST:
        most = getattr(limits, name)
        if not isinf(most):
            # a time that does not exist violates the limit
            yield f"{words} {most * factor:g} {unit}", _at_most(name, most + rounding)
    if isfinite(limits.margin_m):
        yield f"margin {limits.margin_m * 1e3:g} mm", lambda one: one.margin_m >= limits.margin_m
    if isfinite(limits.unnamed_margin_m):
        words = f"margin {limits.unnamed_margin_m * 1e3:g} mm until named"
        yield words, lambda one: not one.unnamed_margin_m < limits.unnamed_margin_m
    if case.lies:
        yield "no wrong leg named", lambda one: one.named_as != "wrong"
    if limits.named:
        yield "named", lambda one: one.named
    if limits.torque_stays:
        yield "torque stays as it is", lambda one: not one.switched
    if isfinite(limits.again_s) or limits.walks_on:
        yield "walks on afterwards", lambda one: not one.stuck
    if limits.walks_on:
        yield "walks on", lambda one: one.stops == 0
    if limits.seated:
        yield "seated before the cut-off", lambda one: isfinite(one.seated_s) and not one.cut_off
    if not isinf(limits.cycle_s):
        yield "five missed cycles in a row are reported", lambda one: one.missed < LATE_CYCLES or isfinite(one.decided_s)
    if case.lets_go:
        yield "off stays off", lambda one: not one.on_again
        yield "off before any goal", lambda one: one.goals_before_off == 0
    if case.course:
        ends = ("walks", "arrived", "stands") if limits.stands else ("walks", "arrived")
        yield f"ends {' or '.join(ends)}", lambda one: one.ended in ends
        yield "stands with the reason", lambda one: not one.unnamed
    yield "no fall", lambda one: one.falls == 0
    yield "no goal outside of the limits", lambda one: one.outside == 0


def _at_most(name: str, most: float) -> Callable[[Outcome], bool]:
    return lambda one: bool(getattr(one, name) <= most)


_AT_MOST = (  # name, rounding allowed, words, unit, factor
    ("decided_s", 1e-6, "hold decided within", "ms", 1e3),
    ("rest_s", 1e-6, "at rest within", "ms", 1e3),
    ("again_s", 1e-6, "walks again within", "s", 1.0),
    ("jump_deg", 1e-6, "joint jump at most", "deg", 1.0),
    ("lunge_dps", 1e-6, "joint speed after its reset at most", "deg/s", 1.0),
    ("off_s", 1e-6, "torque off within", "ms", 1e3),
    ("cycle_s", 1e-6, "cycle p99 at most", "ms", 1e3),
    ("goal_dps", 1e-6, "goal speed at most", "deg/s", 1.0),
    ("place_m", 1e-6, "place error at most", "mm", 1e3),
    ("lost_s", 1e-6, "lost recording time at most", "s", 1.0),
)


def markdown(table: Sequence[Row]) -> str:
    """Return the table as Markdown; figures are p50 / p99 / worst."""
    columns = (
        "fault | n | hold decided [ms] | at rest [ms] | margin [mm] | falls | walks again [s] | jump [deg] | torque switched"
    )
    lines = [f"| {columns} | other | limits | commit |", f"|{' --- |' * 12}"]
    for one in table:
        cells = (
            one.fault,
            f"{one.n}",
            _cell(one.decided_s, 1e3, ".0f"),
            _cell(one.rest_s, 1e3, ".0f"),
            _cell(one.margin_m, 1e3, ".0f"),
            f"{one.falls}",
            _cell(one.again_s, 1.0, ".1f"),
            _cell(one.jump_deg, 1.0, ".1f"),
            f"{one.switched}",
            "; ".join(_others(one)),
            "pass" if one.passed else f"FAIL: {'; '.join(one.missed)}",
            ", ".join(one.commits),
        )
        lines.append(f"| {' | '.join(cells)} |")
    passed = sum(one.passed for one in table)
    least = min((one.n for one in table), default=0)
    high = f"; none of {least} means at most {100 * wilson(0, least).high:.1f} % (95 % confidence)" if least else ""
    lines += ["", f"{passed} of {len(table)} faults keep all limits. A limit is kept when no injection misses it{high}."]
    return "\n".join(lines)


def _others(one: Row) -> Iterable[str]:
    """Yield the figures that apply only to some faults."""
    if one.off_s.n:
        yield f"torque off after {_cell(one.off_s, 1e3, '.0f')} ms"
    if one.seated_s.n and not one.off_s.n:
        yield f"seated after {_cell(one.seated_s, 1.0, '.1f')} s"
    if one.lunge_dps.worst > 0.0:
        yield f"after the reset {_cell(one.lunge_dps, 1.0, '.0f')} deg/s"
    if not isinf(BY_NAME[one.fault].limits.cycle_s):
        yield f"cycle p99 {_cell(one.cycle_s, 1e3, '.1f')} ms"
    if one.lost_s.n:
        yield f"the recording lacks {_cell(one.lost_s, 1.0, '.1f')} s"
    if one.ended:
        yield f"ended: {', '.join(f'{how} {count}' for how, count in one.ended.items())}"
        yield f"place {_cell(one.place_m, 1e3, '.0f')} mm"
    if one.plans:
        fast = f", as fast as {one.goal_dps.worst:.0f} deg/s" if one.goal_dps.n else ""
        yield f"{one.plans} plans, {f'{one.walked} walked, ' if one.walked else ''}{one.outside} goals outside{fast}"
    if BY_NAME[one.fault].lies:
        how = "".join(f", {name} in {n}" for name, n in one.named_as.items())
        yield f"named in {one.named_s.n} after {_cell(one.named_s, 1e3, '.0f')} ms{how}"
    if one.misheard:
        yield f"a servo misheard torque in {one.misheard}"
    if one.stopped < one.n:
        yield f"stopped in {one.stopped}"


def _cell(one: Figure, unit: float, form: str) -> str:
    if not one.n:
        return "-"
    return " / ".join(f"{unit * value:{form}}" for value in (one.p50, one.p99, one.worst))


def to_json(table: Sequence[Row]) -> str:
    """Return the table as JSON; missing values are null."""
    return json.dumps([_plain(asdict(one)) | {"passed": one.passed} for one in table], indent=1, ensure_ascii=False) + "\n"


def from_json(text: str) -> list[Row]:
    """Read the rows of a table written by `to_json`."""
    return [_row(entry) for entry in json.loads(text)]


def _row(entry: dict[str, Any]) -> Row:
    known = [f.name for f in fields(Row) if f.name in entry]  # old rows lack newer quantities
    counts = ("ended", "named_as")
    figures = {name: Figure(**_numbers(entry[name])) for name in known if isinstance(entry[name], dict) and name not in counts}
    values = {name: entry[name] for name in known if name not in figures}
    return Row(**values | figures | {name: tuple(values.get(name, ())) for name in ("missed", "commits")})


def _numbers(figure: dict[str, Any]) -> dict[str, Any]:
    return {name: nan if value is None else value for name, value in figure.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    return None if isinstance(value, float) and not isfinite(value) else value
