"""`sextant servos`: scan, configure, calibrate and test servos, real or emulated."""

import json
import shlex
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from datetime import date
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING

from sextant.deploy.commands import options, pulse_servos, servos_off
from sextant.deploy.commands.common import FAILED, INTERRUPTED, SUCCESS, InputError, complain, say
from sextant.deploy.commands.operator_questions import Terminal
from sextant.deploy.commands.servo_port import (
    Bus,
    completing,
    ended_once,
    examine,
    of_each_bus,
    of_servo,
    open_all,
    open_ids,
    open_line,
    opener_of,
)
from sextant.deploy.terminal.arguments import Choice, Group, Parsed, argument, flag, number, option, options_of, whole

if TYPE_CHECKING:
    from sextant.services.actuator.commissioning.bus_survey import Found
    from sextant.services.actuator.commissioning.operator_dialogue import Operator
    from sextant.services.actuator.servo_bus.bus_driver import ServoBus
    from sextant.shared.robot.profile import Calibration, RobotProfile

_ONE_BUS = "--bus: none expected, because the robot has one bus"
_LEGS = ("left front", "right front", "right middle", "right rear", "left rear", "left middle")

servos = Group("servos", "Scan, centre, set ids, calibrate, test, emulate servos, or turn torque off.")


_port = option(
    "--port",
    "serial device, I2C bus, or socket://host:port (default: /dev/ttyUSB0, or that usual for the board)",
    "PORT",
    default="",
)
_echo = flag("--echo", "the adapter returns every sent byte, as some half-duplex adapters do")
_bus_options = options_of(Bus, "bus", options.robot, _port, _echo)
_leg = option("--leg", "only this leg, e.g. 'left front'; repeatable", "LEG", into="legs", multiple=True, type=Choice(_LEGS))
_all_rates = flag("--all-rates", "ask at all baud rates of these servos, not only at the robot's own and those of factories")
_yes = flag("--yes", "for scripts: ask no question, assume yes")


def _of_bus(command: Callable[..., int]) -> Callable[..., int]:
    """Add the options of a servo bus to a command, and complete the commands that its errors name."""
    return _bus_options(completing(command))


@dataclass(frozen=True, slots=True)
class _One:
    """One servo at a port, which tells its model unless a robot or a model is given."""

    servo_id: int
    robot: str | None
    servo: str | None
    port: str
    echo: bool
    yes: bool


_of_one = options_of(
    _One,
    "one",
    argument("servo_id", "id of the servo; channel of a hobby servo", "ID", type=whole(0, 253)),
    option("--robot", "profile by name, or path of a TOML file; hobby servos need one (default: none)", "NAME"),
    option("--servo", "model of the servo, by its name in docs/servos.md (default: as it tells)", "MODEL"),
    _port,
    _echo,
    _yes,
)


@servos.command("scan")
@_of_bus
@option("--ids", "servo ids to scan, B not included (default: all)", "A:B", type=Parsed(options.servo_ids, "ids"))
@_all_rates
@options.as_json
def scan(bus: Bus, ids: range | None, all_rates: bool, as_json: bool) -> int:
    """List the servos on the bus; report missing, duplicate, wrong or reset ones."""
    bus, profile = bus.of_robot()
    if profile.servo.pulses is not None:
        return pulse_servos.scan(bus, profile, as_json)
    seen = [_scan_bus(*one, ids, all_rates, as_json) for one in of_each_bus(bus, profile)]
    if as_json:
        found, wrong = ([row for one in seen for row in one[k]] for k in (0, 1))
        say(json.dumps({"servos": found, "problems": wrong}, indent=1))
    return FAILED if any(wrong for _, wrong in seen) else SUCCESS


def _scan_bus(
    name: str, bus: Bus, profile: "RobotProfile", ids: range | None, all_rates: bool, as_json: bool
) -> tuple[list[dict[str, object]], list[dict[str, str]]]:
    """Scan one bus and report its servos; return them and their problems for JSON."""
    from sextant.services.actuator.commissioning import bus_survey

    ids = bus_survey.all_ids(profile.servo_model) if ids is None else ids
    which_bus = {"bus": name} if name else {}
    with open_line(bus, profile, all_rates) as line:
        unanswered = examine(bus, profile, line.rates, ids)
        rates = " and ".join(map(str, line.rates))
        tell = complain if as_json else say
        if name:
            tell(f"bus {name}, {bus.port}:")
        if not unanswered:
            tell(f"scanning {len(ids)} ids at {rates} baud; unused ids take longer")
        found = [] if unanswered else bus_survey.scan(line, ids)
    wrong = [unanswered] if unanswered else bus_survey.verdict(found, profile, ids, each=as_json)
    named = replace(bus, port=f"{name}={bus.port}") if name else bus
    wrong = [problem._replace(advice=named.completed(problem.advice)) for problem in wrong]
    result = [which_bus | _row(one, profile) for one in found], [which_bus | problem._asdict() for problem in wrong]
    if as_json:
        return result
    if found:
        say(bus_survey.in_words(found, profile))
    if holding := bus_survey.holding(found, profile):
        say(named.completed(f"{holding}; `sextant servos off` turns torque off"))
    for advice, alike in groupby(wrong, key=lambda problem: problem.advice):
        for problem in alike:
            say(problem.words)
        say(f"  -> {advice}")
    if not wrong:
        count, asked = len(profile.servo_names), sum(i in ids for i in profile.servo_names)
        which = f"all {count} servos of {profile.name}" + (f" on bus {name}" if name else "")
        say(f"{which} are in order" if asked == count else f"{asked} of {which} were scanned and are in order")
    return result


@servos.command("find")
@_of_one
@completing
def find(one: _One) -> int:
    """Turn one servo to and fro by 8 deg, to see which one it is.

    It turns slowly and with low torque, and is without torque afterwards. No other servo moves.
    """
    from sextant.services.actuator.commissioning import single_servo

    return _turn(one, single_servo.wiggle, pulse_servos.find)


@servos.command("centre")
@_of_one
@completing
def centre(one: _One) -> int:
    """Turn one servo to its middle, and hold it there while its horn is screwed on.

    It turns slowly and with low torque. Enter or Ctrl-C turns its torque off. No other servo moves.
    """
    from sextant.services.actuator.commissioning import single_servo

    return _turn(one, single_servo.centre, pulse_servos.centre, for_horn=True)


def _turn(
    one: _One,
    of_bus: "Callable[[ServoBus, int, Operator, Callable[[], int]], bool]",
    of_board: "Callable[[str, RobotProfile, int, Operator], bool]",
    for_horn: bool = False,
) -> int:
    """Turn one servo on a bus, or one behind a board that sends pulses; with `for_horn` state the angles of the joints."""
    from sextant.services.actuator.commissioning.single_servo import identify
    from sextant.services.actuator.servo_bus.triage import Opener
    from sextant.shared.robot.horn_assembly import angles_at_centre
    from sextant.shared.robot.profiles import load_profile
    from sextant.shared.robot.servo_proposal import unknown_model
    from sextant.shared.servo.models import MODEL_NAMED

    if one.robot and one.servo:
        raise InputError("one of --robot and --servo expected, found both: the profile of a robot has the model of its servos")
    if one.servo and one.servo not in MODEL_NAMED:
        raise InputError(f"--servo: {unknown_model(one.servo)}; hobby servos need --robot, see docs/hobby_servos.md")
    profile = load_profile(one.robot) if one.robot else None
    bus = Bus(one.robot or "", one.port, one.echo).checked(profile)
    operator = Terminal(one.yes, bus.completed)
    is_hobby = profile is not None and profile.servo.pulses is not None
    if profile is not None and is_hobby and one.servo_id not in profile.servo_names:
        channels = f"{min(profile.servo_names)} to {max(profile.servo_names)}"
        raise InputError(f"a channel of {profile.name} expected, {channels}, found {one.servo_id}")
    if for_horn and profile:
        operator.say(f"screw the horn on with the joint at its angle: {angles_at_centre(profile)}")
    elif for_horn:
        operator.say("--robot states the angle of each joint at the servo's centre, at which its horn is screwed on")
    if profile is not None and is_hobby:
        with ended_once():
            return SUCCESS if of_board(bus.port, profile, one.servo_id, operator) else FAILED
    names = {one.servo_id: profile.servo_names.get(one.servo_id, "") if profile else ""}
    wanted = profile.servo_models.get(one.servo_id, profile.servo_model) if profile else MODEL_NAMED.get(one.servo or "")
    bus = of_servo(bus, profile, one.servo_id) if profile else bus
    with ended_once():
        opener = Opener(lambda rate, model: open_ids(bus, names, model, rate), bus.port, not bus.networked)
        found = identify(opener, one.servo_id, wanted)
        with closing(opener.open(found.rate, found.model)) as opened:
            return SUCCESS if of_bus(opened, one.servo_id, operator, time.monotonic_ns) else FAILED


@servos.command("off")
@_of_bus
@flag("--bridge", "a microcontroller on the port drives the servos, like the actuator's setting `bridge`, see docs/bridge.md")
def off(bus: Bus, bridge: bool) -> int:
    """Turn the torque of all servos off at the port, without a running actuator.

    The latch is set first: a running actuator on this port turns torque off, and so does one that starts later.
    """
    bus, profile = bus.of_robot(bridge=bridge)
    return servos_off.off(bus, profile, bridge)


@servos.command("set-id")
@_of_bus
@_all_rates
def set_id(bus: Bus, all_rates: bool) -> int:
    """Set each servo's id to that of its joint, one at a time.

    It can be interrupted and resumed.
    """
    from sextant.services.actuator.commissioning import set_ids
    from sextant.services.actuator.servo_bus import triage

    bus, profile = bus.of_robot()
    if profile.servo.pulses is not None:
        return pulse_servos.set_id()
    for name, one_bus, servos_on_it in of_each_bus(bus, profile):
        if name:
            say(f"bus {name}, {one_bus.port}:")
        with open_line(one_bus, servos_on_it, all_rates) as line:
            foreign = partial(
                triage.other_family, opener_of(one_bus, servos_on_it), servos_on_it.servo_model, servos_on_it.servo_names
            )
            if not set_ids.set_ids(line, servos_on_it, Terminal(completed=bus.completed), foreign):
                return FAILED
    return SUCCESS


@servos.command("calibrate")
@_of_bus
@_leg
@_yes
@option("--out", "TOML file to write (default: that of --robot, or my_NAME.toml for a profile)", "FILE")
@option(
    "--pose",
    "joint angles of a jig [deg] (default: 0 0 0, straight out)",
    "COXA FEMUR TIBIA",
    type=number(-180.0, 180.0, "degrees"),
    nargs=3,
)
def calibrate(bus: Bus, legs: tuple[str, ...], yes: bool, out: str | None, pose: tuple[float, float, float] | None) -> int:
    """Measure the horn offsets of each leg; write them to the robot's TOML file."""
    from sextant.services.actuator.commissioning import calibration
    from sextant.shared.robot import profile_file
    from sextant.shared.robot.profile import LEGS

    path, base, profile = options.own_file(bus.robot, out)
    bus, operator = bus.checked(profile), Terminal(yes, bus.completed)
    known = [entry.leg for entry in profile.calibration]
    chosen = legs or [leg for leg in LEGS if leg not in known] or list(LEGS)
    angles = pose or calibration.STRAIGHT_OUT
    try:
        for leg in chosen:
            calibration.see_pose(profile, leg, angles)
    except ValueError as error:
        raise InputError(f"--pose: {error}") from None
    again, others = "" if set(chosen) - set(known) else " again", [leg for leg in known if leg not in chosen]
    say(
        f"calibrating {', '.join(chosen)}{again} into {path}" + (f"; already calibrated: {', '.join(others)}" if others else "")
    )

    def keep(entry: "Calibration") -> None:
        say(f"{entry.leg}: written to {profile_file.change(path, base, legs=(entry,)) and path}")

    if profile.servo.pulses is not None:
        return pulse_servos.calibrate(bus.port, profile, operator, keep, tuple(chosen), angles)
    with ended_once(), closing(open_all(bus, profile)) as opened:
        done = calibration.calibrate(
            opened,
            profile,
            operator,
            keep,
            date.today(),
            legs=chosen,
            pose_deg=angles,
        )
    return SUCCESS if done else FAILED


@servos.command("test")
@_of_bus
@_leg
@_yes
@option("--torque", "torque state after the test (default: ask, or off with --yes)", type=Choice(("on", "off")))
def test(bus: Bus, legs: tuple[str, ...], yes: bool, torque: str | None) -> int:
    """Move each joint a few degrees and back, one at a time, with low torque.

    It asks which way each foot went: no servo measures a wrong sign or a wrong id.
    """
    from sextant.services.actuator.commissioning.joint_test import run_joint_test
    from sextant.services.actuator.commissioning.watched_motion import UNWATCHED
    from sextant.shared.robot.profile import LEGS

    bus, profile = bus.of_robot()
    operator = Terminal(yes, bus.completed)
    if profile.servo.pulses is not None:
        if torque == "on":
            raise InputError("--torque off expected: hobby servos jump when torque is turned on, so it is off after the test")
        return pulse_servos.test(bus.port, profile, operator, legs or LEGS)
    hold = torque == "on" if torque else (False if yes else None)
    with ended_once(), closing(open_all(bus, profile)) as opened:
        moved = run_joint_test(opened, profile, operator, time.monotonic_ns, legs=legs or LEGS, hold_after=hold)
    if moved is None:
        return FAILED
    wrong = [f"{one.name}: {one.problem}" for one in moved if one.problem]
    named = shlex.quote(bus.robot)
    command = f"camera calibrate --robot {named}"
    if profile.camera.device == "none":
        command = f"up onboard --robot {named} --set actuator.port={shlex.quote(bus.port)}"
    after = "" if legs else f"; next, on a flat floor: `sextant {command}`"
    after = f"; {UNWATCHED}" if yes else after
    after = "; not:\n  " + "\n  ".join(wrong) if wrong else after
    say(f"{len(moved) - len(wrong)} of {len(moved)} joints {'turn and return' if yes else 'are in order'}{after}")
    return FAILED if wrong else SUCCESS


@servos.command("emulate")
@options.robot
@flag("--fresh", "factory-new servos, all with id 1, to be plugged in at this terminal")
@options.count("--seed", 3, "random seed of the horn offsets", lowest=0)
@option("--listen", "TCP port on 127.0.0.1 (default: any free port)", "PORT", type=options.PORT, default=0)
@option("--bus", "name of the bus to emulate, of a robot with several", "NAME")
def emulate(robot: str, fresh: bool, seed: int, listen: int, bus: str | None) -> int:
    """Emulate the servos of a robot, or a set of new servos, on a network port."""
    import numpy as np

    from sextant.shared.robot.profiles import load_profile

    try:
        from sextant.services.simulator.servo_bus.bench_emulator import make_bench
        from sextant.services.simulator.servo_bus.tcp_port import TcpBusServer
    except ImportError as error:
        raise InputError(f"{error}; emulated servos need it: pip install -e '.[simulator]'") from None
    profile = load_profile(robot)
    names = [one.name for one in profile.servos.buses]
    if (bus or "") not in names:
        raise InputError(f"--bus: one of {', '.join(names)} expected, found {bus or 'none'}" if profile.buses else _ONE_BUS)
    if fresh and profile.servo.pulses is not None:
        raise InputError("--fresh: hobby servos have no ids and no settings; emulate them without it")
    bench = make_bench(profile, np.random.default_rng(seed), fresh=fresh, bus=names.index(bus or ""))
    try:
        server = TcpBusServer(bench, port=listen, rejects_others=True)
    except OSError as error:
        raise InputError(f"cannot listen on port {listen}: {error}; give another with --listen") from None
    with server:
        of_robot = "" if robot == "phantomx_mk2" else f" --robot {shlex.quote(robot)}"
        command = f"sextant servos {'set-id' if fresh else 'scan'} --port {f'{bus}=' if bus else ''}{server.url}{of_robot}"
        say(f"servos on {server.url}; in another terminal: {command}")
        say(f"{bench.execute('list')}; type {bench.commands}")
        for line in sys.stdin:
            if line.strip() in ("quit", "q"):
                return SUCCESS
            try:
                with server.lock:
                    told = bench.execute(line)
            except ValueError as error:
                complain(str(error))
            else:
                say(told)
        threading.Event().wait()  # stdin has ended: wait for Ctrl-C
    return INTERRUPTED


def _row(one: "Found", profile: "RobotProfile") -> dict[str, object]:
    from sextant.services.actuator.servo_bus.bus_scan import BusResponse

    seen = one.seen
    row: dict[str, object] = {"id": seen.servo_id, "baud": one.rate, "joint": profile.servo_names.get(seen.servo_id, "")}
    if seen.response is not BusResponse.CLEAR:
        return row | {"problem": seen.response.value}
    if not seen.is_alike:
        return row | {"model": seen.model}
    measured = {"voltage": round(seen.voltage, 1), "temperature": seen.temperature}
    return row | {"model": seen.model, "firmware": seen.firmware, **measured}
