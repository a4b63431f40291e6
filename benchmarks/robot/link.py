"""Walks in real time with map and planner behind a radio.

There are links of several kinds, and outages of the radio.
"""

import json
import math
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.net_testbed.link_outages import BACK_S, HOLD_S, Cut, judge
from benchmarks.net_testbed.testbed import NetTestbed, two_machines
from benchmarks.net_testbed.two_machines import TwoMachines
from benchmarks.peers.timing import machine
from sextant.evaluation.trials.statistics import wilson
from sextant.shared.scenario.scenario import Link

LINKS = (Link(20.0, 20.0, 0.0), Link(20.0, 20.0, 0.05), Link(20.0, 2.0, 0.0))  # links for the walks
CUT_LINK = LINKS[0]
CUT_S = (0.1, 30.0)  # [s] shortest and longest outage, log-uniformly distributed
_BETWEEN_S = (1.0, 4.0)  # [s] of walking between two outages
_MEET_S, _WALK_S, _PATIENCE_S = 90.0, 60.0, 40.0
_COURSE = 'name = "{name}"\ntime_limit_s = {limit:.0f}.0\n[goal]\ndistance = {far:.1f}\n[[terrain]]\nkind = "plane"\n'
_SPEED = 0.1  # [m/s] maximum


@dataclass(frozen=True, slots=True)
class Walks:
    """Walks over one link."""

    link: Link
    reports: tuple[dict[str, Any], ...]  # report.json of each
    up_mbit: float  # mean data rate from the robot
    lost: float  # share of lost packets from the robot


def walks(
    scenario: str, seeds: Sequence[int], links: Sequence[Link], say: Callable[[str], object]
) -> tuple[tuple[Walks, ...], str]:
    """Walk a scenario over each link with each seed.

    Return the walks, and a description of the radio.

    Raises:
        NetTestbedError: Two machines cannot be emulated here.
        TimeoutError: The machines did not connect, or a walk left no report.
    """
    found: list[Walks] = []
    radio = ""
    for link in links:
        reports, carried, packets, lost, seconds = [], 0, 0, 0, 0.0
        for seed in seeds:
            with two_machines(link, seed) as bed, TwoMachines(bed, None, scenario, seed) as halves:
                halves.meet(_MEET_S)
                radio = bed.words
                began = bed.carried()
                reports.append(_run(halves, scenario, seed))
                ended = bed.carried()
            carried += ended.from_robot - began.from_robot
            packets += ended.packets_from_robot - began.packets_from_robot
            lost += ended.lost_from_robot - began.lost_from_robot
            seconds += (ended.at_ns - began.at_ns) * 1e-9
            say(f"{_words(link)}: seed {seed}: {reports[-1]['reason']}")
        found.append(Walks(link, tuple(reports), 8e-6 * carried / seconds, lost / (packets + lost)))
    return tuple(found), radio


def cuts(count: int, seed: int, longest_s: float, say: Callable[[str], object]) -> tuple[tuple[Cut, ...], str, str]:
    """Interrupt the radio at random phases of a walk, each for a random time.

    The walk is on level ground, and is led from the base station.

    Returns:
        The outages; a description of the radio; and why there are fewer outages than requested, or an empty string.

    Args:
        count: Number of outages.
        seed: Random seed of phases, durations and losses.
        longest_s: [s] the longest outage.
        say: Called with the result of each outage.

    Raises:
        NetTestbedError: Two machines cannot be emulated here.
        TimeoutError: The machines did not connect.
    """
    rng = np.random.default_rng(seed)
    lasts_s = np.exp(rng.uniform(math.log(CUT_S[0]), math.log(longest_s), count))
    walks_s = rng.uniform(*_BETWEEN_S, count)
    limit_s = _WALK_S + float(lasts_s.sum() + walks_s.sum()) + count * _PATIENCE_S
    found: list[Cut] = []
    with tempfile.TemporaryDirectory() as folder:
        course = Path(folder) / "long.toml"
        course.write_text(_COURSE.format(name="long", limit=limit_s, far=_SPEED * limit_s), encoding="utf-8")
        with two_machines(CUT_LINK, seed) as bed, TwoMachines(bed, None, str(course), seed) as halves:
            halves.meet(_MEET_S)
            halves.lead(str(course))
            for lasts, walked in zip(lasts_s, walks_s, strict=True):
                try:
                    found.append(_cut(bed, halves, float(lasts), float(walked)))
                except TimeoutError as error:
                    return tuple(found), bed.words, str(error)
                say(f"cut {len(found)} of {count}: {_told(found[-1])}")
            return tuple(found), bed.words, ""


def _cut(bed: NetTestbed, halves: TwoMachines, lasts_s: float, walks_s: float) -> Cut:
    """Walk, interrupt the radio, and observe until the robot walks again."""
    halves.until(lambda: halves.heard[-1].walks, _WALK_S, "a walk")
    halves.pass_time(walks_s)
    halves.until(lambda: halves.heard[-1].walks, _WALK_S, "a walk")
    cut = bed.cut()
    halves.pass_time(lasts_s)
    mended = bed.mend()
    halves.pass_time(2 * HOLD_S)  # by then it has started to hold, if it does
    until_ns = time.monotonic_ns() + round(1e9 * _PATIENCE_S)
    halves.until(lambda: halves.heard[-1].walks or time.monotonic_ns() > until_ns, 2 * _PATIENCE_S, "the walk to continue")
    return judge(cut.at_ns, mended.at_ns, list(halves.heard))


def _run(halves: TwoMachines, scenario: str, seed: int) -> dict[str, Any]:
    """Return the report of `sextant run` on the robot's machine.

    It leads the robot, and evaluates the walk next to the simulator, whose ground truth stays there.
    """
    with tempfile.TemporaryDirectory() as folder:
        meeting = ("--connect", halves.robot_router, "--namespace", halves.namespace)
        words = halves.on_robot("run", scenario, "--seed", str(seed), *meeting, "--out", folder)
        done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
        report = Path(folder) / "report.json"
        if not report.exists():
            raise TimeoutError(f"sextant run wrote no report: {' / '.join(done.stderr.splitlines()[-2:])}")
        return dict(json.loads(report.read_text(encoding="utf-8")))


def walks_in_words(found: Sequence[Walks]) -> str:
    """Return the walks as a Markdown table."""
    lines = [
        "| link | success | 95 % interval | duration p50, s | falls | from the robot, Mbit/s | lost |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in found:
        rate = wilson(sum(r["success"] for r in one.reports), len(one.reports))
        took = [r["duration_s"] for r in one.reports if r["success"]]
        p50 = f"{np.median(took):.1f}" if took else ""
        lines.append(
            f"| {_words(one.link)} | {rate.successes} of {rate.n} | {100 * rate.low:.0f} to {100 * rate.high:.0f} % | {p50} "
            f"| {sum(r['falls'] for r in one.reports)} | {one.up_mbit:.2f} | {100 * one.lost:.1f} % |"
        )
    return "\n".join(lines)


def cuts_in_words(found: Sequence[Cut]) -> str:
    """Return the outages as a Markdown table, with each violation."""
    if not found:
        return "no cut"
    held = [one for one in found if one.must_hold]
    oldest = max((one.oldest_s for one in found), default=0.0)
    lines = [
        "| after | times | p50, s | worst, s | wanted, s |",
        "|---|---|---|---|---|",
        _row("the cut: it holds", [one.held_s for one in held], f"{HOLD_S:.2f}"),
        _row("the cut: all feet on the ground", [one.rested_s for one in held], ""),
        _row("the radio's return: it walks", [one.back_s for one in found], f"{BACK_S:.1f}"),
        "",
        f"{len(found)} cuts of {min(one.lasted_s for one in found):.1f} to {max(one.lasted_s for one in found):.1f} s, "
        f"{sum(not one.problems for one in found)} as required; the oldest accepted plan was {oldest:.2f} s old.",
        *(f"- a cut of {one.lasted_s:.2f} s: {', '.join(one.problems)}" for one in found if one.problems),
    ]
    return "\n".join(lines)


def to_json(what: str, found: Sequence[Walks] | Sequence[Cut], radio: str) -> str:
    """Return the results as JSON."""
    return json.dumps({"machine": machine(), "bed": radio, what: [asdict(one) for one in found]}, indent=1, default=str)


def walks_from_json(text: str) -> tuple[Walks, ...]:
    """Read walks written by `to_json`."""
    return tuple(
        Walks(Link(**one["link"]), tuple(one["reports"]), one["up_mbit"], one["lost"]) for one in json.loads(text)["walks"]
    )


def cuts_from_json(text: str) -> tuple[Cut, ...]:
    """Read outages written by `to_json`."""
    return tuple(Cut(**cut) for cut in json.loads(text)["cuts"])


def _row(what: str, seconds: Sequence[float | None], wanted: str) -> str:
    known = [s for s in seconds if s is not None]
    never = len(seconds) - len(known)
    worst = f"never, {never} times" if never else f"{max(known, default=0.0):.2f}"
    return f"| {what} | {len(seconds)} | {np.median(known) if known else math.nan:.2f} | {worst} | {wanted} |"


def _words(link: Link) -> str:
    return f"{link.delay_ms:.0f} ms, {link.mbit:.0f} Mbit/s, {100 * link.loss:.0f} % lost"


def _told(cut: Cut) -> str:
    what = "; ".join(cut.problems) or "as required"
    numbers = ", ".join(
        f"{name} {'never' if s is None else f'{s:.2f} s'}"
        for name, s in (("held", cut.held_s), ("rested", cut.rested_s), ("back", cut.back_s))
    )
    return f"{cut.lasted_s:.2f} s: {numbers}: {what}"
