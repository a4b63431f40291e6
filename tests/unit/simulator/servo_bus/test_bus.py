"""The emulated bus in memory and over TCP.

Tests cover answers, their times, and the times at which writes reach the joints.
"""

import socket
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.simulator.servo_bus.bus import BusTiming, Reply, ServoBusEmulator
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.services.simulator.servo_bus.tcp_port import TcpBusServer
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.dynamixel import Instruction, PacketParser
from sextant.shared.servo.models import RX_64
from sextant.shared.servo.servo_model import Packet, Register, ServoError

WILD = settings(deadline=None, derandomize=True)

USB = 1_000_000
BYTE = 10_000  # [ns] at 1 Mbps
DELAY = 500_000  # [ns] factory return delay


def make_bus(n: int = 2, *, echo: bool = False) -> tuple[ServoBank, ServoBusEmulator]:
    bank = ServoBank(range(1, n + 1))
    return bank, ServoBusEmulator(bank, echo=echo)


def packets(replies: list[Reply]) -> list[Packet]:
    return PacketParser().feed(b"".join(reply.data for reply in replies))


def answer(bus: ServoBusEmulator, request: bytes, now_ns: int = 0) -> Packet:
    (packet,) = packets(bus.receive(request, now_ns))
    return packet


def read_register(bus: ServoBusEmulator, servo_id: int, register: Register) -> int:
    return int.from_bytes(answer(bus, dxl.read(servo_id, register.address, register.size)).parameters, "little")


def write_packet(servo_id: int, register: Register, value: int) -> bytes:
    return dxl.write(servo_id, register.address, register.encode(value))


def test_ping_reply_matches_manual_bytes_and_timing() -> None:
    _, bus = make_bus()
    (reply,) = bus.receive(bytes.fromhex("FF FF 01 02 01 FB"), 1_000)
    assert reply.data == bytes.fromhex("FF FF 01 02 00 FC")
    assert reply.due_ns == 1_000 + 6 * BYTE + DELAY + 6 * BYTE + USB


def test_sync_write_of_goal_and_speed_to_18_servos_takes_1_ms() -> None:
    bank, bus = make_bus(18)
    packet = dxl.sync_write(30, 4, [(i, bytes((0x10, 2, 100, 0))) for i in range(1, 19)])
    assert BusTiming().wire_ns(len(packet)) == 980_000
    assert bus.receive(packet, 0) == []
    goals = bank.tables[:, dxl.GOAL_POSITION.address]
    bus.advance(979_999)
    assert not (goals == 0x10).any()
    bus.advance(980_000)
    assert (goals == 0x10).all()
    assert (bank.tables[:, dxl.MOVING_SPEED.address] == 100).all()


def test_bus_time_to_read_18_servos() -> None:
    """Read 6 bytes of 18 servos in 12.6 ms, or 3.6 ms without return delay.

    12.6 ms is the time with the factory's return delay.
    """
    for delay, expected_ns in ((250, 12_600_000), (0, 3_600_000)):
        _, bus = make_bus(18)
        bus.receive(write_packet(dxl.BROADCAST_ID, dxl.RETURN_DELAY, delay), 0)
        start = now = 1_000_000
        for servo_id in range(1, 19):
            (reply,) = bus.receive(dxl.read(servo_id, 36, 6), now)
            now = reply.due_ns - USB
        assert now - start == pytest.approx(expected_ns, rel=0.01)


def test_bytes_queue_on_the_bus() -> None:
    _, bus = make_bus()
    bus.receive(bytes(100), 0)  # noise takes time on the wire too
    (reply,) = bus.receive(dxl.ping(1), 0)
    assert reply.due_ns == (100 + 6 + 6) * BYTE + DELAY + USB


def test_two_packets_in_one_transfer_are_answered_in_sequence() -> None:
    _, bus = make_bus()
    first, second = bus.receive(dxl.ping(1) + dxl.ping(2), 0)
    assert first.due_ns == 12 * BYTE + DELAY + USB
    assert second.due_ns >= first.due_ns + 6 * BYTE


def test_servos_reply_only_at_their_baud_rate() -> None:
    bank = ServoBank([1, 2], RX_64)
    assert ServoBusEmulator(bank).receive(dxl.ping(1), 0) == []
    bus = ServoBusEmulator(bank, BusTiming(baud_rate=57_600, usb_transaction_ns=0))
    (reply,) = bus.receive(dxl.ping(1), 0)
    assert reply.due_ns == pytest.approx(12 * 10 / 57_600 * 1e9 + DELAY, abs=2)
    bus.receive(write_packet(1, dxl.BAUD_RATE, 1), 0)
    assert bus.receive(dxl.ping(1), 10**9) == []
    assert bus.receive(dxl.ping(2), 10**9) != []


def test_reads_include_pending_writes() -> None:
    bank, bus = make_bus()
    bus.receive(write_packet(1, dxl.GOAL_POSITION, 700), 0)
    assert read_register(bus, 1, dxl.GOAL_POSITION) == 700
    assert answer(bus, dxl.read(1, 28, 4)).parameters == bytes((32, 32, 700 & 0xFF, 700 >> 8))
    assert bank.tables[0, 30] == 0
    bus.advance(10**9)
    assert read_register(bus, 1, dxl.GOAL_POSITION) == 700
    assert read_register(bus, 2, dxl.GOAL_POSITION) == 512


def test_reads_return_state_of_last_physics_step() -> None:
    bank, bus = make_bus(1)
    bank.step(np.array([0.5]), np.zeros(1), np.array([-0.3]), 0.002)
    data = answer(bus, dxl.read(1, 36, 8)).parameters
    position, speed, load, voltage, temperature = dxl.PRESENT_STATE.unpack(data)
    assert (position, speed, load) == (dxl.ticks_from_angle(0.5), 0, 1024 + 200)
    assert (voltage, temperature) == (125, 25)


@pytest.mark.parametrize(
    ("request_bytes", "error"),
    [
        (write_packet(1, dxl.TORQUE_ENABLE, 1), ServoError.NONE),
        (dxl.write(1, 30, b"\x00\x04"), ServoError.RANGE),  # 1024
        (dxl.write(1, 24, b"\x02"), ServoError.RANGE),
        (dxl.write(1, 30, b"\x00"), ServoError.RANGE),  # half a register
        (dxl.write(1, 36, b"\x00\x00"), ServoError.RANGE),  # read-only
        (dxl.write(1, 48, bytes(4)), ServoError.RANGE),  # past the table
        (dxl.read(1, 48, 4), ServoError.RANGE),
        (dxl.encode(1, Instruction.READ, b"\x24"), ServoError.INSTRUCTION),
        (dxl.encode(1, Instruction.WRITE, b"\x24"), ServoError.INSTRUCTION),
        (dxl.encode(1, 0x55), ServoError.INSTRUCTION),
        (dxl.encode(1, Instruction.SYNC_WRITE, b"\x18\x01\x01\x01"), ServoError.INSTRUCTION),
        (dxl.action(1), ServoError.INSTRUCTION),  # nothing registered
        (dxl.ping(1)[:-1] + b"\x00", ServoError.CHECKSUM),
    ],
)
def test_error_bits(request_bytes: bytes, error: ServoError) -> None:
    bank, bus = make_bus()
    before = bank.tables.copy()
    assert answer(bus, request_bytes) == Packet(1, error, b"", 6)
    bus.advance(10**9)
    if error:
        assert (bank.tables == before).all()
        assert sum(bus.counts.refused.values()) == 1


def test_goals_outside_the_angle_limits_are_refused() -> None:
    bank, bus = make_bus()
    bus.receive(write_packet(1, dxl.CW_ANGLE_LIMIT, 300), 0)
    assert answer(bus, write_packet(1, dxl.GOAL_POSITION, 299)).code == ServoError.ANGLE_LIMIT
    assert answer(bus, write_packet(1, dxl.GOAL_POSITION, 300)).code == 0
    bus.receive(dxl.sync_write(30, 2, [(1, b"\x00\x00"), (2, b"\x00\x00")]), 0)
    bus.advance(10**9)
    assert bank.tables[:, 30:32].tolist() == [[300 & 0xFF, 1], [0, 0]]


def test_fault_bits_are_in_every_reply() -> None:
    bank, bus = make_bus()
    bank.temperature[0] = 80.0
    bank.step(np.zeros(2), np.zeros(2), np.zeros(2), 0.002)
    assert answer(bus, dxl.ping(1)).code == ServoError.OVERHEATING
    assert answer(bus, dxl.read(1, 34, 2)) == Packet(1, ServoError.OVERHEATING, b"\x00\x00", 8)
    assert answer(bus, dxl.write(1, 24, b"\x07")).code == ServoError.OVERHEATING | ServoError.RANGE
    assert answer(bus, dxl.ping(2)).code == 0


def test_unknown_ids_and_broadcasts_except_ping_get_no_reply() -> None:
    bank, bus = make_bus(3)
    assert bus.receive(dxl.ping(77), 0) == []
    assert bus.counts.unanswered == 1
    assert bus.receive(write_packet(dxl.BROADCAST_ID, dxl.LED, 1), 0) == []
    assert bus.receive(dxl.read(dxl.BROADCAST_ID, 36, 2), 0) == []
    assert [p.servo_id for p in packets(bus.receive(dxl.ping(dxl.BROADCAST_ID), 0))] == [1, 2, 3]
    bus.advance(10**9)
    assert bank.tables[:, dxl.LED.address].tolist() == [1, 1, 1]


@pytest.mark.parametrize(("level", "answers"), [(0, (1, 0, 0)), (1, (1, 1, 0)), (2, (1, 1, 1))])
def test_status_return_level(level: int, answers: tuple[int, int, int]) -> None:
    _, bus = make_bus()
    bus.receive(write_packet(1, dxl.STATUS_RETURN_LEVEL, level), 0)
    requests = (dxl.ping(1), dxl.read(1, 0, 2), write_packet(1, dxl.LED, 1))
    assert tuple(len(bus.receive(request, 0)) for request in requests) == answers


def test_registered_writes_wait_for_action() -> None:
    bank, bus = make_bus()
    assert answer(bus, dxl.reg_write(1, 30, b"\x64\x00")).code == 0
    assert answer(bus, dxl.reg_write(1, 30, b"\x64\x09")).code == ServoError.RANGE
    assert read_register(bus, 1, dxl.REGISTERED) == 1
    assert read_register(bus, 1, dxl.GOAL_POSITION) == 512
    assert bus.receive(dxl.action(), 0) == []
    assert read_register(bus, 1, dxl.REGISTERED) == 0
    bus.advance(10**9)
    assert bank.tables[0, 30:32].tolist() == [100, 0]


def test_id_can_be_changed_and_reset_sets_id_1() -> None:
    _, bus = make_bus(2)
    assert answer(bus, write_packet(2, dxl.ID, 19)).servo_id in (2, 19)
    assert bus.receive(dxl.ping(2), 0) == []
    assert answer(bus, dxl.ping(19)).servo_id == 19
    bus.advance(10**9)
    assert answer(bus, dxl.ping(19)).servo_id == 19
    assert answer(bus, dxl.reset(19)).servo_id == 19
    assert bus.receive(dxl.ping(19), 0) == []


def test_servos_with_the_same_id_collide() -> None:
    bank, bus = make_bus(2)
    bus.receive(write_packet(2, dxl.ID, 1), 0)
    assert answer(bus, dxl.ping(1)).servo_id == 1  # the same bytes: the host cannot distinguish them
    bank.step(np.array([0.5, -0.9]), np.zeros(2), np.zeros(2), 0.002)
    (reply,) = bus.receive(dxl.read(1, 36, 2), 0)
    assert PacketParser().feed(reply.data) == []


def test_locked_eeprom_refuses_writes_and_unlocking() -> None:
    _, bus = make_bus()
    assert answer(bus, write_packet(1, dxl.LOCK, 1)).code == 0
    assert answer(bus, write_packet(1, dxl.ID, 5)).code == ServoError.RANGE
    assert answer(bus, write_packet(1, dxl.LOCK, 0)).code == ServoError.RANGE
    assert answer(bus, write_packet(1, dxl.PUNCH, 40)).code == ServoError.RANGE
    for register in (dxl.TORQUE_ENABLE, dxl.LED, dxl.GOAL_POSITION, dxl.MOVING_SPEED, dxl.TORQUE_LIMIT):
        assert answer(bus, write_packet(1, register, 1)).code == 0


def test_echo_returns_every_byte_sent() -> None:
    _, bus = make_bus(echo=True)
    echo, reply = bus.receive(dxl.ping(1), 0)
    assert echo == Reply(6 * BYTE + USB, dxl.ping(1))
    assert reply.data == dxl.status(1, 0)


def test_split_packet_is_completed_and_lost_rest_times_out() -> None:
    _, bus = make_bus()
    packet = dxl.ping(1)
    assert bus.receive(packet[:3], 0) == []
    (reply,) = bus.receive(packet[3:], 50_000_000)
    assert reply.due_ns == 50_000_000 + 3 * BYTE + DELAY + 6 * BYTE + USB
    bus.receive(b"\xff\xff\x01\x20", 60_000_000)
    assert len(bus.receive(packet, 200_000_000)) == 1


@WILD
@given(
    st.lists(st.one_of(st.binary(max_size=60), st.lists(st.sampled_from([255, 255, 1, 2, 3, 4, 0x83]), max_size=30).map(bytes)))
)
def test_garbage_never_breaks_the_bus(chunks: list[bytes]) -> None:
    _, bus = make_bus(2)
    for i, chunk in enumerate(chunks):
        bus.receive(chunk, i * 1_000_000)
    bus.advance(len(chunks) * 1_000_000)
    bus.receive(b"", 10**10)
    assert bus.receive(dxl.ping(2), 10**11) != []


@WILD
@given(
    st.lists(
        st.one_of(
            st.builds(dxl.write, st.integers(0, 3), st.integers(0, 60), st.binary(min_size=0, max_size=30)),
            st.builds(dxl.encode, st.sampled_from([1, 2, 254]), st.sampled_from(list(Instruction)), st.binary(max_size=12)),
        ),
        max_size=12,
    )
)
def test_random_instructions_leave_tables_in_range(requests: list[bytes]) -> None:
    bank, bus = make_bus(2)
    for i, request in enumerate(requests):
        bus.receive(request, i * 1_000_000)
    bus.advance(10**12)
    bank.step(np.zeros(2), np.zeros(2), np.zeros(2), 0.002)
    for row in range(2):
        for register in dxl.REGISTERS:
            value = int.from_bytes(bank.read(row, register.address, register.size), "little")
            assert register.min <= value <= register.max


# ------------------------------------------------------------------------------------------------------- memory port


def test_memory_port_advances_its_time_by_bus_time() -> None:
    _, bus = make_bus()
    clock = [5_000_000]
    port = MemoryPort(bus, lambda: clock[0])
    port.write(dxl.ping(1))
    assert port.now_ns() == 5_000_000
    assert port.in_waiting == 0
    assert port.read(6) == dxl.status(1, 0)
    assert port.now_ns() == 5_000_000 + 12 * BYTE + DELAY + USB
    clock[0] = 20_000_000
    assert port.now_ns() == 20_000_000


def test_memory_port_timeout_is_virtual_and_late_reply_is_kept() -> None:
    _, bus = make_bus()
    port = MemoryPort(bus, lambda: 0, timeout=0.001)
    port.write(dxl.ping(1))
    assert port.read(6) == b""
    assert port.now_ns() == 1_000_000
    port.timeout = 0.01
    assert port.read(10) == dxl.status(1, 0)
    assert port.now_ns() == 11_000_000
    port.write(dxl.ping(1))
    port.read(1)
    assert port.in_waiting == 5
    port.reset_input_buffer()
    assert port.in_waiting == 0


def test_closed_memory_port_raises_os_error() -> None:
    _, bus = make_bus()
    port = MemoryPort(bus, lambda: 0)
    port.close()
    with pytest.raises(OSError, match="closed"):
        port.write(b"x")


# --------------------------------------------------------------------------------------------------------------- tcp


def receive_exactly(client: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        part = client.recv(count - len(data))
        assert part
        data += part
    return data


def test_tcp_replies_when_due_and_accepts_reconnection() -> None:
    _, bus = make_bus()
    with TcpBusServer(bus) as server:
        for _ in range(2):
            with socket.create_connection(server.address, timeout=5.0) as client:
                start = time.monotonic_ns()
                client.sendall(dxl.ping(1))
                assert receive_exactly(client, 6) == dxl.status(1, 0)
                assert time.monotonic_ns() - start >= 12 * BYTE + DELAY + USB
        assert server.clients == 2
        assert server.url == "socket://{}:{}".format(*server.address)


def test_tcp_server_closes_with_connected_client_and_frees_its_port() -> None:
    _, bus = make_bus()
    server = TcpBusServer(bus)
    address = server.address
    with socket.create_connection(address, timeout=5.0) as client:
        client.sendall(dxl.ping(1))
        receive_exactly(client, 6)
        server.close()
        server.close()
        assert client.recv(1) == b""
    assert not [thread for thread in threading.enumerate() if thread.name == "servo-bus"]
    TcpBusServer(bus, port=address[1]).close()
