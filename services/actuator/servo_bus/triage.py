"""Triage of a servo port before its ids are scanned: which family of servos answers, at which rate, or what else talks."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from functools import partial
from typing import NamedTuple

from sextant.services.actuator.servo_bus import usb_adapter
from sextant.services.actuator.servo_bus.bus_driver import ServoBus
from sextant.services.actuator.servo_bus.bus_scan import FACTORY_ID, Problem, refuse_another_device, retry
from sextant.shared.servo.models import MODELS
from sextant.shared.servo.servo_model import ServoModel

OTHER_ROBOT = "give --robot your_robot.toml, a profile with these servos; `sextant robot new` makes one"
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


def examine(opener: Opener, model: ServoModel, ids: Iterable[int], rates: Sequence[int]) -> Problem | None:
    """Return why no servo of the robot can be used, or None if something answers at these ids.

    Args:
        opener: Opens the port.
        model: Model of the robot's servos.
        ids: The robot's ids. That of new servos is asked, too.
        rates: [1/s] at which to ask servos of the model.

    Raises:
        NotAServoBusError: Another device sends on the port.
    """
    with closing(opener.open(rates[0], model)) as bus:
        if echo := bus.echo_problem():
            return echo
    asked = tuple(dict.fromkeys((FACTORY_ID, *ids)))
    for rate in rates:
        with closing(opener.open(rate, model)) as bus:
            if any(not bus.ping_responses(i).silent for i in asked):
                return None
    return other_family(opener, model, asked) or _silence(opener, model, rates)


def other_family(opener: Opener, model: ServoModel, ids: Iterable[int]) -> Problem | None:
    """Return that a servo answers at one of these ids, or at that of new servos, in another protocol than a model; else None.

    Raises:
        NotAServoBusError: Another device sends on the port.
    """
    asked = tuple(dict.fromkeys((FACTORY_ID, *ids)))
    with closing(opener.open(model.bus_rate, model)) as bus:
        refuse_another_device(bus)
    for other in _other_families(model):
        for rate in usual_rates(other) if opener.has_rates else (other.bus_rate,):
            with closing(opener.open(rate, other)) as bus:
                first = next((i for i in asked if i <= other.protocol.MAX_ID and bus.ping(i) is not None), None)
                if first is not None:
                    return _of_other_family(bus, first, rate, model)
    return None


def _other_families(model: ServoModel) -> tuple[ServoModel, ...]:
    """Return one model of each family whose packets differ from those of a model."""
    families = {one.protocol.answer_start: one for one in reversed(MODELS)}
    return tuple(one for start, one in families.items() if start is not model.protocol.answer_start)


def _of_other_family(bus: ServoBus, servo_id: int, rate: int, model: ServoModel) -> Problem:
    """Return the problem of a servo that answers in another protocol."""
    alike = [one for one in MODELS if one.protocol.answer_start is bus.model.protocol.answer_start]
    tell = [one for one in alike if one.has(one.table.model_number)]
    numbers = {
        register: retry(partial(bus.read, servo_id, register))
        for register in dict.fromkeys(one.table.model_number for one in tell)
    }
    unknown = f"a servo of model {next(iter(numbers.values()))}" if numbers else " or ".join(one.name for one in alike)
    name = next((one.name for one in tell if numbers[one.table.model_number] == one.number), unknown)
    words = f"servo {servo_id} is {name} ({bus.model.protocol.NAME}) at {rate} baud, {model.name} expected"
    return Problem(words, OTHER_ROBOT)


def _silence(opener: Opener, model: ServoModel, rates: Sequence[int]) -> Problem:
    """Return the problem of a port on which nothing answers."""
    names = [one.protocol.NAME for one in _other_families(model)]
    at = f" at {', '.join(map(str, rates))} baud" if opener.has_rates else ""
    latency = usb_adapter.latency_ms(opener.name)
    adapter = "" if latency is None else f"; its adapter has a latency timer of {latency} ms"
    more = "; --all-rates asks at all rates of these servos" if opener.has_rates and set(all_rates(model)) - set(rates) else ""
    return Problem(
        f"no servo answers on {opener.name} as {model.name}{at}, nor another servo in {' or '.join(names)}{adapter}",
        f"check the power of the servos and the cable at the adapter{more}; "
        "a bridge does not pass scans on, see docs/bridge.md",
    )
