"""Servo bus driver under every fault of the grid.

Calls end in time, losses are counted and no wrong reading is accepted.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.actuator.servo_bus.bus_driver import REPLY_TIMEOUT_NS, BusDisconnectedError, Lost, ServoBus
from sextant.services.actuator.servo_bus.reading_validation import Implausibility
from sextant.services.simulator.servo_bus.bus import ServoBusEmulator
from sextant.services.simulator.servo_bus.bus_faults import BusFaults
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.bus_fault import GRID, BusFault
from sextant.shared.wire.messages import FaultKind, FaultTarget

WILD = settings(deadline=None, derandomize=True, max_examples=150)
IDS = tuple(range(1, 19))
CYCLE_NS, MS = 20_000_000, 1_000_000
BUDGET_NS = 6_500_000
CELLS = sorted(GRID)
MOVE = 120  # [ticks] amplitude of the joints' motion, once a second


class Rig:
    """Eighteen servos that follow their goals, their faults, and a driver.

    The driver reads the servos and sends goals in every cycle.
    """

    def __init__(self, *faults: BusFault, seed: int = 0, echo: bool = False) -> None:
        self.now_ns = 0
        self.bank = ServoBank(IDS)
        self.bus = BusFaults(ServoBusEmulator(self.bank, echo=echo), self.bank, seed)
        self.port = MemoryPort(self.bus, lambda: self.now_ns)
        self.driver = ServoBus(self.port, IDS, self.port.now_ns, echo=echo)
        self.driver.setup()
        self.driver.set_torque(True)
        self.begin_ns = self.now_ns = self.port.now_ns() + CYCLE_NS
        self.bus.origin_ns = self.begin_ns
        for fault in faults:
            self.bus.inject(fault, self.now_ns)
        self.true = np.zeros(18, dtype=np.int64)
        self.off: list[int] = []  # [ticks] error of accepted readings against the measured positions

    def cycle(self) -> int:
        """Run one control cycle; return the number of accepted readings.

        A cycle takes at most its budget and one timeout.
        """
        phase = (self.now_ns - self.begin_ns) * 1e-9 * 2.0 * math.pi + np.arange(18)
        goals = np.rint(512 + MOVE * np.sin(phase)).astype(int)
        q = np.array([dxl.angle_from_ticks(ticks) for ticks in goals])
        self.bus.advance(self.now_ns)
        self.bank.step(q, np.zeros(18), np.full(18, 0.1), CYCLE_NS * 1e-9)
        start = self.port.now_ns()
        readings = self.driver.poll(BUDGET_NS)
        assert self.port.now_ns() - start <= BUDGET_NS + REPLY_TIMEOUT_NS
        self.off += [r.position_ticks - int(goals[r.index]) for r in readings]
        self.driver.sync_write_goals(goals)
        self.now_ns = max(self.now_ns + CYCLE_NS, self.port.now_ns())
        return len(readings)

    def run(self, cycles: int) -> int:
        return sum(self.cycle() for _ in range(cycles))


def of(target: FaultTarget, kind: FaultKind, at_s: float = 0.0, **parameters: object) -> BusFault:
    if GRID[target, kind].needs_servo:
        parameters.setdefault("servo", 7)
    return BusFault(target, kind, at_s, **parameters)  # type: ignore[arg-type]


def test_clean_bus_loses_no_readings() -> None:
    rig = Rig()
    assert rig.run(100) >= 300
    assert not rig.driver.lost
    assert rig.driver.loss == 0.0
    assert set(rig.off) == {0}


LATE = 20  # [ticks] motion of a joint in a cycle, in which a reply may arrive after the next request

# Faults that produce false values by nature: a register that is stuck or wrong, or an old reply.
LIARS = (("servo", "stuck"), ("servo", "wrong"), ("packets", "stuck"), ("bus", "wrong"))


@pytest.mark.slow
@pytest.mark.parametrize("echo", [False, True], ids=["plain", "echo"])
@pytest.mark.parametrize("cell", CELLS, ids=" ".join)
def test_each_fault_keeps_time_budget_and_bus_recovers_afterwards(cell: tuple[FaultTarget, FaultKind], echo: bool) -> None:
    extra = {"share": 0.1 if cell[0] == "packets" else 0.0075} if "share" in GRID[cell].takes else {}
    rig = Rig(of(*cell, at_s=0.2, for_s=1.0, **extra), echo=echo)
    rig.run(9)
    if cell == ("bus", "gone"):
        with pytest.raises(BusDisconnectedError, match="the servo port is gone"):
            rig.run(10)
        return
    rig.run(60)
    if cell[1] == "slow":
        assert np.abs(rig.off).max(initial=0) <= LATE
    elif cell not in LIARS:
        assert set(rig.off) <= {0}
    rig.run(60)
    rig.off.clear()
    lost = rig.driver.lost
    assert rig.run(60) >= 200
    assert rig.driver.lost == lost
    assert rig.driver.ages().max() < 0.2
    assert set(rig.off) == {0}


@pytest.mark.slow
@WILD
@given(
    st.lists(st.tuples(st.sampled_from(CELLS), st.floats(0, 0.4), st.floats(0.01, 1.0), st.floats(0.005, 1.0)), max_size=4),
    st.integers(0, 5),
    st.booleans(),
)
def test_random_faults_raise_only_bus_disconnected_and_keep_time_budget(
    faults: list[tuple[tuple[FaultTarget, FaultKind], float, float, float]], seed: int, echo: bool
) -> None:
    made = []
    for cell, at_s, for_s, share in faults:
        extra = {"share": share} if "share" in GRID[cell].takes else {}
        made.append(of(*cell, at_s=at_s, for_s=for_s, **extra))
    rig = Rig(*made, seed=seed, echo=echo)
    gone = any(fault.kind == "gone" for fault in made)
    for _ in range(40):
        try:
            rig.cycle()
        except BusDisconnectedError:
            assert gone
            break
        assert 0.0 <= rig.driver.loss <= 1.0


@pytest.mark.slow
def test_wrong_values_with_valid_checksum_are_rejected_by_reason() -> None:
    rig = Rig(of("packets", "wrong", share=0.1, for_s=60.0))
    assert rig.run(1500) > 3000
    assert set(rig.off) == {0}
    assert rig.driver.lost[Implausibility.RANGE] > 300
    rig = Rig(of("packets", "wrong", share=0.1, for_s=60.0, part="error"))
    rig.run(500)
    assert set(rig.off) == {0}
    assert rig.driver.lost[Implausibility.ERROR] > 40
    assert not rig.driver.errors.any()


@pytest.mark.parametrize(("part", "reason"), [("id", Lost.STRANGER), ("length", Lost.SIZE)])
def test_replies_with_wrong_id_or_length_are_rejected(part: str, reason: Lost) -> None:
    rig = Rig(of("packets", "wrong", share=0.1, for_s=60.0, part=part))
    rig.run(500)
    assert set(rig.off) == {0}
    assert rig.driver.lost[reason] > 50


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_packet_loss_matches_share_of_lost_requests(share: float) -> None:
    rig = Rig(of("packets", "silent", share=share, for_s=1000.0))
    found = []
    for _ in range(300):
        rig.cycle()
        found.append(rig.driver.loss)
    assert 0.6 * share < np.mean(found[20:]) < 1.6 * share  # a loss takes the time of several requests


def test_silent_bus_is_detected_in_200_ms_but_silent_servo_is_no_bus_loss() -> None:
    rig = Rig(of("bus", "silent", at_s=1.0))
    rig.run(50)
    assert rig.driver.loss == 0.0
    rig.run(11)
    assert rig.driver.loss == 1.0
    rig = Rig(of("servo", "silent", at_s=1.0, for_s=10.0))
    rig.run(150)
    assert rig.driver.loss < 0.15
    ages = rig.driver.ages()
    assert ages.argmax() == 6
    assert ages[6] > 1.9
    assert np.delete(ages, 6).max() < 0.2


def test_returning_bus_is_read_again_within_1_s() -> None:
    rig = Rig(of("bus", "silent", at_s=0.2, for_s=5.0))
    rig.run(round(5.2 / 0.02) + 1)
    rig.run(50)
    assert rig.driver.ages().max() < 0.2


@pytest.mark.slow
def test_1_percent_packet_loss_keeps_readings_within_two_rotations() -> None:
    clean = Rig()
    rotation = max(clean.driver.ages().max() for _ in range(100) if clean.cycle() and np.isfinite(clean.driver.ages()).all())
    for fault in (of("packets", "silent", share=0.01, for_s=60.0), of("bytes", "garbage", share=0.0007, for_s=60.0)):
        rig = Rig(fault)
        rig.run(20)
        ages = []
        for _ in range(1000):
            rig.cycle()
            ages.append(rig.driver.ages().max())
        assert np.percentile(ages, 99) < 2.0 * rotation
        assert set(rig.off) == {0}


def share_of_cycles_with_goals_received(rig: Rig, cycles: int) -> float:
    """Return the share of cycles after which all servos hold the goals that were sent."""
    good = 0
    for _ in range(cycles):
        rig.cycle()
        rig.bus.advance(rig.now_ns)
        sent = rig.driver._writes._rows[0]._goals
        good += int((rig.bank.tables.view("<u2")[:, dxl.GOAL_POSITION.address // 2] == sent).all())
    return good / cycles


def test_goals_are_sent_twice_while_replies_are_corrupted() -> None:
    clean, broken = Rig(), Rig(of("bytes", "garbage", share=0.001, for_s=60.0))
    assert share_of_cycles_with_goals_received(clean, 100) == 1.0
    assert clean.bus._bus.counts.instructions[dxl.Instruction.SYNC_WRITE] == 101  # one of them for torque
    assert share_of_cycles_with_goals_received(broken, 1000) > 0.97  # 9 % of these packets are broken, and 3 % of the requests


def test_torque_off_reaches_servos_that_await_a_truncated_packet() -> None:
    rig = Rig(of("packets", "silent", for_s=0.04, share=1.0))
    rig.run(3)
    rig.bus.receive(b"\xff\xff\x01\xff\x03", rig.now_ns)  # its length field announces 253 more bytes
    rig.driver.set_torque(False)
    rig.bus.advance(rig.now_ns + CYCLE_NS)
    assert not rig.bank.tables[:, dxl.TORQUE_ENABLE.address].any()
