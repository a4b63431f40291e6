"""Bus scan: missing servos, id collisions, wrong models and factory resets.

The scan names each faulty servo by leg and joint.
"""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.actuator.servo_bus import bus_scan
from sextant.services.actuator.servo_bus.bus_driver import BusSetupError, ServoBus
from sextant.services.actuator.servo_bus.bus_scan import BusResponse, ServoScan, scan_servo, wrong_settings
from sextant.services.actuator.servo_bus.other_device import NotAServoBusError
from sextant.services.simulator.servo_bus.bus import Reply
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.models import SCS0009, XM430_W350
from tests.support.desk import Desk

NAMES = Desk().profile.servo_names
FEMUR = 9  # left rear
COXA = 1  # left front: a factory reset sets this id


def setup_error(desk: Desk) -> str:
    with pytest.raises(BusSetupError) as failure:
        desk.bus().setup()
    return str(failure.value)


@pytest.mark.parametrize("servo_id", list(NAMES))
def test_a_missing_servo_is_named_by_leg_and_joint(servo_id: int) -> None:
    desk = Desk()
    desk.bench.unplug([desk.row(servo_id)])
    words = setup_error(desk)
    assert f"1 of 18 servos are not ready: servo {servo_id} ({NAMES[servo_id]}) does not answer" in words
    assert "reset" not in words


CHAINS = {
    (11,): ("servo 11 (left rear tibia) does not answer", "between the left rear femur and the left rear tibia"),
    (9, 11): (
        "servo 9 (left rear femur) and servo 11 (left rear tibia) do not",
        "between the left rear coxa and the left rear femur",
    ),
    (7, 9, 11): ("none of the 3 servos of the left rear leg answers (ids 7, 9, 11)", "check the cable before its coxa"),
    (7, 9, 11, 1, 3, 5): ("none of the 6 servos of 2 legs (left front, left rear) answers", "the cable or hub that they share"),
    (9,): ("servo 9 (left rear femur) does not answer, but the servo behind it does", "the chain is intact"),
}


@pytest.mark.parametrize("silent", CHAINS)
def test_one_fault_of_a_chain_is_one_problem_with_its_place(silent: tuple[int, ...]) -> None:
    desk = Desk()
    desk.bench.unplug([desk.row(i) for i in silent])
    wrong = bus_scan.problems(NAMES, bus_scan.call(desk.bus(), NAMES))
    words, place = CHAINS[silent]
    assert set(wrong) == set(silent)
    (problem,) = set(wrong.values())
    assert words in problem.words
    assert place in problem.advice
    assert setup_error(desk).count(problem.words) == 1
    assert setup_error(desk).startswith(f"{len(silent)} of 18 servos are not ready")


def test_silent_robot_is_one_problem_that_points_to_other_servos() -> None:
    desk = Desk()
    desk.bench.unplug(range(18))
    (problem,) = set(bus_scan.problems(NAMES, bus_scan.call(desk.bus(), NAMES)).values())
    assert problem.words == "none of the 18 servos answers"
    assert "`sextant servos scan` also tries other baud rates and protocols" in problem.advice


def test_two_faults_of_a_leg_are_two_problems() -> None:
    desk = Desk()
    desk.bench.unplug([desk.row(i) for i in (7, 11)])
    wrong = bus_scan.problems(NAMES, bus_scan.call(desk.bus(), NAMES))
    assert "the servo behind it does" in wrong[7].words
    assert "between the left rear femur and the left rear tibia" in wrong[11].advice


def test_a_servo_of_another_model_is_named() -> None:
    desk = Desk()
    desk.tables[desk.row(FEMUR), dxl.MODEL_NUMBER.address] = 64
    assert "servo 9 (left rear femur) is model 64 (RX-64), expected 12 (AX-12A)" in setup_error(desk)


def test_reset_servo_sharing_another_id_is_detected() -> None:
    desk = Desk()
    desk.reset(FEMUR)
    words = setup_error(desk)
    assert "2 of 18 servos" in words
    assert "servo 1 (left front coxa) gives several or garbled answers" in words
    assert "a reset sets id 1: this may be servo 9 (left rear femur)" in words
    assert (desk.tables[[desk.row(COXA)], dxl.RETURN_DELAY.address] == 0).all()
    assert sorted(desk.tables[:, dxl.RETURN_DELAY.address])[-1] == 250  # the scan has not configured the reset servo


def test_reset_hint_counts_servos_if_many_are_missing() -> None:
    desk = Desk()
    desk.reset(FEMUR)
    desk.bench.unplug([desk.row(i) for i in (3, 4, 5)])
    assert "a reset sets id 1: this may be any of the 4 missing servos" in setup_error(desk)


def test_reset_servo_on_unused_id_is_detected() -> None:
    desk = Desk()
    desk.change(COXA, dxl.ID, 19)
    desk.reset(FEMUR)
    legs = (replace(desk.profile.legs[0], servo_ids=(19, 3, 5)), *desk.profile.legs[1:])
    desk.profile = replace(desk.profile, legs=legs)
    words = setup_error(desk)
    assert "servo 9 (left rear femur) does not answer" in words
    assert "servo 1 is not one of the robot's servos; a reset sets id 1: this may be servo 9 (left rear femur)" in words


@pytest.mark.parametrize("delay", [0, 250], ids=["speaking at once", "one after the other"])
def test_id_collision_is_detected(delay: int) -> None:
    desk = Desk()
    desk.change(FEMUR, dxl.RETURN_DELAY, delay)
    desk.change(FEMUR, dxl.ID, 16)
    words = setup_error(desk)
    assert "servo 9 (left rear femur) does not answer" in words
    assert "servo 16 (right middle femur) gives several or garbled answers" in words


def test_setup_writes_nothing_to_colliding_servos() -> None:
    desk = Desk()
    for servo_id in (FEMUR, 16):
        desk.change(servo_id, dxl.RETURN_DELAY, 100)
    desk.change(FEMUR, dxl.ID, 16)
    setup_error(desk)
    assert (desk.tables[desk.bench._with_id(16), dxl.RETURN_DELAY.address] == 100).all()


def test_scan_servo_reads_full_control_table() -> None:
    desk = Desk()
    seen = bus_scan.scan_servo(desk.bus(), FEMUR)
    assert seen is not None
    assert seen.response is BusResponse.CLEAR
    assert (seen.model, seen[dxl.FIRMWARE], seen[dxl.ID], seen.is_wheel) == ("AX-12A", 24, FEMUR, False)
    assert seen.voltage == pytest.approx(12.6, abs=0.2)
    assert seen.temperature == 25.0
    table = desk.tables[desk.row(FEMUR)]
    assert (np.frombuffer(seen.table, dtype=np.uint8)[:19] == table[:19]).all()
    assert (np.frombuffer(seen.table, dtype=np.uint8)[24:] == table[24:48]).all()
    assert bus_scan.scan_servo(desk.bus(), 99) is None


def test_setup_of_healthy_bus_has_no_timeouts() -> None:
    desk = Desk()
    bus = desk.bus()
    began = desk.clock()
    bus.setup()
    assert desk.clock() - began < 18 * 8_000_000
    assert not bus.lost


def test_late_reply_is_not_taken_for_a_second_servo() -> None:
    """Check that a late reply to one ping, read during the next, counts once."""
    desk = Desk()
    bus = desk.bus()
    receive, late = desk.bench.receive, []

    def one_late(data: bytes, now_ns: int) -> list[Reply]:
        replies = receive(data, now_ns)
        if not late:
            late.extend(reply._replace(due_ns=reply.due_ns + 7_000_000) for reply in replies)
            return late
        return replies

    desk.bench.receive = one_late  # type: ignore[method-assign]
    seen = bus_scan.scan_servo(bus, FEMUR)
    assert late
    assert seen is not None
    assert seen.response is BusResponse.CLEAR


def test_loose_cable_is_not_taken_for_id_collision() -> None:
    desk = Desk()
    bus = desk.bus()
    receive = desk.bench.receive

    def loose(data: bytes, now_ns: int) -> list[Reply]:
        return [] if data[4:5] == b"\x02" and data[6] > 2 else receive(data, now_ns)  # long replies are lost

    desk.bench.receive = loose  # type: ignore[method-assign]
    seen = bus_scan.scan_servo(bus, FEMUR)
    assert seen is not None
    assert seen.response is BusResponse.FADING


@pytest.mark.parametrize(("number", "name"), [(18, "AX-18A"), (300, "AX-12W")])
def test_models_with_the_same_control_table_are_named(number: int, name: str) -> None:
    desk = Desk()
    address = dxl.MODEL_NUMBER.address
    desk.tables[desk.row(FEMUR), address : address + 2] = list(number.to_bytes(2, "little"))
    assert f"is model {number} ({name}), expected 12 (AX-12A)" in setup_error(desk)
    assert replace(desk.profile.servo, model=name).model == name


class _Station:
    """A port on which another device prints one line, independent of the request."""

    def __init__(self, line: bytes) -> None:
        self.line, self.now_ns = line, 0

    def clock(self) -> int:
        return self.now_ns

    def write(self, data: bytes, /) -> int:
        return len(data)

    def read(self, size: int = 1, /) -> bytes:
        self.now_ns += 10_000_000
        return (self.line * (1 + size // len(self.line)))[:size]

    def reset_input_buffer(self) -> None: ...

    def close(self) -> None: ...


def test_foreign_device_on_port_is_reported_with_its_output() -> None:
    station = _Station(b"Temperature 21.5 C\r\n")
    bus = ServoBus(station, [1, 2], station.clock)
    with pytest.raises(
        NotAServoBusError, match=r"another device sends 'Temperature 21\.5 C\.\.Temp.*; serial ports of this computer: "
    ):
        scan_servo(bus, 1)
    assert station.now_ns < 5e9, "within seconds"


def test_model_that_a_profile_states_by_numbers_has_its_name_in_a_scan() -> None:
    model = replace(XM430_W350, name="XM430-W210", number=1030)
    assert ServoScan(1, BusResponse.CLEAR, model, model.factory_table()).model == "XM430-W210"
    assert ServoScan(1, BusResponse.CLEAR, model, XM430_W350.factory_table()).model == "XM430-W350"


def test_limits_are_those_of_the_factory_or_the_whole_range_where_they_are_too_narrow() -> None:
    table, units = SCS0009.table, SCS0009.units
    low, high = SCS0009.default(table.low_limit), SCS0009.default(table.high_limit)
    seen = ServoScan(1, BusResponse.CLEAR, SCS0009, SCS0009.factory_table())
    assert wrong_settings(seen, SCS0009, (low, high)) == []
    wide = {one.register: one.value for one in wrong_settings(seen, SCS0009, (low - 5, high + 5))}
    assert wide == {table.low_limit: 0, table.high_limit: units.max_position}
