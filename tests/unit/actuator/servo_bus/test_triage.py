"""Triage of a port: what talks, in which protocol and at which rate."""

from collections.abc import Callable

import pytest

from sextant.services.actuator.servo_bus import triage, usb_adapter
from sextant.services.actuator.servo_bus.bus_driver import ServoBus
from sextant.services.actuator.servo_bus.bus_scan import Problem
from sextant.services.actuator.servo_bus.command_bus import bus_of
from sextant.services.actuator.servo_bus.other_device import NotAServoBusError
from sextant.services.actuator.servo_bus.triage import Opener, all_rates, usual_rates
from sextant.shared.servo.models import MODEL_NAMED, MODELS
from sextant.shared.servo.servo_model import ServoModel
from tests.support.desk import PHANTOMX, Desk
from tests.support.families import robot_with

AX_12A = MODEL_NAMED["AX-12A"]


def opener(desk: Desk) -> Opener:
    def at(rate: int, model: ServoModel) -> ServoBus:
        return bus_of(model)(desk.open(rate), [1, 2, 3], desk.clock, model=model)

    return Opener(at, "/dev/ttyUSB0", has_rates=True)


def examined(
    desk: Desk, model: ServoModel = AX_12A, rates: Callable[[ServoModel], tuple[int, ...]] = usual_rates
) -> Problem | None:
    return triage.examine(opener(desk), model, [1, 2, 3], rates(model))


def test_silent_port_names_its_adapter(monkeypatch: pytest.MonkeyPatch) -> None:
    desk, told = Desk(PHANTOMX, fresh=True), "nor another servo in LewanSoul or Dynamixel Protocol 2.0"
    monkeypatch.setattr(usb_adapter, "name_of", lambda url: "CP2102 USB to UART (10c4:ea60)")
    found = examined(desk)
    assert found is not None
    assert found.words.endswith(f"{told}; its adapter is CP2102 USB to UART (10c4:ea60)")
    monkeypatch.setattr(usb_adapter, "latency_ms", lambda url: 16)
    found = examined(desk)
    assert found is not None
    assert found.words.endswith("; its adapter is CP2102 USB to UART (10c4:ea60) and has a latency timer of 16 ms")


@pytest.mark.parametrize("name", ["XL430-W250", "STS3215"])
def test_servo_is_named_with_its_own_protocol(name: str) -> None:
    expected = {"XL430-W250": "AX-12A", "STS3215": "XL-320"}[name]
    found = examined(Desk(robot_with(name)), MODEL_NAMED[expected])
    assert found is not None
    assert f"servo 1 is {name} ({MODEL_NAMED[name].protocol.NAME}) at 1000000 baud" in found.words


@pytest.mark.parametrize("name", ["AX-12A", "MX-28", "XL430-W250", "STS3215", "LX-16A"])
def test_own_servos_need_no_triage(name: str) -> None:
    assert examined(Desk(robot_with(name)), MODEL_NAMED[name]) is None


@pytest.mark.parametrize(
    ("there", "expected"), [("XL430-W250", "AX-12A"), ("AX-12A", "XM430-W350"), ("STS3215", "XL430-W250"), ("LX-16A", "MX-28")]
)
def test_servo_of_another_protocol_is_named(there: str, expected: str) -> None:
    found = examined(Desk(robot_with(there)), MODEL_NAMED[expected])
    assert found is not None
    name = "LX-16A or HX-35H" if there == "LX-16A" else there  # which do not tell their model
    assert f"servo 1 is {name} (" in found.words
    assert f"{expected} expected" in found.words
    assert found.advice.startswith("give --robot your_robot.toml")


def test_new_servo_of_another_protocol_is_found_at_the_rate_of_its_factory() -> None:
    desk = Desk(robot_with("XL430-W250"), fresh=True)
    desk.bench.plug([4])
    found = examined(desk)
    assert found is not None
    assert found.words == "servo 1 is XL430-W250 (Dynamixel Protocol 2.0) at 57600 baud, AX-12A expected"


def test_silent_port_names_rates_and_protocols_once() -> None:
    desk = Desk(PHANTOMX, fresh=True)
    found = examined(desk)
    assert found is not None
    assert found.words == (
        "no servo answers on /dev/ttyUSB0 as AX-12A at 1000000, 57143 baud, "
        "nor another servo in LewanSoul or Dynamixel Protocol 2.0"
    )
    assert "--all-rates" in found.advice
    every = examined(desk, rates=all_rates)
    assert every is not None
    assert "115942" not in every.words
    assert "117647" in every.words
    assert "--all-rates" not in every.advice


def test_another_device_is_shown_by_its_text(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk(PHANTOMX, fresh=True)
    monkeypatch.setattr(ServoBus, "unrequested_bytes", lambda self: b"$GPGGA,120000.00\r\n")
    with pytest.raises(NotAServoBusError, match=r"another device sends '\$GPGGA,120000.00\.\.' without a request"):
        examined(desk)
    monkeypatch.setattr(ServoBus, "unrequested_bytes", lambda self: b"\xff" * 64)
    with pytest.raises(
        NotAServoBusError, match=r"another device sends the bytes ff ff ff ff ff ff ff ff \.\.\. without a request"
    ):
        examined(desk)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_rates_begin_with_that_of_the_robot_and_reach_different_servos(model: ServoModel) -> None:
    usual, every = usual_rates(model), all_rates(model)
    assert usual[0] == model.bus_rate
    assert every[: len(usual)] == usual
    assert set(every) <= {*model.rates.values(), 57_143}
    assert all(abs(one - other) > 0.03 * other for one in every for other in every if one != other)
