"""Bus scan and id assignment: each servo gets the id of its joint, one at a time.

Terminal and port are interfaces: an `Operator` answers questions, and a `Line` opens the port. Nothing is moved, and no torque
is turned on.
"""

from collections.abc import Callable, Collection, Iterable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from sextant.services.actuator.servo_bus.bus_driver import BAUD_RATE, ServoBus
from sextant.services.actuator.servo_bus.bus_scan import (
    FACTORY_ID,
    OTHER_ROBOT,
    SET_ID,
    BusResponse,
    Problem,
    ServoScan,
    ensure,
    grouped,
    is_unassigned,
    named,
    on_wrong_bus,
    problems,
    reset_servos,
    scan_servo,
    wake,
    wrong_settings,
)
from sextant.services.actuator.servo_bus.servo_health import health_problems
from sextant.shared.errors import SextantError
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo.servo_model import ServoModel

_LEAVE = "q"
_NO_ANSWER_ADVICE = "check their power and the cable at the adapter; a bridge does not pass scans on, see docs/bridge.md"
_UNLESS_MEANT = f"if this is not intended, {SET_ID} and type its leg and joint to restore safe values"


class OtherServosError(SextantError):
    """The servos on the bus are not those of the robot."""

    exit_status = 1


class Operator(Protocol):
    """Person who builds the robot."""

    @property
    def absent(self) -> bool:
        """Whether no person is present: every question gets its default answer.

        Repeating a question changes nothing.
        """
        ...

    def say(self, text: str) -> None:
        """Show a message."""

    def ask(self, question: str) -> str:
        """Return the typed answer, empty for plain Enter."""

    def agree(self, question: str) -> bool:
        """Return whether the answer is yes."""


class Line:
    """Servo port that can be opened at several baud rates."""

    def __init__(self, open_bus: Callable[[int], ServoBus], rates: Sequence[int] = (BAUD_RATE,)) -> None:
        """Store the opener; nothing is opened yet.

        Args:
            open_bus: Opens the port at a rate [1/s].
            rates: Rates to try, the robot's own first, see `triage.usual_rates`. A network port has no rates, so give only one.
        """
        self.rates = tuple(rates)
        self._open_bus = open_bus
        self._rate = 0
        self._bus: ServoBus | None = None

    def at(self, rate: int) -> ServoBus:
        """Return the bus at a rate [1/s]."""
        if self._bus is None or rate != self._rate:
            self.close()
            self._rate, self._bus = rate, self._open_bus(rate)
        return self._bus

    def close(self) -> None:
        """Close the port."""
        if self._bus is not None:
            self._bus.close()
            self._bus = None


def all_ids(model: ServoModel) -> range:
    """Return the ids that servos of a model can have."""
    return range(model.protocol.MAX_ID + 1)


class Found(NamedTuple):
    """Servo, and its baud rate [1/s]."""

    rate: int
    seen: ServoScan


# ---------------------------------------------------------------------------------------------------------------- scan


def scan(line: Line, ids: Iterable[int] | None = None, known: Collection[int] | None = None) -> list[Found]:
    """Return all servos that answer at one of the ids and rates.

    An unused id costs a timeout per rate.

    Args:
        line: The port.
        ids: Ids to scan, all of the protocol by default.
        known: Ids to try three times before they count as silent; None means all of the robot's.
    """
    found, asked = [], list(ids or ())
    for rate in line.rates:
        bus = line.at(rate)
        asked = list(all_ids(bus.model)) if ids is None else asked
        for i in asked:
            heard = bus.ping_responses(i)
            if not heard.silent or i in (bus.names if known is None else known):
                seen = scan_servo(bus, i, listen=heard != (1, b""))
                found += [] if seen is None else [Found(rate, seen)]
    return found


def in_words(found: Sequence[Found], profile: RobotProfile) -> str:
    """Return a table of the servos, one per line; "?" follows the joint of a servo with factory settings."""
    answering = {seen.servo_id: seen for _, seen in found}
    unassigned = is_unassigned(answering, profile.servo_names)
    lines = [f"{'id':>3}  {'baud':>7}  {'model':<10} {'firmware':>8}  {'voltage':>7}  {'temperature':>11}  joint"]
    for rate, seen in found:
        name = profile.servo_names.get(seen.servo_id, "")
        if seen.servo_id == FACTORY_ID and unassigned:
            name = f"{name}?"
        if seen.response is not BusResponse.CLEAR:
            lines.append(f"{seen.servo_id:>3}  {rate:>7}  {seen.response.value}")
            continue
        if not seen.is_alike:
            lines.append(f"{seen.servo_id:>3}  {rate:>7}  {seen.model}")
            continue
        firmware = "-" if seen.firmware is None else f"{seen.firmware}"
        measured = f"{seen.voltage:>5.1f} V  {seen.temperature:>5.0f} deg C"
        lines.append(f"{seen.servo_id:>3}  {rate:>7}  {seen.model:<10} {firmware:>8}  {measured}  {name}".rstrip())
    return "\n".join(lines)


def holding(found: Sequence[Found], profile: RobotProfile) -> str:
    """Return which servos have torque on, or an empty string."""
    pulling = [
        one.seen.servo_id
        for one in found
        if one.seen.response is BusResponse.CLEAR and one.seen[(one.seen.identified or one.seen.expected).table.torque_enable]
    ]
    if not pulling:
        return ""
    others = f", and of {len(pulling) - 1} more" if len(pulling) > 1 else ""
    return f"torque is on, of {named(pulling[0], profile.servo_names)}{others}"


def verdict(
    found: Sequence[Found], profile: RobotProfile, asked: Collection[int] | None = None, *, each: bool = True
) -> list[Problem]:
    """Return problems that keep these from being the robot's servos, with remedies.

    Args:
        found: Servos that answered.
        profile: The robot.
        asked: Scanned ids, all by default: only these can be missing.
        each: Name each missing servo even if all are missing; otherwise that is one problem.
    """
    names = {i: name for i, name in profile.servo_names.items() if asked is None or i in asked}
    heard = {seen.servo_id: seen for rate, seen in found if rate == seen.expected.bus_rate}
    wrong = problems(names, heard)
    for i in profile.servos_elsewhere.keys() & heard.keys():
        wrong[i] = on_wrong_bus(i, profile.servos_elsewhere)
    missing, unanswered = [i for i in names if i not in heard], []
    if not each and len(missing) == len(names) > 1:
        missing, unanswered = [], [Problem(f"none of {len(names)} servos answers", _NO_ANSWER_ADVICE)]
        wrong = {i: problem for i, problem in wrong.items() if i not in names}
    for rate, seen in found:
        usual = seen.expected.bus_rate
        if rate != usual:
            reset = f"; {reset_servos(missing, names)}" if seen.servo_id == FACTORY_ID and missing else ""
            words = f"servo {seen.servo_id} answers at {rate} baud, {usual} expected{reset}"
            wrong[-seen.servo_id - 1] = Problem(words, "`sextant servos set-id` sets its rate")
    well = {i: seen for i, seen in heard.items() if seen.response is BusResponse.CLEAR and i not in wrong}
    return [
        *unanswered,
        *dict.fromkeys(wrong.values()),
        *health_problems(well, profile.battery.warn_voltage, names),
        *hampered((seen for i, seen in heard.items() if i in names), profile),
    ]


def hampered(seen: Iterable[ServoScan], profile: RobotProfile) -> list[Problem]:
    """Return servos with unusual limits or protections.

    This is advice: the actuator works with them.
    """
    found: dict[int, Problem] = {}
    reach, servos = _reach(profile), dict(zip(profile.servo_ids.ravel().tolist(), profile.servos.each, strict=True))
    for one in seen:
        model = one.expected
        if one.response is BusResponse.CLEAR and one.number == model.number and not one.is_wheel:
            told = [setting.words for setting in wrong_settings(one, model, reach[one.servo_id])]
            told += [
                f"has a {register.name} of {one[register]}, {value} in the profile"
                for register, value in servos[one.servo_id].controller_settings.items()
                if one[register] != value
            ]
            words = "; ".join(dict.fromkeys(told))
            found |= {one.servo_id: Problem(words, _UNLESS_MEANT)} if words else {}
    return list(dict.fromkeys(grouped(found, profile.servo_names).values()))


def _reach(profile: RobotProfile) -> dict[int, tuple[int, int]]:
    """Return lowest and highest position register for each servo's joint, by id."""
    ends = np.sort([profile.servo_angles(profile.joint_limits[..., end]) for end in (0, 1)], axis=0)
    found = {}
    for i, model, low, high in zip(
        profile.servo_ids.ravel().tolist(), profile.servos.models, *map(np.ravel, ends), strict=True
    ):
        most = model.units.max_position
        found[i] = (min(max(model.units.ticks(low), 0), most), min(max(model.units.ticks(high), 0), most))
    return found


# -------------------------------------------------------------------------------------------------------------- set-id


def set_ids(
    line: Line, profile: RobotProfile, operator: Operator, other_family: Callable[[], Problem | None] = lambda: None
) -> bool:
    """Give every servo the id of its joint; return whether all have one at the end.

    Servos are plugged in one after the other, each alone or behind finished ones. The operator can stop at any question and
    continue later: servos with their ids are found, and so are those that were interrupted during setup. The joint with the
    factory id, if there is one, comes last, because new servos have that id too.

    Args:
        line: The port.
        profile: The robot.
        operator: Plugs in the servos.
        other_family: Returns that a servo answers in another protocol, see `triage.other_family`; the line is closed meanwhile.

    Raises:
        OtherServosError: The first servo is not one of the robot's.
    """
    if echo := line.at(line.rates[0]).echo_problem():
        operator.say(": ".join(echo))
        return False
    done: set[int] = set()  # in this session, plugged in or not
    found = _likely(line, profile)
    if found and all(_is_foreign(one, profile) for one in found):
        target = next(i for i in (found[0].seen.servo_id, *profile.servo_names) if i in profile.servo_names)
        _is_model_of(found[0], target, profile, operator, is_first=True)
    found = _completed(line, found, profile, operator)
    while True:
        done |= {one.seen.servo_id for one in found if _is_set(one, profile)}
        missing = sorted((i for i in profile.servo_names if i not in done), key=lambda i: i == FACTORY_ID)
        if not missing:
            operator.say(f"all {len(done)} servos have their ids; `sextant servos scan` shows them")
            return True
        operator.say(f"{len(done)} of {len(profile.servo_names)} servos have their ids")
        words = _ask_joint(missing[0], profile, operator)
        if words == _LEAVE:
            operator.say("stopped; give the same command again for the remaining servos")
            return False
        target = _by_name(profile)[words] if words else missing[0]
        before = {one.seen.servo_id for one in found}
        found = _likely(line, profile, done | {target})
        if not found:
            line.close()
            if foreign := other_family():
                _refuse(*foreign, operator, is_first=not done)
                continue
        new = _new_one(line, before, found, profile, operator, named_by_hand=bool(words))
        if new is None or not _is_model_of(new, target, profile, operator, is_first=not done):
            continue
        if not _may_change(new, target, before, found, profile, operator):
            continue
        if given := _give(line, new, target, profile, operator):
            done = (done - {new.seen.servo_id}) | {target}
            found = [*(one for one in found if one is not new), given]


def _likely(line: Line, profile: RobotProfile, done: Collection[int] = ()) -> list[Found]:
    """Scan the ids of new servos and of the robot."""
    return scan(line, sorted({FACTORY_ID, *profile.servo_names}), known={FACTORY_ID, *done})


def _is_foreign(one: Found, profile: RobotProfile) -> bool:
    """Return whether a servo tells a model that is none of the robot's."""
    return one.seen.response is BusResponse.CLEAR and all(one.seen.number != i.number for i in profile.servo_models.values())


def _is_model_of(new: Found, target: int, profile: RobotProfile, operator: Operator, *, is_first: bool) -> bool:
    """Return whether a servo may be of the model of a joint; otherwise tell the operator, or raise OtherServosError."""
    seen, wanted = new.seen, profile.servo_models[target]
    if seen.response is not BusResponse.CLEAR or seen.number == wanted.number:
        return True
    words = f"servo {seen.servo_id} is {seen.model}, {wanted.name} expected for the {profile.servo_names[target]}"
    if not _is_foreign(new, profile):
        operator.say(f"{words}: it is unchanged; plug in another one, or type the leg and joint of this one")
    else:
        _refuse(words, OTHER_ROBOT, operator, is_first=is_first)
    return False


def _refuse(words: str, advice: str, operator: Operator, *, is_first: bool) -> None:
    """Tell the operator that a servo is not the robot's; raise OtherServosError if it is the first one."""
    if is_first:
        raise OtherServosError(f"{words}: it is unchanged\n  -> {advice}")
    operator.say(f"{words}: it is unchanged; plug in another one")


def _collide(found: Sequence[Found], operator: Operator) -> bool:
    """Return whether two servos have one id, and report it to the operator."""
    doubled = [one.seen.servo_id for one in found if one.seen.response is BusResponse.DOUBLED]
    for servo_id in doubled:
        operator.say(
            f"two or more servos have id {servo_id}: none of them can be set. Unplug all but one of them; plug the others in "
            f"later, one at a time, and the joint with id {FACTORY_ID} last."
        )
    return bool(doubled)


def _has_place(one: Found, profile: RobotProfile) -> bool:
    """Return whether a servo has the robot's type and the id of a joint."""
    seen = one.seen
    model = profile.servo_models.get(seen.servo_id)
    return model is not None and seen.response is BusResponse.CLEAR and seen.number == model.number


def _is_set(one: Found, profile: RobotProfile) -> bool:
    """Return whether a servo has all settings of a joint.

    A servo with only the id was interrupted or is foreign.
    """
    seen = one.seen
    model = seen.expected
    if one.rate != model.bus_rate or not _has_place(one, profile) or seen.is_wheel:
        return False
    wanted = {**model.joint_settings, model.table.baud_rate: model.rate_code(model.bus_rate)}
    return all(seen[register] == value for register, value in wanted.items())


def _completed(line: Line, found: list[Found], profile: RobotProfile, operator: Operator) -> list[Found]:
    """Complete servos that have only the id of a joint, if the operator agrees.

    Return all servos.
    """
    ids = [one.seen.servo_id for one in found]
    alone = [one for one in found if one.seen.servo_id != FACTORY_ID and ids.count(one.seen.servo_id) == 1]
    half = [one for one in alone if _has_place(one, profile) and not _is_set(one, profile)]
    if not half:
        return found
    who = ", ".join(named(one.seen.servo_id, profile.servo_names) for one in half)
    if not operator.agree(f"The id of {who} is set, but not all other registers. Set them now?"):
        return found
    given = {one.seen.servo_id: _give(line, one, one.seen.servo_id, profile, operator) for one in half}
    return [given.get(one.seen.servo_id) or one for one in found]


def _ask_joint(proposed: int, profile: RobotProfile, operator: Operator) -> str:
    """Ask for the joint of the next servo; an empty string means the proposed one."""
    known, name = _by_name(profile), profile.servo_names[proposed]
    while True:
        answer = operator.ask(
            f"Plug in the {profile.servo_models[proposed].name} of the {name} of {profile.name} (future id {proposed}), "
            f"and press Enter; "
            f"or type another leg and joint, or {_LEAVE} to stop: "
        )
        words = " ".join(answer.lower().split())
        if words in ("", _LEAVE) or words in known:
            return words
        operator.say(f"a leg and a joint, such as {name!r}, expected, found {words!r}; one of {', '.join(known)}")


def _by_name(profile: RobotProfile) -> dict[str, int]:
    return {name: servo_id for servo_id, name in profile.servo_names.items()}


def _new_one(
    line: Line,
    before: Collection[int],
    found: Sequence[Found],
    profile: RobotProfile,
    operator: Operator,
    *,
    named_by_hand: bool,
) -> Found | None:
    """Return the one new servo; None, with a message to the operator, otherwise.

    Args:
        line: The port for a further scan.
        before: Ids that answered after the question to plug it in.
        found: Servos that answer now, at the ids of new servos and of the robot.
        profile: The robot.
        operator: Receives the messages.
        named_by_hand: Whether the operator has typed a joint: then a servo alone on the bus is meant.
    """
    if _collide(found, operator):
        return None
    new = [one for one in found if not _is_set(one, profile)]
    appeared = [] if new else [one for one in found if one.seen.servo_id not in before]
    if len(appeared) > 1:
        who = ", ".join(named(one.seen.servo_id, profile.servo_names) for one in appeared)
        operator.say(f"{who} appeared, and all of them are set; plug in one servo at a time")
        return None
    new += appeared
    if not new and named_by_hand and len(found) == 1:
        return found[0]
    if not new:
        operator.say("searching all ids for the new servo ...")
        known = {FACTORY_ID, *profile.servo_names}
        new = scan(line, (i for i in all_ids(profile.servo_model) if i not in known))
    if len(new) == 1:
        return new[0]
    if new:
        ids = ", ".join(str(one.seen.servo_id) for one in new)
        operator.say(f"one new servo expected, found {len(new)} (ids {ids}); leave one of them plugged in")
    else:
        operator.say("no new servo answers; check its cable and power (its LED blinks once at power-on)")
    return None


def _may_change(
    new: Found, target: int, before: Collection[int], found: Sequence[Found], profile: RobotProfile, operator: Operator
) -> bool:
    """Return whether a servo may become that of a joint.

    The joint's own servo must not be plugged in. A servo with another joint's id needs the operator's consent.
    """
    old, names = new.seen.servo_id, profile.servo_names
    if any(one.seen.servo_id == target for one in found if one is not new):
        operator.say(f"{named(target, names)} is already plugged in: unplug it first, or type another joint")
        return False
    if old == target or old not in names or (old == FACTORY_ID and not _is_set(new, profile)):
        return True
    if old in before and _is_set(new, profile):
        question = f"{named(old, names)} is the only servo that answers, and is already set. Make it the {names[target]}?"
    else:
        question = f"servo {old} ({names[old]} by its id) appeared; make it the {names[target]}?"
    if operator.agree(question):
        return True
    operator.say("the servo is unchanged; plug in the new one")
    return False


def _give(line: Line, one: Found, target: int, profile: RobotProfile, operator: Operator) -> Found | None:
    """Set a servo up for a joint and verify it; report a failure and return None.

    After an interruption the servo is unchanged, or is found by its new id and completed: the setting that identifies a new
    servo is changed last.
    """
    bus, old = line.at(one.rate), one.seen.servo_id
    seen = (wake(bus, old) if one.seen.response is BusResponse.MUTE else None) or one.seen
    wanted = profile.servo_models[target]
    if seen.response is not BusResponse.CLEAR or seen.number != wanted.number:
        is_other = seen.response is BusResponse.CLEAR  # found by waking it
        what = f"is {seen.model}, {wanted.name} expected" if is_other else seen.response.value
        operator.say(f"servo {old} {what}: it is unchanged; {'plug in another one' if is_other else 'try again'}")
        return None
    table = wanted.table
    if table.lock and seen[table.lock] and not wanted.unlocks:
        operator.say(f"servo {old} is locked, as after use by the actuator: switch its power off and on, then try again")
        return None
    if table.lock and wanted.unlocks and not ensure(bus, old, table.lock, 0):
        operator.say(f"servo {old} does not unlock its EEPROM; switch its power off and on, then try again")
        return None
    safe = [(setting.register, setting.value) for setting in wrong_settings(seen, wanted, _reach(profile)[target])]
    refused = [register.name for register, value in safe if not ensure(bus, old, register, value)]
    if not refused:
        if old != target:
            bus.write_unacknowledged(old, table.id, target)  # the answer may have the old id or the new one
        refused = [
            register.name for register, value in wanted.joint_settings.items() if not ensure(bus, target, register, value)
        ]
    fast = wanted.rate_code(wanted.bus_rate)
    if not refused and seen[table.baud_rate] != fast:  # last, because it then no longer answers at this rate
        bus.write_unacknowledged(target, table.baud_rate, fast)
    if not refused and table.lock and wanted.unlocks and not ensure(line.at(wanted.bus_rate), target, table.lock, 1):
        refused.append(table.lock.name)  # last, because it ends the writing of all others
    back = scan_servo(line.at(wanted.bus_rate), target)
    given = None if back is None else Found(wanted.bus_rate, back)
    if refused or given is None or not _is_set(given, profile):
        what = f"it did not accept {', '.join(refused)}" if refused else "it does not answer at its new id"
        operator.say(f"setting {named(target, profile.servo_names)}: {what}; switch its power off and on, then try again")
        return None
    operator.say(f"{named(target, profile.servo_names)} is set and verified: {wanted.name}, {given.seen.voltage:.1f} V")
    return given
