"""Joint test: one slow joint motion at a time, after the operator agrees.

Joints that do not move, are overloaded or report an error are named.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sextant.services.actuator.commissioning.joint_test import STEP_DEG, run_joint_test
from sextant.services.actuator.commissioning.watched_motion import way_in_words
from sextant.services.actuator.servo_bus.bus_driver import ServoBus
from sextant.shared.robot.kinematics import leg_forward
from sextant.shared.robot.profile import JOINTS, LEGS, RobotProfile
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.servo_model import Register
from tests.support.builder import Answer, Builder
from tests.support.desk import PHANTOMX, Desk

TORQUE_LIMIT, MOVING_SPEED = 300, 30  # 30 % of the torque, 20 deg/s

TICK_DEG = float(np.degrees(dxl.TICK_RAD))


class Watched(Desk):
    """A desk that records the state of every servo at each packet of the host."""

    def __init__(self) -> None:
        super().__init__()
        self.q: list[np.ndarray] = []
        self.torque: list[np.ndarray] = []
        self.limits: list[np.ndarray] = []
        receive = self.bench.receive

        def noted(data: bytes, now_ns: int) -> list[object]:
            self.q.append(self.bench._q.copy())
            self.torque.append(self.tables[:, dxl.TORQUE_ENABLE.address].astype(bool))
            self.limits.append(self.tables.view("<u2")[:, [17, 16]].copy())
            return receive(data, now_ns)  # type: ignore[return-value]

        self.bench.receive = noted  # type: ignore[method-assign,assignment]


class Agreeing(Builder):
    """A builder who sees each joint move as it should."""

    def ask(self, question: str) -> str:
        self.asked.append(question)
        return "y"


class Watching(Builder):
    """A builder who says of each joint how the foot of the real robot went."""

    def __init__(self, desk: Watched, real: RobotProfile) -> None:
        super().__init__([True])
        self._desk, self._real = desk, real

    def ask(self, question: str) -> str:
        self.asked.append(question)
        name, _, way = question.partition(" and back")[0].partition(": did the ")
        said = way.partition(" foot go ")[2]
        turned = np.array(self._desk.q) - self._desk.q[0]
        furthest = turned[np.abs(turned).max(axis=1).argmax()]
        self._desk.q.clear()
        row = int(np.abs(furthest).argmax())
        leg, joint = divmod(row, 3)
        if name != f"{LEGS[leg]} {JOINTS[joint]}":
            return "a"
        up = 1 if furthest[row] * self._real.servo_signs[leg, joint] > 0 else -1
        return "y" if said == way_in_words(self._real, leg, joint, up) else "w"


def run(desk: Desk, answers: list[Answer], **options: object):  # type: ignore[no-untyped-def]
    builder = Agreeing(answers)
    return run_joint_test(desk.bus(), desk.profile, builder, desk.clock, **options), builder  # type: ignore[arg-type]


@pytest.mark.slow
def test_joints_move_one_at_a_time_at_limited_torque_and_speed() -> None:
    desk = Watched()
    moved, builder = run(desk, [True])
    assert [one.name for one in moved] == [f"{leg} {joint}" for leg in LEGS for joint in JOINTS]
    for one in moved:
        assert one.problem == "", str(one)
        assert abs(one.asked_deg) == pytest.approx(STEP_DEG, abs=TICK_DEG)
        assert one.moved_deg == pytest.approx(one.asked_deg, abs=2 * TICK_DEG)
        assert one.back_deg == pytest.approx(0.0, abs=2 * TICK_DEG)
        assert one.load <= TORQUE_LIMIT / 1000
        assert (one.voltage, one.temperature) == (pytest.approx(12.5, abs=0.2), 25.0)
    torque, limits = np.array(desk.torque), np.array(desk.limits)
    assert torque.sum(axis=1).max() == 1
    assert (limits[torque] == [TORQUE_LIMIT, MOVING_SPEED]).all()
    way = np.degrees(np.ptp(np.array(desk.q), axis=0))
    assert (np.abs(way - STEP_DEG) < 2.0).all()
    assert not desk.tables[:, dxl.TORQUE_ENABLE.address].any()
    assert "torque is off" in builder.told[-1]


@pytest.mark.parametrize("joint", [1, 2])
def test_foot_goes_up_or_outward_whether_its_leg_is_straight_or_hangs(joint: int) -> None:
    assert way_in_words(PHANTOMX, 0, joint, 1) == "up or outward"
    assert way_in_words(PHANTOMX, 0, joint, -1) == "down or inward"
    for pose in ((0.0, 0.0, 0.0), (0.0, -80.0, 0.0), (0.0, -70.0, -30.0), (0.0, 0.0, -115.0)):
        turned = np.radians(pose) + np.radians(STEP_DEG) * (np.arange(3) == joint)
        outward, _, up = leg_forward(turned, PHANTOMX.links) - leg_forward(np.radians(pose), PHANTOMX.links)
        assert max(outward, up, key=abs) > 0.0


@pytest.mark.slow
def test_reported_directions_match_visible_motion() -> None:
    moved, _ = run(Desk(), [True])
    ways = {one.name: one.way for one in moved}
    assert {ways[f"{leg} femur"] for leg in LEGS} == {"up or outward"}
    coxa = {leg: ways[f"{leg} coxa"] for leg in LEGS}
    # All coxae turn counterclockwise from above: the left legs move backward, the right legs forward.
    assert coxa == {leg: "backward" if leg.startswith("left") else "forward" for leg in LEGS}


def test_joint_test_moves_nothing_without_confirmation() -> None:
    desk = Watched()
    moved, builder = run(desk, [False])
    assert moved is None
    assert not np.array(desk.torque).any()
    assert (np.array(desk.q) == desk.q[0]).all()
    assert "nothing was moved" in builder.told[-1]


@pytest.mark.parametrize("hold", [True, False])
def test_final_torque_state_follows_operator_choice(hold: bool) -> None:
    desk = Desk()
    _, builder = run(desk, [True, hold], legs=LEGS[:1], hold_after=None)
    desk.settle()
    assert desk.tables[:, dxl.TORQUE_ENABLE.address].all() == hold
    assert builder.told[-1] == ("torque is on: the legs hold their present positions" if hold else "torque is off")
    words = desk.tables.view("<u2")
    assert (np.abs(words[:, 15].astype(int) - words[:, 18]) <= 1).all() or not hold  # each goal equals the joint's position


def test_blocked_joint_is_named() -> None:
    desk = Desk()
    row = desk.row(3)
    start = desk.bench._q[row]
    step = desk.bench._servos.step

    def stuck(q: np.ndarray, qd: np.ndarray, torque: np.ndarray, dt: float) -> object:
        desk.bench._q[row] = start
        return step(q, qd, torque, dt)

    desk.bench._servos.step = stuck  # type: ignore[method-assign,assignment]
    moved, _ = run(desk, [True], legs=LEGS[:1])
    problems = {one.name: one.problem for one in moved}
    assert "did not reach its goal: an obstacle blocks it" in problems["left front femur"]
    assert problems["left front coxa"] == problems["left front tibia"] == ""


def test_torque_is_off_after_interrupt_during_motion() -> None:
    desk = Watched()
    receive = desk.bench.receive

    def interrupted(data: bytes, now_ns: int) -> list[object]:
        if desk.torque and desk.torque[-1].any() and len(desk.torque) > 400:
            desk.torque.clear()
            raise KeyboardInterrupt
        return receive(data, now_ns)  # type: ignore[return-value]

    desk.bench.receive = interrupted  # type: ignore[method-assign,assignment]
    with pytest.raises(KeyboardInterrupt):
        run(desk, [True])
    desk.bench.receive = receive  # type: ignore[method-assign]
    desk.settle()
    words = desk.tables.view("<u2")
    assert not desk.tables[:, dxl.TORQUE_ENABLE.address].any()
    assert (words[:, 17] == 1023).all()
    assert (words[:, 16] == 0).all()


@pytest.mark.slow
def test_wrong_sign_and_exchanged_ids_are_found_by_who_watches() -> None:
    """Check a robot whose left front femur is reversed, and whose coxae of the middle legs have each other's ids."""
    desk, legs = Watched(), list(PHANTOMX.legs)
    coxa, femur, tibia = legs[0].servo_signs
    legs[0] = replace(legs[0], servo_signs=(coxa, -femur, tibia))
    (a, *others), (b, *more) = legs[2].servo_ids, legs[5].servo_ids
    legs[2], legs[5] = replace(legs[2], servo_ids=(b, *others)), replace(legs[5], servo_ids=(a, *more))
    wrong = replace(PHANTOMX, legs=tuple(legs))  # type: ignore[arg-type]
    bus = ServoBus(desk.open(), list(wrong.servo_names), desk.clock, model=wrong.servo_model, names=wrong.servo_names)
    builder = Watching(desk, PHANTOMX)
    moved = run_joint_test(bus, wrong, builder, desk.clock)
    assert moved is not None
    problems = {one.name: one.problem for one in moved if one.problem}
    assert list(problems) == ["left front femur", "right middle coxa", "left middle coxa"]
    assert "change the sign of the femur in the leg's servo_signs" in problems["left front femur"]
    assert f"another joint moved, which has id {b}" in problems["right middle coxa"]
    assert problems["right middle coxa"].endswith("then calibrate the legs of both again")  # trims belong to the servos


def test_motion_is_repeated_until_it_is_seen_and_not_asked_of_an_absent_operator() -> None:
    desk = Watched()
    builder = Builder([True, "r", "what?", "y", "n", "y"])
    moved = run_joint_test(desk.bus(), desk.profile, builder, desk.clock, legs=LEGS[:1])
    assert moved is not None
    assert [one.problem for one in moved] == ["", "did not move", ""]
    assert [question.partition(":")[0] for question in builder.asked[1:4]] == ["left front coxa"] * 3
    assert "one of y, w, a, n and r expected" in builder.told
    absent = Builder([True], absent=True)
    assert run_joint_test(desk.bus(), desk.profile, absent, desk.clock, legs=LEGS[:1]) is not None


def interrupt_joint_test(desk: Desk, when: Callable[[bytes], bool], answers: list[Answer], hold_after: bool) -> Builder:
    """Raise Ctrl-C at the first packet for which `when` is true; return the builder."""
    receive = desk.bench.receive

    def interrupted(data: bytes, now_ns: int) -> list[object]:
        if when(data):
            desk.bench.receive = receive  # type: ignore[method-assign]
            raise KeyboardInterrupt
        return receive(data, now_ns)  # type: ignore[return-value]

    desk.bench.receive = interrupted  # type: ignore[method-assign,assignment]
    builder = Agreeing(answers)
    with pytest.raises(KeyboardInterrupt):
        run_joint_test(desk.bus(), desk.profile, builder, desk.clock, legs=LEGS[:1], hold_after=hold_after)
    desk.settle()
    return builder


@pytest.mark.parametrize(
    "register", [dxl.TORQUE_ENABLE, dxl.MOVING_SPEED, dxl.TORQUE_LIMIT], ids=lambda register: register.name
)
def test_interrupt_during_joint_torque_off_still_completes_it(register: Register) -> None:
    desk = Desk()
    row, released = desk.row(1), False

    def in_the_midst(data: bytes) -> bool:
        nonlocal released
        released |= data == dxl.write(dxl.BROADCAST_ID, dxl.TORQUE_ENABLE.address, b"\0")
        return released and data[4:6] == bytes((dxl.Instruction.WRITE, register.address))

    builder = interrupt_joint_test(desk, in_the_midst, [True], hold_after=False)
    words = desk.tables.view("<u2")
    assert not desk.tables[:, dxl.TORQUE_ENABLE.address].any()
    assert (words[row, dxl.TORQUE_LIMIT.address // 2], words[row, dxl.MOVING_SPEED.address // 2]) == (1023, 0)
    assert builder.told[-1] == "torque is off"


def test_interrupt_during_final_torque_on_turns_all_torque_off() -> None:
    desk = Desk()
    builder = interrupt_joint_test(
        desk, lambda data: desk.tables[:, dxl.TORQUE_ENABLE.address].sum() > 5, [True], hold_after=True
    )
    assert not desk.tables[:, dxl.TORQUE_ENABLE.address].any()
    assert builder.told[-1] == "torque is off"
