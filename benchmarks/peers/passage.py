"""Benchmark of the passage planner: speed, success rate and validity of plans.

1. The tests of an expansion, on stances sampled from searches: compiled code compared with NumPy.
2. Whole crossings of the thesis' three scenarios and of random pillars. The roadmap search, with its full budget for unsolved
   cases, is compared with Masri's planner as published, and with OMPL's planner for the body alone.
3. Every plan of the first two is validated by the checker.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.peers import timing
from benchmarks.peers.passage_checker import violations
from benchmarks.peers.passage_ompl import BodyPlanner
from benchmarks.peers.passage_peer import NumpyTests
from benchmarks.peers.passage_strips import BEYOND, GAP, NEAR, START, heights, random_blocks, thesis_blocks
from benchmarks.peers.timing import Race, installed, one_core
from sextant.evaluation.baselines.masri_planner import Crossing, MasriPlanner
from sextant.evaluation.scoring.passage_truth import stance_at
from sextant.evaluation.whole_maps.strip import strip_of
from sextant.services.planner.roadmap import roadmap_search
from sextant.services.planner.roadmap.params import PassageSettings
from sextant.services.planner.roadmap.roadmap import NoSection, PassageStep, Roadmap, SectionPlan, Stance
from sextant.services.planner.roadmap.search_tables import ground_of, legs_of, rules_of
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile

OURS, MASRI = "Sextant", "Masri 2016"
CASES = ("scenario 1", "scenario 2", "scenario 3", "strewn pillars")
HEADINGS = {"per_s": ("per second", 1.0, 0)}
_COLUMNS = (
    "crossing",
    "planner",
    "solved",
    "centre of mass leaves its feet",
    "ms, median",
    "p99",
    "n_g",
    "n_e",
    "steps",
    "edge, cm",
    "least margin, cm",
    "plans with an error",
)
HEIGHT = 0.105  # [m] of the body
Y, LENGTH, SHIFT, TWO = (
    0.16,
    0.17,
    0.035,
    0.27,
)  # [m] pillars of shared/scenario/scenarios/passage1 to 3
_PITCH, _SHARE, _SIZE = 0.13, 0.85, 0.10  # [m] grid and size of random pillars, and the share of grid points with one
_STANCES, _REPEATS = 100, 3  # stances of each search in one timed call, and repetitions
_OFF = 0.01  # [m] random displacement of pillars with each seed


@dataclass(frozen=True, slots=True)
class Section:
    """Results of one planner on one kind of ground."""

    case: str
    planner: str
    plans: int  # attempts
    solved: int  # plans that reach the goal
    checked: int  # plans validated by the checker; some do not reach the goal
    ms_median: float  # core time; unsolved cases use their full budget
    ms_p99: float
    generated: float  # n_g of a search, median; Masri's planner makes three for a crossing
    expanded: float  # n_e of a search, median
    outside: int  # crossings in which the centre of mass leaves its standing feet
    violations: int  # plans with a violation
    steps: float | None = None  # median of all crossings, if there are any
    edge_m: float | None = None  # median distance of footholds in the gap to the nearest edge of their surface
    margin_m: float | None = None  # minimum support margin of all steps


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured(timing.Measured):
    """All results."""

    sections: tuple[Section, ...]
    wrong: tuple[str, ...]  # violations of our plans that the checker found, as text


def measure(seeds: Sequence[int], robot: str = "phantomx_mk2", say: Callable[[str], object] = lambda _: None) -> Measured:
    """Plan on each kind of ground once for each seed."""
    profile, settings = load_profile(robot), PassageSettings(body_height=HEIGHT)
    roadmap, stance = Roadmap(profile, settings), stance_at(profile, START, HEIGHT)
    peers, missing = installed({"OMPL (body only)": BodyPlanner}, profile)
    _compile(roadmap, stance)
    planners: dict[str, Callable[[StripMap, Stance, float], object]] = {
        OURS: _planned_by(roadmap),
        MASRI: MasriPlanner(profile).plan,
        **{name: peer.plan for name, peer in peers.items()},
    }
    planners[MASRI](ground(CASES[0], 0), stance, START + _OFF)  # compile it
    expansion = Race("expansion", f"{settings.body_moves}x{settings.footholds} samples", warm=1)
    timings, sections, wrong = [], [], []
    with one_core():
        for case in CASES:
            race = Race("crossing", case)
            race.start(planners)
            tried: dict[str, list[_Tried]] = {OURS: [], MASRI: []}
            for seed in seeds:
                field = ground(case, seed)
                found = race.run(field, stance, NEAR + GAP + BEYOND)
                for name, results in tried.items():
                    results.append(_tried(profile, field, stance, found[name]))
                _race_expansions(expansion, roadmap, profile, settings, field, seed)
            wrong += [f"{case}: {words}" for one in tried[OURS] for words in one.wrong]
            sections += [_section(case, name, race.ms(name), results) for name, results in tried.items()]
            timings += race.timings({})
            say(f"passage: {case} done")
    rates = {name: {"per_s": 1e3 * _STANCES / float(np.median(expansion.ms(name)))} for name in (OURS, "NumPy")}
    return Measured(
        timings=(*timings, *expansion.timings(rates)), missing=tuple(missing), sections=tuple(sections), wrong=tuple(wrong)
    )


def ground(case: str, seed: int) -> StripMap:
    """Return the strip of a case; the seed displaces its pillars a little."""
    rng = np.random.default_rng(seed)
    if case == "strewn pillars":
        return strip_of(heights(random_blocks(rng, GAP, _PITCH, _SHARE, _SIZE), GAP), HEIGHT)
    blocks = thesis_blocks(CASES.index(case) + 1, GAP, Y, LENGTH, SHIFT, TWO)
    moved = [(block, rng.uniform(-_OFF, _OFF, 2)) for block in blocks]
    return strip_of(heights([type(b)(b.x + dx, b.y + dy, b.length, b.width, b.top) for b, (dx, dy) in moved], GAP), HEIGHT)


def in_words(measured: Measured) -> str:
    """Return the plans and the timings as Markdown."""
    lines = [f"| {' | '.join(_COLUMNS)} |", "|---" * len(_COLUMNS) + "|"]
    for s in measured.sections:
        numbers = (s.ms_median, 1), (s.ms_p99, 0), (s.generated, 0), (s.expanded, 0), (s.steps, 0)
        cells = [f"{s.solved} of {s.plans}", f"in {s.outside} of {s.solved}", *(_shown(*one) for one in numbers)]
        cells += [_shown(s.edge_m, 1, 100.0), _shown(s.margin_m, 1, 100.0), f"{s.violations} of {s.checked}"]
        lines.append(f"| {' | '.join([s.case, s.planner, *cells])} |")
    lines += ["", *(f"Error in a plan of ours: {words}." for words in measured.wrong)]
    lines += [*bool(measured.wrong) * [""], timing.in_words(measured, HEADINGS)]
    return "\n".join(lines)


def _shown(value: float | None, digits: int, factor: float = 1.0) -> str:
    return "-" if value is None else f"{factor * value:.{digits}f}"


def _planned_by(roadmap: Roadmap) -> Callable[[StripMap, Stance, float], object]:
    def plan(field: StripMap, stance: Stance, goal_x: float) -> object:
        roadmap.begin(field, stance, goal_x, seed=1)
        return roadmap.grow(10**9)

    return plan


def _compile(roadmap: Roadmap, stance: Stance) -> None:
    roadmap.begin(strip_of(heights([], GAP), HEIGHT), stance, NEAR + GAP + BEYOND, seed=0)
    roadmap.grow(10)


def _race_expansions(
    race: Race, roadmap: Roadmap, profile: RobotProfile, settings: PassageSettings, field: StripMap, seed: int
) -> None:
    """Time the tests for expansions of stances from the newest search."""
    legs, rules, strip = legs_of(profile, settings), rules_of(profile, settings), ground_of(field)
    peer = NumpyTests(legs, rules, strip)
    work = _expansions(roadmap, profile, settings, np.random.default_rng(seed))
    verdict, lifts = np.zeros(work[-1].shape[:3], dtype=np.int64), np.zeros(work[-1].shape[:3])

    def ours(feet: Array, leg: NDArray[np.int64], body: Array, bodies: Array, goals: Array) -> NDArray[np.int64]:
        roadmap_search.judge_all(legs, rules, strip, feet, leg, body, bodies, goals, verdict, lifts)
        return verdict.copy()

    race.start({OURS: ours, "NumPy": lambda *work: np.array([peer.judge(*one)[0] for one in zip(*work, strict=True)])})
    for _ in range(_REPEATS):
        told = race.run(*work)
    if (told[OURS] != told["NumPy"]).any():
        raise ValueError(f"the same verdicts expected, found {told}")


def _expansions(
    roadmap: Roadmap, profile: RobotProfile, settings: PassageSettings, rng: np.random.Generator
) -> tuple[Array, NDArray[np.int64], Array, Array, Array]:
    """Return stances of a search (k) as arguments of `judge`.

    They are feet, a swing leg, the body, and samples around the motion.
    """
    k, m, n = _STANCES, settings.body_moves, settings.footholds
    stances = roadmap.sampled(rng, k)
    feet, body = np.array([s.feet for s in stances]), np.array([s.body for s in stances])
    leg = rng.integers(0, 6, k)
    bodies = body[:, None] + np.stack(
        [rng.uniform(0.0, 0.05, (k, m)), rng.normal(0.0, 0.01, (k, m)), np.zeros((k, m))], axis=-1
    )
    off = np.stack([rng.uniform(-0.06, 0.12, (k, m, n)), rng.normal(0.0, 0.02, (k, m, n)), np.zeros((k, m, n))], axis=-1)
    nominal = np.column_stack([profile.rest_feet()[leg, :2], np.zeros(k)])
    goals = bodies[:, :, None] + nominal[:, None, None] + off
    goals[..., 2] = feet[:, :, 2].mean(axis=1)[:, None, None]
    return feet, leg, body, bodies, goals


@dataclass(frozen=True, slots=True)
class _Tried:
    """Result of a planner on one strip."""

    field: StripMap
    steps: tuple[PassageStep, ...]  # empty without a plan
    complete: bool  # whether they reach the goal
    counts: tuple[tuple[int, int], ...]  # n_g and n_e of each search
    wrong: list[str]  # violations


def _tried(profile: RobotProfile, field: StripMap, stance: Stance, found: object) -> _Tried:
    if isinstance(found, Crossing):
        counts = tuple(zip(found.generated, found.expanded, strict=True))
        complete, steps = found.complete, found.steps if found.complete else ()
    elif isinstance(found, SectionPlan | NoSection):
        counts = ((found.generated, found.expanded),)
        complete, steps = (found.complete, found.steps) if isinstance(found, SectionPlan) else (False, ())
    else:
        raise TypeError(f"a result of a planner expected, found {type(found).__name__}")
    return _Tried(field, steps, complete, counts, violations(profile, field, stance, steps))


def _section(case: str, planner: str, ms: Array, tried: Sequence[_Tried]) -> Section:
    crossings = [one for one in tried if one.complete]
    edges = [edge for one in crossings for edge in _edges(one.field, one.steps)]
    least = [min(step.margin for step in one.steps) for one in crossings]
    generated, expanded = np.median([count for one in tried for count in one.counts], axis=0).tolist()
    return Section(
        case=case,
        planner=planner,
        plans=len(ms),
        solved=len(crossings),
        checked=sum(bool(one.steps) for one in tried),
        ms_median=float(np.median(ms)),
        ms_p99=float(np.percentile(ms, 99)),
        generated=generated,
        expanded=expanded,
        steps=float(np.median([len(one.steps) for one in crossings])) if crossings else None,
        edge_m=float(np.median(edges)) if edges else None,
        margin_m=min(least, default=None),
        outside=sum(margin < 0.0 for margin in least),
        violations=sum(bool(one.wrong) for one in tried),
    )


def _edges(field: StripMap, steps: Sequence[PassageStep]) -> Iterator[float]:
    """Yield distances [m] of footholds in the gap to the nearest lower cell."""
    i, j = np.nonzero(field.elevation < -0.1)
    low = np.column_stack([i, j]) * field.resolution + field.first_cell
    for step in steps:
        if step.leg >= 0 and NEAR < step.touchdown[0] < NEAR + GAP:
            off = np.maximum(np.abs(low - step.touchdown[:2]) - field.resolution / 2, 0.0)
            yield float(np.linalg.norm(off, axis=1).min())
