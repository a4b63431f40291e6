"""Guard as a state machine: random orders, plans and faults against its rules.

Single cases are in test_guard_orders, test_guard_lease, test_guard_time and test_guard_plans.
"""

from dataclasses import replace

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from sextant.services.actuator.safety.command_arbiter import AWAY_NS, LEASE_NS
from sextant.services.actuator.safety.command_ordering import ORDER_AGE_NS
from sextant.services.actuator.safety.guard import DEADLINE_NS, Act, Guard
from sextant.services.actuator.safety.health_monitor import Verdict
from sextant.shared.wire.messages import Mode, ModeCommand, StepPlan
from tests.support.guarded import AGE_NS, BAD, BROKEN, CYCLE, ORDERS, PROFILE, SPENT, Robot, rested

PLANS = ["next", "renewal", *BAD]
HOLDERS = ("a", "b", "c")


class Everything(RuleBasedStateMachine):
    """Orders, plans, faults and time in any sequence.

    The rules keep their own small account of the state and compare the guard with it.
    """

    def __init__(self) -> None:
        super().__init__()
        self.robot = Robot(torque=False)
        self.orders: list[ModeCommand] = []
        self.newest: dict[str, int] = {}
        self.holder, self.heard = "", -1
        self.begun, self.off_at = self.robot.now, -1  # [ns] times when the guard began, and when torque was last ordered off
        self.ordered_to_walk = False  # by the lease holder, and nothing has ended the walk since
        self.last: ModeCommand | None = None  # last order obeyed by this or an earlier guard; None if something else ended it
        self.woke_ns = -1  # [ns] last time that the computer woke from sleep
        self.stamps = [-1]  # of accepted plans
        self.considered: list[StepPlan] = []
        self.accepted = -1  # [ns]
        self.late = self.halted = self.seats = False
        self.before: tuple[Mode, bool] = (Mode.OFF, False)

    @property
    def leader(self) -> str:
        return self.holder if self.heard >= 0 and self.robot.now - self.heard <= LEASE_NS else ""

    # -------------------------------------------------------------------------------------------------------- orders

    @rule(
        mode=st.sampled_from(ORDERS),
        holder=st.sampled_from(HOLDERS),
        take=st.booleans(),
        off_ns=st.sampled_from([-10 * ORDER_AGE_NS, -ORDER_AGE_NS - 1, ORDER_AGE_NS + 1]),
        number=st.integers(0, 10**18),
    )
    def give_stale_or_future_order(self, mode: str, holder: str, take: bool, off_ns: int, number: int) -> None:
        """Give an order that is too old or ahead: it stops at most, without later effects."""
        order = ModeCommand(self.robot.now + off_ns, mode, number, holder, take)  # type: ignore[arg-type]
        was, lease = self.robot.mode, self.leader
        acts = self.robot.handle_order(order)
        assert self.robot.guard.lease(self.robot.now) == lease
        assert set(acts) <= {Act.TORQUE_OFF, Act.SET_DOWN, Act.FREEZE}
        if mode not in ("off", "stop"):
            assert (acts, self.robot.mode) == ((), was)
            assert "at most 2 s allowed" in self.robot.guard.objection
            return
        if number > self.newest.get(holder, -1):
            self.last = None
        if mode == "off" and (acts or number > self.newest.get(holder, -1)):
            self.off_at = self.robot.now
            self.ordered_to_walk = self.seats = False
        elif self.robot.mode is not was or acts:
            self.ordered_to_walk = self.seats = False
            self.halted |= was is Mode.WALK and mode == "stop"
        elif mode == "stop" and number > self.newest.get(holder, -1):
            self.ordered_to_walk = self.seats = False

    @rule(mode=st.sampled_from(ORDERS), holder=st.sampled_from(HOLDERS), take=st.booleans(), skip=st.integers(1, 3))
    def give_new_order(self, mode: str, holder: str, take: bool, skip: int) -> None:
        number = max(self.newest.get(holder, 0) + skip, self.robot.now)
        order = ModeCommand(self.robot.now, mode, number, holder, take)  # type: ignore[arg-type]
        self.orders.append(order)
        self.give(order)

    @rule(
        mode=st.sampled_from(ORDERS),
        holder=st.sampled_from(HOLDERS),
        take=st.booleans(),
        age_ns=st.sampled_from([ORDER_AGE_NS, ORDER_AGE_NS + 1, AWAY_NS, AWAY_NS + 1]),
    )
    def give_delayed_order(self, mode: str, holder: str, take: bool, age_ns: int) -> None:
        """Give an order that its client has repeated since, but the link was cut."""
        given_ns = self.robot.now - age_ns
        if given_ns > self.newest.get(holder, -1):
            order = ModeCommand(self.robot.now, mode, given_ns, holder, take)  # type: ignore[arg-type]
            self.orders.append(order)
            self.give(order)

    def give(self, order: ModeCommand) -> None:
        """Give an order that is new to the guard."""
        mode, holder, take, given_ns = order.mode, order.holder, order.take_over, order.sequence
        self.newest[holder] = given_ns
        was, leads, last = self.robot.mode, self.leader, self.last
        may = mode in ("off", "stop") or not leads or leads == holder or take
        after_ns = self.robot.guard.given_ns + 1  # an `off` counts as given after all orders before it
        acts = self.robot.handle_order(order)
        if not may:
            assert acts == ()
            assert self.robot.mode is was
            assert leads in self.robot.guard.objection
            return
        age_ns = self.robot.now - given_ns
        if "by its sequence" in self.robot.guard.objection and mode not in ("off", "stop"):
            assert (acts, self.robot.mode) == ((), was)
            assert age_ns > ORDER_AGE_NS or given_ns < self.off_at or given_ns < self.begun or given_ns <= self.woke_ns
            return
        self.check_obeyed_order(order, was, acts)
        if mode in ("ready", "stand", "sit") and age_ns > ORDER_AGE_NS:
            assert (acts, self.robot.mode) == ((), was)
            assert self.robot.guard.objection
        if mode == "walk" and (age_ns > AWAY_NS or given_ns < self.begun) and not self.robot.guard.objection:
            assert self.robot.now - self.begun <= AWAY_NS
            assert last is not None, "of before this guard no order but the last is obeyed"
            assert (last.holder, last.sequence) == (holder, given_ns)
        assert mode in ("off", "stop") or given_ns > self.woke_ns
        if was is Mode.OFF and Act.TORQUE_ON in acts:
            assert given_ns >= self.off_at
        if mode == "off":
            self.off_at = max(self.off_at, min(max(given_ns, after_ns), self.robot.now))

    def check_obeyed_order(self, order: ModeCommand, was: Mode, acts: tuple[Act, ...]) -> None:
        guard, mode = self.robot.guard, order.mode
        if mode not in ("off", "stop") or order.take_over:
            self.ordered_to_walk &= self.holder == order.holder
            self.holder = order.holder
        if self.holder == order.holder:
            self.heard = self.robot.now
        wrong = self.robot.verdict.broken or self.robot.verdict.sit
        if mode == "off":
            assert acts == (Act.TORQUE_OFF,)
            assert guard.mode is Mode.OFF
        if Act.TORQUE_ON in acts:
            assert mode in ("ready", "stand")
            assert was in (Mode.OFF, Mode.READY, Mode.FAULT)
            assert was is not Mode.OFF or not wrong
        assert (Act.TORQUE_OFF in acts) == (mode == "off")
        assert Act.RISE not in acts or mode == "stand"
        assert not guard.objection or (acts == () and guard.mode is was), "what is refused does nothing"
        if was is Mode.OFF and mode not in ("ready", "stand"):
            assert guard.mode is Mode.OFF
        if not guard.objection:
            self.last = order
            self.ordered_to_walk = mode == "walk"
            self.seats = mode == "sit" and was is not Mode.OFF
        if was is Mode.WALK and mode != "walk" and mode != "off":
            assert acts == (Act.SET_DOWN,)
            self.halted |= mode != "sit"

    @precondition(lambda self: self.orders)
    @rule(data=st.data())
    def repeat_order(self, data: st.DataObject) -> None:
        order = replace(data.draw(st.sampled_from(self.orders)), stamp_ns=self.robot.now)
        if order.sequence > self.newest.get(order.holder, -1):
            self.give(order)  # the guard has restarted
            return
        if order.mode in ("off", "stop") and order.sequence < self.begun:
            return  # a guard that has restarted does not know this stop, and obeys it
        guard, was, reason = self.robot.guard, self.robot.mode, self.robot.guard.reason
        assert self.robot.handle_order(order) == ()
        assert (guard.mode, guard.reason) == (was, reason)
        if order.sequence == self.newest[order.holder]:
            if order.holder == self.holder:
                self.ordered_to_walk &= self.robot.now - self.heard <= AWAY_NS
                self.heard = self.robot.now
        else:
            assert "each client needs its own name" in guard.objection

    @rule(kept=st.booleans())
    def restart_guard(self, kept: bool) -> None:
        """Restart the guard: clients repeat their orders, and the robot keeps its posture.

        The walk order that was in force may be known.
        """
        robot = self.robot
        walk, self.last = (robot.guard.walk_order(robot.now), self.last) if kept else (None, None)
        robot.now += CYCLE
        off_ns = -1 if robot.torque else self.off_at
        robot.guard = Guard(PROFILE, AGE_NS * 1e-9, robot.now, robot.torque, off_ns=off_ns, walk=walk)
        rested(robot)
        robot.still, robot.posing, robot.next = False, "", None
        robot.step, robot.swing = 0, np.zeros(6, dtype=bool)
        robot.guard.watch(robot.now, robot.walk, robot.verdict)
        self.newest, self.holder, self.heard, self.begun, self.woke_ns = {}, "", -1, robot.now, -1
        self.ordered_to_walk = self.late = self.halted = self.seats = False

    @rule()
    def wake_computer(self) -> None:
        robot, was = self.robot, self.robot.mode
        acts = robot.perform(robot.guard.resume_from_suspend(60.0, robot.now))
        assert acts == {Mode.WALK: (Act.SET_DOWN,), Mode.STAND: (Act.FREEZE,), Mode.SIT: (Act.FREEZE,)}.get(was, ())
        assert robot.guard.walk_order(robot.now) is None
        self.holder, self.heard, self.last, self.woke_ns = "", -1, None, robot.now
        self.ordered_to_walk, self.halted = False, self.halted or was is Mode.WALK
        self.seats &= bool(robot.verdict.sit)

    @rule()
    def receive_nothing_for_30_s(self) -> None:
        self.advance_time(AWAY_NS, 1, ends=False)

    # --------------------------------------------------------------------------------------------------------- plans

    @rule(kind=st.sampled_from(PLANS))
    def send_plan(self, kind: str) -> None:
        robot = self.robot
        robot.now += 1
        match kind:
            case "next":
                self.accept_plan(robot.plan(), good=True)
            case "renewal":
                self.accept_plan(robot.renewal(), good=robot.walk.planned)
            case _:
                self.accept_plan(BAD[kind][0](robot), good=False)

    @precondition(lambda self: self.considered)
    @rule(data=st.data())
    def repeat_plan(self, data: st.DataObject) -> None:
        self.accept_plan(data.draw(st.sampled_from(self.considered)), good=False)

    def accept_plan(self, plan: StepPlan, good: bool) -> None:
        robot = self.robot
        was, reason = robot.mode, robot.guard.reason
        taken = robot.accept_plan(plan)
        if not taken:
            assert robot.guard.refused
            assert (robot.mode, robot.guard.reason) == (was, reason)
            return
        assert good
        assert plan.stamp_ns > max(self.stamps)
        assert abs(robot.now - plan.stamp_ns) <= AGE_NS
        assert plan.epoch == robot.guard.epoch
        assert plan.step == robot.step + 1 or (plan.step == robot.step and robot.walk.planned)
        assert was in (Mode.HOLD, Mode.WALK)
        assert self.leader, "a living lease"
        assert self.ordered_to_walk
        assert not robot.verdict.broken
        assert not any((robot.guard.tipped, robot.searching, self.late, self.seats))
        assert (robot.mode, robot.guard.refused) == (Mode.WALK, "")
        self.stamps.append(plan.stamp_ns)
        self.considered.append(plan)
        self.accepted, self.halted = robot.now, False

    # ---------------------------------------------------------------------------------------------------- what happens

    @rule(
        after=st.sampled_from([1, CYCLE, CYCLE, 2 * CYCLE, DEADLINE_NS, LEASE_NS // 2]),
        count=st.integers(1, 4),
        ends=st.booleans(),
    )
    def advance_time(self, after: int, count: int, ends: bool) -> None:
        for k in range(count):
            self.run_cycle(after, ends and k == count - 1)

    def run_cycle(self, after: int, ends: bool) -> None:
        robot = self.robot
        was, walked = robot.mode, robot.mode is Mode.WALK
        acts = robot.cycle(after, ends)
        assert Act.TORQUE_ON not in acts
        assert Act.RISE not in acts
        assert was is not Mode.OFF or (acts == () and robot.mode is Mode.OFF)
        assert Act.TORQUE_OFF not in acts or (was is Mode.SIT and ends), (
            "only an order turns the torque of a standing robot off"
        )
        overdue = robot.walk.planned and robot.now - self.accepted > DEADLINE_NS
        if walked and overdue and not self.late and not self.halted:
            assert Act.SET_DOWN in acts
            self.late = True
        if walked and robot.verdict.broken:
            assert Act.SET_DOWN in acts
            assert robot.mode is Mode.FAULT
        if robot.verdict.sit:
            self.ordered_to_walk = False
        if robot.mode is Mode.HOLD and walked and self.halted and not robot.guard.tipped:
            assert robot.guard.reason.startswith("ordered to stop")
        if robot.mode is not Mode.WALK:
            self.late = self.halted = False
            self.seats &= robot.mode is Mode.FAULT
        if robot.verdict.broken:
            assert robot.mode in (Mode.OFF, Mode.READY, Mode.FAULT, Mode.SIT)
            assert robot.mode is not Mode.FAULT or robot.guard.reason == robot.verdict.broken

    @rule(verdict=st.sampled_from([Verdict(), Verdict(), BROKEN, SPENT, replace(SPENT, broken="a servo is silent")]))
    def change_servo_health(self, verdict: Verdict) -> None:
        self.robot.verdict = verdict
        self.run_cycle(CYCLE, ends=False)

    @precondition(lambda self: self.robot.mode in (Mode.HOLD, Mode.WALK))
    @rule()
    def tip_over(self) -> None:
        was = self.robot.mode
        assert self.robot.perform(self.robot.guard.tip("it leans")) == ((Act.SET_DOWN,) if was is Mode.WALK else ())
        self.ordered_to_walk, self.last = False, None

    @precondition(lambda self: self.robot.running)
    @rule(what=st.sampled_from(["own", "searching"]))
    def disturb_step(self, what: str) -> None:
        """Take a step back, or let a foot search for ground."""
        self.robot.own, self.robot.searching = True, what == "searching"
        self.robot.running = not self.robot.searching

    # ------------------------------------------------------------------------------------------------------ at any time

    @invariant()
    def torque_is_on_except_in_mode_off(self) -> None:
        assert self.robot.torque is (self.robot.mode is not Mode.OFF)

    @invariant()
    def lease_matches_model(self) -> None:
        assert self.robot.guard.lease(self.robot.now) == self.leader

    @invariant()
    def reason_is_never_empty(self) -> None:
        assert self.robot.guard.reason

    def teardown(self) -> None:
        """Check that nothing blocks the robot: after recovery any client can have it walk.

        It takes a few orders, and any client can turn torque off in one.
        """
        robot = self.robot
        robot.verdict = Verdict()
        rested(robot)
        assert robot.mode in (Mode.OFF, Mode.READY, Mode.HOLD)
        robot.order("stand", "d", take=True)
        robot.cycle(ends=True)
        assert robot.mode is Mode.HOLD, robot.guard.objection
        robot.order("walk", "d")
        assert robot.accept_plan(robot.plan()), robot.guard.refused
        robot.cycle()
        assert robot.order("off", "e") == (Act.TORQUE_OFF,)
        assert not robot.torque


TestEverything = Everything.TestCase
TestEverything.settings = settings(
    max_examples=60,
    stateful_step_count=40,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
