"""Command line of the benchmarks: `python -m benchmarks COMMAND`, in a checkout."""

import argparse
import sys
from collections.abc import Sequence

from benchmarks.commands.benches import (
    bench_access,
    bench_accuracy,
    bench_bus,
    bench_fleet,
    bench_link,
    bench_page,
    bench_passage,
    bench_recording,
    bench_roles,
    bench_servos,
    bench_size,
    bench_soak,
    bench_speed,
    bench_stages,
    bench_start,
    bench_strangers,
)
from benchmarks.commands.faults import faults
from benchmarks.commands.fuzz import fuzz
from sextant.deploy.commands import values
from sextant.deploy.terminal.arguments import AddCommand, ArgumentParser, command_adder
from sextant.deploy.terminal.run_command import run_command

PROGRAM = "python -m benchmarks"


def main(argv: Sequence[str] | None = None) -> int:
    """Run a benchmark and return its exit status."""
    return run_command(PROGRAM, parse, sys.argv[1:] if argv is None else argv)


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments of a command; exit with a message if they are invalid."""
    parser = ArgumentParser(prog=PROGRAM, description="Benchmarks, fault injection and fuzzing of Sextant.")
    add = command_adder(parser.add_subparsers(required=True, metavar="COMMAND"))
    _add_peers(add)
    _add_access(add)
    _add_robot(add)
    _add_campaigns(add)
    return parser.parse_whole(argv)


def _add_peers(add: AddCommand) -> None:
    one = add("accuracy", bench_accuracy, "measure pose and map errors of the real services on rebuilt scenes")
    one.add_argument("--jobs", type=values.processes, default=1, metavar="N", help="parallel processes (default %(default)s)")
    _add_bench(one)
    one = add("speed", bench_speed, "compare the time of registration with other implementations, frame by frame in one run")
    _add_frames(one)
    _add_bench(one)
    one = add(
        "stages",
        bench_stages,
        "compare the times of the mapping stages with other implementations, frame by frame in one run",
    )
    _add_frames(one)
    _add_bench(one)
    one = add(
        "passage",
        bench_passage,
        "compare the time of the passage planner with other implementations, and check its plans",
    )
    _add_bench(one)


def _add_access(add: AddCommand) -> None:
    one = add("access", bench_access, "publish unauthorised messages through a secured router, and count those that pass")
    one.add_argument(
        "--messages", type=values.positive, default=10_000, metavar="N", help="messages of each kind (default %(default)s)"
    )
    _add_out_and_json(one)
    one = add("strangers", bench_strangers, "measure how fast authorised clients connect while strangers connect too")
    words = "radio outages between robot and base station (default %(default)s)"
    one.add_argument("--cuts", type=values.positive, default=100, metavar="N", help=words)
    words = "strangers' connections per second (default %(default)s)"
    one.add_argument("--rate", type=values.positive, default=1000, metavar="HZ", help=words)
    words = "actuator restarts, each with and without silent connections (default %(default)s)"
    one.add_argument("--restarts", type=values.natural, default=10, metavar="N", help=words)
    words = "silent connections at each router endpoint during these restarts (default %(default)s)"
    one.add_argument("--silent", type=values.positive, default=500, metavar="N", help=words)
    one.add_argument("--seed", type=values.natural, default=0, help="random seed of the outages (default %(default)s)")
    _add_out_and_json(one)
    words = "send valid messages with extreme values as each role while a robot walks, and count the failures"
    one = add("roles", bench_roles, words)
    one.add_argument(
        "--messages", type=values.positive, default=10_000, metavar="N", help="messages of each role (default %(default)s)"
    )
    one.add_argument("--only", action="append", default=[], metavar="ROLE", help="role to test; repeatable (default: all)")
    one.add_argument("--lockstep", action="store_true", help="run on simulated time, in this process")
    one.add_argument("--seed", type=values.natural, default=1, help="random seed (default %(default)s)")
    _add_out_and_json(one)


def _add_robot(add: AddCommand) -> None:
    one = add(
        "bus",
        bench_bus,
        "inject faults into the emulated servo bus; count the replies that the driver loses, doubts and accepts",
    )
    words = "least number of requests in each case (default %(default)s)"
    one.add_argument("--questions", type=values.positive, default=20_000, metavar="N", help=words)
    one.add_argument("--only", default="", metavar="WORDS", help="run only cases with these words in their name")
    one.add_argument("--seed", type=values.natural, default=0, help="random seed of the faults (default %(default)s)")
    _add_out_and_json(one)
    one = add("servos", bench_servos, "compare the servo bus driver's time with that of dynamixel-sdk")
    one.add_argument(
        "--rounds", type=values.positive, default=300, metavar="N", help="repetitions of each job (default %(default)s)"
    )
    _add_out_and_json(one)

    one = add("link", bench_link, "walk with mapper and planner behind a radio with packet loss or outages")
    one.add_argument("--walks", type=values.positive, default=5, metavar="N", help="walks over each link (default %(default)s)")
    one.add_argument("--scenario", default="steps", help="scenario of the walks (default %(default)s)")
    one.add_argument("--cuts", type=values.natural, default=0, metavar="N", help="only inject N radio outages into one walk")
    words = "duration [s] of the longest outage; the shortest takes 0.1 s (default %(default)s)"
    one.add_argument("--longest", type=values.longest_cut, default=30.0, metavar="S", help=words)
    one.add_argument(
        "--seed", type=values.natural, default=0, help="first seed of the walks, or seed of the outages (default %(default)s)"
    )
    _add_out_and_json(one)
    one = add("fleet", bench_fleet, "add robots to one base station until it is overloaded")
    words = "largest number of robots (default %(default)s)"
    one.add_argument("--robots", type=values.positive, default=12, metavar="N", help=words)
    words = "scenario, walked once in lockstep, then replayed by each robot (default %(default)s)"
    one.add_argument("--course", default="steps", metavar="SCENARIO", help=words)
    _add_out_and_json(one)
    one = add("page", bench_page, "measure the stop latency of the operator's page in a real browser, and its cost")
    one.add_argument(
        "--rounds", type=values.positive, default=30, metavar="N", help="repetitions of each measurement (default %(default)s)"
    )
    _add_out_and_json(one)
    one = add(
        "recording",
        bench_recording,
        "measure the servo cycle during recording, with a full disk, and with a killed recorder",
    )
    one.add_argument(
        "--rounds", type=values.positive, default=5, metavar="N", help="repetitions of each measurement (default %(default)s)"
    )
    _add_out_and_json(one)
    _add_out_and_json(add("size", bench_size, "measure the disk space of each role"))
    one = add("soak", bench_soak, "walk for a long time, and check that memory and latency do not grow")
    words = "duration of the walk in minutes (default %(default)s)"
    one.add_argument("--minutes", type=values.minutes, default=60.0, metavar="MIN", help=words)
    _add_out_and_json(one)
    one = add("start", bench_start, "measure the actuator's start-up time on a standing robot")
    one.add_argument("--rounds", type=values.positive, default=20, metavar="N", help="number of starts (default %(default)s)")
    _add_out_and_json(one)


def _add_campaigns(add: AddCommand) -> None:
    one = add("faults", faults, "inject faults at many phases of a step, and check the robot's reaction")
    one.add_argument("fault", nargs="*", metavar="FAULT", help="faults to inject (default: all)")
    one.add_argument(
        "--live", action="store_true", help="inject the faults that need live processes over Zenoh, not those in lockstep"
    )
    one.add_argument("--phases", type=values.positive, metavar="N", help="injections of each fault (default 300, live 30)")
    one.add_argument("--list", action="store_true", help="list the faults and exit")
    words = "parallel processes, in lockstep (default %(default)s)"
    one.add_argument("--jobs", type=values.processes, default=1, metavar="N", help=words)
    one.add_argument("--out", metavar="DIR", help="folder to write to; injections stored there are not repeated")
    one.add_argument("--json", action="store_true", help="print the result as JSON; progress goes to stderr")

    one = add("fuzz", fuzz, "fuzz every message and file parser")
    words = "total number of messages (default %(default)s)"
    one.add_argument("--messages", type=values.positive, default=10_000_000, metavar="N", help=words)
    one.add_argument("--seed", type=values.natural, default=0, help="random seed (default %(default)s)")
    one.add_argument("--only", action="append", default=[], metavar="NAME", help="parser to fuzz; repeatable (default: all)")
    one.add_argument("--list", action="store_true", help="list the parsers and exit")
    one.add_argument("--give", metavar="FILE", help="pass this file unchanged to the parser named by --only")
    one.add_argument("--jobs", type=values.processes, default=1, metavar="N", help="parallel processes (default %(default)s)")
    _add_out_and_json(one)


def _add_frames(parser: argparse.ArgumentParser) -> None:
    words = "frames of each ride, 2 cm apart (default %(default)s)"
    parser.add_argument("--frames", type=values.frames, default=100, metavar="N", help=words)


def _add_bench(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--seeds",
        type=values.seeds,
        default=range(1000, 1003),
        metavar="A:B",
        help="seeds of the rides, B not included (default 1000:1003)",
    )
    _add_out_and_json(parser)


def _add_out_and_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="DIR", help="folder to write to (default: a new one below runs/)")
    parser.add_argument("--json", action="store_true", help="print the result as JSON; progress goes to stderr")
