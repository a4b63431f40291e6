"""Cost and stopping times of the operator's page.

A real browser leads a simulated robot in real time. Times are from the browser's input to the packets on the servo bus. The
pad is released, or the whole browser is stopped (SIGSTOP) while it holds the pad. The time ends with the last goals that move
the body over the standing legs; another one ends when the swinging feet are down. A third is from the press of the button to
torque off.
"""

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.page.browser import DESKTOP, Hand, browser, frozen
from benchmarks.page.page_robot import PageRobot
from benchmarks.peers import kept
from sextant.services.console.web.control_arbiter import DEAD_MAN_NS
from sextant.shared.wire.messages import Mode

# Limits of the page: times, share of a core, bytes per second, frames per second.
RELEASE_S, OFF_S, CORE, RATE, FRAMES = 0.350, 0.150, 0.03, 3e6, 20.0
FROZEN_S = RELEASE_S + DEAD_MAN_NS * 1e-9
_WALK_S, _MORE_S = 1.0, 1.5  # [s] of walking before the pad is released, and a maximum random addition
_SETTLE_S = 1.5
_ATTEMPTS = 3  # attempts to press the pad
_WATCH_S = 15.0  # [s] for measuring the cost
_BENCH_S = 5.0  # [s] of drawing


@dataclass(frozen=True, slots=True)
class Delay:
    """Several measurements of a delay."""

    what: str
    seconds: tuple[float, ...]  # those with an end
    never: int = 0  # those without
    limit_s: float | None = None

    @classmethod
    def of(cls, what: str, seconds: Sequence[float], limit_s: float | None = None) -> "Delay":
        """Collect measurements; infinite ones have no end."""
        finite = tuple(s for s in seconds if math.isfinite(s))
        return cls(what, finite, len(seconds) - len(finite), limit_s)


@dataclass(frozen=True, slots=True)
class Cost:
    """Cost of a page while the robot walks."""

    core: float  # share of a core used by the server
    core_alone: float  # the share without an open page
    bytes_per_s: float  # to the page
    drawn_per_s: float  # frames drawn while the robot is simulated on the same machine
    frames_per_s: float  # maximum frames without any other load
    renderer: str  # name of the renderer


@dataclass(frozen=True, slots=True)
class Measured:
    """All measurements."""

    delays: tuple[Delay, ...]
    cost: Cost


@dataclass(frozen=True, slots=True)
class _Stop:
    """Delays [s] between an input, or the browser's stop, and its effects."""

    ordered_s: float
    body_s: float
    feet_s: float


def measure(rounds: int, say: Callable[[str], object]) -> Measured:
    """Lead a robot over the field of `steps`, and measure its stops.

    The pad is released, the browser is frozen, or torque is turned off.

    Args:
        rounds: Number of repetitions of each.
        say: Called with the progress.

    Raises:
        FileNotFoundError: No browser is found.
        ImportError: Playwright is missing.
        TimeoutError: The robot does not execute an order.
    """
    rng = np.random.default_rng(0)
    with PageRobot("flat") as robot, browser() as chromium:
        hand = Hand(chromium.new_page(viewport={"width": DESKTOP[0], "height": DESKTOP[1]}))
        hand.page.goto(robot.url)
        robot.stand(lambda: hand.click('[data-order="stand"]'))
        released = [_release(robot, hand, rng) for _ in range(rounds)]
        say(f"page: {rounds} times released")
        stopped = [_freeze(robot, hand, rng) for _ in range(rounds)]
        say(f"page: {rounds} times frozen")
        off = [_off(robot, hand, rng) for _ in range(rounds)]
        say(f"page: {rounds} times off")
    cost = _cost(say)
    delays = (
        *_delays("pad released", RELEASE_S, released),
        *_delays("browser frozen", FROZEN_S, stopped),
        Delay.of("torque off", off, OFF_S),
    )
    return Measured(delays, cost)


def _delays(what: str, limit_s: float, stops: Sequence[_Stop]) -> tuple[Delay, ...]:
    return (
        Delay.of(f"{what}: the console orders to stop", [stop.ordered_s for stop in stops]),
        Delay.of(f"{what}: the body rests", [stop.body_s for stop in stops], limit_s),
        Delay.of(f"{what}: all feet are down and still", [stop.feet_s for stop in stops]),
    )


def _walk(robot: PageRobot, hand: Hand, rng: np.random.Generator) -> None:
    """Hold the pad until the robot walks, and for some time more."""
    for attempt in range(1, _ATTEMPTS + 1):
        hand.hold_forward()
        try:
            robot.until(lambda: robot.is_in(Mode.WALK), 5.0, "a walk by the pad")
        except TimeoutError:
            hand.release()  # on a busy machine the page did not run for a moment: press again
            if attempt == _ATTEMPTS:
                raise
        else:
            break
    robot.pass_time(_WALK_S + _MORE_S * rng.random())


def _stop(robot: PageRobot, since_s: float, swing: NDArray[np.bool_]) -> _Stop:
    return _Stop(robot.stop_ordered_after(since_s), robot.stands_after(since_s, swing), robot.still_after(since_s))


def _release(robot: PageRobot, hand: Hand, rng: np.random.Generator) -> _Stop:
    _walk(robot, hand, rng)
    swing = robot.swinging()
    hand.release()
    robot.pass_time(_SETTLE_S)
    return _stop(robot, hand.newest_input_s(), swing)


def _freeze(robot: PageRobot, hand: Hand, rng: np.random.Generator) -> _Stop:
    _walk(robot, hand, rng)
    since = time.monotonic()
    with frozen():
        robot.pass_time(DEAD_MAN_NS * 1e-9)
        swing = robot.swinging()
        robot.pass_time(_SETTLE_S)
        took = _stop(robot, since, swing)
    robot.pass_time(_SETTLE_S)
    if robot.is_in(Mode.WALK):
        raise TimeoutError("the robot walked again as soon as the browser was resumed")
    hand.release()
    return took


def _off(robot: PageRobot, hand: Hand, rng: np.random.Generator) -> float:
    _walk(robot, hand, rng)
    hand.release()
    hand.move_to("#off")
    since = time.monotonic()
    hand.page.mouse.down()
    robot.until(lambda: np.isfinite(robot.torque_off_after(since)), what="torque off on the wire")
    robot.until(lambda: robot.is_in(Mode.OFF), what="the mode off")
    robot.pass_time(0.5)
    took = robot.torque_off_after(hand.newest_input_s())
    hand.page.mouse.up()
    robot.stand(lambda: hand.click('[data-order="stand"]'))
    return took


def _cost(say: Callable[[str], object]) -> Cost:
    """Measure the cost over `steps`, where the map has obstacles to show."""
    with PageRobot("steps") as robot, browser() as chromium:
        robot.until(lambda: robot.pose is not None, what="a pose")
        alone = _share(robot, lambda: robot.pass_time(_WATCH_S))
        page = chromium.new_page(viewport={"width": DESKTOP[0], "height": DESKTOP[1]})
        received = [0]
        page.on("websocket", lambda socket: socket.on("framereceived", lambda data: _count(received, data)))
        hand = Hand(page)
        page.goto(robot.url)
        robot.stand(lambda: hand.click('[data-order="stand"]'))
        hand.click("#look")
        hand.hold_forward()
        robot.until(lambda: robot.is_in(Mode.WALK), 15.0, "a walk by the pad")
        before, begun, drawn = received[0], time.monotonic(), page.evaluate("window.sextant.view.frames")
        share = _share(robot, lambda: page.wait_for_timeout(1000 * _WATCH_S))
        length = time.monotonic() - begun
        rate, drawn = (received[0] - before) / length, (page.evaluate("window.sextant.view.frames") - drawn) / length
        hand.release()
        robot.pass_time(_SETTLE_S)
        with robot.stopped():
            frames = page.evaluate(f"window.sextant.view.benchmark({_BENCH_S})")
        renderer = page.evaluate("window.sextant.view.renderedBy")
        say("page: cost measured")
    return Cost(share, alone, rate, drawn, frames, renderer)


def _count(received: list[int], data: str | bytes) -> None:
    received[0] += len(data)


def _share(robot: PageRobot, passes: Callable[[], object]) -> float:
    """Return the share of a core that the console uses meanwhile."""
    pid, begun = robot.pid("console"), time.monotonic()
    before = _spent(pid)
    passes()
    return (_spent(pid) - before) / (time.monotonic() - begun)


def _spent(pid: int) -> float:
    """Return the processor time [s] of a process, user and system."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def in_words(found: Measured) -> str:
    """Return the results as Markdown."""
    lines = [
        "| from the page to the servos' wire | p50, ms | p99, ms | worst, ms | wanted, ms | kept |",
        "|---|---|---|---|---|---|",
    ]
    for delay in found.delays:
        p50, p99, worst = (f"{1e3 * v:.0f}" for v in _percentiles([*delay.seconds, *[math.inf] * delay.never]))
        limit, most_s, n = "", delay.limit_s, len(delay.seconds) + delay.never
        within = f"{n} times"
        if most_s is not None:
            limit, within = f"{1e3 * most_s:.0f}", f"{sum(s <= most_s for s in delay.seconds)} of {n}"
        lines.append(f"| {delay.what} | {p50} | {p99} | {worst} | {limit} | {within} |")
    cost = found.cost
    lines += [
        "",
        f"The server takes {cost.core:.1%} of a core while the robot walks ({CORE:.0%} wanted) and {cost.core_alone:.1%} "
        f"while no page is open; a page receives {cost.bytes_per_s / 1e6:.1f} MB/s (at most {RATE / 1e6:.0f}), drew "
        f"{cost.drawn_per_s:.0f} frames per second next to the simulated robot, and draws at most {cost.frames_per_s:.0f} "
        f"({FRAMES:.0f} wanted), with {cost.renderer}.",
    ]
    return "\n".join(lines)


def to_json(found: Measured) -> str:
    """Return the results as JSON."""
    return kept.to_json(found)


def from_json(text: str) -> Measured:
    """Read results written by `to_json`."""
    return kept.from_json(text, Measured)


def _percentiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Return p50 and p99 by nearest rank, and the worst."""
    ordered = sorted(values)
    rank = max(0, int(np.ceil(0.99 * len(ordered))) - 1)
    return ordered[len(ordered) // 2], ordered[rank], ordered[-1]
