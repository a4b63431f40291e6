"""Bus scan: state and problems of each servo, by leg and joint. Nothing is moved.

Two servos with one id answer at the same time. If their return delays differ, two answers follow one ping. If they are equal,
the answers collide, and reads of registers that differ between the two are broken.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from typing import NamedTuple, Protocol

from sextant.services.actuator.servo_bus import other_device
from sextant.services.actuator.servo_bus.attempts import ATTEMPTS, retry
from sextant.services.actuator.servo_bus.model_identification import models_alike, told_model
from sextant.services.actuator.servo_bus.other_device import refuse_another_device
from sextant.shared.servo.servo_model import Register, ServoError, ServoModel, error_words

FACTORY_ID = 1  # of all makers
_FEW = 3  # servos that are named one by one


class Problem(NamedTuple):
    """Problem of a servo, and its remedy."""

    words: str
    advice: str


class Setting(NamedTuple):
    """EEPROM register that limits a servo too much, or does not protect it."""

    register: Register
    value: int  # recommended value
    words: str  # what is wrong with the present value


class Bus(other_device.Bus, Protocol):
    """Part of `ServoBus` that is used here."""

    def model_of(self, servo_id: int) -> ServoModel:
        """Return the expected model of a servo."""

    @property
    def garbled(self) -> int:
        """Number of invalid bytes and packets so far."""

    def ping(self, servo_id: int) -> ServoError | None:
        """Return the error bits of a servo, None when it does not answer."""

    def read(self, servo_id: int, register: Register) -> int | None:
        """Return the value of a register."""

    def read_bytes(self, servo_id: int, address: int, size: int) -> bytes | None:
        """Return bytes of a control table."""

    def write(self, servo_id: int, register: Register, value: int) -> bool:
        """Write a register."""

    def write_unacknowledged(self, servo_id: int, register: Register, value: int) -> None:
        """Write a register without waiting for an answer."""


class BusResponse(StrEnum):
    """Response type of an id."""

    CLEAR = "answers"
    DOUBLED = "gives several or garbled answers: two servos have this id, or a cable is bad"
    MUTE = "answers pings, but no reads"
    FADING = "answers only sometimes: a cable is loose, or this computer is too busy"


_LOCKED = "its EEPROM may be locked until its power is cycled"
SET_ID = "run `sextant servos set-id` with this servo alone on the bus"
ALSO_ASKS = "`sextant servos scan` also tries other baud rates and protocols"
OTHER_ROBOT = "give --robot your_robot.toml, a profile with these servos; `sextant robot new` makes one"
_PROTECTION = int(ServoError.OVERLOAD | ServoError.OVERHEATING)
_REMEDIES = {
    BusResponse.DOUBLED: f"unplug one of the two, and give the other another id: {SET_ID}",
    BusResponse.FADING: "check its plugs, and end other programs",
    BusResponse.MUTE: f"its status return level is 0: {SET_ID}",
}
ECHO = Problem(
    "the adapter returns every byte that is sent",
    "turn the echo setting on: --echo for `sextant servos`, and --set actuator.echo=true for the actuator",
)
NO_ECHO = Problem(
    "the adapter does not return what is sent",
    "turn the echo setting off, which is --echo or actuator.echo; if this adapter echoes, check its power",
)


@dataclass(frozen=True, slots=True)
class ServoScan:
    """Scan result of one id."""

    servo_id: int
    response: BusResponse
    expected: ServoModel  # the robot's servos are of this type, whose control table these bytes are
    table: bytes = b""  # from address 0, by its own model; empty unless the response is clear
    error: ServoError = ServoError.NONE

    def __getitem__(self, register: Register) -> int:
        """Return the value of a register; requires a clear response."""
        return register.decode(self.table[register.address : register.address + register.size])

    @property
    def model(self) -> str:
        """Name of its model, or its number."""
        if not self.expected.has(self.expected.table.model_number):
            return "not told"
        found = self.identified
        return found.name if found else f"model {self.number}"

    @property
    def identified(self) -> ServoModel | None:
        """Expected or known model with the packets of the expected one, whose number is in its own place of the table."""
        alike = [self.expected, *models_alike(self.expected)]
        alike.sort(key=lambda one: one.table.of_bus != self.expected.table.of_bus)
        return next((one for one in alike if self[one.table.model_number] == one.number), None)

    @property
    def is_other_model(self) -> bool:
        """Whether it tells another model than the expected one."""
        return self.response is BusResponse.CLEAR and self.number != self.expected.number

    @property
    def is_alike(self) -> bool:
        """Whether its registers are where the expected model has them, as far as is known; else its measurements are not."""
        return self.identified is None or self.identified.table.of_bus == self.expected.table.of_bus

    @property
    def number(self) -> int:
        """Number of its model."""
        return self[self.expected.table.model_number]

    @property
    def firmware(self) -> int | None:
        """Version of its firmware, None if it does not tell."""
        return self[self.expected.table.firmware] if self.expected.has(self.expected.table.firmware) else None

    @property
    def voltage(self) -> float:
        """Present voltage [V]."""
        return self[self.expected.table.present_voltage] * self.expected.units.volt

    @property
    def temperature(self) -> float:
        """Present temperature [deg C]."""
        return float(self[self.expected.table.present_temperature])

    @property
    def is_wheel(self) -> bool:
        """Whether the servo is in wheel or multi-turn mode; requires a clear response."""
        return self[self.expected.table.low_limit] == self[self.expected.table.high_limit]


def scan_servo(bus: Bus, servo_id: int, *, listen: bool = True) -> ServoScan | None:
    """Scan one id; return None if nothing answers.

    Args:
        bus: The bus.
        servo_id: The id to scan.
        listen: Wait for a second answer to a ping, for the whole timeout of a servo.
    """
    error = retry(lambda: bus.ping(servo_id))
    crowd = (listen or error is None) and _crowded(bus, servo_id)
    if error is None and not crowd:
        return None
    expected = bus.model_of(servo_id)
    table = expected.table
    register = table.model_number
    model = retry(lambda: bus.read(servo_id, register))
    if crowd or error is None:
        refuse_another_device(bus)
        return ServoScan(servo_id, BusResponse.DOUBLED, expected)
    if model is None:
        return ServoScan(servo_id, BusResponse.MUTE, expected)
    other = None if model == expected.number else told_model(bus, servo_id, expected).model
    garbled, there = bus.garbled, other.table if other else table
    eeprom, ram = (_read(bus, servo_id, block, table.size) for block in (there.eeprom, there.ram))
    if eeprom is None or ram is None:  # same models answer alike to the model number, but their measurements differ
        return ServoScan(servo_id, BusResponse.DOUBLED if bus.garbled > garbled else BusResponse.FADING, expected)
    contents = bytes(there.eeprom.start) + eeprom + bytes(there.ram.start - there.eeprom.stop) + ram
    found = ServoScan(servo_id, BusResponse.CLEAR, expected, contents, error)
    if table.hardware_error is not None:  # whose errors an answer does not carry
        return replace(found, error=error | expected.hardware_errors(found[table.hardware_error]))
    return found


def _read(bus: Bus, servo_id: int, block: range, most: int) -> bytes | None:
    """Return the bytes at some addresses, at most `most` in an answer; None if the servo does not answer."""
    parts = [block[k : k + most] for k in range(0, len(block), most)]
    found = [retry(partial(bus.read_bytes, servo_id, part.start, len(part))) for part in parts]
    return None if None in found else b"".join(filter(None, found))


def _crowded(bus: Bus, servo_id: int) -> bool:
    """Return whether pings repeatedly get several or no intact answers.

    A single time may be a late answer.
    """
    heard = (bus.ping_responses(servo_id) for _ in range(ATTEMPTS))
    return all(ping_responses.answers != 1 and not ping_responses.silent for ping_responses in heard)


def call(bus: Bus, names: Mapping[int, str]) -> dict[int, ServoScan]:
    """Scan a robot's servos.

    If one is missing, also check the factory id and the found ids for a second servo.
    """
    seen = {i: found for i in names if (found := scan_servo(bus, i, listen=False))}
    if len(seen) < len(names) and seen:
        whom = {FACTORY_ID, *seen}
        seen |= {i: found for i in sorted(whom) if (found := scan_servo(bus, i))}
    return seen


def problems(names: Mapping[int, str], seen: Mapping[int, ServoScan]) -> dict[int, Problem]:
    """Return the problems of a robot's servos, by id; servos that one fault of a cable silences share one problem.

    A foreign servo with the factory id may be a missing one after a reset, and so may the servo of the joint with that id, if
    it has factory settings and others are missing.

    Args:
        names: Id -> leg and joint, as "left rear femur"; empty without a name.
        seen: Scan results by id.
    """
    missing = [i for i in names if i not in seen]
    found = {i: problem for i in seen if i in names and (problem := _wrong(seen[i]))}
    for i in sorted(seen.keys() - names.keys()):
        found[i] = Problem("is not one of the robot's servos", SET_ID)
    first = seen.get(FACTORY_ID)
    if first and missing and (FACTORY_ID not in names or first.response is BusResponse.DOUBLED):
        words, advice = found[FACTORY_ID]
        found[FACTORY_ID] = Problem(f"{words}; {reset_servos(missing, names)}", advice)
    if FACTORY_ID not in found and is_unassigned(seen, names):
        words = f"has factory settings, so it may be a new servo of another joint; {reset_servos(missing, names)}"
        found[FACTORY_ID] = Problem(words, f"{SET_ID}, and type the leg and joint where it is mounted")
    if names and all(i in found and seen[i].is_other_model for i in names):
        found |= {i: found[i]._replace(advice=OTHER_ROBOT) for i in names}
    wrong = grouped(found, names) | unreachable(missing, names)
    return {i: wrong[i] for i in (*names, *wrong) if i in wrong}


def grouped(found: Mapping[int, Problem], names: Mapping[int, str]) -> dict[int, Problem]:
    """Return the problems of servos with their subjects: many servos with the same problem share one.

    Args:
        found: Problems by id, without a subject, as "is in wheel mode".
        names: Id -> leg and joint of the robot's servos.
    """
    alike: dict[Problem, list[int]] = {}
    for i, problem in found.items():
        alike.setdefault(problem, []).append(i)
    whole = {
        problem: Problem(f"{many} {problem.words}", problem.advice)
        for problem, ids in alike.items()
        if (many := each_of(ids, names))
    }
    return {i: whole.get(one) or Problem(f"{named(i, names)} {one.words}", one.advice) for i, one in found.items()}


def each_of(ids: Collection[int], names: Mapping[int, str]) -> str:
    """Return many servos, or all of a robot, as the subject of a sentence; "" for few servos, which have names."""
    if len(ids) > 1 and set(ids) == set(names):
        return f"each of the {len(ids)} servos"
    return f"each of {len(ids)} servos (ids {', '.join(map(str, sorted(ids)))})" if len(ids) > _FEW else ""


def on_wrong_bus(servo_id: int, elsewhere: Mapping[int, str]) -> Problem:
    """Return the problem of a servo that answers on another bus of the robot than its own."""
    words = f"servo {servo_id} ({elsewhere[servo_id]}) is on this bus"
    return Problem(words, "exchange the ports in --port, connect the servo to its own bus, or change [[buses]] of the profile")


def is_unassigned(seen: Mapping[int, ServoScan], names: Mapping[int, str]) -> bool:
    """Return whether the servo with the factory id may belong to any joint, although a joint has that id.

    It has the factory's value of the setting that `sextant servos set-id` changes last, and no other servo of the robot has it;
    servos that another program has set up keep it. If none is missing, it is the servo of that joint.
    """
    first = seen.get(FACTORY_ID)
    if (
        first is None
        or not first.expected.joint_settings
        or FACTORY_ID not in names
        or first.response is not BusResponse.CLEAR
        or names.keys() <= seen.keys()
    ):
        return False
    others = [one for i, one in seen.items() if i in names and i != FACTORY_ID and one.response is BusResponse.CLEAR]
    return _is_new(first) and not any(map(_is_new, others))


def _is_new(seen: ServoScan) -> bool:
    """Return whether the setting that tells a new servo has its factory value."""
    register = next(reversed(seen.expected.joint_settings))
    return seen[register] == seen.expected.default(register)


def unreachable(missing: Collection[int], names: Mapping[int, str]) -> dict[int, Problem]:
    """Return the problem of each servo that does not answer.

    The servos of a leg are a chain from coxa to tibia. Those at its end that do not answer share one problem, with the cable
    that is its likely cause, and so do the servos of all legs that do not answer at all. A servo with an answering one behind
    it has a separate fault.
    """
    legs: dict[str, list[int]] = {}
    for i, name in names.items():
        legs.setdefault(name.rpartition(" ")[0] or f"{i}", []).append(i)
    whole = [leg for leg, chain in legs.items() if len(chain) > 1 and all(i in missing for i in chain)]
    found: dict[int, Problem] = {}
    for leg, chain in legs.items():
        ahead = max((k + 1 for k, i in enumerate(chain) if i not in missing), default=0)
        for i in (i for i in chain[:ahead] if i in missing):
            words = f"{named(i, names)} does not answer, but the servo behind it does"
            advice = f"the chain is intact, so check its id and baud rate: {SET_ID}; on a hub, check its cable"
            if i == FACTORY_ID and whole:
                advice = (
                    f"if it is not set up yet: `set-id` does this last, since new servos have id {FACTORY_ID}; else {advice}"
                )
            found[i] = Problem(words, advice)
        silent = chain[ahead:]
        if leg not in whole and silent:
            place = f"between the {names[chain[ahead - 1]]} and the {names[silent[0]]}" if ahead else "of this servo"
            found |= dict.fromkeys(
                silent, Problem(f"{_listed(silent, names)} not answer", f"check the cable {place}, and its plugs")
            )
    if whole:
        silent = [i for leg in whole for i in legs[leg]]
        which = f"the {whole[0]} leg" if len(whole) == 1 else f"{len(whole)} legs ({', '.join(whole)})"
        words = f"none of the {len(silent)} servos of {which} answers (ids {', '.join(map(str, silent))})"
        place = "the cable before its coxa" if len(whole) == 1 else "the power and the cable or hub that they share"
        if len(silent) == len(names):
            words, place = f"none of the {len(silent)} servos answers", f"the power and the cable at the adapter; {ALSO_ASKS}"
        found |= dict.fromkeys(silent, Problem(words, f"check {place}"))
    return found


def _listed(silent: Sequence[int], names: Mapping[int, str]) -> str:
    """Return servos as the subject of a verb: "servo 9 (left rear femur) does"."""
    if len(silent) == 1:
        return f"{named(silent[0], names)} does"
    return f"{' and '.join(named(i, names) for i in silent)} do"


def reset_servos(missing: Iterable[int], names: Mapping[int, str]) -> str:
    """Return which servos may have got the factory id by a reset."""
    who = [named(i, names) for i in missing]
    words = " or ".join(who) if len(who) <= _FEW else f"any of the {len(who)} missing servos"
    return f"a reset sets id {FACTORY_ID}: this may be {words}"


def named(servo_id: int, names: Mapping[int, str]) -> str:
    """Return a servo's id and name: "servo 9 (left rear femur)"."""
    name = names.get(servo_id, "")
    return f"servo {servo_id} ({name})" if name else f"servo {servo_id}"


def _wrong(seen: ServoScan) -> Problem | None:
    """Return the problem of a servo that answers, or None."""
    model = seen.expected
    if seen.response is not BusResponse.CLEAR:
        return Problem(seen.response.value, _REMEDIES[seen.response])
    if seen.is_other_model:
        found = seen.identified
        which = f"{found.number} ({found.name})" if found else f"{seen.number} (unknown)"
        words = f"is model {which}, expected {model.number} ({model.name})"
        return Problem(words, "replace it by the right model, or choose the profile of a robot with this model")
    for register, (mask, value) in model.required.items():
        if seen[register] & mask != value:
            words = f"has a {register.name} of {seen[register]}, with which positions or speeds mean something else"
            return Problem(words, f"set the {register.name} with the tool of its maker")
    if seen.is_wheel:
        return Problem(
            f"is in wheel mode (both angle limits are {seen[model.table.low_limit]})", f"{SET_ID}: this sets joint mode"
        )
    return None


def wrong_settings(seen: ServoScan, model: ServoModel, reach: tuple[int, int]) -> list[Setting]:
    """Return limits and protections that differ from data sheet and joint needs.

    A robot can work with them.

    Args:
        seen: A servo with a clear response.
        model: Its type.
        reach: Lowest and highest position register that its joint needs.
    """
    table = model.table
    low, high = seen[table.low_limit], seen[table.high_limit]
    hot, usual = seen[table.temperature_limit], model.default(table.temperature_limit)
    torque, most = seen[table.max_torque], model.default(table.max_torque)
    protects = _PROTECTION & model.hardware_errors(model.default(table.shutdown))  # as its factory sets it
    unguarded = protects & ~model.hardware_errors(seen[table.shutdown])
    guarded = seen[table.shutdown] | model.hardware_error_code(_PROTECTION)
    narrow = f"turns from tick {low} to {high} only, {reach[0]} to {reach[1]} needed"
    bare = f"does not shut down for {error_words(unguarded)}"
    lowest, highest = model.default(table.low_limit), model.default(table.high_limit)
    lowest = lowest if lowest <= reach[0] else 0  # the whole range, because calibration moves what a joint needs
    highest = highest if highest >= reach[1] else model.units.max_position
    settings = (
        (low > reach[0], Setting(table.low_limit, lowest, narrow)),
        (high < reach[1], Setting(table.high_limit, highest, narrow)),
        (hot != usual, Setting(table.temperature_limit, usual, f"shuts down at {hot} deg C, {usual} expected")),
        (
            torque < most,
            Setting(table.max_torque, most, f"gives {100 * torque * model.units.torque:.0f} % of its torque at most"),
        ),
        (unguarded, Setting(table.shutdown, guarded, bare)),
    )
    return [setting for wrong, setting in settings if wrong]


def prepare(bus: Bus, seen: ServoScan, lock: bool) -> str:
    """Configure immediate answers to all requests, and lock the EEPROM.

    Return what failed, or an empty string.

    EEPROM is written only where it differs.
    """
    model = seen.expected
    locked = ((model.table.lock, 1),) if lock and model.table.lock else ()
    for register, value in (*model.joint_settings.items(), *locked):
        if seen[register] != value and not ensure(bus, seen.servo_id, register, value):
            why = "it may have torque: `sextant servos off`" if model.eeprom_needs_torque_off else _LOCKED
            return f"does not accept {register.name} {value}; {why}"
    return ""


def wake(bus: Bus, servo_id: int) -> ServoScan | None:
    """Raise the status return level of a servo that answers only pings, and scan it.

    The write itself is not acknowledged.
    """
    model = bus.model_of(servo_id)
    level = model.table.status_return_level
    bus.write_unacknowledged(servo_id, level, model.joint_settings[level])
    return scan_servo(bus, servo_id, listen=False)


def ensure(bus: Bus, servo_id: int, register: Register, value: int) -> bool:
    """Write a register unless it has the value; return whether it has it at the end."""
    for _ in range(ATTEMPTS):
        if bus.read(servo_id, register) == value:
            return True
        bus.write(servo_id, register, value)
    return bus.read(servo_id, register) == value
