"""Survey of a servo bus at several baud rates: which servos answer, and what keeps them from being the robot's.

Nothing is moved, and no torque is turned on.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sextant.services.actuator.servo_bus.bus_driver import BAUD_RATE, ServoBus
from sextant.services.actuator.servo_bus.bus_scan import (
    FACTORY_ID,
    SET_ID,
    BusResponse,
    Problem,
    ServoScan,
    each_of,
    grouped,
    is_unassigned,
    named,
    on_wrong_bus,
    problems,
    reset_servos,
    scan_servo,
    wrong_settings,
)
from sextant.services.actuator.servo_bus.servo_health import health_problems
from sextant.services.actuator.servo_bus.triage import usual_rates
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo.servo_model import ServoModel

_NO_ANSWER_ADVICE = "check their power and the cable at the adapter; a bridge does not pass scans on, see docs/bridge.md"
_UNLESS_MEANT = f"if this is not intended, {SET_ID} and type its leg and joint to restore safe values"
_GAIN_ADVICE = (
    "switch the servos' power off and on, which ends most changes; if it remains, set it with the tool of the maker, "
    "or state it and its stiffness in the profile"
)


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
    robot = {i: name for i, name in profile.servo_names.items() if asked is None or i in asked}
    heard = {seen.servo_id: seen for rate, seen in found if rate == seen.expected.bus_rate}
    elsewhere = {seen.servo_id for rate, seen in found if rate != seen.expected.bus_rate} - heard.keys()
    if not robot.keys() <= elsewhere:
        elsewhere.discard(FACTORY_ID)  # it may be a new servo of any joint
    names = {i: name for i, name in robot.items() if i not in elsewhere}
    wrong = problems(names, heard)
    for i in profile.servos_elsewhere.keys() & heard.keys():
        wrong[i] = on_wrong_bus(i, profile.servos_elsewhere)
    missing, unanswered = [i for i in names if i not in heard], []
    if not each and len(missing) == len(names) > 1:
        missing, unanswered = [], [Problem(f"none of {len(names)} servos answers", _NO_ANSWER_ADVICE)]
        wrong = {i: problem for i, problem in wrong.items() if i not in names}
    well = {i: seen for i, seen in heard.items() if seen.response is BusResponse.CLEAR and i not in wrong}
    return [
        *unanswered,
        *dict.fromkeys(wrong.values()),
        *_at_other_rates(found, missing, robot),
        *health_problems(well, profile.battery.warn_voltage, names),
        *hampered((seen for i, seen in heard.items() if i in names), profile),
    ]


def _at_other_rates(found: Sequence[Found], missing: Collection[int], names: Mapping[int, str]) -> list[Problem]:
    """Return the problems of servos that answer at another rate than the robot's, one for many of them."""
    alike: dict[tuple[int, ServoModel], list[int]] = {}
    for rate, seen in found:
        if rate != seen.expected.bus_rate:
            alike.setdefault((rate, seen.expected), []).append(seen.servo_id)
    wrong = []
    for (rate, model), ids in alike.items():
        rates = f"at {rate} baud, {model.bus_rate} expected"
        option = "" if rate in usual_rates(model) else " --all-rates"
        advice = f"`sextant servos set-id{option}` sets the rate"
        many = each_of(ids, names)
        words = [f"{many} answers {rates}"] if many else [f"servo {i} answers {rates}" for i in ids]
        if FACTORY_ID in ids and missing:
            words[0] += f"; {reset_servos(missing, names)}"
        wrong += [Problem(one, advice) for one in words]
    return wrong


def hampered(seen: Iterable[ServoScan], profile: RobotProfile) -> list[Problem]:
    """Return servos with unusual limits or protections.

    This is advice: the actuator works with them.
    """
    limited, gains = dict[int, Problem](), dict[int, Problem]()
    limits, servos = position_limits(profile), dict(zip(profile.servo_ids.ravel().tolist(), profile.servos.each, strict=True))
    for one in seen:
        model = one.expected
        if one.response is BusResponse.CLEAR and one.number == model.number and not one.is_wheel:
            told = [setting.words for setting in wrong_settings(one, model, limits[one.servo_id])]
            gain = [
                f"has a {register.name} of {one[register]}, {value} in the profile"
                for register, value in servos[one.servo_id].controller_settings.items()
                if one[register] != value
            ]
            for each, words, advice in ((limited, told, _UNLESS_MEANT), (gains, gain, _GAIN_ADVICE)):
                each |= {one.servo_id: Problem("; ".join(dict.fromkeys(words)), advice)} if words else {}
    names = profile.servo_names
    return list(dict.fromkeys((*grouped(limited, names).values(), *grouped(gains, names).values())))


def position_limits(profile: RobotProfile) -> dict[int, tuple[int, int]]:
    """Return lowest and highest position register for each servo's joint, by id."""
    ends = np.sort([profile.servo_angles(profile.joint_limits[..., end]) for end in (0, 1)], axis=0)
    found = {}
    for i, model, low, high in zip(
        profile.servo_ids.ravel().tolist(), profile.servos.models, *map(np.ravel, ends), strict=True
    ):
        most = model.units.max_position
        found[i] = (min(max(model.units.ticks(low), 0), most), min(max(model.units.ticks(high), 0), most))
    return found
