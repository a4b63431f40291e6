"""`sextant servos`: scan, configure, calibrate and test servos, real or emulated."""

import argparse
import errno
import json
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from datetime import date
from itertools import groupby
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from sextant.deploy.commands.common import FAILED, INTERRUPTED, SUCCESS, InputError, complain, say
from sextant.deploy.terminal.interrupts import Interrupts

if TYPE_CHECKING:
    from sextant.services.actuator.commissioning.set_ids import Found, Line
    from sextant.services.actuator.servo_bus.dynamixel_bus import ServoBus
    from sextant.services.actuator.servo_bus.mcu_bridge import Bridge
    from sextant.shared.robot.profile import RobotProfile

PATIENCE_NS = 25_000_000  # [ns] to wait for an answer; longer than an adapter's default latency timer
_NETWORK_PATIENCE_NS = 50_000_000  # [ns] longer, because a machine that emulates servos may be busy
_NOBODY_SAYS = "torque off is not confirmed: if the legs do not give way, switch the servos' power off"
_LAST_PORT = 65535


class Terminal:
    """The operator at the terminal; with `yes` every question has its default answer."""

    def __init__(self, yes: bool = False) -> None:
        """Initialise without a question."""
        self._yes = yes

    @property
    def absent(self) -> bool:
        """Whether no operator is present."""
        return self._yes

    def say(self, text: str) -> None:
        """Print a line."""
        say(text)

    def ask(self, question: str) -> str:
        """Ask a question and return the typed answer; empty with `yes`."""
        sys.stdout.write(question)
        if self._yes:
            say("")
            return ""
        sys.stdout.flush()
        line = sys.stdin.readline()
        if not line:
            raise InputError("an answer expected, found the end of the input; in a script, give --yes to calibrate and test")
        return line.strip()

    def agree(self, question: str) -> bool:
        """Ask a question; return whether y or yes was typed, True with `yes`."""
        if self._yes:
            say(f"{question} yes (--yes)")
            return True
        return self.ask(f"{question} [y/N] ").lower() in ("y", "yes")


def scan(arguments: argparse.Namespace) -> int:
    """`sextant servos scan`: list the servos on the bus and their problems."""
    from sextant.services.actuator.commissioning import set_ids

    profile = _profile(arguments.robot)
    with _line(arguments, profile) as line:
        rates = " and ".join(map(str, line.rates))
        tell = complain if arguments.json else say
        tell(f"scanning {len(arguments.ids)} ids at {rates} baud; unused ids take longer")
        found = set_ids.scan(line, arguments.ids)
    wrong = set_ids.verdict(found, profile, arguments.ids, each=arguments.json)
    if arguments.json:
        problems = [problem._asdict() for problem in wrong]
        say(json.dumps({"servos": [_row(one, profile) for one in found], "problems": problems}, indent=1))
        return FAILED if wrong else SUCCESS
    if found:
        say(set_ids.in_words(found, profile))
    if holding := set_ids.holding(found, profile):
        say(f"{holding}; `sextant servos off` turns torque off")
    for advice, alike in groupby(wrong, key=lambda problem: problem.advice):
        for problem in alike:
            say(problem.words)
        say(f"  -> {advice}")
    if not wrong:
        count, asked = len(profile.servo_names), sum(i in arguments.ids for i in profile.servo_names)
        which = f"all {count} servos of {profile.name}"
        say(f"{which} are in order" if asked == count else f"{asked} of {which} were scanned and are in order")
    return FAILED if wrong else SUCCESS


def off(arguments: argparse.Namespace) -> int:
    """`sextant servos off`: turn torque off without an actuator or router.

    The latch is set first: a running actuator on this port turns torque off, and so does one that starts later.
    """
    from sextant.services.actuator.commissioning.torque_off import torque_off
    from sextant.services.actuator.servo_bus.dynamixel_bus import BusDisconnectedError, BusSetupError

    profile = _profile(arguments.robot)
    unlatched = _latch_off(arguments.port)
    with _ended_once():
        try:
            bus = _bridge(arguments, profile) if arguments.bridge else _bus(arguments, profile)
        except BusDisconnectedError as error:
            used = getattr(error.__cause__, "errno", None) in (errno.EAGAIN, errno.EBUSY)
            lets_go = "torque is latched off: an actuator on this port turns it off at once, or as soon as its servos respond"
            say(unlatched or lets_go)
            complain(_NOBODY_SAYS)
            if not used:
                raise
            complain(f"sextant servos off: {arguments.port} is in use")
            return FAILED
        with closing(bus):
            try:
                left = torque_off(bus)
            except BusSetupError as error:
                complain(f"{_NOBODY_SAYS}\nsextant servos off: {error}")
                return FAILED
    _say_who_holds(left, profile, arguments.bridge)
    if unlatched:
        complain(f"{unlatched}; an actuator that starts now leaves torque on at servos that have not received torque off")
    return FAILED if left or unlatched else SUCCESS


def _say_who_holds(left: dict[int, str], profile: "RobotProfile", bridged: bool) -> None:
    """Report the servos that did not confirm torque off, and how many did."""
    from sextant.services.actuator.commissioning.bus_scan import named

    count, off = len(profile.servo_names), len(profile.servo_names) - len(left)
    alike = set(left.values())
    if off == 0 and len(alike) == 1:
        bridge = "" if bridged else "if a microcontroller drives them, add --bridge; otherwise "
        say(f"each of {count} servos {alike.pop()}\n  -> {bridge}switch their power off")
    else:
        for servo_id, words in left.items():
            say(f"{named(servo_id, profile.servo_names)} {words}\n  -> check its cable, or switch the servos' power off")
    say(f"{off} of {count} servos confirm torque off" if left else f"torque is off: confirmed by {off} of {count} servos")


def _latch_off(port: str) -> str:
    """Set the torque-off latch of a port; return the error as text, or nothing."""
    from sextant.services.actuator.safety.torque_off_latch import Latch
    from sextant.shared.runtime.clock import now_ns

    try:
        Latch.of_port(port).close(now_ns())
    except OSError as error:
        return f"torque is not latched off: {error}"
    return ""


def set_id(arguments: argparse.Namespace) -> int:
    """`sextant servos set-id`: give each servo the id of its joint."""
    from sextant.services.actuator.commissioning import set_ids

    profile = _profile(arguments.robot)
    with _line(arguments, profile) as line:
        return SUCCESS if set_ids.set_ids(line, profile, Terminal()) else FAILED


def calibrate(arguments: argparse.Namespace) -> int:
    """`sextant servos calibrate`: measure the horn offsets into the robot's TOML."""
    from sextant.services.actuator.commissioning import calibration, calibration_file
    from sextant.shared.robot.profile import LEGS

    path, base, profile = _own_file(arguments.robot, arguments.out)
    known = [entry.leg for entry in profile.calibration]
    legs = arguments.leg or [leg for leg in LEGS if leg not in known] or list(LEGS)
    pose = tuple(arguments.pose or calibration.STRAIGHT_OUT)
    try:
        for leg in legs:
            calibration.see_pose(profile, leg, pose)
    except ValueError as error:
        raise InputError(f"--pose: {error}") from None
    say(f"calibrating {', '.join(legs)} into {path}" + (f"; already calibrated: {', '.join(known)}" if known else ""))
    with _line(arguments, profile) as line:
        done = calibration.calibrate(
            line.at(line.rates[0]),
            profile,
            Terminal(arguments.yes),
            lambda entry: say(f"{entry.leg}: written to {calibration_file.keep(path, entry, base) and path}"),
            date.today(),
            legs=legs,
            pose_deg=pose,
        )
    return SUCCESS if done else FAILED


def test(arguments: argparse.Namespace) -> int:
    """`sextant servos test`: move each joint a little, one at a time."""
    from sextant.services.actuator.commissioning.joint_test import run_joint_test
    from sextant.shared.robot.profile import LEGS

    profile = _profile(arguments.robot)
    chosen = {"on": True, "off": False, "": False if arguments.yes else None}[arguments.torque]
    operator, legs = Terminal(arguments.yes), arguments.leg or LEGS
    with _line(arguments, profile) as line:
        moved = run_joint_test(line.at(line.rates[0]), profile, operator, time.monotonic_ns, legs=legs, hold_after=chosen)
    if moved is None:
        return FAILED
    wrong = [one.name for one in moved if one.problem]
    say(f"{len(moved) - len(wrong)} of {len(moved)} joints are in order" + (f"; not: {', '.join(wrong)}" if wrong else ""))
    return FAILED if wrong else SUCCESS


def emulate(arguments: argparse.Namespace) -> int:
    """`sextant servos emulate`: serve emulated servos on a TCP port until Ctrl-C."""
    import numpy as np

    try:
        from sextant.services.simulator.servo_bus.bench_emulator import HELP, BenchEmulator
        from sextant.services.simulator.servo_bus.tcp_port import TcpBusServer
    except ImportError as error:
        raise InputError(f"{error}; emulated servos need it: pip install -e '.[simulator]'") from None
    if arguments.listen > _LAST_PORT:
        raise InputError(f"a port up to {_LAST_PORT} expected, found {arguments.listen}; give another with --listen")
    bench = BenchEmulator(_profile(arguments.robot), np.random.default_rng(arguments.seed), fresh=arguments.fresh)
    try:
        server = TcpBusServer(bench, port=arguments.listen, turns_away=True)
    except OSError as error:
        raise InputError(f"cannot listen on port {arguments.listen}: {error}; give another with --listen") from None
    with server:
        say(f"servos on {server.url}; in another terminal: sextant servos scan --port {server.url}")
        say(f"{bench.obey('list')}; type {HELP}")
        for line in sys.stdin:
            if line.strip() in ("quit", "q"):
                return SUCCESS
            try:
                with server.lock:
                    told = bench.obey(line)
            except ValueError as error:
                complain(str(error))
            else:
                say(told)
        threading.Event().wait()  # stdin has ended: wait for Ctrl-C
    return INTERRUPTED


class _Once(Interrupts):
    """Raise only the first Ctrl-C, SIGTERM or SIGHUP while entered.

    Later signals are ignored, because the command is cleaning up.
    """

    def _count(self, number: int, frame: FrameType | None) -> None:
        super()._count(number, frame)
        if not self.insisted():
            raise KeyboardInterrupt


def _ended_once() -> AbstractContextManager[object]:
    """Return a context in which the first signal ends a command like Ctrl-C.

    Outside the main thread it does nothing, because only that thread receives signals.
    """
    return _Once() if threading.current_thread() is threading.main_thread() else nullcontext()


@contextmanager
def _line(arguments: argparse.Namespace, profile: "RobotProfile") -> "Iterator[Line]":
    """Open the servo port; close it at the end, also after a signal."""
    from sextant.services.actuator.commissioning.set_ids import USUAL_RATES, Line
    from sextant.services.actuator.servo_bus.dynamixel_bus import BAUD_RATE

    rates = (BAUD_RATE,) if "://" in arguments.port else USUAL_RATES
    with _ended_once(), closing(Line(lambda rate: _bus(arguments, profile, rate), rates)) as line:
        yield line


def _bus(arguments: argparse.Namespace, profile: "RobotProfile", rate: int | None = None) -> "ServoBus":
    """Open the servos at the port, at a baud rate [1/s]; None is the robot's own.

    Raises:
        BusDisconnectedError: The port cannot be opened.
    """
    from sextant.services.actuator.servo_bus.dynamixel_bus import BAUD_RATE, ServoBus, open_port
    from sextant.shared.servo import dynamixel as dxl

    patience, names = _NETWORK_PATIENCE_NS if "://" in arguments.port else PATIENCE_NS, profile.servo_names
    return ServoBus(
        open_port(arguments.port, rate or BAUD_RATE, patience),
        list(names),
        time.monotonic_ns,
        model=dxl.MODEL_NAMED[profile.servo.model],
        names=names,
        echo=arguments.echo,
        reply_timeout_ns=patience,
    )


def _bridge(arguments: argparse.Namespace, profile: "RobotProfile") -> "Bridge":
    """Open the servos behind a microcontroller at the port.

    Raises:
        BusDisconnectedError: The port cannot be opened.
    """
    from sextant.services.actuator.servo_bus.dynamixel_bus import open_port
    from sextant.services.actuator.servo_bus.mcu_bridge import READ_NS, Bridge

    port = open_port(arguments.port, timeout_ns=READ_NS)
    return Bridge(port, list(profile.servo_names), time.monotonic_ns, names=profile.servo_names)


def _profile(robot: str) -> "RobotProfile":
    from sextant.shared.robot.profiles import load_profile

    return load_profile(robot)


def _own_file(robot: str, out: str | None) -> "tuple[Path, str, RobotProfile]":
    """Return the robot's own TOML, the profile it extends, and the current robot.

    The base profile is needed where the TOML does not exist yet.
    """
    path = Path(out or (robot if robot.endswith(".toml") else f"my_{robot}.toml"))
    if path.suffix != ".toml":  # `--robot` accepts only .toml files as profiles
        raise InputError(f"--out: a file that ends in .toml expected, found {path}")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"--out: an existing, writable folder expected, found {path.parent.resolve()}")
    base, profile = robot, _profile(robot)
    if robot.endswith(".toml"):
        base = os.path.relpath(Path(robot).resolve(), path.resolve().parent)
    if not path.exists():
        return path, base, profile
    own = _profile(str(path))
    if own.name != profile.name:
        raise InputError(f"{path} is a {own.name}, {profile.name} expected; name it with --robot, or another file with --out")
    return path, base, own


def _row(one: "Found", profile: "RobotProfile") -> dict[str, object]:
    from sextant.services.actuator.commissioning.bus_scan import BusResponse
    from sextant.shared.servo import dynamixel as dxl

    seen = one.seen
    row: dict[str, object] = {"id": seen.servo_id, "baud": one.rate, "joint": profile.servo_names.get(seen.servo_id, "")}
    if seen.response is not BusResponse.CLEAR:
        return row | {"problem": seen.response.value}
    measured = {"voltage": round(seen.voltage, 1), "temperature": seen.temperature}
    return row | {"model": seen.model, "firmware": seen[dxl.FIRMWARE], **measured}
