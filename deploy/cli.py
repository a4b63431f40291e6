"""Command-line interface: argument parsing, error reporting and exit status.

Every failure states its cause and what to do next.

Exit status: 0 on success only, 1 for a failed run, 2 for invalid input, 130 when the operator interrupts it.
Modules that take long to import are imported by the command that needs them.
"""

import argparse
import importlib.util
import os
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

from sextant.deploy.commands import keys, service, servos, values
from sextant.deploy.commands.common import InputError, complain
from sextant.deploy.commands.facts import compose, doctor
from sextant.deploy.commands.fleet import fleet
from sextant.deploy.commands.order import order
from sextant.deploy.commands.plots import plot
from sextant.deploy.commands.recordings import export, foxglove, info, record, recover, replay
from sextant.deploy.commands.ros2 import ros2
from sextant.deploy.commands.topics import docs, echo, hz, list_topics
from sextant.deploy.commands.trials import table, trials
from sextant.deploy.commands.up import up
from sextant.deploy.commands.video import video
from sextant.deploy.commands.walks import DEMOS, demo, run
from sextant.deploy.terminal.arguments import AddCommand, ArgumentParser, command_adder
from sextant.deploy.terminal.run_command import run_command

# Commands that have moved, and their new words; the old ones work in this release, with a hint.
_MOVED = {
    "info": ("recording", "info"),
    "recover": ("recording", "recover"),
    "export": ("recording", "export"),
    "foxglove": ("topics", "foxglove"),
    "ros2": ("topics", "ros2"),
    "compose": ("service", "compose"),
}
_BENCHMARKS = ("bench", "faults", "fuzz")  # they have moved out of the package


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""
    return run_command("sextant", parse, sys.argv[1:] if argv is None else argv)


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments of a command; exit with a message if they are invalid."""
    words = list(argv)
    if words and words[0] in _MOVED:
        new = _MOVED[words[0]]
        complain(f"`sextant {words[0]}` is now `sextant {' '.join(new)}`")
        words[:1] = new
    if words and words[0] in _BENCHMARKS:
        return argparse.Namespace(name=words[0], command=lambda _: _run_benchmark(words))
    if words[:2] == ["trials", "table"]:  # a two-word command whose first word is also a command
        words[:2] = ["trials table"]
    return _parser().parse_whole(words)


def _run_benchmark(words: Sequence[str]) -> int:
    """Run a command that has moved to the benchmarks; return its exit status."""
    new = words[1:] if words[0] == "bench" else words
    moved = f"`sextant {words[0]}` is now `python -m benchmarks`"
    if importlib.util.find_spec("benchmarks") is None:
        raise InputError(f"{moved}; run it in a checkout of Sextant, because the benchmarks are not installed")
    complain(moved)
    return subprocess.call([sys.executable, "-m", "benchmarks", *new])


def _parser() -> ArgumentParser:
    parser = ArgumentParser(
        prog="sextant", description="Perception, planning and control of a six-legged robot on rubble, steps and gaps."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    add = command_adder(commands)
    _add_walks(add)
    _add_campaigns(add)
    _add_robots(add)
    _add_recordings(add)
    _add_plot(add)

    _add_certificates(add, commands.add_parser("keys", help="certificates: make and show the keys of each role"))
    _add_recording(add, commands.add_parser("recording", help="describe, repair or convert a recording"))
    _add_services(add, commands.add_parser("service", help="run the processes of a role as systemd services, or in containers"))
    _add_topics(
        add, commands.add_parser("topics", help="list topics, print messages, measure rates; pass them on to Foxglove or ROS 2")
    )
    _add_servos(add, commands.add_parser("servos", help="scan, set ids, calibrate, test, emulate servos, or turn torque off"))

    one = add("doctor", doctor, "check that this machine has what the services need")
    one.add_argument("--port", help="also check this servo port, e.g. /dev/ttyUSB0")
    one.add_argument("--camera", default="", metavar="DEVICE", help="also check this camera: openni2, realsense, or a folder")
    words = "only try to connect to this endpoint without authorisation, e.g. tls/hexapod.local:7448; publishes nothing"
    one.add_argument("--stranger", metavar="ENDPOINT", help=words)
    words = "folder of `sextant keys new` with its ca/; --stranger then also tries an expired certificate"
    one.add_argument("--keys", dest="key_folder", metavar="DIR", help=words)
    one.add_argument("--robot", default="phantomx_mk2", help="robot whose servos and camera are checked (default %(default)s)")
    one.add_argument("--json", action="store_true", help="print the result as JSON")
    return parser


def _add_recordings(add: AddCommand) -> None:
    one = add("record", record, "record all topics to MCAP, one file per minute, until Ctrl-C")
    one.add_argument("--out", metavar="DIR", help="folder to write to (default: a new one below recordings/)")
    one.add_argument("--seconds", type=values.seconds, metavar="S", help="duration of the recording (default: until Ctrl-C)")
    one.add_argument("--pictures", action="store_true", help="also record full camera images, 90 %% of the data")
    words = "disk space to keep free (default %(default)s)"
    one.add_argument("--reserve", type=values.natural, default=500, metavar="MB", help=words)
    one.add_argument("--robot", default="phantomx_mk2", help="profile by name, or path of a TOML file (default %(default)s)")
    _add_meeting(one)
    one = add(
        "replay", replay, "run perception and mapper on a recorded depth sequence, or mapper and planner on a recorded run"
    )
    one.add_argument("source", help="folder with depth.txt, camera.toml (and groundtruth.txt), or a recording")
    one.add_argument("--only", action="append", metavar="TOPIC", help="replay only this recorded topic; repeatable")
    one.add_argument("--json", action="store_true", help="print the result as JSON; progress goes to stderr")
    one.add_argument("--out", metavar="DIR", help="folder to write to (default: a new one below runs/)")

    one = add("video", video, "draw a video of a recorded run: robot, ground, map, footholds and reports")
    one.add_argument("run", help="folder of a run, an MCAP file, or a folder of them")
    words = "output file: .mp4, .webm, .avi, or animated .webp, .gif, .png (default: walk.mp4 next to the recording)"
    one.add_argument("--out", metavar="FILE", help=words)
    one.add_argument("--speed", type=values.times, default=1.0, metavar="X", help="playback speed (default %(default)g)")
    one.add_argument(
        "--size", type=values.size, default=(1280, 720), metavar="WxH", help="picture size in pixels (default 1280x720)"
    )
    words = "scenario that gives the ground, by name or TOML file (default: the recorded scenario)"
    one.add_argument("--scenario", default="", metavar="NAME", help=words)
    one.add_argument("--fps", type=values.rate, default=25.0, metavar="N", help="frames per second (default %(default)g)")
    one.add_argument(
        "--from", dest="from_s", type=values.instant, default=0.0, metavar="S", help="start time in the recording (default 0 s)"
    )
    one.add_argument(
        "--to",
        dest="to_s",
        type=values.instant,
        default=float("inf"),
        metavar="S",
        help="end time in the recording (default: its end)",
    )


def _add_plot(add: AddCommand) -> None:
    one = add("plot", plot, "draw the figures of a recorded run, or compare several runs")
    one.add_argument("run", nargs="*", metavar="RUN", help="folder of a run, or its recording; several are compared")
    one.add_argument("--what", nargs="+", action="extend", metavar="NAME", help="figures to draw (default: all)")
    one.add_argument("--list", action="store_true", help="list the figures and exit")
    one.add_argument("--format", choices=("svg", "pdf", "png"), default="svg", help="file format (default %(default)s)")
    words = "scenario that was walked, by name or TOML file, if the recorded name does not come with sextant"
    one.add_argument("--scenario", default="", metavar="SCENARIO", help=words)
    one.add_argument("--out", metavar="DIR", help="folder to write to (default: a new one below runs/)")
    one.add_argument("--json", action="store_true", help="print the numbers of the runs as JSON, not as a table")


def _add_walks(add: AddCommand) -> None:
    one = add("demo", demo, "simulate a walk over low steps, or across a gap, over Zenoh")
    one.add_argument("course", nargs="?", choices=tuple(DEMOS), default="steps", help="course to walk (default %(default)s)")
    _add_seed_and_out(one)
    _add_params(one)

    one = add("run", run, "run a scenario and write a folder with report.json, pictures and recording.mcap")
    one.add_argument("scenario", help="name of a scenario that comes with sextant, or path of a TOML file")
    _add_robot_and_gait(one)
    one.add_argument(
        "--lockstep", action="store_true", help="run in one process on simulated time, as fast as the machine allows"
    )
    one.add_argument("--bridge", action="store_true", help="simulate a microcontroller on the servo bus, see docs/bridge.md")
    words = "slow simulated time down if this computer is too slow, as the demo does (default: real time)"
    one.add_argument("--slow-down", action="store_true", help=words)
    one.add_argument("--json", action="store_true", help="print report.json; progress goes to stderr")
    one.add_argument("--record-depth", metavar="DIR", help="also write the depth frames for `sextant replay` (with --lockstep)")
    one.add_argument("--connect", action="append", help="use running services, at this endpoint, e.g. tcp/127.0.0.1:7447")
    one.add_argument("--namespace", default="sextant", help="namespace of those services (default %(default)s)")
    _add_keys(one)
    one.add_argument("--parent", type=int, help=argparse.SUPPRESS)  # id of the launcher's process
    _add_seed_and_out(one)
    _add_params(one)


def _add_params(one: argparse.ArgumentParser) -> None:
    words = "parameter of a service, e.g. planner.costmap.max_step_m=0.07, see docs/parameters.md; repeatable"
    one.add_argument("--set", action="append", default=[], metavar="SERVICE.KEY=VALUE", help=words)


def _add_campaigns(add: AddCommand) -> None:
    one = add("trials", trials, "run a scenario in lockstep with many seeds: success rate with 95 %% interval")
    one.add_argument("scenario", help="scenario name or TOML file; or a group: all, passages, troubles")
    _add_robot_and_gait(one)
    words = "seeds from A to B, B not included; or commit:N, N seeds derived from the hash of the commit, not chosen by hand"
    one.add_argument("--seeds", type=values.any_seeds, required=True, metavar="A:B", help=words)
    one.epilog = (
        "`sextant trials table` prints tables of stored trials without running anything; see `sextant trials table --help`."
    )
    one.add_argument("--blind", action="store_true", help="also run the baseline without a map, and compare")
    _add_params(one)
    one.add_argument("--jobs", type=values.processes, default=1, metavar="N", help="parallel processes (default %(default)s)")
    one.add_argument("--out", metavar="DIR", help="folder to write to; seeds stored there are not run again")
    one.add_argument("--json", action="store_true", help="print the result as JSON; progress goes to stderr")

    one = add("trials table", table, "print a Markdown table of stored trials without running anything", listed=False)
    words = "output folder of trials, or its campaign.jsonl; parts of a campaign are combined"
    one.add_argument("kept", nargs="+", metavar="KEPT", help=words)
    words = (
        "content of the table: walks, goals reached, missteps, map errors, passages, or each planned section of the passages"
    )
    choices = ("walks", "reached", "missteps", "maps", "passages", "sections")
    one.add_argument("--of", choices=choices, default="walks", help=f"{words} (default %(default)s)")
    one.add_argument("--json", action="store_true", help="print all of it as JSON")


def _add_robots(add: AddCommand) -> None:
    one = add("up", up, "run the processes of a role until Ctrl-C")
    _add_role(one)
    words = "print the Zenoh configuration of this machine's router, and start nothing"
    one.add_argument("--print-zenoh", action="store_true", help=words)

    one = add("fleet", fleet, "run the base station of several robots with one common page, until Ctrl-C")
    one.add_argument("file", metavar="FLEET.toml", help="file with the robots and their endpoints, see docs/fleet.md")
    one.add_argument(
        "--open", action="store_true", help="also connect to robots without certificates; repeats a warning while it runs"
    )

    one = add("order", order, "command a running robot: stand, walk, stop, sit, or torque off")
    words = "off: torque off; stop: set the feet down; ready: torque on; stand: rise; walk: start the planner; sit: lie down"
    one.add_argument("what", choices=("off", "stop", "ready", "stand", "walk", "sit"), help=words)
    _add_meeting(one)
    one.add_argument(
        "--holder", default="", help="name of the lease holder; only one may move the legs (default: USER at MACHINE)"
    )
    one.add_argument("--take", action="store_true", help="take the lease over from its holder")


def _add_role(one: argparse.ArgumentParser) -> None:
    """Add the arguments that select the processes and connect them to other machines."""
    one.add_argument(
        "role",
        choices=("all", "onboard", "offboard", "sim"),
        help="processes to start; onboard: actuator, stop, camera, perception; offboard: all others",
    )
    one.add_argument("--scenario", help="scenario to simulate instead of the hardware")
    one.add_argument("--no-page", action="store_true", help="do not start the console, so there is no operator's page")
    words = "profile by name, or path of a TOML file (default: the scenario's, or phantomx_mk2)"
    one.add_argument("--robot", default="", help=words)
    one.add_argument(
        "--camera", default="", metavar="DEVICE", help="openni2, realsense, none, or a recorded folder (default: the profile's)"
    )
    one.add_argument("--seed", type=values.natural, default=3, help="random seed of the simulation (default %(default)s)")
    words = "also run these processes here, e.g. mapper,planner"
    one.add_argument("--with", dest="also", action="append", default=[], metavar="NAMES", help=words)
    one.add_argument("--without", action="append", default=[], metavar="NAMES", help="processes not to start here")
    words = "endpoint of this machine's router (default tcp/127.0.0.1:7447, with --keys also tls/0.0.0.0:7448)"
    one.add_argument("--listen", action="append", metavar="ENDPOINT", help=words)
    words = "router of another machine to connect to whenever reachable, e.g. tls/robot.local:7448"
    one.add_argument("--connect", action="append", metavar="ENDPOINT", help=words)
    _add_keys(one)
    one.add_argument(
        "--open", action="store_true", help="admit any client, without certificates; repeats a warning while it runs"
    )
    one.add_argument("--namespace", default="sextant", help="prefix of every key (default %(default)s)")
    one.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SERVICE.KEY=VALUE",
        help="setting or parameter of a service; repeatable",
    )


def _add_services(add: AddCommand, parser: argparse.ArgumentParser) -> None:
    group = parser.add_subparsers(required=True, metavar="WHAT")
    one = add("install", service.install, "write a unit for each process of a role, and sextant.target for all", group)
    _add_role(one)
    one.add_argument("--dry-run", action="store_true", help="print the units, write nothing")
    other = add("uninstall", service.uninstall, "remove exactly the units that `install` wrote", group)
    for each in (one, other):
        each.set_defaults(name=f"service {'install' if each is one else 'uninstall'}")
        words = "use the system's service manager, /etc/systemd/system, not the user's"
        each.add_argument("--system", action="store_true", help=words)
        each.add_argument(
            "--as",
            dest="run_as",
            default="",
            metavar="USER",
            help="user that runs the --system units (default: the calling user)",
        )
        each.add_argument("--folder", metavar="DIR", help="folder of the units (default: that of the service manager)")

    one = add("compose", compose, "print a compose.yaml that starts each service in its own container", group)
    one.set_defaults(name="service compose")
    one.add_argument("--scenario", default="steps", help="name of the scenario (default %(default)s)")
    one.add_argument("--seed", type=values.natural, default=3, help="random seed of the simulation (default %(default)s)")
    one.add_argument("--offboard", action="store_true", help="print compose.yaml of the base station, with certificates")


def _add_certificates(add: AddCommand, parser: argparse.ArgumentParser) -> None:
    group = parser.add_subparsers(required=True, metavar="WHAT")
    one = add("new", keys.new, "make an authority and a folder of keys for each role", group)
    one.set_defaults(name="keys new")
    one.add_argument("folder", metavar="DIR", help="folder to create the keys in; existing files are not overwritten")
    words = "host name or address of the robot, e.g. hexapod.local or 192.168.1.20; repeatable"
    one.add_argument("--robot-address", action="append", default=[], metavar="NAME_OR_IP", help=words)
    words = "host name or address of a router between the robot and others, if any, see docs/fleet.md; repeatable"
    one.add_argument("--site-address", action="append", default=[], metavar="NAME_OR_IP", help=words)
    one.add_argument("--days", type=values.positive, default=365, metavar="N", help="validity in days (default %(default)s)")
    one = add("show", keys.show, "print role and expiry of each certificate", group)
    one.set_defaults(name="keys show")
    one.add_argument("folder", metavar="DIR", help="folder of `sextant keys new`, or of one role")


def _add_recording(add: AddCommand, parser: argparse.ArgumentParser) -> None:
    group = parser.add_subparsers(required=True, metavar="WHAT")
    one = add("info", info, "print a recording's files, topics, rates and sizes", group)
    one.set_defaults(name="recording info")
    one.add_argument("recording", help="an MCAP file, or a folder of them")
    one.add_argument("--json", action="store_true", help="print the result as JSON")
    one = add("recover", recover, "repair a recording that a crash truncated; the old file is kept", group)
    one.set_defaults(name="recording recover")
    one.add_argument("recording", help="an MCAP file, or a folder of them")
    one = add("export", export, "write a recording in another tool's format", group)
    one.set_defaults(name="recording export")
    one.add_argument("recording", help="an MCAP file, or a folder of them")
    one.add_argument("--rerun", required=True, metavar="FILE.rrd", help="output file for the rerun viewer")


def _add_topics(add: AddCommand, parser: argparse.ArgumentParser) -> None:
    group = parser.add_subparsers(required=True, metavar="WHAT")
    one = add("list", list_topics, "print the topic table", group)
    one.add_argument("--json", action="store_true", help="print the result as JSON")

    one = add("docs", docs, "print a reference page: docs/keys.md or docs/parameters.md", group)
    words = "keys, messages and schemas, or the parameters of the services (default %(default)s)"
    one.add_argument("page", nargs="?", choices=("keys", "parameters"), default="keys", help=words)

    def heard(name: str, command: Any, words: str) -> argparse.ArgumentParser:
        one: argparse.ArgumentParser = add(name, command, words, group)
        one.set_defaults(name=f"topics {name}")
        one.add_argument("keys", nargs="*", metavar="KEY", help="topics to receive (default: all except camera images)")
        _add_meeting(one)
        return one

    one = heard("echo", echo, "print received messages, large arrays as shape and range")
    one.add_argument(
        "--count", type=values.positive, default=0, metavar="N", help="number of messages to print (default: until Ctrl-C)"
    )
    one.add_argument(
        "--within", type=values.seconds, default=5.0, metavar="S", help="time to wait for the first message (default 5 s)"
    )
    one.add_argument("--json", action="store_true", help="print one JSON object per line")
    one = heard("hz", hz, "measure rate and bandwidth of each topic, and compare with the topic table")
    one.add_argument(
        "--seconds", type=values.seconds, default=5.0, metavar="S", help="duration of the measurement (default 5 s)"
    )
    one.add_argument("--json", action="store_true", help="print the result as JSON")

    one = add("foxglove", foxglove, "serve live topics to Foxglove or Lichtblick, until Ctrl-C", group)
    one.set_defaults(name="topics foxglove")
    one.add_argument("--host", default="127.0.0.1", help="address to listen on (default %(default)s)")
    one.add_argument("--port", type=values.port, default=8765, help="TCP port, 0 for any free port (default %(default)s)")
    one.add_argument("--robot", default="phantomx_mk2", help="profile by name, or path of a TOML file (default %(default)s)")
    _add_meeting(one)
    one = add("ros2", ros2, "run the robot as a ROS 2 node over rmw_zenoh, without ROS, see docs/ros2.md", group)
    one.set_defaults(name="topics ros2")
    words = "ROS domain id (default: ROS_DOMAIN_ID, or 0)"
    one.add_argument("--domain", type=values.natural, default=os.environ.get("ROS_DOMAIN_ID") or "0", metavar="N", help=words)
    words = "namespace of the node and its topics, for several robots in one graph (default %(default)s)"
    one.add_argument("--ros-namespace", default="/", metavar="/NAME", help=words)
    words = "router of the ROS nodes, `ros2 run rmw_zenoh_cpp rmw_zenohd` (default: the robot's router)"
    one.add_argument("--ros-connect", action="append", metavar="ENDPOINT", help=words)
    one.add_argument("--connect", action="append", default=None, help="router of the robot (default: tcp/127.0.0.1:7447)")
    one.add_argument("--namespace", default="sextant", help="prefix of every key of the robot (default %(default)s)")
    _add_keys(one)
    one.add_argument("--robot", default="phantomx_mk2", help="profile by name, or path of a TOML file (default %(default)s)")
    words = "gait for Twist messages (default %(default)s)"
    one.add_argument("--gait", default="tripod", choices=("tripod", "ripple", "wave"), help=words)
    one.add_argument("--pictures", action="store_true", help="also publish the small camera previews")


def _add_servos(add: AddCommand, parser: argparse.ArgumentParser) -> None:
    group = parser.add_subparsers(required=True, metavar="WHAT")
    legs = ("left front", "right front", "right middle", "right rear", "left rear", "left middle")

    def of_robot(name: str, command: Any, words: str) -> argparse.ArgumentParser:
        one: argparse.ArgumentParser = add(name, command, words, group)
        one.set_defaults(name=f"servos {name}")
        one.add_argument(
            "--robot", default="phantomx_mk2", help="profile by name, or path of a TOML file (default %(default)s)"
        )
        return one

    def on_port(name: str, command: Any, words: str) -> argparse.ArgumentParser:
        one = of_robot(name, command, words)
        one.add_argument("--port", default="/dev/ttyUSB0", help="serial device, or socket://host:port (default %(default)s)")
        one.add_argument(
            "--echo", action="store_true", help="the adapter returns every sent byte, as some half-duplex adapters do"
        )
        return one

    def of_legs(name: str, command: Any, words: str) -> argparse.ArgumentParser:
        one = on_port(name, command, words)
        one.add_argument(
            "--leg", action="append", choices=legs, metavar="LEG", help="only this leg, e.g. 'left front'; repeatable"
        )
        one.add_argument("--yes", action="store_true", help="for scripts: ask no question, assume yes")
        return one

    one = on_port("scan", servos.scan, "list the servos on the bus, and report missing, duplicate, wrong or reset ones")
    one.add_argument(
        "--ids",
        type=values.servo_ids,
        default=range(254),
        metavar="A:B",
        help="servo ids to scan, B not included (default 0:254)",
    )
    one.add_argument("--json", action="store_true", help="print the result as JSON")
    one = on_port("off", servos.off, "turn the torque of all servos off at the port, without a running actuator")
    words = "a microcontroller on the port drives the servos, like the actuator's setting `bridge`, see docs/bridge.md"
    one.add_argument("--bridge", action="store_true", help=words)
    on_port("set-id", servos.set_id, "set each servo's id to that of its joint, one at a time; can be interrupted and resumed")
    one = of_legs(
        "calibrate", servos.calibrate, "measure the horn offsets of each leg, and write them to the robot's TOML file"
    )
    one.add_argument(
        "--out", metavar="FILE", help="TOML file to write (default: that of --robot, or my_NAME.toml for a profile)"
    )
    angles = ("COXA", "FEMUR", "TIBIA")
    one.add_argument(
        "--pose", type=values.angle, nargs=3, metavar=angles, help="joint angles of a jig [deg] (default 0 0 0: straight out)"
    )
    one = of_legs("test", servos.test, "move each joint a few degrees and back, one at a time, slowly and with low torque")
    one.add_argument(
        "--torque", choices=("on", "off"), default="", help="torque state after the test (default: ask, or off with --yes)"
    )
    one = of_robot("emulate", servos.emulate, "emulate the servos of a robot, or a set of new servos, on a network port")
    one.add_argument(
        "--fresh", action="store_true", help="factory-new servos, all with id 1, to be plugged in at this terminal"
    )
    one.add_argument("--seed", type=values.natural, default=3, help="random seed of the horn offsets (default %(default)s)")
    one.add_argument(
        "--listen", type=values.port, default=0, metavar="PORT", help="TCP port on 127.0.0.1 (default: any free port)"
    )


def _add_meeting(parser: argparse.ArgumentParser) -> None:
    words = "router of the robot (default: tcp/127.0.0.1:7447)"
    parser.add_argument("--connect", action="append", default=None, help=words)
    parser.add_argument("--namespace", default="sextant", help="prefix of every key (default %(default)s)")
    _add_keys(parser)


def _add_keys(parser: argparse.ArgumentParser) -> None:
    words = "this machine's folder of `sextant keys new`, required for tls endpoints"
    parser.add_argument("--keys", dest="key_folder", metavar="DIR", help=words)


def _add_robot_and_gait(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", default="", help="robot profile by name, or path of a TOML file (default: the scenario's)")
    gaits = ("tripod", "ripple", "wave")
    parser.add_argument(
        "--gait", default="", choices=gaits, help="gait (default: the scenario's); a slower gait gets a longer time limit"
    )
    words = "radio simulated in lockstep: one-way delay, total Mbit/s both ways, share of lost packets, e.g. 20,20,0.05"
    parser.add_argument("--link", default="", metavar="MS,MBIT,LOSS", help=words)


def _add_seed_and_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=values.natural, default=3, help="random seed (default %(default)s)")
    parser.add_argument("--out", metavar="DIR", help="folder to write to (default: a new one below runs/)")


if __name__ == "__main__":
    sys.exit(main())
