"""Id assignment: each servo gets the id of its joint, one at a time.

Terminal and port are interfaces: an `Operator` answers questions, and a `Line` opens the port. Nothing is moved, and no torque
is turned on.
"""

from collections.abc import Callable, Collection, Sequence

from sextant.services.actuator.commissioning.bus_survey import Found, Line, all_ids, position_limits, scan
from sextant.services.actuator.commissioning.operator_dialogue import Operator
from sextant.services.actuator.servo_bus.bus_scan import (
    FACTORY_ID,
    OTHER_ROBOT,
    BusResponse,
    Problem,
    ensure,
    named,
    scan_servo,
    wake,
    wrong_settings,
)
from sextant.services.actuator.servo_bus.triage import all_rates
from sextant.shared.errors import SextantError
from sextant.shared.robot.profile import RobotProfile

_LEAVE = "q"


class OtherServosError(SextantError):
    """The servos on the bus are not those of the robot."""

    exit_status = 1


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
        model = profile.servo_model
        rates = "; --all-rates asks at all rates" if len(line.rates) > 1 and set(all_rates(model)) - set(line.rates) else ""
        operator.say(f"no new servo answers; check its cable and power (its LED blinks once at power-on){rates}")
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
    safe = [(setting.register, setting.value) for setting in wrong_settings(seen, wanted, position_limits(profile)[target])]
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
