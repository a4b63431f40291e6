"""The fault grid byte by byte: effects on hosts and servos, and the faults' ends."""

import socket
import time
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.simulator.servo_bus.bus import BusTiming, ServoBusEmulator
from sextant.services.simulator.servo_bus.bus_faults import BusFaults
from sextant.services.simulator.servo_bus.host_link import AdapterPort, Reply
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.services.simulator.servo_bus.tcp_port import TcpBusServer
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.bus_fault import GRID, BusFault
from sextant.shared.servo.dynamixel import PRESENT_STATE, PacketParser
from sextant.shared.servo.servo_model import Packet, Register, ServoError
from sextant.shared.wire.messages import FaultKind, FaultTarget

WILD = settings(deadline=None, derandomize=True, max_examples=60)
IDS = (1, 2, 3)
MS, S = 1_000_000, 1_000_000_000
DT = 0.004
CELLS = sorted(GRID)


class Rig:
    """Three servos with torque on, on a bus with faults, on a test clock."""

    def __init__(self, *faults: BusFault, seed: int = 0) -> None:
        self.bank = ServoBank(IDS)
        for row in range(3):
            self.bank.write(row, dxl.TORQUE_ENABLE.address, b"\x01")
            self.bank.write(row, dxl.RETURN_DELAY.address, b"\x00")
        self.plain = ServoBusEmulator(self.bank, BusTiming())
        self.bus = BusFaults(self.plain, self.bank, seed, faults)
        self.now_ns = 0
        self.out = self.step()

    def step(self, q: Sequence[float] = (0.0, 0.0, 0.0), torque: float = 0.0):  # type: ignore[no-untyped-def]
        self.bus.advance(self.now_ns)
        self.out = self.bank.step(np.array(q), np.zeros(3), np.full(3, torque), DT)
        self.now_ns += round(DT * S)
        return self.out

    def run(self, seconds: float, q: Sequence[float] = (0.0, 0.0, 0.0), torque: float = 0.0) -> None:
        for _ in range(round(seconds / DT)):
            self.step(q, torque)

    def hear(self, request: bytes) -> list[Reply]:
        return self.bus.receive(request, self.now_ns)

    def state(self, servo_id: int) -> list[Packet]:
        heard = self.hear(dxl.read(servo_id, dxl.PRESENT_POSITION.address, PRESENT_STATE.size))
        return PacketParser().feed(b"".join(reply.data for reply in heard))

    def position(self, servo_id: int) -> int:
        (answer,) = self.state(servo_id)
        return int(PRESENT_STATE.unpack(answer.parameters)[0])

    def value(self, servo_id: int, register: Register) -> int:
        start, row = register.address, IDS.index(servo_id)
        return int.from_bytes(self.bank.read(row, start, register.size), "little")


def of(target: FaultTarget, kind: FaultKind, at_s: float = 0.0, **parameters: object) -> BusFault:
    if GRID[target, kind].needs_servo:
        parameters.setdefault("servo", 2)
    return BusFault(target, kind, at_s, **parameters)  # type: ignore[arg-type]


# ------------------------------------------------------------------------------------------------------- all of them


def test_bus_without_faults_equals_plain_bus() -> None:
    rig, plain = Rig(), Rig()
    requests = [dxl.ping(1), dxl.sync_write(30, 2, [(i, b"\x00\x01") for i in IDS]), dxl.read(2, 30, 2), b"\xff\xff\x01", b"x"]
    for request in requests:
        assert rig.hear(request) == plain.plain.receive(request, plain.now_ns)
    assert rig.bus.adapter_port(0) == AdapterPort()
    assert rig.bus.words(0) == ""


@pytest.mark.parametrize("cell", CELLS, ids=" ".join)
def test_fault_is_active_only_between_start_and_end(cell: tuple[FaultTarget, FaultKind]) -> None:
    rig = Rig(of(*cell, at_s=1.0, for_s=1.0))
    for at_ns, on in ((S - 1, False), (S, True), (2 * S - 1, True), (2 * S, False)):
        assert (rig.bus.words(at_ns) != "") is on


@WILD
@given(
    st.lists(st.tuples(st.sampled_from(CELLS), st.floats(0, 0.3), st.floats(0.01, 0.3), st.floats(0.01, 1.0)), max_size=4),
    st.lists(
        st.one_of(
            st.binary(max_size=20),
            st.sampled_from([dxl.read(i, 36, 8) for i in IDS] + [dxl.ping(254)]),
            st.just(dxl.sync_write(30, 4, [(i, b"\x00\x02\x64\x00") for i in IDS])),
        ),
        min_size=5,
        max_size=40,
    ),
    st.integers(0, 9),
)
def test_random_faults_are_reproducible_and_bus_recovers(
    faults: list[tuple[tuple[FaultTarget, FaultKind], float, float, float]], requests: list[bytes], seed: int
) -> None:
    made = []
    for cell, at_s, for_s, share in faults:
        extra = {"share": share} if "share" in GRID[cell].takes else {}
        made.append(of(*cell, at_s=at_s, for_s=for_s, **extra))
    rig, again = Rig(*made, seed=seed), Rig(*made, seed=seed)
    for request in requests:
        for one in (rig, again):
            one.run(0.016)
        heard = rig.hear(request)
        assert heard == again.hear(request)  # the same seed gives the same bytes
        assert all(reply.due_ns >= rig.now_ns for reply in heard)
    rig.run(1.0)
    rig.hear(b"")  # during a pause servos drop incomplete packets
    assert rig.bus.words(rig.now_ns) == ""
    for servo_id in IDS:
        assert rig.position(servo_id) == 512
        for register in dxl.REGISTERS:
            assert register.min <= rig.value(servo_id, register) <= register.max


@pytest.mark.parametrize("cell", CELLS, ids=" ".join)
def test_bus_is_restored_after_each_fault(cell: tuple[FaultTarget, FaultKind]) -> None:
    """Restore the bus after a fault.

    Lasting effects are exceptions: heat, charge, a latched overload.
    """
    broken, well = Rig(of(*cell, at_s=0.0, for_s=0.1)), Rig()
    request = dxl.read(2, dxl.PRESENT_POSITION.address, PRESENT_STATE.size)
    for rig in (broken, well):
        for _ in range(25):
            rig.hear(request)
            rig.step()
        rig.run(0.2)
    lasting = cell in (("servo", "heat"), ("servo", "overload"), ("supply", "drain"))
    heard, expected = broken.hear(request), well.hear(request)
    if not lasting:
        assert heard == expected
        assert (broken.bank.tables == well.bank.tables).all()
    else:
        assert len(heard) == len(expected)


def test_fault_of_unknown_servo_is_refused() -> None:
    with pytest.raises(ValueError, match=r"servo silent, servo 99.*one of the servos 1, 2, 3 expected, found 99"):
        Rig(BusFault("servo", "silent", 0.0, servo=99))


# ------------------------------------------------------------------------------------------------------------- bytes


def received_and_sent_bytes(kind: FaultKind, n: int = 400, **parameters: object) -> tuple[bytes, bytes]:
    """Return what a host receives of long answers, and the answers."""
    rig = Rig(of("bytes", kind, for_s=100.0, **parameters))
    said = dxl.status(1, 0, bytes(50))
    heard = b""
    for _ in range(n):
        rig.bus._bus.receive = lambda _data, now: [Reply(now, said, 1)]  # type: ignore[method-assign]
        heard += b"".join(reply.data for reply in rig.hear(b""))
    return heard, said * n


def test_given_share_of_bytes_is_lost() -> None:
    heard, said = received_and_sent_bytes("silent", share=0.1)
    assert 1.0 - len(heard) / len(said) == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize("kind", ["stuck", "garbage", "wrong"])
def test_given_share_of_bytes_is_corrupted(kind: FaultKind) -> None:
    heard, said = received_and_sent_bytes(kind, share=0.1, **({"value": 0x55} if kind == "stuck" else {}))
    assert len(heard) == len(said)
    changed = [(a, b) for a, b in zip(said, heard, strict=True) if a != b]
    assert len(changed) / len(said) == pytest.approx(0.1, abs=0.01)
    if kind == "stuck":
        assert {b for _, b in changed} == {0x55}
    elif kind == "wrong":
        assert {(a ^ b).bit_count() for a, b in changed} == {1}
    else:
        assert len({a ^ b for a, b in changed}) > 200


def test_byte_loss_with_share_1_drops_every_byte() -> None:
    heard, said = received_and_sent_bytes("silent", share=1.0)
    assert heard == b""
    assert said


def test_delayed_bytes_are_complete_and_in_order() -> None:
    rig = Rig(of("bytes", "slow", share=0.3, delay_ms=5.0))
    heard = rig.hear(dxl.read(1, 0, 50))
    assert len(heard) > 3
    assert PacketParser().feed(b"".join(reply.data for reply in heard))[0].servo_id == 1
    assert np.diff([reply.due_ns for reply in heard]).min() == 5 * MS


def test_intermittent_byte_fault_follows_on_off_times() -> None:
    rig = Rig(of("bytes", "intermittent", on_ms=20.0, off_ms=8.0))
    whole = []
    for _ in range(28):
        whole.append([packet.servo_id for packet in rig.state(1)] == [1])
        rig.step()
    clear = [k * 4 % 28 < 20 for k in range(1, 29)]
    assert whole[:5] == clear[:5]  # later, servos and parser may wait for the rest of damaged packets
    assert not any(good for good, well in zip(whole, clear, strict=True) if not well)


def test_byte_faults_affect_requests_to_servos() -> None:
    rig = Rig(of("bytes", "garbage", share=0.2, for_s=0.1))
    for _ in range(20):
        rig.hear(dxl.sync_write(30, 2, [(i, b"\x00\x01") for i in IDS]))
    assert rig.plain.counts.instructions[dxl.Instruction.SYNC_WRITE] < 5
    assert rig.plain.dropped.total() > 0


# ----------------------------------------------------------------------------------------------------------- answers


def test_given_share_of_replies_is_lost_only_for_target_servo() -> None:
    rig = Rig(of("packets", "silent", share=0.5, servo=2))
    lost = sum(not rig.state(2) for _ in range(400))
    assert lost == pytest.approx(200, abs=40)
    assert all(rig.state(1) for _ in range(100))


def test_stuck_packet_fault_repeats_old_replies() -> None:
    rig = Rig(of("packets", "stuck", share=1.0))
    seen = []
    for k in range(4):
        rig.step((0.1 * k, 0.0, 0.0))
        seen.append(rig.position(1))
        assert rig.position(2) == 512  # servos are not mixed up
    true = [dxl.ticks_from_angle(0.1 * k) for k in range(4)]
    assert seen == [true[0], *true[:3]]


def test_garbage_packet_fault_prepends_noise() -> None:
    rig = Rig(of("packets", "garbage", share=1.0))
    for _ in range(50):
        (reply,) = rig.hear(dxl.ping(1))
        assert reply.data.endswith(dxl.status(1, 0))
        assert len(reply.data) > 6


@pytest.mark.parametrize("part", ["value", "id", "length", "error"])
def test_wrong_packet_fault_changes_one_part_with_valid_checksum(part: str) -> None:
    rig = Rig(of("packets", "wrong", share=1.0, part=part))
    true = Rig().state(1)[0].parameters
    for _ in range(50):
        (reply,) = rig.hear(dxl.read(1, 36, 8))
        (packet,) = PacketParser().feed(reply.data)
        assert (packet.servo_id != 1) is (part == "id")
        assert (len(packet.parameters) != 8) is (part == "length")
        assert (packet.code != 0) is (part == "error")
        assert (packet.parameters != true) is (part in ("value", "length"))


def test_slow_fault_delays_replies_of_packets_servo_or_bus() -> None:
    (punctual,) = Rig().hear(dxl.ping(2))
    for fault in (of("packets", "slow", share=1.0), of("servo", "slow"), of("bus", "slow")):
        rig = Rig(fault)
        assert rig.hear(dxl.ping(2)) == [punctual._replace(due_ns=punctual.due_ns + 16 * MS)]
    rig = Rig(of("servo", "slow"))
    assert rig.hear(dxl.ping(1)) == [punctual._replace(data=dxl.status(1, 0), servo_id=1)]


@pytest.mark.parametrize("target", ["packets", "servo", "bus"])
def test_intermittent_fault_drops_replies_by_on_off_times(target: FaultTarget) -> None:
    rig = Rig(of(target, "intermittent", on_ms=12.0, off_ms=8.0))
    heard = []
    for _ in range(20):
        heard.append(bool(rig.state(2)))
        rig.step()
    assert heard == [k * 4 % 20 < 12 for k in range(1, 21)]


# --------------------------------------------------------------------------------------------------------- one servo


@pytest.mark.parametrize("cable", [False, True])
def test_silent_servo_ignores_packets_and_loses_torque_without_cable(cable: bool) -> None:
    rig = Rig(of("servo", "silent", for_s=0.1, cable=cable))
    assert rig.state(2) == []
    assert rig.state(1) != []
    rig.hear(dxl.sync_write(30, 2, [(i, b"\x00\x01") for i in IDS]))
    rig.run(0.02)
    assert [rig.value(i, dxl.GOAL_POSITION) for i in IDS][0::2] == [256, 256]
    assert rig.value(2, dxl.GOAL_POSITION) != 256
    assert (rig.out.torque_limit > 0).tolist() == [True, not cable, True]
    rig.run(0.2)
    assert rig.state(2) != []
    assert rig.value(2, dxl.TORQUE_ENABLE) == (0 if cable else 1)  # its RAM is lost, and no host turns torque on
    assert rig.value(2, dxl.RETURN_DELAY) == 0  # its EEPROM is kept
    assert (rig.out.torque_limit > 0).tolist() == [True, not cable, True]


def test_stuck_position_register_keeps_old_position() -> None:
    rig = Rig()
    rig.step((0.0, 0.2, 0.0))
    rig.bus.inject(of("servo", "stuck", for_s=0.1), rig.now_ns)
    rig.step((0.1, 0.5, 0.0))
    assert rig.position(2) == dxl.ticks_from_angle(0.2)
    assert rig.position(1) == dxl.ticks_from_angle(0.1)
    rig.run(0.15, (0.1, 0.5, 0.0))
    assert rig.position(2) == dxl.ticks_from_angle(0.5)


def test_wrong_position_register_has_constant_offset() -> None:
    rig = Rig(of("servo", "wrong", offset_ticks=-40))
    rig.step()
    assert [rig.position(i) for i in IDS] == [512, 472, 512]


def test_jammed_joint_is_held_in_place_under_full_motor_load() -> None:
    rig = Rig()
    rig.step((0.0, 0.3, 0.0))
    rig.bus.inject(of("servo", "jammed", for_s=0.1), rig.now_ns)
    rig.hear(dxl.sync_write(30, 2, [(2, dxl.GOAL_POSITION.encode(800))]))
    for _ in range(5):
        rig.step((0.0, 0.3, 0.0))
    assert rig.out.setpoint[1] == pytest.approx(0.3)
    assert rig.out.torque_limit[1] > 1.5
    (answer,) = rig.state(2)
    assert dxl.load_from_register(PRESENT_STATE.unpack(answer.parameters)[2]) == pytest.approx(1.0)
    rig.run(0.15, (0.0, 0.3, 0.0))
    assert rig.out.torque_limit[1] == pytest.approx(1.5)


@pytest.mark.parametrize(("kind", "parameters", "after_s", "degrees"), [
    ("slipped", {"degrees": 20.0}, 0.1, 10.0), ("slipped", {"degrees": -20.0}, 0.3, -20.0),
    ("jump", {"degrees": 20.0}, 0.01, 20.0), ("drift", {"deg_per_s": -3.0}, 2.0, -6.0),
])  # fmt: skip
def test_encoder_is_ahead_of_its_link(kind: FaultKind, parameters: dict[str, float], after_s: float, degrees: float) -> None:
    rig = Rig(of("servo", kind, for_s=100.0, **parameters))
    rig.run(after_s)
    assert np.degrees(rig.bank.slipped) == pytest.approx([0.0, degrees, 0.0], abs=0.5)


@pytest.mark.parametrize(("value", "wanted", "followed"), [(0, 64, 0), (0, 60, 60), (1, 0, 64), (1, 70, 70)])
def test_stuck_bit_changes_the_goal_that_a_servo_follows(value: int, wanted: int, followed: int) -> None:
    rig = Rig(of("servo", "bit", bit=6, value=value))
    rig.hear(dxl.sync_write(30, 2, [(i, dxl.GOAL_POSITION.encode(512 + wanted)) for i in (1, 2)]))
    rig.run(0.1)
    assert rig.out.setpoint[:2] / dxl.TICK_RAD == pytest.approx([wanted, followed], abs=1.1)  # the compliance margin


def test_wrong_sign_changes_only_the_load_reading() -> None:
    rig, honest = Rig(of("servo", "sign")), Rig()
    for one in (rig, honest):
        one.run(0.1, (0.0, 0.1, 0.0), torque=0.5)
    loads = [dxl.load_from_register(PRESENT_STATE.unpack(one.state(2)[0].parameters)[2]) for one in (rig, honest)]
    assert loads[0] == -loads[1] != 0.0
    assert rig.position(2) == honest.position(2)


def test_weak_servo_has_a_share_of_its_torque_and_shows_its_duty() -> None:
    rig, strong = Rig(of("servo", "weak", share=0.3, for_s=1.0)), Rig()
    for one in (rig, strong):
        one.run(0.1, torque=0.3)
    assert rig.out.torque_limit / strong.out.torque_limit == pytest.approx([1.0, 0.3, 1.0])
    assert rig.out.stiffness / strong.out.stiffness == pytest.approx([1.0, 0.3, 1.0])
    (answer,) = rig.state(2)
    assert dxl.load_from_register(PRESENT_STATE.unpack(answer.parameters)[2]) == pytest.approx(0.3 / 0.45, abs=0.02)


def test_garbage_fault_affects_only_replies_of_its_servo() -> None:
    rig = Rig(of("servo", "garbage"))
    (reply,) = rig.hear(dxl.read(2, 36, 8))
    assert len(reply.data) == 14
    assert PacketParser().feed(reply.data) == []
    assert len(rig.state(1)) == 1


def test_overload_fault_latches_again_after_reset_until_its_end() -> None:
    rig = Rig(of("servo", "overload", for_s=0.1))
    rig.step()
    assert rig.bank.shutdown.tolist() == [False, True, False]
    assert rig.out.torque_limit[1] == 0.0
    (answer,) = rig.state(2)
    assert answer.code == ServoError.OVERLOAD

    def mend() -> None:
        rig.hear(dxl.write(2, dxl.TORQUE_LIMIT.address, dxl.TORQUE_LIMIT.encode(1023)))
        rig.step()
        rig.step()

    mend()
    assert rig.bank.shutdown[1]
    rig.run(0.1)
    assert rig.bank.shutdown[1]  # it does not recover by itself
    mend()
    assert not rig.bank.shutdown.any()
    assert rig.out.torque_limit[1] > 0


def test_heat_fault_warms_servo_until_shutdown() -> None:
    rig = Rig(of("servo", "heat", for_s=10.0, kelvin_per_s=10.0))
    rig.run(4.0)
    assert rig.bank.temperature[1] == pytest.approx(65.0, abs=1.0)
    assert rig.bank.temperature[0] == pytest.approx(25.0, abs=0.1)
    assert not rig.bank.shutdown.any()
    rig.run(1.0)
    assert rig.bank.shutdown.tolist() == [False, True, False]


def test_hot_fault_changes_only_the_temperature_reading() -> None:
    rig = Rig(of("servo", "hot", for_s=0.5, celsius=85))
    question = dxl.read(2, dxl.PRESENT_TEMPERATURE.address, 1)
    rig.run(0.1)
    assert rig.hear(question)[0].data[5] == 85
    rig.run(1.0)
    assert rig.hear(question)[0].data[5] == 25
    assert rig.bank.temperature[1] == pytest.approx(25.0, abs=0.1)
    assert not rig.bank.shutdown.any()


# ------------------------------------------------------------------------------------------------- bus and supply


def test_silent_adapter_delivers_nothing_and_servos_hold() -> None:
    rig = Rig(of("bus", "silent", for_s=0.1))
    assert rig.hear(dxl.sync_write(30, 2, [(i, b"\x00\x01") for i in IDS])) == []
    assert rig.hear(dxl.ping(1)) == []
    rig.run(0.05)
    assert (rig.out.torque_limit > 0).all()
    assert rig.value(1, dxl.GOAL_POSITION) != 256


@pytest.mark.parametrize("kind", ["stuck", "garbage"])
def test_stuck_or_garbage_bus_fault_floods_the_line(kind: FaultKind) -> None:
    rig = Rig(of("bus", kind, **({"value": 0xFF} if kind == "stuck" else {})))
    heard = rig.hear(dxl.ping(1))
    data = b"".join(reply.data for reply in heard)
    assert len(data) == 800
    assert (len(set(data)) == 1) == (kind == "stuck")
    assert heard[-1].due_ns == rig.now_ns + 8 * MS
    rig.step()
    assert sum(len(reply.data) for reply in rig.hear(dxl.ping(1))) == 400  # of 4 ms: a line has one speed


def test_wrong_bus_fault_returns_reply_to_previous_request() -> None:
    rig = Rig(of("bus", "wrong"))
    assert rig.state(1) == []
    assert [packet.servo_id for packet in rig.state(2)] == [1]
    assert [packet.servo_id for packet in rig.state(3)] == [2]


def test_lost_port_returns_under_same_or_new_name() -> None:
    rig = Rig(of("bus", "gone", 0.1, for_s=0.1), of("bus", "gone", 0.3, for_s=0.1, renamed=True))
    port = MemoryPort(rig.bus, lambda: rig.now_ns)
    port.write(dxl.ping(1))
    rig.run(0.12)
    for use in (lambda: port.write(dxl.ping(1)), lambda: port.read(6), port.reset_input_buffer):
        with pytest.raises(OSError, match="unplugged"):
            use()
    with pytest.raises(OSError, match="port any of the simulated bus expected, found none"):
        MemoryPort(rig.bus, lambda: rig.now_ns)
    assert (rig.out.torque_limit > 0).all()
    rig.run(0.1)
    with pytest.raises(OSError, match="unplugged"):  # the open port does not work again
        port.read(6)
    again = MemoryPort(rig.bus, lambda: rig.now_ns, name=0, start_ns=port.now_ns())
    again.write(dxl.ping(1))
    assert again.read(6) == dxl.status(1, 0)
    rig.run(0.2)
    with pytest.raises(OSError, match="port 0 of the simulated bus expected, found 1"):
        MemoryPort(rig.bus, lambda: rig.now_ns, name=0)
    MemoryPort(rig.bus, lambda: rig.now_ns, name=1)


def test_supply_faults_sag_voltage_and_drain_battery() -> None:
    rig = Rig(of("supply", "sag", for_s=0.2, volts=3.0), of("supply", "drain", 0.5, for_s=2.0))
    rig.run(0.1)
    full = rig.bank.supply.full_voltage - rig.bank.supply.resistance * rig.bank.current
    assert rig.bank.voltage == pytest.approx(full - 3.0, abs=0.01)
    rig.run(0.3)
    assert rig.bank.voltage == pytest.approx(full, abs=0.01)
    rig.run(1.1)
    assert rig.bank.charge == pytest.approx(0.5, abs=0.01)
    rig.run(1.1)
    assert rig.bank.charge == pytest.approx(0.0, abs=1e-3)
    assert rig.bank.voltage == pytest.approx(full - 2.7, abs=0.01)


# --------------------------------------------------------------------------------------------------------------- tcp


def ping(address: tuple[str, int]) -> bytes:
    with socket.create_connection(address, timeout=5.0) as client:
        client.sendall(dxl.ping(1))
        return client.recv(6, socket.MSG_WAITALL)


def test_lost_tcp_port_returns_at_another_address() -> None:
    rig = Rig()
    now = [0]

    def clock() -> int:
        return now[0] or time.monotonic_ns()

    rig.bus.origin_ns = time.monotonic_ns()
    with TcpBusServer(rig.bus, clock=clock) as server:
        first = server.address
        with socket.create_connection(first, timeout=5.0) as client:
            client.sendall(dxl.ping(1))
            assert client.recv(6, socket.MSG_WAITALL) == dxl.status(1, 0)
            with server.lock:
                rig.bus.inject(BusFault("bus", "gone", 0.0, for_s=3600.0, renamed=True), clock())
            server.replug()
            assert client.recv(1) == b""  # the server closed it
        with pytest.raises(ConnectionError):  # refused, or reset if it was in the listener's queue already
            ping(first)
        now[0] = rig.bus.origin_ns + 4000 * S  # the fault is over
        server.replug()
        patience = time.monotonic() + 10.0
        while server.address == first and time.monotonic() < patience:
            pass
        assert server.address != first
        now[0] = 0
        rig.bus.advance(rig.bus.origin_ns + 4000 * S)  # and forgotten
        assert ping(server.address) == dxl.status(1, 0)
