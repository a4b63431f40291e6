"""Triage of a servo port before its ids are scanned: which family of servos answers, at which rate, or what else talks."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from types import MappingProxyType
from typing import NamedTuple

from sextant.services.actuator.servo_bus import usb_adapter
from sextant.services.actuator.servo_bus.bus_driver import ServoBus
from sextant.services.actuator.servo_bus.bus_scan import FACTORY_ID, OTHER_ROBOT, Problem, on_wrong_bus
from sextant.services.actuator.servo_bus.model_identification import models_alike, told_model
from sextant.services.actuator.servo_bus.other_device import refuse_another_device
from sextant.shared.servo import maestro
from sextant.shared.servo.models import MODELS
from sextant.shared.servo.servo_model import ServoModel

HOBBY_ROBOT = "give --robot your_robot.toml, a profile with hobby servos, see docs/hobby_servos.md"
NO_OTHERS: Mapping[int, str] = MappingProxyType({})
USUAL_IDS = range(1, 19)  # of bus servos on the port of a robot with hobby servos
_FACTORY_RATES = (57_143,)  # [1/s] of an RX-64 or MX
_RATE_TOLERANCE = 0.03  # [1] relative difference of two rates up to which bytes are received correctly


class Opener(NamedTuple):
    """Port that can be opened at several rates, for servos of several models."""

    open: Callable[[int, ServoModel], ServoBus]  # of a rate [1/s] and a model
    name: str  # of the port
    has_rates: bool  # a network port has none


def usual_rates(model: ServoModel) -> tuple[int, ...]:
    """Return the baud rates [1/s] at which servos of a model may answer: the robot's own, and those of factories."""
    others = _FACTORY_RATES if model.commands is None else ()
    return _apart((model.bus_rate, model.rates[model.default(model.table.baud_rate)], *others))


def all_rates(model: ServoModel) -> tuple[int, ...]:
    """Return all baud rates [1/s] that the manual of a model lists, the usual ones first."""
    return _apart((*usual_rates(model), *sorted(model.common_rates or model.rates.values(), reverse=True)))


def rates_of_all(models: Iterable[ServoModel], of_model: Callable[[ServoModel], tuple[int, ...]]) -> tuple[int, ...]:
    """Return the baud rates [1/s] of all models, those of the first one first; `of_model` is one of the functions above."""
    return _apart(rate for model in dict.fromkeys(models) for rate in of_model(model))


def _apart(rates: Iterable[int]) -> tuple[int, ...]:
    """Return the rates that do not reach the same servos as an earlier one."""
    kept: list[int] = []
    for rate in rates:
        if all(abs(rate - other) > _RATE_TOLERANCE * other for other in kept):
            kept.append(rate)
    return tuple(kept)


def examine(
    opener: Opener, model: ServoModel, ids: Iterable[int], rates: Sequence[int], elsewhere: Mapping[int, str] = NO_OTHERS
) -> Problem | None:
    """Return why no servo of the robot can be used, or None if something answers at these ids.

    Args:
        opener: Opens the port.
        model: Model of the robot's servos.
        ids: The robot's ids. That of new servos is asked, too.
        rates: [1/s] at which to ask servos of the model.
        elsewhere: Id -> name of servos on other buses of the robot, which may be on this one.

    Raises:
        NotAServoBusError: Another device sends on the port.
    """
    with closing(opener.open(rates[0], model)) as bus:
        if echo := bus.echo_problem():
            return echo
    asked = tuple(dict.fromkeys((FACTORY_ID, *ids, *elsewhere)))
    for rate in rates:
        with closing(opener.open(rate, model)) as bus:
            heard = next((heard for i in asked if not (heard := bus.ping_responses(i)).silent), None)
            if heard is not None:
                if not heard.answers:
                    refuse_another_device(bus)
                return None
    return other_family(opener, model, asked, elsewhere) or _silence(opener, model, rates)


def other_family(
    opener: Opener, model: ServoModel | None, ids: Iterable[int], elsewhere: Mapping[int, str] = NO_OTHERS
) -> Problem | None:
    """Return that a servo answers at one of these ids, or at that of new servos, in another protocol than a model; else None.

    None in place of the model stands for hobby servos, which have no protocol.

    Raises:
        NotAServoBusError: Another device sends on the port.
    """
    families = other_families(model)
    with closing(opener.open(*(families[0].bus_rate, families[0]) if model is None else (model.bus_rate, model))) as bus:
        refuse_another_device(bus)
        if model is not None and is_maestro(bus):
            return Problem(f"a Pololu Maestro answers, {model.name} expected", HOBBY_ROBOT)
    found = first_answer(opener, families, ids)
    if found is not None and found.servo_id in elsewhere:
        return on_wrong_bus(found.servo_id, elsewhere)
    return None if found is None else found.problem(model)


def is_maestro(bus: ServoBus) -> bool:
    """Return whether a Maestro answers in place of servos, which take no packet of one byte for a request."""
    answers = [bus.bytes_after(maestro.get_errors()) for _ in range(2)]
    return all(len(one) == 2 and maestro.number(one) <= maestro.ALL_ERRORS for one in answers)


def instead_of_board(opener: Opener, board: str) -> Problem | None:
    """Return that bus servos answer in place of a board of hobby servos that is silent, or None.

    Raises:
        NotAServoBusError: Another device sends on the port.
    """
    return other_family(opener, None, USUAL_IDS) if board == "maestro" else None  # other boards are on an I2C bus


class Answering(NamedTuple):
    """Servo that answers, and how it does."""

    servo_id: int
    rate: int  # [1/s]
    model: ServoModel  # its own, or the first with its packets if it does not tell a known one
    name: str

    def problem(self, expected: ServoModel | None) -> Problem:
        """Return its problem, where servos of a model at its usual rate are expected; None stands for hobby servos."""
        if self.model is expected:
            words = f"servo {self.servo_id} answers at {self.rate} baud, {expected.bus_rate} expected"
            return Problem(words, "`sextant servos set-id` sets its rate")
        wanted = "hobby servos" if expected is None else expected.name
        words = f"servo {self.servo_id} is {self.name} ({self.model.protocol.NAME}) at {self.rate} baud, {wanted} expected"
        return Problem(words, OTHER_ROBOT)


def first_answer(opener: Opener, models: Iterable[ServoModel], ids: Iterable[int]) -> Answering | None:
    """Return the first servo that answers at one of these ids, or at that of new servos, with the packets of these models."""
    asked = tuple(dict.fromkeys((FACTORY_ID, *ids)))
    for model in models:
        for rate in usual_rates(model) if opener.has_rates else (model.bus_rate,):
            with closing(opener.open(rate, model)) as bus:
                first = next((i for i in asked if i <= model.protocol.MAX_ID and bus.ping(i) is not None), None)
                if first is not None:
                    return _identified(bus, first, rate)
    return None


def _identified(bus: ServoBus, servo_id: int, rate: int) -> Answering:
    """Return a servo that answers on a bus, with its model."""
    told = told_model(bus, servo_id, bus.model)
    if told.model is not None:
        return Answering(servo_id, rate, told.model, told.model.name)
    names = " or ".join(one.name for one in models_alike(bus.model))
    return Answering(servo_id, rate, bus.model, names if told.number is None else f"a servo of model {told.number}")


def other_families(model: ServoModel | None) -> tuple[ServoModel, ...]:
    """Return one model of each family whose packets differ from those of a model; of all families for None."""
    families = {one.protocol.answer_start: one for one in reversed(MODELS)}
    return tuple(one for start, one in families.items() if model is None or start is not model.protocol.answer_start)


def _silence(opener: Opener, model: ServoModel, rates: Sequence[int]) -> Problem:
    """Return the problem of a port on which nothing answers."""
    names = [one.protocol.NAME for one in other_families(model)]
    at = f" at {', '.join(map(str, rates))} baud" if opener.has_rates else ""
    latency, name = usb_adapter.latency_ms(opener.name), usb_adapter.name_of(opener.name)
    about = (f"is {name}" if name else "", "" if latency is None else f"has a latency timer of {latency} ms")
    adapter = f"; its adapter {' and '.join(filter(None, about))}" if any(about) else ""
    more = "; --all-rates asks at all rates of these servos" if opener.has_rates and set(all_rates(model)) - set(rates) else ""
    return Problem(
        f"no servo answers on {opener.name} as {model.name}{at}, nor another servo in {' or '.join(names)}{adapter}",
        f"check the power of the servos and the cable at the adapter{more}; "
        "a bridge does not pass scans on, see docs/bridge.md",
    )
