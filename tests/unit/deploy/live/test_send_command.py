"""Orders from the terminal: sent repeatedly until the actuator confirms them.

An order that fails ends with the reason.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sextant.deploy.live.send_command import Order
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, Health, Mode, ModeCommand, StopOrder, Tick
from tests.support.states import actuator_state, frame_of_version_0_1

MS = 1_000_000
PROFILE = load_profile("phantomx_mk2")


class OrderBench:
    """An order, and an actuator that reports scripted states."""

    def __init__(self, order: Order, **state: Any) -> None:
        self.order = order
        self.inbox = Inbox(order.subscribes, order.stages)
        self.now_ns = 1_000 * MS
        self.ahead_ns = 0  # offset of the robot's clock ahead of this machine's
        self.state: ActuatorState | None = actuator_state(PROFILE, stamp_ns=0, **{"lease": "", **state})
        self.given: list[ModeCommand] = []

    def run_ticks(self, count: int, **changes: Any) -> None:
        for _ in range(count):
            self.now_ns += 50 * MS
            self.inbox.now_ns = self.now_ns
            if self.state is not None:
                self.state = replace(self.state, stamp_ns=self.now_ns + self.ahead_ns, **changes)
                self.inbox.receive(topics.ACTUATOR_STATE, codec.encode(self.state), self.now_ns)
            made = list(self.order.step(Tick(self.now_ns), self.inbox))
            self.given += [m for m in made if isinstance(m, ModeCommand)]


def test_stand_order_finishes_when_robot_stands() -> None:
    desk = OrderBench(Order("stand", "me"), mode=Mode.OFF, reason="torque is off")
    desk.run_ticks(2)
    desk.run_ticks(40, mode=Mode.STAND, reason="standing up", lease="me")
    assert not desk.order.finished
    assert desk.order.status() == "stand: standing up"
    desk.run_ticks(1, mode=Mode.HOLD, reason="standing", lease="me")
    assert desk.order.finished
    assert not desk.order.failed
    assert len(desk.given) == 5, "twice a second, so that the lease lasts"
    assert len({(m.sequence, m.mode, m.holder) for m in desk.given}) == 1, "one order, repeated"


def test_order_to_a_robot_that_already_obeys_finishes_when_it_has_obeyed_again() -> None:
    desk = OrderBench(Order("sit", "me"), mode=Mode.READY, reason="sitting")
    desk.run_ticks(2)
    desk.run_ticks(5, mode=Mode.SIT, reason="ordered to sit", lease="me")
    assert not desk.order.finished
    desk.run_ticks(1, mode=Mode.READY, reason="sitting", lease="me")
    assert desk.order.finished
    assert not desk.order.failed


def test_already_standing_robot_does_not_finish_stand_order() -> None:
    desk = OrderBench(Order("stand", "me"), mode=Mode.HOLD, reason="torque was on at the start")
    desk.run_ticks(5)
    assert not desk.order.finished


@pytest.mark.parametrize("what", ["off", "stop"])
def test_off_and_stop_need_no_lease(what: Any) -> None:
    desk = OrderBench(Order(what, "me"), mode=Mode.WALK, reason="walking", lease="another")
    desk.run_ticks(3)
    assert not desk.order.finished
    desk.run_ticks(1, mode=Mode.OFF if what == "off" else Mode.HOLD, reason="ordered")
    assert desk.order.finished
    assert not desk.order.failed


def test_refusal_fails_order_unless_older_than_order() -> None:
    old = "`walk` of me refused: another holds the lease; take it over, or wait until it expires"
    desk = OrderBench(Order("walk", "me"), mode=Mode.HOLD, reason="standing", warnings=(old,))
    desk.run_ticks(10)
    assert not desk.order.finished
    desk.run_ticks(1, warnings=("`walk` refused: the mode is ready, order `stand` first",))
    assert desk.order.failed.endswith("order `stand` first")


def test_refusal_for_another_holder_names_the_option_that_takes_over() -> None:
    desk = OrderBench(Order("walk", "me"), mode=Mode.HOLD, reason="standing", lease="another")
    desk.run_ticks(2)
    desk.run_ticks(1, warnings=("`walk` of me refused: another holds the lease; take it over, or wait until it expires",))
    assert desk.order.failed.endswith("another holds the lease; take it over, or wait until it expires; --take takes it over")


def test_order_waits_for_the_lease_of_an_earlier_order_of_the_same_name() -> None:
    desk = OrderBench(Order("walk", "me"), mode=Mode.HOLD, reason="standing", lease="me")
    desk.run_ticks(50)
    assert desk.given == []
    assert desk.order.status() == "waiting for the lease of an earlier order of me to end"
    desk.run_ticks(2, lease="")
    desk.run_ticks(40, lease="me")
    assert len(desk.given) == 5
    assert not desk.order.failed


@pytest.mark.parametrize("take", [False, True])
def test_order_is_not_given_while_another_client_of_the_same_name_leads(take: bool) -> None:
    desk = OrderBench(Order("walk", "me", take), mode=Mode.WALK, reason="walking", lease="me")
    desk.run_ticks(80)
    assert desk.given == []
    assert desk.order.failed == (
        "another client named 'me' leads it; end that one, or give this one another name with --holder"
    )
    desk = OrderBench(Order("stop", "me"), mode=Mode.WALK, reason="walking", lease="me")
    desk.run_ticks(1)
    assert [m.mode for m in desk.given] == ["stop"], "any client may stop"


def test_walk_order_continues_until_withdrawn() -> None:
    desk = OrderBench(Order("walk", "me", take=True), mode=Mode.HOLD, reason="standing")
    desk.run_ticks(2)
    desk.run_ticks(200, mode=Mode.WALK, reason="walking", lease="me")
    assert not desk.order.finished
    assert all(m.take_over for m in desk.given)
    stop, anyway = desk.order.withdraw()
    assert (stop.mode, stop.holder) == ("stop", "me")
    assert stop.sequence > desk.given[-1].sequence
    assert isinstance(anyway, StopOrder)


def test_withdraw_before_first_command_sends_nothing() -> None:
    order = Order("walk", "me")
    assert list(order.step(Tick(1), Inbox(order.subscribes, order.stages))) == []
    assert order.withdraw() == ()


def test_refusal_of_another_holders_order_is_ignored() -> None:
    desk = OrderBench(Order("walk", "me"), mode=Mode.HOLD, reason="standing")
    desk.run_ticks(2)
    desk.run_ticks(5, warnings=("`walk` of another refused: it is 60.0 s old, at most 2 s allowed",))
    assert not desk.order.finished
    desk.run_ticks(1, warnings=("`walk` of me refused: it is 60.0 s old, at most 2 s allowed",))
    assert desk.order.failed.startswith("`walk` of me refused")


def test_order_times_out_without_actuator_or_mode_change() -> None:
    desk = OrderBench(Order("sit", "me"))
    desk.state = None
    desk.run_ticks(90)
    assert not desk.order.finished
    desk.run_ticks(20)
    assert desk.order.failed.startswith("no word from the actuator within 5 s")
    desk = OrderBench(Order("sit", "me"), mode=Mode.WALK, reason="walking")
    desk.run_ticks(2)
    desk.run_ticks(320, lease="me")
    assert desk.order.failed == "15 s after the order the mode is walk: walking"


def test_order_to_a_robot_of_another_version_names_the_versions() -> None:
    desk = OrderBench(Order("stand", "me"))
    desk.state = None
    desk.inbox.receive(topics.ACTUATOR_STATE, frame_of_version_0_1(PROFILE), 0)
    desk.run_ticks(110)
    assert "found ActuatorState:5576558f: sender and receiver need the same version of Sextant" in desk.order.failed


def test_unanswered_order_names_routers_on_the_way() -> None:
    desk = OrderBench(Order("stand", "me"), mode=Mode.OFF, reason="torque is off", lease="")
    desk.run_ticks(320)
    assert desk.order.failed == (
        "15 s after the order the mode is off: torque is off; the order may not have arrived: "
        "each router on the way needs keys of a role that may send operator/mode (docs/access.md)"
    )


@pytest.mark.parametrize("leads", [True, False])
@pytest.mark.parametrize("what", ["off", "stop"])
def test_stop_order_is_sent_without_permission_to_lead(what: Any, leads: bool) -> None:
    order = Order(what, "me", leads=leads)
    made = list(order.step(Tick(1), Inbox(order.subscribes, order.stages)))
    assert [m.mode for m in made if isinstance(m, StopOrder)] == [what]
    assert not [m for m in made if isinstance(m, ModeCommand)], "by the robot's clock, which was not heard yet"
    desk = OrderBench(Order(what, "me", leads=leads), mode=Mode.WALK, reason="walking", lease="another")
    desk.run_ticks(1)
    assert len(desk.given) == leads
    walk = Order("walk", "me")
    assert list(walk.step(Tick(1), Inbox(walk.subscribes, walk.stages))) == [], "what the robot's clock says is not known yet"


def test_mode_commands_are_stamped_with_robot_clock() -> None:
    desk = OrderBench(Order("walk", "me"), mode=Mode.HOLD, reason="standing")
    desk.ahead_ns = 3_600_000_000_000
    desk.run_ticks(2)
    desk.run_ticks(28, lease="me")
    assert len(desk.given) > 2
    assert all(0 <= desk.now_ns + desk.ahead_ns - m.stamp_ns <= 30 * 50 * MS for m in desk.given)
    assert {m.sequence for m in desk.given} == {desk.given[0].stamp_ns}, "it counts on from orders of other machines"
    desk.run_ticks(400)
    desk.ahead_ns = 0
    desk.run_ticks(60)
    assert desk.order.failed.startswith("the robot's clock has restarted")


def receive_router_health(desk: OrderBench, name: str, role: str = "robot") -> None:
    nothing = np.zeros(0)
    word = Health(desk.now_ns, name, "listening", 0, 0, 0, "", (), nothing, nothing)
    desk.inbox.receive(topics.HEALTH_OF[role], codec.encode(word), desk.now_ns)


def test_stop_only_certificate_fails_motion_orders() -> None:
    desk = OrderBench(Order("stand", "me"), mode=Mode.OFF, reason="torque is off")
    receive_router_health(desk, "router of viewer")
    desk.run_ticks(1)
    assert not desk.order.finished, "by the key of another role it is a claim"
    receive_router_health(desk, "router of viewer", "viewer")
    desk.run_ticks(1)
    assert "this certificate (viewer: " in desk.order.failed
    assert "may not send operator/mode, only operator/stop; use the keys of another role: base, console" in desk.order.failed
    for what, name in (("off", "router of viewer"), ("stand", "router of console"), ("stand", "router of robot")):
        desk = OrderBench(Order(what, "me"), mode=Mode.READY, reason="torque is on")
        receive_router_health(desk, name)
        desk.run_ticks(1)
        assert not desk.order.failed


@pytest.mark.parametrize(("what", "during"), [("stand", Mode.STAND), ("sit", Mode.SIT)])
def test_interrupted_motion_ends_its_order_at_once_with_the_cause(what: Any, during: Mode) -> None:
    """Check an order whose motion a fault has ended: the actuator does not resume it."""
    desk = OrderBench(Order(what, "me"), mode=Mode.FAULT, reason="an earlier fault")
    desk.run_ticks(2)
    desk.run_ticks(10, lease="me")
    assert not desk.order.finished, "the motion has not begun"
    desk.run_ticks(10, mode=during, reason="moving", lease="me")
    desk.run_ticks(1, mode=Mode.FAULT, reason="no servo answers", lease="me")
    assert desk.order.failed == f"`{what}` was interrupted: no servo answers; then order it again"


def test_stand_order_that_another_client_stops_ends() -> None:
    desk = OrderBench(Order("stand", "me"), mode=Mode.OFF, reason="torque is off")
    desk.run_ticks(2)
    desk.run_ticks(10, mode=Mode.STAND, reason="standing up", lease="me")
    desk.run_ticks(1, mode=Mode.READY, reason="stopped while rising or sitting down; order `stand` or `sit`", lease="me")
    assert desk.order.failed == "`stand` was interrupted: stopped while rising or sitting down; order `stand` or `sit`"


def test_order_ends_while_the_times_of_the_robot_do_not_agree() -> None:
    desk = OrderBench(Order("stand", "me"), mode=Mode.OFF, reason="torque is off")
    desk.run_ticks(5)
    for k in range(400):  # each message is of another time
        desk.ahead_ns = (100_000 + 20_000 * (k % 3)) * 1_000 * MS
        desk.run_ticks(1)
    assert desk.order.failed == "the robot's messages of the last 15 s have times that do not agree"
