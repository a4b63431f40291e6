"""Command-line interface: argument parsing, error reporting and exit status.

Every failure states its cause and what to do next.

Exit status: 0 on success only, 1 for a failed run, 2 for invalid input, 130 when the operator interrupts it.
Modules that take long to import are imported by the command that needs them.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Any

from sextant.deploy.arguments import ArgumentParser
from sextant.deploy.commands import keys, service, servos, values
from sextant.deploy.commands.benches import (
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
from sextant.deploy.commands.common import FAILED, INTERRUPTED, WRONG_INPUT, InputError, complain
from sextant.deploy.commands.facts import compose, doctor
from sextant.deploy.commands.faults import faults
from sextant.deploy.commands.fleet import fleet
from sextant.deploy.commands.fuzz import fuzz
from sextant.deploy.commands.order import order
from sextant.deploy.commands.plots import plot
from sextant.deploy.commands.recordings import export, foxglove, info, record, recover, replay
from sextant.deploy.commands.ros2 import ros2
from sextant.deploy.commands.topics import docs, echo, hz, list_topics
from sextant.deploy.commands.trials import table, trials
from sextant.deploy.commands.up import up
from sextant.deploy.commands.video import video
from sextant.deploy.commands.walks import DEMOS, demo, run
from sextant.deploy.output import OutputError, discard_output, flushed_output, prepare_streams
from sextant.shared.files.whole_files import OUT_OF_ROOM, cause

_SAID_IN_WORDS = {  # exceptions that are reported as one line; only some commands import their modules
    "sextant.shared.wire.transport": "TransportError",
    "sextant.shared.files.input_file": "FileError",
    "sextant.shared.runtime.lockstep": "ServiceFailedError",
    "sextant.shared.wire.access": "AccessError",
    "sextant.shared.recording.layout": "RecordingError",
    "sextant.shared.files.whole_files": "WriteError",
    "sextant.deploy.video.story": "StoryError",
    "sextant.deploy.video.files": "FileError",
    "sextant.deploy.launch.fleet": "FleetError",
    "sextant.deploy.trials.kept": "KeptError",
    "sextant.deploy.launch.units": "UnitError",
    "sextant.deploy.trials.batch": "ChangedError",
    "sextant.deploy.replay.error": "ReplayError",
    "sextant.services.actuator.servo_bus.serial_port": "BusGone",
    "sextant.services.actuator.commissioning.limited_motion": "ServoSilentError",
}
_OF_THE_MACHINE = (
    "TransportError",
    "BusGone",
    "ServoSilentError",
    "ServiceFailedError",
    "WriteError",
)  # caused by the machine, not by the caller: exit status 1


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""
    prepare_streams()
    name = "sextant"
    try:
        with flushed_output():
            arguments = parse(sys.argv[1:] if argv is None else argv)
            name = f"sextant {arguments.name}"
            return int(arguments.command(arguments))
    except KeyboardInterrupt:
        complain("stopped by the operator")
        return INTERRUPTED
    except BrokenPipeError:  # the reader closed the pipe
        discard_output()
        return FAILED
    except OutputError as error:
        discard_output()
        complain(f"{name}: {error}")
        return FAILED
    except _refusals() as error:
        complain(f"{name}: {error}")
        return FAILED if type(error).__name__ in _OF_THE_MACHINE else WRONG_INPUT
    except OSError as error:
        if error.errno not in OUT_OF_ROOM:
            raise
        complain(f"{name}: {error.filename or 'a temporary file'} cannot be written: {cause(error)}")
        return FAILED


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments of a command; exit with a message if they are invalid."""
    words = list(argv)
    if words[:2] == ["trials", "table"]:  # a two-word command whose first word is also a command
        words[:2] = ["trials table"]
    return _parser().parse_whole(words)


def _refusals() -> tuple[type[Exception], ...]:
    """Return the exception types that are reported as one line, without traceback."""
    from sextant.shared.files.config import ConfigError

    others = [getattr(sys.modules[module], name) for module, name in _SAID_IN_WORDS.items() if module in sys.modules]
    return ConfigError, InputError, *others


def _parser() -> ArgumentParser:
    parser = ArgumentParser(prog="sextant", description="Six-legged walking where only some places carry a foot.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(name: str, command: Any, words: str, to: Any = commands, listed: bool = True) -> argparse.ArgumentParser:
        about = {"help": words} if listed else {}
        made: argparse.ArgumentParser = to.add_parser(
            name, description=words[0].upper() + words[1:].replace("%%", "%") + ".", **about
        )
        made.set_defaults(command=command, name=name, parser=made)
        return made

    _add_walks(add)
    _add_campaigns(add)
    _add_robots(add)
    _add_recordings(add)
    _add_plot(add)

    _add_benches(add, commands.add_parser("bench", help="what the stages are worth"))
    _add_certificates(add, commands.add_parser("keys", help="certificates: who may meet the robot, and what each may do"))
    _add_services(add, commands.add_parser("service", help="the processes of a role as services of systemd"))
    _add_topics(add, commands.add_parser("topics", help="what travels on the wire"))
    _add_servos(add, commands.add_parser("servos", help="from a box of servos to a robot: find, name, calibrate, test them"))

    one = add("doctor", doctor, "check that this machine has what the services need")
    one.add_argument("--port", help="also check this servo port, e.g. /dev/ttyUSB0")
    one.add_argument("--camera", default="", metavar="DEVICE", help="also check this camera: openni2, realsense, or a folder")
    words = "instead try to get in there without being asked in, e.g. tls/hexapod.local:7448; nothing is put"
    one.add_argument("--stranger", metavar="ENDPOINT", help=words)
    words = "folder of `sextant keys new` with its ca/, for --stranger to try a certificate that has expired, too"
    one.add_argument("--keys", dest="key_folder", metavar="DIR", help=words)
    one.add_argument("--robot", default="phantomx_mk2", help="whose servos and camera are looked for (default %(default)s)")
    one.add_argument("--json", action="store_true", help="as JSON")

    one = add("compose", compose, "print a compose.yaml that starts the services in containers of their own")
    one.add_argument("--scenario", default="steps", help="name of the scenario (default %(default)s)")
    one.add_argument("--seed", type=values.natural, default=3, help="of the simulation (default %(default)s)")
    one.add_argument("--offboard", action="store_true", help="in place of it, what runs beside a robot, by certificates")
    return parser


def _add_recordings(add: Any) -> None:
    one = add("record", record, "record all that is said on the wire, in MCAP files of a minute, until Ctrl-C")
    one.add_argument("--out", metavar="DIR", help="folder to write to (default: a new one below recordings/)")
    one.add_argument("--seconds", type=values.seconds, metavar="S", help="end after as long")
    one.add_argument("--pictures", action="store_true", help="the camera's own pictures too: nine tenths of the bytes")
    words = "of the disk that stay free (default %(default)s)"
    one.add_argument("--reserve", type=values.natural, default=500, metavar="MB", help=words)
    one.add_argument("--robot", default="phantomx_mk2", help="whose (default %(default)s)")
    _add_meeting(one)
    one = add("info", info, "say what is in a recording: its files, topics, rates and sizes")
    one.add_argument("recording", help="an MCAP file, or a folder of them")
    one.add_argument("--json", action="store_true", help="as JSON")
    one = add("recover", recover, "make a recording whole that a crash cut off; the old file stays as it is")
    one.add_argument("recording", help="an MCAP file, or a folder of them")
    one = add("export", export, "write a recording in another tool's format")
    one.add_argument("recording", help="an MCAP file, or a folder of them")
    one.add_argument("--rerun", required=True, metavar="FILE.rrd", help="for the rerun viewer")
    one = add("foxglove", foxglove, "show what is said, live, in Foxglove or Lichtblick, until Ctrl-C")
    one.add_argument("--host", default="127.0.0.1", help="address to listen on (default %(default)s)")
    one.add_argument("--port", type=values.port, default=8765, help="TCP port, 0 for any that is free (default %(default)s)")
    one.add_argument("--robot", default="phantomx_mk2", help="whose (default %(default)s)")
    _add_meeting(one)
    one = add(
        "replay", replay, "run perception and mapper on a recorded depth sequence, or mapper and planner on a recorded run"
    )
    one.add_argument("source", help="folder with depth.txt, camera.toml (and groundtruth.txt), or a recording")
    one.add_argument("--only", action="append", metavar="TOPIC", help="feed only these of the recorded topics")
    one.add_argument("--json", action="store_true", help="print the result as JSON; progress goes to stderr")
    one.add_argument("--out", metavar="DIR", help="folder to write to (default: a new one below runs/)")

    one = add("video", video, "draw a recorded run: the robot on its ground, its map, its footholds and what it says")
    one.add_argument("run", help="folder that a run has left, an MCAP file, or a folder of them")
    words = "where to: .mp4, .webm, .avi, or animated .webp, .gif, .png (default: walk.mp4 beside the recording)"
    one.add_argument("--out", metavar="FILE", help=words)
    one.add_argument(
        "--speed", type=values.times, default=1.0, metavar="X", help="times as fast as it walked (default %(default)g)"
    )
    one.add_argument("--size", type=values.size, default=(1280, 720), metavar="WxH", help="in pixels (default 1280x720)")
    words = "whose ground it is drawn on, where the recording names one that is not known here: a name, or a TOML file"
    one.add_argument("--scenario", default="", metavar="NAME", help=words)
    one.add_argument("--fps", type=values.rate, default=25.0, metavar="N", help="pictures a second (default %(default)g)")
    one.add_argument("--from", dest="from_s", type=values.instant, default=0.0, metavar="S", help="begin there")
    one.add_argument("--to", dest="to_s", type=values.instant, default=float("inf"), metavar="S", help="end there")


def _add_plot(add: Any) -> None:
    one = add("plot", plot, "draw the figures of a recorded run, or of several beside each other")
    one.add_argument("run", nargs="*", metavar="RUN", help="folder of a run, or its recording; several are compared")
    one.add_argument("--what", nargs="+", action="extend", metavar="NAME", help="only these figures (default: all)")
    one.add_argument("--list", action="store_true", help="name the figures, and draw nothing")
    one.add_argument("--format", choices=("svg", "pdf", "png"), default="svg", help="of the files (default %(default)s)")
    words = "name or TOML file of what was walked, where the recording's own does not come with sextant"
    one.add_argument("--scenario", default="", metavar="SCENARIO", help=words)
    one.add_argument("--out", metavar="DIR", help="folder to write to (default: a new one below runs/)")
    one.add_argument("--json", action="store_true", help="print the runs in numbers as JSON, in place of a table")


def _add_walks(add: Any) -> None:
    one = add("demo", demo, "watch the robot walk a field of low steps, or cross a gap, over Zenoh")
    one.add_argument("course", nargs="?", choices=tuple(DEMOS), default="steps", help="what it walks (default %(default)s)")
    _add_seed_and_out(one)

    one = add("run", run, "run a scenario and write a folder with report.json, pictures and recording.mcap")
    one.add_argument("scenario", help="name of a scenario that comes with sextant, or path of a TOML file")
    _add_robot_and_gait(one)
    one.add_argument("--lockstep", action="store_true", help="in one process on simulated time, as fast as the machine allows")
    one.add_argument(
        "--bridge", action="store_true", help="a simulated microcontroller speaks the servo bus, see docs/bridge.md"
    )
    words = "let simulated time wait where this computer is too slow, as the demo does (default: real time)"
    one.add_argument("--slow-down", action="store_true", help=words)
    one.add_argument("--json", action="store_true", help="print report.json; progress goes to stderr")
    one.add_argument("--record-depth", metavar="DIR", help="also write the depth frames for `sextant replay` (with --lockstep)")
    one.add_argument("--connect", action="append", help="use services that already run, met here, e.g. tcp/127.0.0.1:7447")
    one.add_argument("--namespace", default="sextant", help="of those services (default %(default)s)")
    _add_keys(one)
    one.add_argument("--parent", type=int, help=argparse.SUPPRESS)  # id of the launcher's process
    _add_seed_and_out(one)


def _add_campaigns(add: Any) -> None:
    one = add("trials", trials, "run a scenario in lockstep with many seeds: success rate with its 95 %% interval")
    one.add_argument("scenario", help="scenario name or TOML file; or a group: all, passages, troubles")
    _add_robot_and_gait(one)
    words = "from A up to, not including, B; or commit:N, N that the hash of the commit gives, so that nobody has chosen them"
    one.add_argument("--seeds", type=values.any_seeds, required=True, metavar="A:B", help=words)
    one.epilog = "`sextant trials table --help`: print tables of trials that were kept, nothing being run."
    one.add_argument("--blind", action="store_true", help="also run the baseline, without a map, and compare")
    one.add_argument("--jobs", type=values.processes, default=1, metavar="N", help="processes at a time (default %(default)s)")
    one.add_argument("--out", metavar="DIR", help="folder to write to; seeds that it has already are not run again")
    one.add_argument("--json", action="store_true", help="print the result as JSON; progress goes to stderr")

    one = add("trials table", table, "print a table of trials that were kept, in Markdown, nothing being run", listed=False)
    words = "folder that trials have left, or a campaign.jsonl of one; parts of a campaign are put together"
    one.add_argument("kept", nargs="+", metavar="KEPT", help=words)
    words = (
        "walks, how often the goal was reached, missteps, how right the maps were, passages, or every section planned of them"
    )
    choices = ("walks", "reached", "missteps", "maps", "passages", "sections")
    one.add_argument("--of", choices=choices, default="walks", help=f"{words} (default %(default)s)")
    one.add_argument("--json", action="store_true", help="print all of it as JSON")

    one = add("faults", faults, "break a walk in every way at many phases of a step, and see what the robot does")
    one.add_argument("fault", nargs="*", metavar="FAULT", help="only these (default: all)")
    one.add_argument("--live", action="store_true", help="all that need processes over Zenoh, in place of those in lockstep")
    one.add_argument("--phases", type=values.positive, metavar="N", help="times that each is injected (default 300, live 30)")
    one.add_argument("--list", action="store_true", help="name the faults, and break nothing")
    words = "processes at a time, in lockstep (default %(default)s)"
    one.add_argument("--jobs", type=values.processes, default=1, metavar="N", help=words)
    one.add_argument("--out", metavar="DIR", help="folder to write to; what it has already is not done again")
    one.add_argument("--json", action="store_true", help="print the result as JSON; progress goes to stderr")

    one = add("fuzz", fuzz, "give broken messages to whatever takes in something that others have made")
    words = "to all of them together (default %(default)s)"
    one.add_argument("--messages", type=values.positive, default=10_000_000, metavar="N", help=words)
    one.add_argument("--seed", type=values.natural, default=0, help="of how they are broken (default %(default)s)")
    one.add_argument("--only", action="append", default=[], metavar="NAME", help="only for this one; again for another")
    one.add_argument("--list", action="store_true", help="name all that takes messages in, and break none")
    one.add_argument("--give", metavar="FILE", help="give the one of --only this message, as it is")
    one.add_argument("--jobs", type=values.processes, default=1, metavar="N", help="processes at a time (default %(default)s)")
    _add_out_and_json(one)


def _add_robots(add: Any) -> None:
    one = add("up", up, "start the processes of a role and keep them until Ctrl-C")
    _add_role(one)
    words = "start nothing; print the configuration of Zenoh that this machine's router would have, made from the tables"
    one.add_argument("--print-zenoh", action="store_true", help=words)

    one = add("fleet", fleet, "start a base for several robots, with one page for all, and keep it until Ctrl-C")
    one.add_argument("file", metavar="FLEET.toml", help="the robots and where each is met, see docs/fleet.md")
    one.add_argument("--open", action="store_true", help="meet robots without certificates, too; warns as long as it runs")

    one = add("order", order, "order the legs of a robot that is up: stand, walk, stop, sit, or let go")
    words = "off: let go; stop: set the feet down; ready: torque on; stand: rise; walk: let the planner walk; sit: lie down"
    one.add_argument("what", choices=("off", "stop", "ready", "stand", "walk", "sit"), help=words)
    _add_meeting(one)
    one.add_argument("--holder", default="", help="who orders: one at a time may move the legs (default: USER at MACHINE)")
    one.add_argument("--take", action="store_true", help="take over from whoever may move them now")

    one = add("ros2", ros2, "make the robot a node of ROS 2 over rmw_zenoh, without ROS, see docs/ros2.md")
    words = "of ROS (default: ROS_DOMAIN_ID, or 0)"
    one.add_argument("--domain", type=values.natural, default=os.environ.get("ROS_DOMAIN_ID") or "0", metavar="N", help=words)
    words = "of the node and its topics, for several robots in one graph (default %(default)s)"
    one.add_argument("--ros-namespace", default="/", metavar="/NAME", help=words)
    words = "router of the ROS nodes, `ros2 run rmw_zenoh_cpp rmw_zenohd` (default: that of the robot)"
    one.add_argument("--ros-connect", action="append", metavar="ENDPOINT", help=words)
    one.add_argument("--connect", action="append", default=None, help="router of the robot (default: tcp/127.0.0.1:7447)")
    one.add_argument("--namespace", default="sextant", help="prefix of every key of the robot (default %(default)s)")
    _add_keys(one)
    one.add_argument("--robot", default="phantomx_mk2", help="profile by name, or path of a TOML file (default %(default)s)")
    words = "in which Twists walk (default %(default)s)"
    one.add_argument("--gait", default="tripod", choices=("tripod", "ripple", "wave"), help=words)
    one.add_argument("--pictures", action="store_true", help="also pass the camera's small pictures on")


def _add_role(one: argparse.ArgumentParser) -> None:
    """Add the arguments that select the processes and connect them to other machines."""
    one.add_argument(
        "role",
        choices=("all", "onboard", "offboard", "sim"),
        help="onboard: actuator, stop, camera, perception; offboard: the rest",
    )
    one.add_argument("--scenario", help="simulate it in place of the hardware")
    one.add_argument("--no-page", action="store_true", help="start no console: nobody leads from a browser")
    words = "profile by name, or path of a TOML file (default: the scenario's, or phantomx_mk2)"
    one.add_argument("--robot", default="", help=words)
    one.add_argument(
        "--camera", default="", metavar="DEVICE", help="openni2, realsense, none, or a recorded folder, over the profile"
    )
    one.add_argument("--seed", type=values.natural, default=3, help="of the simulation (default %(default)s)")
    words = "run these processes here, too: names of the table, e.g. mapper,planner"
    one.add_argument("--with", dest="also", action="append", default=[], metavar="NAMES", help=words)
    one.add_argument("--without", action="append", default=[], metavar="NAMES", help="leave these out: they run elsewhere")
    words = "where to host this machine's router (default tcp/127.0.0.1:7447, with --keys also tls/0.0.0.0:7448)"
    one.add_argument("--listen", action="append", metavar="ENDPOINT", help=words)
    words = "router of another machine that this one is chained to, whenever that is there: tls/robot.local:7448"
    one.add_argument("--connect", action="append", metavar="ENDPOINT", help=words)
    _add_keys(one)
    one.add_argument("--open", action="store_true", help="let anybody in where the router listens; warns as long as it runs")
    one.add_argument("--namespace", default="sextant", help="prefix of every key (default %(default)s)")
    one.add_argument("--set", action="append", default=[], metavar="SERVICE.KEY=VALUE", help="a setting of one service")


def _add_services(add: Any, parser: argparse.ArgumentParser) -> None:
    group = parser.add_subparsers(required=True, metavar="WHAT")
    one = add("install", service.install, "write a unit for each process of a role, and sextant.target for all", group)
    _add_role(one)
    one.add_argument("--dry-run", action="store_true", help="print them, write nothing")
    other = add("uninstall", service.uninstall, "remove what `install` wrote, and nothing else", group)
    for each in (one, other):
        each.set_defaults(name=f"service {'install' if each is one else 'uninstall'}")
        words = "for the machine's service manager, not your own: /etc/systemd/system"
        each.add_argument("--system", action="store_true", help=words)
        each.add_argument("--as", dest="run_as", default="", metavar="USER", help="whom --system runs them as (default: you)")
        each.add_argument("--folder", metavar="DIR", help="to have the units in, in place of the usual one")


def _add_certificates(add: Any, parser: argparse.ArgumentParser) -> None:
    group = parser.add_subparsers(required=True, metavar="WHAT")
    one = add("new", keys.new, "make an authority and a folder of keys for each role", group)
    one.set_defaults(name="keys new")
    one.add_argument("folder", metavar="DIR", help="to make them in; what is there is not overwritten")
    words = "at which the robot is reached, as often as it has some, e.g. hexapod.local or 192.168.1.20"
    one.add_argument("--robot-address", action="append", default=[], metavar="NAME_OR_IP", help=words)
    words = "likewise a router between the robot and others, where there is one, see docs/fleet.md"
    one.add_argument("--site-address", action="append", default=[], metavar="NAME_OR_IP", help=words)
    one.add_argument(
        "--days", type=values.positive, default=365, metavar="N", help="for which they are good (default %(default)s)"
    )
    one = add("show", keys.show, "say of each certificate its role, and when it ends", group)
    one.set_defaults(name="keys show")
    one.add_argument("folder", metavar="DIR", help="of `sextant keys new`, or one role's")


def _add_benches(add: Any, parser: argparse.ArgumentParser) -> None:
    group = parser.add_subparsers(required=True, metavar="WHAT")
    one = add("accuracy", bench_accuracy, "ride over rebuilt scenes: errors of pose and map through the real services", group)
    one.add_argument("--jobs", type=values.processes, default=1, metavar="N", help="processes at a time (default %(default)s)")
    _add_bench(one)
    one = add("speed", bench_speed, "time registration beside its peers, frame by frame in one run", group)
    _add_frames(one)
    _add_bench(one)
    one = add("stages", bench_stages, "time the stages of the map beside their peers, frame by frame in one run", group)
    _add_frames(one)
    _add_bench(one)
    one = add("passage", bench_passage, "time the passage planner beside its peers, and check its plans", group)
    _add_bench(one)

    one = add("access", bench_access, "put what may not be put through a guarded router: what comes through", group)
    one.add_argument("--messages", type=values.positive, default=10_000, metavar="N", help="of each kind (default %(default)s)")
    _add_out_and_json(one)
    one = add("strangers", bench_strangers, "time how soon rightful clients are let in while strangers connect", group)
    words = "cuts of the radio between robot and base (default %(default)s)"
    one.add_argument("--cuts", type=values.positive, default=100, metavar="N", help=words)
    words = "connections of strangers a second (default %(default)s)"
    one.add_argument("--rate", type=values.positive, default=1000, metavar="HZ", help=words)
    words = "restarts of an actuator, each without silent connections and with them (default %(default)s)"
    one.add_argument("--restarts", type=values.natural, default=10, metavar="N", help=words)
    words = "silent connections at each endpoint of the router meanwhile (default %(default)s)"
    one.add_argument("--silent", type=values.positive, default=500, metavar="N", help=words)
    one.add_argument("--seed", type=values.natural, default=0, help="random seed of the cuts (default %(default)s)")
    _add_out_and_json(one)
    words = "send well-formed messages with extreme values as each role while a robot walks; count what fails"
    one = add("roles", bench_roles, words, group)
    one.add_argument("--messages", type=values.positive, default=10_000, metavar="N", help="of each role (default %(default)s)")
    one.add_argument("--only", action="append", default=[], metavar="ROLE", help="only this role; again for another")
    one.add_argument("--lockstep", action="store_true", help="on simulated time, in this process")
    one.add_argument("--seed", type=values.natural, default=1, help="random seed (default %(default)s)")
    _add_out_and_json(one)
    one = add("bus", bench_bus, "break the emulated servo bus in many ways: what the driver loses, doubts and believes", group)
    words = "asked in each case, at least (default %(default)s)"
    one.add_argument("--questions", type=values.positive, default=20_000, metavar="N", help=words)
    one.add_argument("--only", default="", metavar="WORDS", help="the cases whose names contain these words")
    one.add_argument("--seed", type=values.natural, default=0, help="of what is broken (default %(default)s)")
    _add_out_and_json(one)
    one = add("servos", bench_servos, "time the servo bus through our own packets and through dynamixel-sdk", group)
    one.add_argument("--rounds", type=values.positive, default=300, metavar="N", help="of each job (default %(default)s)")
    _add_out_and_json(one)

    one = add("link", bench_link, "walk a robot whose map and planner are behind a radio that loses, or is cut", group)
    one.add_argument("--walks", type=values.positive, default=5, metavar="N", help="over each link (default %(default)s)")
    one.add_argument("--scenario", default="steps", help="of the walks (default %(default)s)")
    one.add_argument(
        "--cuts", type=values.natural, default=0, metavar="N", help="instead cut the radio so many times in one walk"
    )
    words = "[s] of the longest cut; the shortest takes 0.1 s (default %(default)s)"
    one.add_argument("--longest", type=values.longest_cut, default=30.0, metavar="S", help=words)
    one.add_argument(
        "--seed", type=values.natural, default=0, help="first seed of the walks, or that of the cuts (default %(default)s)"
    )
    _add_out_and_json(one)
    one = add("fleet", bench_fleet, "load a base with one robot, two and so on, until it does not carry them", group)
    words = "at most so many (default %(default)s)"
    one.add_argument("--robots", type=values.positive, default=12, metavar="N", help=words)
    words = "scenario that is walked once in lockstep and then played by each robot (default %(default)s)"
    one.add_argument("--course", default="steps", metavar="SCENARIO", help=words)
    _add_out_and_json(one)
    one = add("page", bench_page, "time how soon the operator's page stops the robot, by a real browser, and its cost", group)
    one.add_argument("--rounds", type=values.positive, default=30, metavar="N", help="of each (default %(default)s)")
    _add_out_and_json(one)
    one = add(
        "recording",
        bench_recording,
        "time the servos' cycle while somebody records, the disk fills up, the recorder dies",
        group,
    )
    one.add_argument("--rounds", type=values.positive, default=5, metavar="N", help="of each (default %(default)s)")
    _add_out_and_json(one)
    _add_out_and_json(add("size", bench_size, "say how much each role takes on a disk", group))
    one = add("soak", bench_soak, "walk for long, and see whether memory or latency grow", group)
    words = "of walking (default %(default)s)"
    one.add_argument("--minutes", type=values.minutes, default=60.0, metavar="MIN", help=words)
    _add_out_and_json(one)
    one = add(
        "start", bench_start, "time how soon the actuator holds a robot that stands, from the start of its process", group
    )
    one.add_argument("--rounds", type=values.positive, default=20, metavar="N", help="starts (default %(default)s)")
    _add_out_and_json(one)


def _add_topics(add: Any, parser: argparse.ArgumentParser) -> None:
    group = parser.add_subparsers(required=True, metavar="WHAT")
    one = add("list", list_topics, "print the topic table", group)
    one.add_argument("--json", action="store_true", help="as JSON")

    add("docs", docs, "print docs/keys.md: keys, messages and schemas on one page", group)

    def heard(name: str, command: Any, words: str) -> argparse.ArgumentParser:
        one: argparse.ArgumentParser = add(name, command, words, group)
        one.set_defaults(name=f"topics {name}")
        one.add_argument("keys", nargs="*", metavar="KEY", help="only these (default: all but pictures)")
        _add_meeting(one)
        return one

    one = heard("echo", echo, "print messages as they come, large arrays by their shape and what lies in them")
    one.add_argument("--count", type=values.positive, default=0, metavar="N", help="end after as many (default: at Ctrl-C)")
    one.add_argument("--within", type=values.seconds, default=5.0, metavar="S", help="for the first to come (default 5 s)")
    one.add_argument("--json", action="store_true", help="one object per line")
    one = heard("hz", hz, "measure how often and how much each topic says, beside the topic table")
    one.add_argument("--seconds", type=values.seconds, default=5.0, metavar="S", help="to listen for (default 5 s)")
    one.add_argument("--json", action="store_true", help="as JSON")


def _add_servos(add: Any, parser: argparse.ArgumentParser) -> None:
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
        one.add_argument("--echo", action="store_true", help="the adapter returns every byte sent, as some with one wire do")
        return one

    def of_legs(name: str, command: Any, words: str) -> argparse.ArgumentParser:
        one = on_port(name, command, words)
        one.add_argument("--leg", action="append", choices=legs, metavar="LEG", help="only this one, e.g. 'left front'")
        one.add_argument("--yes", action="store_true", help="for scripts: nobody is asked, every answer is yes")
        return one

    one = on_port("scan", servos.scan, "list the servos on the bus, and name what is missing, doubled, wrong or reset")
    one.add_argument(
        "--ids", type=values.servo_ids, default=range(254), metavar="A:B", help="ids to ask, B not included (default 0:254)"
    )
    one.add_argument("--json", action="store_true", help="as JSON")
    one = on_port("off", servos.off, "turn the torque of all servos off at the port, where no actuator runs to be ordered so")
    words = "a microcontroller on the port drives the servos, as with the actuator's setting of that name: docs/bridge.md"
    one.add_argument("--bridge", action="store_true", help=words)
    on_port("set-id", servos.set_id, "give each servo the id of its joint, one at a time; can be left and resumed")
    one = of_legs("calibrate", servos.calibrate, "measure how the horns sit, leg by leg, into a TOML of this robot")
    one.add_argument("--out", metavar="FILE", help="that TOML (default: the one of --robot, or my_NAME.toml for a profile)")
    angles = ("COXA", "FEMUR", "TIBIA")
    one.add_argument(
        "--pose", type=values.angle, nargs=3, metavar=angles, help="joint angles of a jig [deg] (default 0 0 0: straight out)"
    )
    one = of_legs("test", servos.test, "move each joint a few degrees and back, alone, slowly and with little torque")
    one.add_argument(
        "--torque", choices=("on", "off"), default="", help="how the torque is left (default: asked, off with --yes)"
    )
    one = of_robot("emulate", servos.emulate, "servos without servos: a robot's on a network port, or a box of new ones")
    one.add_argument(
        "--fresh", action="store_true", help="as from the factory, all with id 1, to be plugged in at this terminal"
    )
    one.add_argument("--seed", type=values.natural, default=3, help="by which their horns sit wrong (default %(default)s)")
    one.add_argument("--listen", type=values.port, default=0, metavar="PORT", help="on 127.0.0.1 (default: any that is free)")


def _add_frames(parser: argparse.ArgumentParser) -> None:
    words = "of each ride, 2 cm apart (default %(default)s)"
    parser.add_argument("--frames", type=values.frames, default=100, metavar="N", help=words)


def _add_bench(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--seeds", type=values.seeds, default=range(1000, 1003), metavar="A:B", help="rides (default 1000:1003)"
    )
    _add_out_and_json(parser)


def _add_out_and_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="DIR", help="folder to write to (default: a new one below runs/)")
    parser.add_argument("--json", action="store_true", help="print the result as JSON; progress goes to stderr")


def _add_meeting(parser: argparse.ArgumentParser) -> None:
    words = "router of the robot (default: tcp/127.0.0.1:7447)"
    parser.add_argument("--connect", action="append", default=None, help=words)
    parser.add_argument("--namespace", default="sextant", help="prefix of every key (default %(default)s)")
    _add_keys(parser)


def _add_keys(parser: argparse.ArgumentParser) -> None:
    words = "this machine's folder of `sextant keys new`, for endpoints of tls"
    parser.add_argument("--keys", dest="key_folder", metavar="DIR", help=words)


def _add_robot_and_gait(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", default="", help="profile by name, or path of a TOML file, in place of the scenario's")
    gaits = ("tripod", "ripple", "wave")
    parser.add_argument("--gait", default="", choices=gaits, help="in place of the scenario's, with more time for slower ones")
    words = "radio between robot and base in lockstep: MS,MBIT,LOSS, e.g. 20,20,0.05 (one way, together, share of packets)"
    parser.add_argument("--link", default="", metavar="MS,MBIT,LOSS", help=words)


def _add_seed_and_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=values.natural, default=3, help="of everything random (default %(default)s)")
    parser.add_argument("--out", metavar="DIR", help="folder to write to (default: a new one below runs/)")


if __name__ == "__main__":
    sys.exit(main())
