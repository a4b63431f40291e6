"""From a box of servos to a robot's: who is on the bus, and each servo given the id of its joint, one at a time.

Terminal and port are somebody else's: an `Operator` is asked, a `Line` opened. Nothing is moved and no torque turned on.
"""

from collections.abc import Callable, Collection, Iterable, Sequence
from typing import NamedTuple, Protocol

from services.actuator.bus import BAUD_RATE, ServoBus
from services.actuator.roll_call import (
    ANSWER_ALL,
    FACTORY_ID,
    Problem,
    Seen,
    Voice,
    ailing,
    ensure,
    left_by_reset,
    look,
    named,
    problems,
    wake,
)
from shared import dynamixel as dxl
from shared.robot import RobotProfile

ALL_IDS = range(dxl.MAX_ID + 1)
USUAL_RATES = (BAUD_RATE, dxl.baud_rate(dxl.RX_64.default(dxl.BAUD_RATE)))
_LEAVE = "q"


class Operator(Protocol):
    """Who builds the robot."""

    @property
    def absent(self) -> bool:
        """Whether nobody is there: every question has its plain answer, and nothing changes by being asked again."""
        ...

    def say(self, text: str) -> None:
        """Tell something."""

    def ask(self, question: str) -> str:
        """An answer in words, empty for plain Enter."""

    def agree(self, question: str) -> bool:
        """Whether the answer is yes."""


class Line:
    """A servo port that is opened at one baud rate after another."""

    def __init__(self, open_bus: Callable[[int], ServoBus], rates: Sequence[int] = USUAL_RATES) -> None:
        """Nothing is opened yet.

        Args:
            open_bus: Opens the port at a rate [1/s].
            rates: What may be tried, the robot's own first; a network port knows no rates, so only one.
        """
        self.rates = tuple(rates)
        self._open_bus = open_bus
        self._rate = 0
        self._bus: ServoBus | None = None

    def at(self, rate: int) -> ServoBus:
        """The bus at a rate [1/s]."""
        if self._bus is None or rate != self._rate:
            self.close()
            self._rate, self._bus = rate, self._open_bus(rate)
        return self._bus

    def close(self) -> None:
        """Close the port."""
        if self._bus is not None:
            self._bus.close()
            self._bus = None


class Found(NamedTuple):
    """A servo, and at which baud rate [1/s] it talks."""

    rate: int
    seen: Seen


# ---------------------------------------------------------------------------------------------------------------- scan


def scan(line: Line, ids: Iterable[int] = ALL_IDS, known: Collection[int] | None = None) -> list[Found]:
    """Everybody who answers to one of the ids at one of the line's rates. An id that nobody has costs a timeout a rate.

    Args:
        line: Where to look.
        ids: Whom to ask.
        known: Whom to ask three times before they count as silent; None is all of the robot's.
    """
    asked = list(ids)
    found = []
    for rate in line.rates:
        bus = line.at(rate)
        for i in asked:
            heard = bus.chorus(i)
            if not heard.silent or i in (bus.names if known is None else known):
                seen = look(bus, i, listen=heard != (1, False))
                found += [] if seen is None else [Found(rate, seen)]
    return found


def in_words(found: Sequence[Found], profile: RobotProfile) -> str:
    """A table of the servos, one a line."""
    lines = [f"{'id':>3}  {'baud':>7}  {'model':<8} {'firmware':>8}  {'voltage':>7}  {'temperature':>11}  joint"]
    for rate, seen in found:
        name = profile.servo_names.get(seen.servo_id, "")
        if seen.voice is not Voice.CLEAR:
            lines.append(f"{seen.servo_id:>3}  {rate:>7}  {seen.voice.value}")
            continue
        measured = f"{seen.voltage:>5.1f} V  {seen.temperature:>5.0f} deg C"
        lines.append(f"{seen.servo_id:>3}  {rate:>7}  {seen.model:<8} {seen[dxl.FIRMWARE]:>8}  {measured}  {name}".rstrip())
    return "\n".join(lines)


def holding(found: Sequence[Found], profile: RobotProfile) -> str:
    """Whose torque is on, in words, or nothing."""
    pulling = [one.seen.servo_id for one in found if one.seen.voice is Voice.CLEAR and one.seen[dxl.TORQUE_ENABLE]]
    if not pulling:
        return ""
    others = f", and of {len(pulling) - 1} more" if len(pulling) > 1 else ""
    return f"torque is on, of {named(pulling[0], profile.servo_names)}{others}"


def verdict(found: Sequence[Found], profile: RobotProfile) -> list[Problem]:
    """What keeps these from being the robot's servos, and what to do."""
    names = profile.servo_names
    heard = {seen.servo_id: seen for rate, seen in found if rate == BAUD_RATE}
    wrong = problems(names, heard, dxl.MODEL_NAMED[profile.servo.model])
    missing = [i for i in names if i not in heard]
    for rate, seen in found:
        if rate != BAUD_RATE:
            reset = f"; {left_by_reset(missing, names)}" if seen.servo_id == FACTORY_ID and missing else ""
            words = f"servo {seen.servo_id} talks at {rate} baud, {BAUD_RATE} expected{reset}"
            wrong[-seen.servo_id - 1] = Problem(words, "`sextant servos set-id` sets its rate")
    for i, seen in heard.items():
        if seen.voice is Voice.CLEAR and i not in wrong and (words := ailing(seen)):
            wrong[i] = Problem(f"{named(i, names)} {words}", "see to it before anything moves")
    return list(wrong.values())


# -------------------------------------------------------------------------------------------------------------- set-id


def set_ids(line: Line, profile: RobotProfile, operator: Operator) -> bool:
    """Give every servo of a robot the id of its joint; whether all have one in the end.

    Servos are plugged in one after the other, each alone or behind those that are done. It can be left at any question, and
    gone on with: servos that have their ids are found. The joint with the factory's id, if there is one, comes last, since
    new servos have that id too.
    """
    done: set[int] = set()  # in this sitting, plugged in or not
    found = _likely(line, profile)
    while True:
        done |= {one.seen.servo_id for one in found if _is_set(one, profile)}
        missing = sorted((i for i in profile.servo_names if i not in done), key=lambda i: i == FACTORY_ID)
        if not missing:
            operator.say(f"all {len(done)} servos have their ids; `sextant servos scan` shows them")
            return True
        operator.say(f"{len(done)} of {len(profile.servo_names)} servos have their ids")
        words = _ask_joint(missing[0], profile, operator)
        if words == _LEAVE:
            operator.say("left; `sextant servos set-id` goes on with what is missing")
            return False
        target = _by_name(profile)[words] if words else missing[0]
        found = _likely(line, profile, done)
        new = _new_one(line, found, profile, operator, named_by_hand=bool(words))
        if new is None or not _may_change(new, target, done, profile, operator):
            continue
        if _give(line, new, target, profile, operator):
            done = (done - {new.seen.servo_id}) | {target}
            found = [one for one in found if one is not new]


def _likely(line: Line, profile: RobotProfile, done: Collection[int] = ()) -> list[Found]:
    """Who is at the ids that new servos and the robot's have."""
    return scan(line, sorted({FACTORY_ID, *profile.servo_names}), known={FACTORY_ID, *done})


def _collide(found: Sequence[Found], operator: Operator) -> bool:
    """Whether two servos have one id, which the operator is told."""
    doubled = [one.seen.servo_id for one in found if one.seen.voice is Voice.DOUBLED]
    for servo_id in doubled:
        operator.say(
            f"two servos or more answer as {servo_id}: neither can be set. Unplug all but one of them; plug the others in "
            f"later, one at a time, and the joint with id {FACTORY_ID} last."
        )
    return bool(doubled)


def _is_set(one: Found, profile: RobotProfile) -> bool:
    """Whether a servo has the id of a joint; with the factory's id, only where it was set up: else it is a new one."""
    seen = one.seen
    if seen.voice is not Voice.CLEAR or seen[dxl.MODEL_NUMBER] != dxl.MODEL_NAMED[profile.servo.model].number:
        return False
    talks = one.rate == BAUD_RATE and seen[dxl.BAUD_RATE] == dxl.BAUD_RATE.default
    return talks and seen.servo_id in profile.servo_names and (seen.servo_id != FACTORY_ID or not seen.fresh)


def _ask_joint(proposed: int, profile: RobotProfile, operator: Operator) -> str:
    """For which joint the next servo is, by its name; empty for the proposed one."""
    known, name = _by_name(profile), profile.servo_names[proposed]
    while True:
        answer = operator.ask(
            f"Plug in the servo of the {name}, to be id {proposed}, and press Enter; "
            f"or type another leg and joint, or {_LEAVE} to leave: "
        )
        words = " ".join(answer.lower().split())
        if words in ("", _LEAVE) or words in known:
            return words
        operator.say(f"leg and joint as in {name!r} expected, found {words!r}; one of {', '.join(known)}")


def _by_name(profile: RobotProfile) -> dict[str, int]:
    return {name: servo_id for servo_id, name in profile.servo_names.items()}


def _new_one(
    line: Line, found: Sequence[Found], profile: RobotProfile, operator: Operator, *, named_by_hand: bool
) -> Found | None:
    """The one servo that has no joint yet; None, and the operator told, when there is none, or more."""
    if _collide(found, operator):
        return None
    new = [one for one in found if not _is_set(one, profile)]
    if not new and named_by_hand and len(found) == 1:  # alone on the bus, it is the one that was named
        return found[0]
    if not new:
        operator.say("looking for it at all ids ...")
        known = {FACTORY_ID, *profile.servo_names}
        new = scan(line, (i for i in ALL_IDS if i not in known))
    if len(new) == 1:
        return new[0]
    if new:
        ids = ", ".join(str(one.seen.servo_id) for one in new)
        operator.say(f"one new servo expected, found {len(new)} (ids {ids}); leave one of them plugged in")
    else:
        operator.say("no new servo answers; see to its cable, and to its power: its LED blinks once when that comes")
    return None


def _may_change(new: Found, target: int, done: Collection[int], profile: RobotProfile, operator: Operator) -> bool:
    """Whether a servo may become that of a joint: one that is another joint's already only where the operator says so."""
    old = new.seen.servo_id
    if old == target or old not in done:
        return True
    names = profile.servo_names
    if operator.agree(f"{named(old, names)} is the only one that answers, and is set already. Make it the {names[target]}?"):
        return True
    operator.say("it is left as it is; plug the new one in")
    return False


def _give(line: Line, one: Found, target: int, profile: RobotProfile, operator: Operator) -> bool:
    """Make a servo the one of a joint, and read back whether it is."""
    bus, old = line.at(one.rate), one.seen.servo_id
    seen = (wake(bus, old) if one.seen.voice is Voice.MUTE else None) or one.seen
    wanted = dxl.MODEL_NAMED[profile.servo.model]
    if seen.voice is not Voice.CLEAR or seen[dxl.MODEL_NUMBER] != wanted.number:
        what = f"it is an {seen.model}" if seen.voice is Voice.CLEAR else f"it {seen.voice.value}"
        operator.say(f"a servo {wanted.name} expected, but {what}: left as it is; plug another one in")
        return False
    if seen[dxl.LOCK]:
        operator.say(f"servo {old} is locked, as the actuator leaves it: switch its power off and on and try again")
        return False
    if old != target:
        bus.tell(old, dxl.ID, target)  # the answer may have the old id or the new one
    settings = [(dxl.STATUS_RETURN_LEVEL, ANSWER_ALL), (dxl.RETURN_DELAY, 0)]
    if not seen[dxl.CW_ANGLE_LIMIT] and not seen[dxl.CCW_ANGLE_LIMIT]:
        settings.append((dxl.CCW_ANGLE_LIMIT, dxl.TICK_MAX))
    refused = [register.name for register, value in settings if not ensure(bus, target, register, value)]
    if not refused and seen[dxl.BAUD_RATE] != dxl.BAUD_RATE.default:  # last, for then it is heard no more
        bus.tell(target, dxl.BAUD_RATE, dxl.BAUD_RATE.default)
    back = look(line.at(BAUD_RATE), target)
    if refused or back is None or not _is_set(Found(BAUD_RATE, back), profile):
        what = f"it did not take {', '.join(refused)}" if refused else "it does not answer as that"
        operator.say(f"setting {named(target, profile.servo_names)}: {what}; switch its power off and on and try again")
        return False
    operator.say(f"{named(target, profile.servo_names)} is set, and read back: {back.model}, {back.voltage:.1f} V")
    return True
