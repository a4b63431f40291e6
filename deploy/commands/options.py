"""Options and types of values that several commands share."""

import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from sextant.deploy.commands.common import InputError
from sextant.deploy.terminal.arguments import Choice, flag, number, option, options_of, whole

_Function = Callable[..., Any]

if TYPE_CHECKING:
    from sextant.shared.plugins.loading import Kind, Plugins
    from sextant.shared.robot.profile import RobotProfile
    from sextant.shared.scenario.scenario import Link, Scenario
    from sextant.shared.wire.messages import GaitRequest
    from sextant.shared.wire.transport import Endpoints

ROUTER = "tcp/127.0.0.1:7447"  # of the robot, by default
_MOST_SERVO_IDS = 254  # the next id is the broadcast id
_LARGEST_SEED = 2**53
_MOST_SEEDS = 1_000_000

NATURAL, POSITIVE = whole(0), whole(1)
PORT = whole(0, 65535)
SECONDS = number(0.001, 86400.0, "seconds")
GAIT = Choice(("tripod", "ripple", "wave", "auto"))


def seeds(text: str) -> range:
    """Parse seeds A:B, B not included."""
    found = re.fullmatch(r"(\d{1,16}):(\d{1,16})", text)
    if found is None or not int(found[1]) < int(found[2]) <= _LARGEST_SEED:
        raise ValueError(f"A:B with A < B expected, B not included, found {text[:60]!r}; for example 0:50")
    if int(found[2]) - int(found[1]) > _MOST_SEEDS:
        raise ValueError(f"at most {_MOST_SEEDS} seeds expected, found {text[:60]!r}; for example 0:50")
    return range(int(found[1]), int(found[2]))


def walk_speed(text: str) -> float | Literal["auto"]:
    """Parse a speed [m/s], or auto."""
    if text == "auto":
        return "auto"
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not 0.001 <= speed <= 10.0:
        raise ValueError(f"auto, or a speed from 0.001 to 10 m/s expected, found {text[:60]!r}")
    return speed


def servo_ids(text: str) -> range:
    """Parse servo ids A:B, B not included."""
    found = seeds(text)
    if found.stop > _MOST_SERVO_IDS:
        raise ValueError(f"ids of servos expected, 0 to {_MOST_SERVO_IDS - 1}, found {text!r}; for example 1:19")
    return found


def any_seeds(text: str) -> Sequence[int]:
    """Parse seeds A:B, or commit:N for N seeds derived from the commit."""
    drawn = re.fullmatch(r"commit:([1-9]\d{0,15})", text)
    if drawn is None:
        return seeds(text)
    from sextant.evaluation.provenance import seeds_of_commit

    return seeds_of_commit(int(drawn[1]))


def picture_size(text: str) -> tuple[int, int]:
    """Parse width and height [px] of a picture that can be encoded."""
    found = re.fullmatch(r"(\d{2,4})x(\d{2,4})", text)
    width, height = (int(found[1]), int(found[2])) if found else (0, 0)
    if not (64 <= width <= 3840 and 64 <= height <= 2160) or width % 2 or height % 2:
        raise ValueError(f"WxH expected, even and 64x64 to 3840x2160, found {text!r}; for example 960x540")
    return width, height


def width_in(text: str) -> float:
    """Parse a width of 1 to 40 inches, in in, cm or mm; return it [in]."""
    found = re.fullmatch(r"(\d{1,4}(?:\.\d{1,4})?)(in|cm|mm)", text)
    width = float(found[1]) / {"in": 1.0, "cm": 2.54, "mm": 25.4}[found[2]] if found else 0.0
    if not 1.0 <= width <= 40.0:
        raise ValueError(f"1in to 40in expected, found {text[:60]!r}; for example 3.5in or 89mm")
    return width


def count(name: str, default: int, about: str, lowest: int = 1, metavar: str = "N") -> Callable[[_Function], _Function]:
    """Return an option whose value is an integer of at least `lowest`."""
    return option(name, about, metavar, type=whole(lowest), default=default)


out = option("--out", "folder to write to (default: a new one below runs/)", "DIR")
as_json = flag("--json", "print the result as JSON; any progress goes to stderr", "as_json")
seed = count("--seed", 3, "random seed", lowest=0)
robot = option("--robot", "profile by name, or path of a TOML file", "NAME", default="phantomx_mk2")
jobs = option("--jobs", "parallel processes", "N", type=whole(1, 256), default=1)
connect = option("--connect", f"router of the robot (default: {ROUTER})", "ENDPOINT", multiple=True)
namespace = option("--namespace", "prefix of every key", "NAME", default="sextant")
keys = option("--keys", "this machine's folder of `sextant keys new`, required for tls endpoints", "DIR", into="key_folder")


@dataclass(frozen=True, slots=True)
class Connection:
    """Endpoints and namespace of a robot, and this machine's keys."""

    connect: tuple[str, ...]
    namespace: str
    key_folder: str | None

    def endpoints(self) -> "Endpoints":
        """Return the robot's endpoints, with the keys.

        Raises:
            AccessError: The keys are wrong.
            InputError: An endpoint needs keys, and there are none.
        """
        from sextant.shared.wire.access import Keys
        from sextant.shared.wire.transport import Endpoints

        held = Keys.load(Path(self.key_folder)) if self.key_folder else None
        try:
            return Endpoints(self.connect or (ROUTER,), namespace=self.namespace, keys=held)
        except ValueError as error:
            raise InputError(str(error)) from None


connection = options_of(Connection, "connection", connect, namespace, keys)


params = option(
    "--set",
    "parameter of a service, e.g. planner.costmap.max_step_m=0.07, see docs/parameters.md; repeatable",
    "SERVICE.KEY=VALUE",
    into="params",
    multiple=True,
)


@dataclass(frozen=True, slots=True)
class Variant:
    """Robot, walk, radio and parameters in place of those of a scenario, where they are given."""

    robot: str = ""
    scaled: bool = False
    gait: "GaitRequest | None" = None
    speed: float | Literal["auto"] | None = None
    height: float | None = None
    link: str = ""
    params: tuple[str, ...] = ()
    planner: str = ""
    foothold: str = ""
    registration: str = ""

    def load(self, scenario: str) -> "Scenario":
        """Return a scenario, by name or TOML file, with these changes."""
        from sextant.shared.scenario.loading import load_scenario

        return self.applied()(load_scenario(scenario))

    def source(self, scenario: str, robot: str) -> str:
        """Return the scenario by name or absolute path, with its scale for a robot, so that other processes can load it."""
        from sextant.shared.scenario.loading import absolute

        path = absolute(scenario)
        if not self.scaled:
            return path
        from sextant.shared.scenario.scale import suffix_of

        return f"{path}{suffix_of(_leg_scale(robot))}"

    def applied(self) -> Callable[["Scenario"], "Scenario"]:
        """Return a function that applies these changes to a scenario.

        Raises:
            InputError: One of them is invalid.
        """
        from sextant.evaluation.params import assigned
        from sextant.services.planner.locomotion.gait import gait_of

        profile, radio, plugins = checked_robot(self.robot), _radio(self.link), self._plugins()

        def apply(scenario: "Scenario") -> "Scenario":
            if profile:
                scenario = replace(scenario, robot=profile)
            if self.scaled:
                scenario = scenario.scaled(_leg_scale(scenario.robot))
            if radio.exists:
                scenario = replace(scenario, link=radio)
            scenario = replace(assigned(scenario, self.params), plugins=plugins)
            walk, slower = scenario.walk, 1.0
            if self.gait:
                slower = gait_of(self.gait).slowness / gait_of(walk.gait).slowness
                walk = replace(walk, gait=self.gait)
            if self.speed == "auto":
                walk = replace(walk, auto_speed=True)
            elif self.speed is not None:
                slower *= walk.speed / self.speed
                walk = replace(walk, speed=self.speed, auto_speed=False)
            if self.height is not None:
                walk = replace(walk, body_height=self.height)
            return replace(scenario, walk=walk, time_limit_s=scenario.time_limit_s * max(slower, 1.0))

        return apply

    def _plugins(self) -> "Plugins":
        from sextant.shared.plugins.loading import KINDS, Plugins

        for kind in KINDS:
            check_plugin(kind, getattr(self, kind))
        return Plugins(self.planner, self.foothold, self.registration)


_PLUGINS: "Mapping[Kind, str]" = {
    "planner": "that plans steps",
    "foothold": "that scores footholds",
    "registration": "that estimates the camera pose",
}


def plugin(kind: "Kind") -> Callable[[_Function], _Function]:
    """Return the option of a kind of plug-in."""
    about = f"plug-in {_PLUGINS[kind]}, as package.module:Object or an entry point's name"
    return option(f"--{kind}", about, "PLUGIN", default="")


def check_plugin(kind: "Kind", name: str) -> None:
    """Load a plug-in, if one is named, to see that it can be.

    Raises:
        PluginError: It cannot be loaded.
    """
    from sextant.shared.plugins.loading import load

    if name:
        load(kind, name)


variant = options_of(
    Variant,
    "variant",
    option("--robot", "robot profile by name, or path of a TOML file (default: the scenario's)", "NAME", default=""),
    flag("--scaled", "scale the course to the robot's legs"),
    option("--gait", "gait, or auto: the planner chooses (default: the scenario's)", type=GAIT),
    option("--speed", "speed in m/s, or auto: the planner chooses (default: the scenario's)", "SPEED", type=walk_speed),
    option(
        "--height",
        "height of the body over the ground in m (default: the scenario's)",
        "M",
        type=number(0.001, 10.0, "a height"),
    ),
    option(
        "--link",
        "radio simulated in lockstep: one-way delay, total Mbit/s both ways, share of lost packets, e.g. 20,20,0.05",
        "MS,MBIT,LOSS",
        default="",
    ),
    params,
    plugin("planner"),
    plugin("foothold"),
    plugin("registration"),
)


def scenarios(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[str]:
    """Return the names of scenarios that a shell can complete a word to; points of families after a first letter."""
    from sextant.shared.scenario.loading import family_names, point_names, scenario_names

    family = incomplete.partition("@")[0]
    points = [point for name in family_names() if incomplete and name.startswith(family) for point in point_names(name)]
    return [name for name in (*scenario_names(), *points) if name.startswith(incomplete)]


def checked_robot(robot: str) -> str:
    """Return a robot as scenarios name it; empty for none.

    Raises:
        ConfigError: The profile is wrong.
    """
    from sextant.shared.robot.profiles import load_profile

    if not robot:
        return ""
    name = str(Path(robot).resolve()) if robot.endswith(".toml") else robot
    load_profile(name)
    return name


def _leg_scale(robot: str) -> float:
    from sextant.shared.robot.profiles import load_profile
    from sextant.shared.scenario.scale import leg_scale

    return leg_scale(load_profile(robot))


def _radio(text: str) -> "Link":
    from sextant.shared.scenario.scenario import Link

    if not text:
        return Link()
    try:
        delay_ms, mbit, loss = (float(word) for word in text.split(","))
    except ValueError:
        raise InputError(f"--link: MS,MBIT,LOSS expected, for example 20,20,0.05, found {text!r}") from None
    try:
        return Link(delay_ms, mbit, loss)
    except ValueError as error:
        raise InputError(f"--link: {error}") from None


def own_file(robot: str, out: str | None) -> "tuple[Path, str, RobotProfile]":
    """Return the robot's own TOML, the profile it extends, and the current robot.

    The base profile is needed where the TOML does not exist yet.
    """
    from sextant.shared.robot.profiles import load_profile

    path = Path(out or (robot if robot.endswith(".toml") else f"my_{robot}.toml"))
    if path.suffix != ".toml":  # `--robot` accepts only .toml files as profiles
        raise InputError(f"--out: a file that ends in .toml expected, found {path}")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"--out: an existing, writable folder expected, found {path.parent.resolve()}")
    base, profile = robot, load_profile(robot)
    if robot.endswith(".toml"):
        base = os.path.relpath(Path(robot).resolve(), path.resolve().parent)
    if not path.exists():
        return path, base, profile
    own = load_profile(str(path))
    if own.name != profile.name:
        raise InputError(f"{path} is a {own.name}, {profile.name} expected; name it with --robot, or another file with --out")
    return path, base, own
