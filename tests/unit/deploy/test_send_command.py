"""Orders from the terminal: sent repeatedly until the actuator confirms them.

An order that fails ends with the reason.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sextant.deploy.send_command import Order
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, Health, Mode, ModeCommand, StopOrder, Tick
from tests.support.states import actuator_state

MS = 1_000_000
PROFILE = load_profile("phantomx_mk2")


class Desk:
    """An order, and an actuator that reports scripted states."""

    def __init__(self, order: Order, **state: Any) -> None:
        self.order = order
        self.inbox = Inbox(order.subscribes, order.stages)
        self.now_ns = 1_000 * MS
        self.ahead_ns = 0  # offset of the robot's clock ahead of this machine's
        self.state: ActuatorState | None = actuator_state(PROFILE, stamp_ns=0, **{"lease": "", **state})
        self.given: list[ModeCommand] = []

    def beats(self, count: int, **changes: Any) -> None:
        for _ in range(count):
            self.now_ns += 50 * MS
            self.inbox.now_ns = self.now_ns
            if self.state is not None:
                self.state = replace(self.state, stamp_ns=self.now_ns + self.ahead_ns, **changes)
                self.inbox.receive(topics.ACTUATOR_STATE, codec.encode(self.state), self.now_ns)
            made = list(self.order.step(Tick(self.now_ns), self.inbox))
            self.given += [m for m in made if isinstance(m, ModeCommand)]


def test_it_stands_up_and_ends_when_the_robot_stands() -> None:
    desk = Desk(Order("stand", "me"), mode=Mode.OFF, reason="torque is off")
    desk.beats(2)
    desk.beats(40, mode=Mode.STAND, reason="standing up", lease="me")
    assert not desk.order.finished
    assert desk.order.doing() == "stand: standing up"
    desk.beats(1, mode=Mode.HOLD, reason="standing", lease="me")
    assert desk.order.finished
    assert not desk.order.failed
    assert len(desk.given) == 5, "twice a second, so that the lease lasts"
    assert len({(m.sequence, m.mode, m.holder) for m in desk.given}) == 1, "one order, repeated"


def test_a_robot_that_stands_already_is_no_answer_to_stand() -> None:
    desk = Desk(Order("stand", "me"), mode=Mode.HOLD, reason="torque was on at the start")
    desk.beats(5)
    assert not desk.order.finished


@pytest.mark.parametrize("what", ["off", "stop"])
def test_anybody_lets_go_and_stops_without_the_lease(what: Any) -> None:
    desk = Desk(Order(what, "me"), mode=Mode.WALK, reason="walking", lease="another")
    desk.beats(3)
    assert not desk.order.finished
    desk.beats(1, mode=Mode.OFF if what == "off" else Mode.HOLD, reason="ordered")
    assert desk.order.finished
    assert not desk.order.failed


def test_a_refusal_is_told_and_one_of_before_is_not() -> None:
    old = "`walk` of me refused: another holds the lease; take it over, or wait until it expires"
    desk = Desk(Order("walk", "me"), mode=Mode.HOLD, reason="standing", warnings=(old,))
    desk.beats(10)
    assert not desk.order.finished
    desk.beats(1, warnings=("`walk` refused: the mode is ready, order `stand` first",))
    assert desk.order.failed.endswith("order `stand` first")


def test_walk_is_held_until_it_is_withdrawn() -> None:
    desk = Desk(Order("walk", "me", take=True), mode=Mode.HOLD, reason="standing")
    desk.beats(2)
    desk.beats(200, mode=Mode.WALK, reason="walking", lease="me")
    assert not desk.order.finished
    assert all(m.take for m in desk.given)
    stop, anyway = desk.order.withdraw()
    assert (stop.mode, stop.holder) == ("stop", "me")
    assert stop.sequence > desk.given[-1].sequence
    assert isinstance(anyway, StopOrder)


def test_what_was_never_ordered_is_not_withdrawn() -> None:
    order = Order("walk", "me")
    assert list(order.step(Tick(1), Inbox(order.subscribes, order.stages))) == []
    assert order.withdraw() == ()


def test_a_refusal_of_somebody_else_s_order_is_not_this_one_s() -> None:
    desk = Desk(Order("walk", "me"), mode=Mode.HOLD, reason="standing")
    desk.beats(2)
    desk.beats(5, warnings=("`walk` of another refused: it is 60.0 s old, at most 2 s allowed",))
    assert not desk.order.finished
    desk.beats(1, warnings=("`walk` of me refused: it is 60.0 s old, at most 2 s allowed",))
    assert desk.order.failed.startswith("`walk` of me refused")


def test_silence_and_what_does_not_come_about_end_it_in_words() -> None:
    desk = Desk(Order("sit", "me"))
    desk.state = None
    desk.beats(90)
    assert not desk.order.finished
    desk.beats(20)
    assert desk.order.failed.startswith("no word from the actuator within 5 s")
    desk = Desk(Order("sit", "me"), mode=Mode.WALK, reason="walking")
    desk.beats(320)
    assert desk.order.failed == "15 s after the order the mode is walk: walking"


@pytest.mark.parametrize("leads", [True, False])
@pytest.mark.parametrize("what", ["off", "stop"])
def test_a_stop_goes_by_the_key_of_those_who_may_not_lead_too(what: Any, leads: bool) -> None:
    order = Order(what, "me", leads=leads)
    made = list(order.step(Tick(1), Inbox(order.subscribes, order.stages)))
    assert [m.mode for m in made if isinstance(m, StopOrder)] == [what]
    assert not [m for m in made if isinstance(m, ModeCommand)], "by the robot's clock, which was not heard yet"
    desk = Desk(Order(what, "me", leads=leads), mode=Mode.WALK, reason="walking", lease="another")
    desk.beats(1)
    assert len(desk.given) == leads
    walk = Order("walk", "me")
    assert list(walk.step(Tick(1), Inbox(walk.subscribes, walk.stages))) == [], "what the robot's clock says is not known yet"


def test_an_order_to_move_is_stamped_by_the_robots_clock_wherever_it_is_given() -> None:
    desk = Desk(Order("walk", "me"), mode=Mode.HOLD, reason="standing", lease="me")
    desk.ahead_ns = 3_600_000_000_000
    desk.beats(30)
    assert len(desk.given) > 2
    assert all(0 <= desk.now_ns + desk.ahead_ns - m.stamp_ns <= 30 * 50 * MS for m in desk.given)
    assert {m.sequence for m in desk.given} == {desk.given[0].stamp_ns}, "it counts on from orders of other machines"
    desk.beats(400)
    desk.ahead_ns = 0
    desk.beats(60)
    assert desk.order.failed.startswith("the robot's clock has restarted")


def router_says(desk: Desk, refused: int, last: str, name: str = "router of robot", role: str = "robot") -> None:
    nothing = np.zeros(0)
    word = Health(desk.now_ns, name, "listening", 0, refused, 0, last, (), nothing, nothing)
    desk.inbox.receive(topics.HEALTH_OF[role], codec.encode(word), desk.now_ns)


def test_whom_a_router_on_the_way_keeps_back_is_told_by_its_word() -> None:
    desk = Desk(Order("stand", "me"), mode=Mode.OFF, reason="torque is off")
    router_says(desk, 3, "refused: viewer may not publish operator/mode")
    desk.beats(1)
    assert not desk.order.finished, "that was another client, before"
    router_says(desk, 4, "refused: viewer may not publish operator/mode")
    desk.beats(1)
    assert desk.order.failed.startswith("the router of robot refused: viewer may not publish operator/mode; use the keys")


def test_who_leads_takes_no_notice_of_others_being_kept_back() -> None:
    desk = Desk(Order("stand", "me"), mode=Mode.OFF, reason="torque is off")
    router_says(desk, 3, "")
    desk.beats(2, mode=Mode.STAND, reason="standing up", lease="me")
    router_says(desk, 4, "refused: viewer may not publish operator/mode")
    desk.beats(1, mode=Mode.STAND, reason="standing up", lease="me")
    assert not desk.order.finished


def test_on_a_machine_that_may_only_stop_its_own_router_says_so() -> None:
    desk = Desk(Order("stand", "me"), mode=Mode.OFF, reason="torque is off")
    router_says(desk, 0, "", "router of viewer")
    desk.beats(1)
    assert not desk.order.finished, "by the key of another role it is a claim"
    router_says(desk, 0, "", "router of viewer", "viewer")
    desk.beats(1)
    assert "this certificate (viewer: " in desk.order.failed
    assert "may not send operator/mode, only operator/stop; use the keys of another role: base, console" in desk.order.failed
    for what, name in (("off", "router of viewer"), ("stand", "router of console"), ("stand", "router of robot")):
        desk = Desk(Order(what, "me"), mode=Mode.READY, reason="torque is on")
        router_says(desk, 0, "", name)
        desk.beats(1)
        assert not desk.order.failed
