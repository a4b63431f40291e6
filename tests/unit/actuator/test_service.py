"""The actuator whole, on emulated servos that go where they are told: orders, plans, faults, a new beginning."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from services.actuator.config import Settings
from services.actuator.goal_limits import GENTLE, LOWERED
from services.actuator.latch import Latch
from services.actuator.load import lag_feed_forward
from services.actuator.service import Actuator
from services.actuator.walker import Walker
from services.simulator.bus import MemoryPort, ServoBusEmulator
from services.simulator.servos import ServoBank
from shared import codec, topics
from shared import dynamixel as dxl
from shared.geometry import Array, apply, from_xyz_rpy, inverse, rotation_from_rpy
from shared.kinematics import body_forward, body_inverse, joint_torques
from shared.messages import ActuatorState, Imu, Message, Mode, ModeCommand, Odometry, StepPlan, Tick
from shared.profiles import load_profile
from shared.robot import RobotProfile
from shared.service import Inbox

PROFILE = load_profile("phantomx_mk2")
REST = PROFILE.rest_feet()
IDS = PROFILE.servo_ids.ravel().tolist()
PERIOD = 20_000_000
TRIPOD = np.arange(6) % 2 == 0
TICK = dxl.TICK_RAD
OUT = np.column_stack([PROFILE.T_body_coxa[:, :2, 0], np.zeros(6)])
UP = np.array([0.0, 0.0, 1.0])
STILL = 0.02  # [rad] of goals: sag that is integrated away, and rounding to ticks
CRAWL = PROFILE.rest_feet(0.03) + 0.05 * OUT


class Rig:
    """Servos on a bus, and the actuator that owns them. A servo with torque is at its goal a cycle later."""

    def __init__(self, feet: Array = REST, torque: bool = True, latch: Latch | None = None) -> None:
        self.now_ns = 0
        self.latch = latch
        q = PROFILE.servo_angles(body_inverse(PROFILE, feet)).ravel()
        self.bank = ServoBank(IDS, q=q)
        for row, angle in enumerate(q):
            self.bank.write(row, dxl.GOAL_POSITION.address, dxl.GOAL_POSITION.encode(dxl.ticks_from_angle(angle)))
            self.bank.write(row, dxl.TORQUE_ENABLE.address, bytes([torque]))
        self.bus = ServoBusEmulator(self.bank)
        self.push = np.zeros((6, 3))  # [N] {body} on the feet, as the servos feel it, besides what the ground gives
        self.ground = np.full(6, True)  # legs that stand on something when they are down
        self.order = 0
        self.ordered: ModeCommand | None = None
        self.leads = True  # the planner sends the running step again and again, and the operator the order
        self.running: StepPlan | None = None
        self.stuck: dict[int, float] = {}  # [rad] joints (0 to 17) that stay where they are, whatever they are told
        self.state: ActuatorState | None = None
        self.start()

    def start(self) -> None:
        """A new actuator on the same servos."""
        self.port = MemoryPort(self.bus, lambda: self.now_ns)
        self.actuator = Actuator(PROFILE, Settings(), lambda: self.port, self.port.now_ns, self.latch)
        self.inbox = Inbox(self.actuator.reads, self.actuator.stages)
        self.now_ns = self.port.now_ns()

    @property
    def goals(self) -> Array:
        """Joint angles (6, 3) that the servos are told."""
        ticks = [int.from_bytes(self.bank.read(row, dxl.GOAL_POSITION.address, 2), "little") for row in range(18)]
        return PROFILE.joint_angles(np.array([dxl.angle_from_ticks(t) for t in ticks]).reshape(6, 3))

    @property
    def torque(self) -> bool:
        return all(self.bank.read(row, dxl.TORQUE_ENABLE.address, 1) == b"\x01" for row in range(18))

    def hear(self, message: Message) -> None:
        if isinstance(message, StepPlan):
            self.running = message
        self.inbox.receive(topics.OF_TYPE[type(message)], codec.encode(message), self.now_ns)

    def command(self, mode: str) -> None:
        self.order += 1
        self.ordered = ModeCommand(self.now_ns, mode, self.order)  # type: ignore[arg-type]
        self.hear(self.ordered)

    def lead(self) -> None:
        """What operator and planner say as long as they are there."""
        state, plan = self.state, self.running
        if self.ordered is not None and self.now_ns % (25 * PERIOD) < PERIOD:
            self.hear(replace(self.ordered, stamp_ns=self.now_ns))
        if state is None or plan is None or state.phase >= 1.0 or self.now_ns % (4 * PERIOD) >= PERIOD:
            return
        if plan.step == state.step:
            self.hear(replace(plan, stamp_ns=self.now_ns, revision=plan.revision + 1))

    def cycle(self, count: int = 1) -> ActuatorState:
        """Let cycles pass; the last state."""
        for _ in range(count):
            self.now_ns = max(self.now_ns + PERIOD, self.port.now_ns())
            self.bus.advance(self.now_ns)
            q = self.goals if self.torque else PROFILE.joint_angles(self.bank._q.reshape(6, 3))
            q.flat[list(self.stuck)] = list(self.stuck.values())
            low = body_forward(PROFILE, q)[:, 2]
            weight = 4.0 * (self.ground & (low < low[self.ground].min(initial=1.0) + 0.005))[:, None] * [0.0, 0.0, 1.0]
            torque = PROFILE.servo_signs * joint_torques(PROFILE, q, weight + self.push)
            self.bank.step(PROFILE.servo_angles(q).ravel(), np.zeros(18), torque.ravel(), 0.02)
            self.inbox.now_ns = self.now_ns
            if self.leads:
                self.lead()
            self.made = list(self.actuator.step(Tick(self.now_ns), self.inbox))
            self.state = next((m for m in self.made if isinstance(m, ActuatorState)), self.state)
        assert self.state is not None
        return self.state  # the last word: it speaks every other cycle, and when there is news

    def plan(self, state: ActuatorState, x: float = 0.04, **changes: Any) -> StepPlan:
        """The next step straight ahead, {world} being {odom}."""
        goal = state.body_ref @ from_xyz_rpy((x, 0.0, 0.0), np.zeros(3))
        feet = apply(state.T_odom_body, state.feet)
        swing = TRIPOD if (state.step + 1) % 2 else ~TRIPOD
        touchdown = np.where(swing[:, None], apply(goal, REST + np.array([x / 2, 0.0, 0.0])), feet)
        touchdown[:, 2] = feet[:, 2]
        plan = StepPlan(
            stamp_ns=state.stamp_ns,
            epoch=state.epoch,
            step=state.step + 1,
            revision=1,
            T_world_odom=np.eye(4),
            swing=swing,
            touchdown=touchdown,
            clearance=np.full(6, 0.03),
            body_goal=goal,
            duration=0.6,
            stop=False,
        )
        return replace(plan, **changes)

    def joint(self, row: int) -> float:
        """[rad] where a joint (0 to 17) is."""
        return float(PROFILE.joint_angles(self.bank._q.reshape(6, 3)).flat[row])

    def air(self, state: ActuatorState) -> NDArray[np.bool_]:
        """(6,) feet that are over the others."""
        heights = apply(state.T_odom_body, state.feet)[:, 2]
        return np.asarray(heights > heights.min() + 0.01)

    def walking(self) -> ActuatorState:
        """Ordered to walk and standing."""
        self.cycle(2)
        self.command("walk")
        return self.cycle()


def test_torque_stays_as_it_was_found() -> None:
    for torque in (True, False):
        rig = Rig(torque=torque)
        state = rig.cycle(5)
        assert rig.torque == torque
        assert state.mode == (Mode.HOLD if torque else Mode.OFF)


def test_a_standing_robot_is_taken_over_without_a_twitch() -> None:
    rig = Rig()
    before = rig.goals
    states = []
    for _ in range(20):
        goals = rig.goals
        states.append(rig.cycle())
        assert np.abs(rig.goals - goals).max() <= GENTLE * 1e-9 * PERIOD + dxl.TICK_RAD
    # What is added is the load's sag, once; then nothing moves.
    after = rig.goals
    assert np.abs(after - before).max() < 0.08
    assert np.abs(states[-1].feet - states[-2].feet).max() < 1e-3


def test_off_writes_no_goals() -> None:
    rig = Rig(CRAWL, torque=False)
    before = rig.goals
    rig.cycle(20)
    np.testing.assert_array_equal(rig.goals, before)


def test_stand_raises_a_lying_robot_to_rest() -> None:
    rig = Rig(CRAWL, torque=False)
    rig.cycle(2)
    rig.command("stand")
    assert rig.cycle().mode is Mode.STAND
    assert rig.cycle(2).mode is Mode.STAND
    state = rig.cycle(round(Settings().stand_s * 50))
    assert rig.torque
    assert state.mode is Mode.HOLD
    assert state.reason == "standing"
    feet = body_forward(PROFILE, rig.goals)
    np.testing.assert_allclose(feet[:, :2], (REST + 0.03 * OUT)[:, :2], atol=0.03)
    assert (feet[:, 2] < REST[:, 2] + 2e-3).all()  # the sag is fed forward: beyond, never short


def test_an_order_counts_once() -> None:
    rig = Rig()
    rig.cycle()
    rig.command("stand")
    rig.cycle()
    rig.hear(ModeCommand(rig.now_ns, "off", rig.order))  # a number that was used
    assert rig.cycle().mode is Mode.STAND
    assert rig.torque


def test_standing_up_again_is_no_leap() -> None:
    rig = Rig()
    rig.cycle(5)
    before = rig.goals
    rig.command("stand")
    rig.cycle(2)
    assert np.abs(rig.goals - before).max() < 0.02


def test_off_is_obeyed_at_once() -> None:
    rig = Rig()
    rig.walking()
    rig.command("off")
    rig.cycle(2)
    assert not rig.torque
    rig.command("walk")  # leads nowhere from there
    state = rig.cycle(2)
    assert state.mode is Mode.OFF
    assert not rig.torque


def test_an_order_to_let_go_outlives_the_process_and_a_new_order_alone_undoes_it(tmp_path: Path) -> None:
    latch = Latch(tmp_path / "off")
    rig = Rig(latch=latch)
    rig.walking()
    rig.command("off")
    rig.cycle(2)
    assert latch.closed
    rig.bank.tables[:, dxl.TORQUE_ENABLE.address] = 1  # it was never heard: the bus was gone
    before = rig.goals
    rig.start()  # a new process on servos that pull
    rig.bus.advance(rig.now_ns)
    assert not rig.torque, "before anything else"
    np.testing.assert_array_equal(rig.goals, before)
    rig.leads = False
    assert rig.cycle(50).mode is Mode.OFF
    rig.command("stand")
    assert rig.cycle(2).mode is Mode.STAND
    assert rig.torque
    assert not latch.closed


def test_a_new_process_lets_go_before_it_asks_anything(tmp_path: Path) -> None:
    latch = Latch(tmp_path / "off")
    rig = Rig(latch=latch)
    latch.close()
    heard: list[bytes] = []
    rig.bus.overhear = lambda data, _: heard.append(data)
    rig.start()
    assert heard[0] == dxl.write(dxl.BROADCAST_ID, dxl.TORQUE_ENABLE.address, b"\0")


def test_the_stop_path_is_obeyed_without_a_word_on_the_wire(tmp_path: Path) -> None:
    latch = Latch(tmp_path / "off")
    rig = Rig(latch=latch)
    rig.walking()
    latch.close()
    state = rig.cycle(2)
    assert state.mode is Mode.OFF
    assert not rig.torque


class LateLatch(Latch):
    """One that somebody else closes as soon as it has been looked at, once that is wished for."""

    armed = False

    @property
    def closed(self) -> bool:
        was = super().closed
        if self.armed:
            self.close()
        return was


def test_an_order_to_let_go_that_comes_in_mid_cycle_comes_before_any_goal(tmp_path: Path) -> None:
    """As where the process was stopped after it had looked, and goes on for long after."""
    latch = LateLatch(tmp_path / "off")
    rig = Rig(latch=latch)
    rig.walking()
    heard: list[bytes] = []
    rig.bus.overhear = lambda data, _: heard.append(data)
    latch.armed = True
    rig.cycle(3)
    writes = [data[5] for data in heard if data[4] in (dxl.Instruction.WRITE, dxl.Instruction.SYNC_WRITE)]  # the address
    assert writes[0] == dxl.TORQUE_ENABLE.address
    assert dxl.GOAL_POSITION.address not in writes
    assert not rig.torque


def test_goals_of_a_cycle_in_which_the_process_was_stopped_for_long_are_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    state = rig.walking()
    rig.hear(rig.plan(state))
    rig.cycle(5)
    heard: list[bytes] = []
    rig.bus.overhear = lambda data, _: heard.append(data)
    read = rig.port.read

    def stopped(size: int = 1) -> bytes:
        data, rig.now_ns = read(size), rig.port.now_ns() + 2_000_000_000
        monkeypatch.undo()
        return data

    monkeypatch.setattr(rig.port, "read", stopped)
    rig.cycle()
    assert len(heard) >= 1, "it has asked"
    assert not [data for data in heard if data[4] == dxl.Instruction.SYNC_WRITE]
    rig.cycle()
    assert [data for data in heard if data[4] == dxl.Instruction.SYNC_WRITE and data[5] == dxl.GOAL_POSITION.address]


def test_without_the_order_to_walk_a_plan_is_refused_in_words() -> None:
    rig = Rig()
    rig.hear(rig.plan(rig.cycle(2)))
    state = rig.cycle()
    assert state.mode is Mode.HOLD
    assert "not ordered to walk" in state.refused
    assert "not ordered to walk" in rig.actuator.doing()


def test_a_plan_is_walked_to_its_end_and_then_it_holds_with_torque_on() -> None:
    rig = Rig()
    state = rig.walking()
    start, plan = state.T_odom_body, rig.plan(state)
    rig.hear(plan)
    modes, phases = [], []
    for _ in range(40):
        state = rig.cycle()
        modes.append(state.mode)
        phases.append(state.phase)
    assert modes[0] is Mode.WALK
    assert modes[-1] is Mode.HOLD
    assert "no new plan came" in state.reason
    assert rig.torque
    assert state.step == plan.step
    assert (np.diff(phases) >= 0).all()
    assert phases[-1] == 1.0
    assert state.refused == ""
    assert (inverse(start) @ state.T_odom_body)[0, 3] == pytest.approx(0.04, abs=0.015)
    held = rig.goals
    rig.cycle(50)
    assert np.abs(rig.goals - held).max() < 4.5 * dxl.TICK_RAD


def test_the_odometry_is_that_of_the_joints() -> None:
    rig = Rig()
    state = rig.walking()
    for _ in range(3):
        rig.hear(rig.plan(state))
        state = rig.cycle(45)
    if len(rig.made) == 1:  # odometry alone: the state comes with the next
        state = rig.cycle()
    odometry = next(m for m in rig.made if isinstance(m, Odometry))
    assert odometry.reliable
    assert odometry.stance.all()
    assert odometry.stamp_ns == state.stamp_ns
    np.testing.assert_array_equal(odometry.T_odom_body, state.T_odom_body)
    np.testing.assert_allclose(state.T_odom_body[:2, 3], state.body_ref[:2, 3], atol=5e-3)
    assert odometry.travelled >= np.linalg.norm(state.T_odom_body[:2, 3]) - 1e-9


def test_a_refused_plan_changes_nothing() -> None:
    rig = Rig()
    state = rig.walking()
    rig.hear(rig.plan(state, duration=99.0))
    after = rig.cycle()
    assert after.mode is Mode.HOLD
    assert "99.00 s" in after.refused
    assert after.step == state.step
    rig.hear(rig.plan(after))
    assert rig.cycle().refused == ""


def test_an_old_plan_is_refused() -> None:
    rig = Rig()
    state = rig.walking()
    plan = rig.plan(state)
    rig.cycle(60)
    rig.hear(plan)
    assert "s old" in rig.cycle().refused


def test_the_next_plan_waits_and_joins_on() -> None:
    rig = Rig()
    state = rig.walking()
    first = rig.plan(state)
    rig.hear(first)
    state = rig.cycle(26)  # so that it does not wait for longer than the deadline: nobody renews it
    swing = ~first.swing
    goal = first.body_goal @ from_xyz_rpy((0.04, 0.0, 0.0), np.zeros(3))
    touchdown = np.where(swing[:, None], apply(goal, REST + np.array([0.02, 0.0, 0.0])), first.touchdown)
    touchdown[:, 2] = first.touchdown[:, 2]
    rig.hear(replace(first, stamp_ns=state.stamp_ns, step=first.step + 1, swing=swing, touchdown=touchdown, body_goal=goal))
    state = rig.cycle()
    assert state.refused == ""
    assert state.step == first.step
    modes = []
    for _ in range(20):
        state = rig.cycle()
        modes.append(state.mode)
    assert state.step == first.step + 1
    assert set(modes) == {Mode.WALK}


def shut_down(rig: Rig, row: int) -> None:
    rig.bank._faults[row] = int(dxl.ServoError.OVERLOAD)


def test_a_servo_that_was_left_weak_is_named_and_taken_up_by_order_alone() -> None:
    rig = Rig()
    row = IDS.index(9)
    rig.bank.write(row, dxl.TORQUE_LIMIT.address, dxl.TORQUE_LIMIT.encode(300))
    rig.start()
    state = rig.cycle(5)
    words = (
        "the femur servo of the left rear leg (id 9) was left with 29% of its torque; order `ready` to turn it up where it is"
    )
    assert (state.mode, words in state.warnings) == (Mode.FAULT, True)
    rig.command("ready")
    state = rig.cycle(2)
    assert state.mode is Mode.READY
    assert words not in state.warnings
    assert rig.bank.read(row, dxl.TORQUE_LIMIT.address, 2) == dxl.TORQUE_LIMIT.encode(dxl.TORQUE_LIMIT.max)


def test_a_servo_that_shuts_down_is_named_and_the_robot_holds() -> None:
    rig = Rig()
    state = rig.walking()
    rig.hear(rig.plan(state))
    rig.cycle(5)
    shut_down(rig, IDS.index(16))
    state = rig.cycle(5)
    assert state.mode is Mode.FAULT
    words = "the femur servo of the right middle leg (id 16) has shut down for its load"
    assert state.reason == words
    rig.hear(rig.plan(state))
    assert words in rig.cycle().refused
    assert rig.torque
    rig.command("stand")
    state = rig.cycle(2)
    assert state.mode is Mode.FAULT
    assert f"`stand` refused: {words}" in state.warnings


def test_an_overloaded_servo_is_reset_where_it_is_three_times_and_then_the_robot_lies_down_and_lets_go() -> None:
    rig = Rig()
    rig.walking()
    row = IDS.index(16)
    for _ in range(3):
        rig.bank.write(row, dxl.TORQUE_LIMIT.address, bytes(2))
        shut_down(rig, row)
        assert rig.cycle(8).mode is Mode.FAULT
        state = rig.cycle(150)
        assert state.mode is Mode.HOLD
        assert state.reason == "what was broken is whole again"
        assert rig.bank.read(row, dxl.TORQUE_LIMIT.address, 2) == dxl.TORQUE_LIMIT.encode(1023)
    shut_down(rig, row)
    assert rig.cycle(40).mode is Mode.FAULT
    assert rig.cycle(60).mode is Mode.SIT
    state = rig.cycle(200)
    assert state.mode is Mode.OFF
    assert "4 times in 5 minutes" in state.reason
    assert not rig.torque


def test_nobody_walks_on_before_a_servo_that_was_reset_is_where_the_others_are() -> None:
    rig = Rig()
    rig.hear(rig.plan(rig.walking()))
    state = rig.cycle(14)
    assert rig.air(state)[4]
    row = IDS.index(16)
    rig.bank.write(row, dxl.TORQUE_LIMIT.address, bytes(2))
    shut_down(rig, row)
    limp = rig.joint(row)
    rig.stuck[row] = limp
    leg = row // 3
    while rig.cycle().mode is Mode.WALK:
        pass
    goals = rig.goals
    state = rig.cycle(36)
    assert state.mode is Mode.FAULT
    assert (rig.air(state) == (np.arange(6) == leg)).all(), "the others have come down"
    np.testing.assert_allclose(rig.goals[leg], goals[leg], atol=1e-9, err_msg="a leg that hangs is led nowhere")
    while rig.bank.read(row, dxl.TORQUE_LIMIT.address, 2) == bytes(2):
        state = rig.cycle()
    del rig.stuck[row]
    seen, highest, found, course = set(), -1.0, state.touch_ns, [rig.goals[leg]]
    lies, last = float(state.feet[leg, 2]), rig.goals
    while state.mode is Mode.FAULT:
        seen.add(state.reason)
        state = rig.cycle()
        assert np.abs((rig.goals - last)[leg]).max() <= GENTLE * 0.02 + TICK
        highest, last = max(highest, float(state.feet[leg, 2])), rig.goals
        course.append(last[leg])
        if state.mode is Mode.FAULT and state.phase < 0.5:
            assert state.touch_ns[leg] == found[leg]
    assert highest > lies + 0.005, "it goes up before it comes down"
    steps = np.diff(np.array(course), axis=0)
    turns = (steps[1:] * steps[:-1] < 0.0).sum(axis=0)
    assert turns.max() <= 4, "its goals do not hunt"
    assert not rig.air(state).any()
    assert "the femur servo of the right middle leg (id 16) takes up its work again, slowly" in seen
    assert state.mode is Mode.HOLD
    assert abs(rig.joint(row) - limp) > np.radians(8.0), "it is where the others are"


def lies_limp(rig: Rig, row: int, by: float) -> None:
    """A servo shuts down, and its joint falls."""
    rig.bank.write(row, dxl.TORQUE_LIMIT.address, bytes(2))
    shut_down(rig, row)
    rig.stuck[row] = rig.joint(row) + by


def test_of_two_legs_that_were_limp_the_second_waits_where_it_lies_and_nobody_walks_on_before() -> None:
    rig = Rig()
    rig.hear(rig.plan(rig.walking()))
    state = rig.cycle(40)
    rows = IDS.index(16), IDS.index(9)
    lies_limp(rig, rows[0], 0.4)
    rig.cycle(40)
    lies_limp(rig, rows[1], 0.4)
    second, order, before = rows[1] // 3, list[int](), None
    state = rig.cycle(5)
    while state.mode is Mode.FAULT:
        for row in [row for row in rig.stuck if rig.bank.read(row, dxl.TORQUE_LIMIT.address, 2) != bytes(2)]:
            del rig.stuck[row]
            before = rig.goals[second] if row == rows[1] else before
        state = rig.cycle()
        swings = np.flatnonzero(state.swing).tolist()
        order += [leg for leg in swings if leg not in order]
        if before is not None and second not in order:
            np.testing.assert_allclose(rig.goals[second], before, atol=2 * TICK)
            assert (
                state.reason == "the femur servo of the right middle leg (id 16), with 1 more, takes up its work again, slowly"
            )
    assert order == [row // 3 for row in rows], "one after the other"
    assert not rig.air(state).any()
    assert state.mode is Mode.HOLD


@pytest.mark.parametrize("heard_again", [False, True])
def test_a_robot_lies_down_on_no_leg_that_hangs(heard_again: bool) -> None:
    rig = Rig()
    rig.hear(rig.plan(rig.walking()))
    rig.cycle(14)
    row = IDS.index(14)  # a coxa in the air
    rig.bus.cut_off(frozenset([row]))
    rig.stuck[row] = rig.joint(row)
    assert rig.cycle(40).mode is Mode.FAULT
    rig.command("sit")
    assert rig.cycle(5).mode is Mode.SIT
    if heard_again:
        rig.bus.cut_off(frozenset())
        rig.stuck.clear()
    while rig.cycle().mode is Mode.SIT:
        pass
    assert body_forward(PROFILE, rig.goals)[:, 2].min() > -0.03, "no foot is far below the body that lies"


@pytest.mark.parametrize(("roll", "leg"), [(0.0, 1), (0.12, 1), (0.12, 4), (-0.12, 5)])
@pytest.mark.parametrize("height", [0.008, 0.02])
def test_a_foot_that_is_found_in_the_air_comes_down_to_the_plane_of_those_that_stand(
    roll: float, leg: int, height: float
) -> None:
    stands = np.arange(6) != leg
    level = REST + np.where(stands, 0.0, height)[:, None] * UP
    rig = Rig(apply(from_xyz_rpy((0.0, 0.0, 0.0), (roll, 0.0, 0.0)), level))
    rig.ground[:] = False
    rig.push[stands, 2] = 5.0
    rig.cycle()
    rig.start()
    assert rig.cycle().swing.tolist() == (~stands).tolist()
    for _ in range(100):
        last = rig.goals
        state = rig.cycle()
        assert np.abs(rig.goals - last).max() <= LOWERED * 0.02 + TICK
    assert state.mode is Mode.HOLD
    plane = np.column_stack([REST[:, :2], np.ones(6)])
    feet = apply(from_xyz_rpy((0.0, 0.0, 0.0), (-roll, 0.0, 0.0)), body_forward(PROFILE, rig.actuator._q_wanted))
    slope = np.linalg.lstsq(plane[stands], feet[stands, 2])[0]
    assert abs(feet[leg, 2] - plane[leg] @ slope) < 0.003


def test_a_robot_that_is_made_ready_while_a_servo_catches_up_may_stand() -> None:
    rig = Rig()
    rig.hear(rig.plan(rig.walking()))
    rig.cycle(14)
    row = IDS.index(16)
    rig.bank.write(row, dxl.TORQUE_LIMIT.address, bytes(2))
    shut_down(rig, row)
    rig.stuck[row] = rig.joint(row)
    while rig.bank.read(row, dxl.TORQUE_LIMIT.address, 2) == bytes(2):
        rig.cycle()
    del rig.stuck[row]
    state = rig.cycle(4)
    assert "takes up its work again" in state.reason
    rig.command("ready")
    state = rig.cycle(20)
    assert state.mode is Mode.READY
    rig.command("stand")
    assert rig.cycle(2).mode is Mode.STAND


def test_a_fault_while_standing_up_is_not_forgotten() -> None:
    rig = Rig(CRAWL, torque=False)
    rig.cycle(2)
    rig.command("stand")
    rig.cycle(20)
    shut_down(rig, 4)
    assert rig.cycle(4).mode is Mode.FAULT
    goals = rig.goals
    rig.bank._faults[:] = 0  # it recovers, but nobody has looked after it
    assert rig.cycle(200).mode is Mode.READY
    np.testing.assert_array_equal(rig.goals, goals)


def test_contacts_and_loads_are_those_the_servos_feel() -> None:
    rig = Rig()
    rig.ground[:] = False
    rig.push[TRIPOD, 2] = 8.0
    state = rig.cycle(40)
    np.testing.assert_array_equal(state.contact, TRIPOD)
    expected = joint_torques(PROFILE, state.q, rig.push)
    np.testing.assert_allclose(state.load_nm, expected, atol=0.02)
    assert 9.0 < state.voltage < 13.0
    assert 20.0 < state.temperature < 40.0


def test_a_killed_actuator_comes_back_standing_as_it_stood() -> None:
    rig = Rig()
    state = rig.walking()
    for _ in range(2):
        rig.hear(rig.plan(state))
        state = rig.cycle(45)
    before = rig.goals
    rig.start()
    state = rig.cycle()
    assert state.mode is Mode.HOLD
    assert (state.step, state.phase) == (0, 1.0)
    assert np.abs(rig.goals - before).max() < 0.06
    rig.hear(rig.plan(state))
    assert "not ordered to walk" in rig.cycle().refused  # the order does not outlive it
    rig.order += 1
    rig.command("walk")
    state = rig.cycle(2)
    rig.hear(rig.plan(state))
    assert rig.cycle().mode is Mode.WALK


@pytest.mark.parametrize("cycles", [3, 5, 9, 15, 21, 27, 29])
def test_after_a_while_without_anybody_to_lead_them_legs_begin_anew_and_feet_come_down_gently(cycles: int) -> None:
    rig = Rig()
    rig.hear(rig.plan(rig.walking()))
    state = rig.cycle(cycles)
    assert state.mode is Mode.WALK
    if cycles == 15:
        assert (rig.air(state) == TRIPOD).all()
    epoch = state.epoch
    rig.now_ns += 3_500_000_000
    state = rig.cycle()
    assert state.mode is Mode.FAULT
    assert state.reason == "the computer has kept the actuator waiting for 3.5 s"
    for _ in range(100):
        last = rig.goals
        state = rig.cycle()
        assert np.abs(rig.goals - last).max() <= np.radians(30.0) * 0.04 + TICK  # a cycle may take two periods
    assert state.epoch > epoch
    assert not rig.air(state).any()
    assert state.mode is Mode.HOLD


def test_no_step_begins_before_the_joints_have_taken_up_their_work() -> None:
    rig = Rig()
    epoch = rig.walking().epoch
    rig.stuck[0] = rig.joint(0) + 0.09  # begins anew there, and so has its goal come
    rig.now_ns += 3_500_000_000
    refused: list[str] = []
    for _ in range(150):
        state = rig.cycle()
        if state.epoch > epoch and state.mode is Mode.HOLD:
            before = rig.goals
            rig.hear(rig.plan(state, stamp_ns=rig.now_ns))
            state = rig.cycle()
            if state.mode is Mode.WALK:
                break
            refused.append(state.refused)
            assert np.abs(rig.goals - before).max() <= np.radians(30.0) * 0.02 + TICK
    assert state.mode is Mode.WALK
    assert refused
    assert refused[-1].endswith("refused: the joints take up their work again, slowly")


@pytest.mark.parametrize("cycles", [3, 15, 27])
def test_legs_that_begin_anew_are_on_no_way_from_where_they_were_wanted_before(
    cycles: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rates: list[float] = []

    def noted(profile: RobotProfile, q_rate: Array, held_s: float) -> Array:
        rates.append(float(np.abs(q_rate).max()))
        return lag_feed_forward(profile, q_rate, held_s)

    monkeypatch.setattr("services.actuator.service.lag_feed_forward", noted)
    rig = Rig()
    rig.hear(rig.plan(rig.walking()))
    epoch = rig.cycle(cycles).epoch
    rig.now_ns += 3_500_000_000
    while rig.cycle().epoch == epoch:
        rates.clear()
    assert rates[0] == 0.0


def test_a_robot_without_servos_does_not_start() -> None:
    rig = Rig()
    rig.bus = ServoBusEmulator(ServoBank([1, 2, 3]))
    with pytest.raises(RuntimeError, match="15 of 18 servos are not ready"):
        rig.start()


@pytest.mark.parametrize(
    "nonsense", [{"rate_hz": 5.0}, {"read_budget_ms": 30.0}, {"unload_s": 0.0}, {"load_s": 0.29}, {"brake_s": 0.0}]
)
def test_nonsense_settings_are_refused(nonsense: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        Settings(**nonsense)  # type: ignore[arg-type]


def stepped(rig: Rig, first: ActuatorState) -> tuple[ActuatorState, list[ActuatorState]]:
    """Two steps, the second planned when the first is over; the state after, and all on the way."""
    rig.hear(rig.plan(first))
    states = [rig.cycle() for _ in range(40)]
    rig.hear(rig.plan(states[-1]))
    states += [rig.cycle() for _ in range(200)]
    return states[-1], states


def test_a_foot_without_ground_reaches_down_and_is_taken_back_and_everybody_hears_of_it() -> None:
    rig = Rig()
    first = rig.walking()
    lost = int(np.flatnonzero(rig.plan(first).swing)[0])
    stood = apply(first.T_odom_body, first.feet)
    rig.ground[lost] = False
    state, states = stepped(rig, first)
    reasons = [s.reason for s in states]
    assert any("it reaches down" in r for r in reasons)
    assert state.mode is Mode.HOLD
    assert "the step is taken back" in state.reason
    assert state.touch_ns[lost] > 0
    assert not state.touch_carries[lost]
    assert state.touch[lost, 2] < -0.02, "it has looked below the ground"
    others = [leg for leg in range(6) if leg != lost and state.touch_ns[leg] > 0]
    assert others
    assert state.touch_carries[others].all()
    np.testing.assert_allclose(state.touch[others, 2], 0.0, atol=6e-3)
    feet = apply(state.T_odom_body, state.feet)
    np.testing.assert_allclose(feet[lost, :2], stood[lost, :2], atol=0.015)
    assert not state.swing.any()


def test_a_plan_that_comes_while_a_foot_looks_for_ground_is_refused_with_that_reason() -> None:
    rig = Rig()
    first = rig.walking()
    rig.ground[int(np.flatnonzero(rig.plan(first).swing)[0])] = False
    rig.hear(rig.plan(first))
    rig.cycle(40)
    assert rig.state is not None
    rig.hear(rig.plan(rig.state))
    while "it reaches down" not in rig.cycle().reason:
        assert rig.now_ns < 10_000_000_000
    rig.hear(rig.plan(rig.state))
    assert "no ground under" in rig.cycle(2).refused


def felt_by(rig: Rig, R_level_ground: Array) -> Array:
    """Up {body} of a robot that stands with six feet on a plane."""
    feet = body_forward(PROFILE, rig.goals)
    ahead, aside, _ = np.linalg.lstsq(np.column_stack([feet[:, :2], np.ones(6)]), feet[:, 2], rcond=None)[0]
    normal = np.array([-ahead, -aside, 1.0]) / np.linalg.norm([ahead, aside, 1.0])
    x = np.array([normal[2], 0.0, -normal[0]]) / np.hypot(normal[0], normal[2])
    R_ground_body = np.array([x, np.cross(normal, x), normal])
    return np.asarray((R_level_ground @ R_ground_body)[2])


def listen(rig: Rig, up: Array) -> ActuatorState:
    """A cycle in which an inertial sensor says where up is (3,) {body}."""
    rig.hear(Imu(rig.now_ns, np.zeros(3), 9.81 * up))
    return rig.cycle()


@pytest.mark.parametrize("slope", [(4.0, 0.0), (0.0, -5.0), (3.0, 3.0)])
def test_on_a_slope_the_body_is_level_where_a_sensor_says_so(slope: tuple[float, float]) -> None:
    rig, R = Rig(), rotation_from_rpy(np.radians([*slope, 0.0]))
    rig.walking()
    tilted = np.degrees(np.arccos(felt_by(rig, R)[2]))
    for _ in range(900):
        state = listen(rig, felt_by(rig, R))
    up = felt_by(rig, R)
    assert tilted > 3.5
    assert np.degrees(np.arccos(up[2])) < 1.0
    np.testing.assert_allclose(state.T_odom_body[2, :3], up, atol=np.radians(1.0))
    assert rig.state is not None
    assert rig.state.warnings == ()
    later = rig.cycle(20)
    assert any("no word from the IMU" in warning for warning in later.warnings)
    np.testing.assert_allclose(later.T_odom_body[2, :3], up, atol=np.radians(1.0))


def test_a_robot_that_tips_over_finishes_its_step_stops_and_says_so() -> None:
    rig, upright = Rig(), UP
    state = rig.walking()
    for _ in range(500):
        state = listen(rig, upright)
    rig.hear(rig.plan(state))
    for _ in range(10):
        state = listen(rig, upright)
    assert state.mode is Mode.WALK
    for tilt in np.radians(np.arange(0.0, 35.0, 2.5)):
        rig.hear(Imu(rig.now_ns, np.array([np.radians(125.0), 0.0, 0.0]), 9.81 * rotation_from_rpy((tilt, 0.0, 0.0))[2]))
        state = rig.cycle()
    running = state.step
    while state.mode is Mode.WALK:
        state = listen(rig, rotation_from_rpy((np.radians(35.0), 0.0, 0.0))[2])
    assert state.mode is Mode.HOLD
    assert state.step == running
    assert "off what is commanded, by the IMU" in state.reason
    assert any("by the IMU" in warning for warning in state.warnings)
    rig.hear(rig.plan(state))
    assert "by the IMU" in rig.cycle().refused
    assert rig.torque


def sure(rig: Rig, up: Array = UP) -> ActuatorState:
    """Walking is allowed, and a sensor has been heard for long enough to be believed, up being (3,) {body}."""
    rig.walking()
    for _ in range(400):
        state = listen(rig, up)
    return state


def tip(rig: Rig, angle: float, cycles: int = 25) -> ActuatorState:
    """Lean to an angle [rad] to one side."""
    for share in np.linspace(0.0, 1.0, cycles):
        up = rotation_from_rpy((share * angle, 0.0, 0.0))[2]
        rig.hear(Imu(rig.now_ns, np.array([angle / (cycles * 0.02), 0.0, 0.0]), 9.81 * up))
        state = rig.cycle()
    return state


def test_a_robot_that_is_lifted_and_turned_keeps_its_legs_still() -> None:
    rig = Rig()
    sure(rig)
    goals = rig.goals
    for _ in range(100):
        rig.hear(Imu(rig.now_ns, np.array([0.0, 0.0, 1.5]), 9.81 * UP))
        rig.cycle()
        np.testing.assert_allclose(rig.goals, goals, atol=STILL)


@pytest.mark.parametrize("angle", [1.0, np.pi / 2, 3.0])
def test_a_fallen_robot_keeps_its_legs_still(angle: float) -> None:
    rig = Rig()
    sure(rig)
    state = tip(rig, angle)
    assert any("off what is commanded" in warning for warning in state.warnings)
    goals = rig.goals
    for _ in range(150):
        state = listen(rig, rotation_from_rpy((angle, 0.0, 0.0))[2])
    np.testing.assert_allclose(rig.goals, goals, atol=STILL)
    assert any("off what is commanded" in warning for warning in state.warnings)


def test_a_sensor_that_is_upside_down_moves_no_leg() -> None:
    rig = Rig()
    rig.walking()
    rig.cycle(300)
    goals = rig.goals
    for _ in range(500):
        state = listen(rig, -UP)
    np.testing.assert_allclose(rig.goals, goals, atol=STILL)
    assert any("180 deg off what is commanded" in warning for warning in state.warnings)


def test_a_robot_with_a_fault_moves_no_leg() -> None:
    rig = Rig()
    sure(rig)
    rig.bank._faults[4] = int(dxl.ServoError.ANGLE_LIMIT)
    rig.cycle(20)
    goals = rig.goals
    tip(rig, np.radians(10.0))
    for _ in range(150):
        state = listen(rig, rotation_from_rpy((np.radians(10.0), 0.0, 0.0))[2])
    assert state.mode is Mode.FAULT
    np.testing.assert_allclose(rig.goals, goals, atol=STILL)


@pytest.mark.parametrize("heard", [True, False])
def test_a_robot_that_has_tipped_walks_on_by_a_new_order_only(heard: bool) -> None:
    """Neither one that is put upright again nor one whose sensor falls silent."""
    rig = Rig()
    sure(rig)
    tip(rig, np.radians(35.0))
    for _ in range(400):
        state = listen(rig, UP) if heard else rig.cycle()
    rig.hear(rig.plan(state))
    state = rig.cycle()
    assert state.mode is Mode.HOLD
    assert "by the IMU" in state.refused
    rig.command("walk")
    state = listen(rig, UP) if heard else rig.cycle()
    rig.hear(rig.plan(state))
    assert rig.cycle().mode is Mode.WALK
    assert not any("off what is commanded" in warning for warning in rig.cycle().warnings)


def test_a_robot_that_lies_on_its_side_does_not_walk_by_an_order() -> None:
    rig, up = Rig(), rotation_from_rpy((1.2, 0.0, 0.0))[2]
    sure(rig)
    state = tip(rig, 1.2)
    rig.command("walk")
    rig.hear(rig.plan(state))
    assert listen(rig, up).mode is Mode.HOLD
    rig.hear(rig.plan(state))
    assert "by the IMU" in listen(rig, up).refused


def test_standing_up_anew_twists_nobody() -> None:
    """The legs count from a new beginning; the gyro goes on."""
    rig = Rig()
    sure(rig)
    rig.actuator._odometry.turn(from_xyz_rpy(np.zeros(3), (0.0, 0.0, 0.15)))  # as gyro and legs agree
    rig.actuator._walker = Walker(Settings(), REST, rig.actuator._odometry.T_odom_body)
    rig.hear(Imu(rig.now_ns, np.array([0.0, 0.0, 0.15 / 0.02]), 9.81 * UP))
    rig.cycle()
    goals = rig.goals
    rig.command("stand")
    state = listen(rig, UP)
    assert state.mode is Mode.STAND
    while listen(rig, UP).mode is Mode.STAND:
        pass
    for _ in range(150):
        listen(rig, UP)
    np.testing.assert_allclose(rig.goals[:, 0], goals[:, 0], atol=STILL)
