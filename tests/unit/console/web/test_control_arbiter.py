"""Requests of operators at their pages, and the resulting messages.

The robot moves only while the leading page asks for it.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from sextant.services.console.web.control_arbiter import DEAD_MAN_NS, SEATS, ControlArbiter
from sextant.services.console.web.requests import CancelGoal, Command, Drive, GoTo, Heartbeat, Name, Release, TakeOver, Walk
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import ActuatorState, Goal, Message, Mode, ModeCommand, PlannerStatus, VelocityCommand
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
MS = 1_000_000
WALK = Walk(0.1, 0.04, "ripple")
GO = GoTo(((1.0, 0.5),), 0.5, WALK, False)


def drive(press: int, forward: float = 0.1, left: float = 0.0) -> Drive:
    return Drive(press, forward, left, 0.1, WALK, False)


class Office:
    """An arbiter, its pages, and an actuator that grants the lease as the guard does."""

    def __init__(self) -> None:
        self.arbiter = ControlArbiter(max_speed=0.12, place="here")
        self.now = 1000 * MS
        self.lease = ""
        self.mode = Mode.HOLD
        self.out: list[Message] = []

    def state(self) -> ActuatorState:
        return actuator_state(PROFILE, stamp_ns=self.now, mode=self.mode, lease=self.lease, reason="")

    def status(self, state: str = "resting") -> PlannerStatus:
        return PlannerStatus(self.now, state, "as it is", 0, 0, -1)  # type: ignore[arg-type]

    def beat(self, after_ns: int = 20 * MS, status: PlannerStatus | None = None) -> list[Message]:
        self.now += after_ns
        out = self.arbiter.beat(self.now, self.state(), status)
        for message in out:
            if (
                isinstance(message, ModeCommand)
                and (message.mode not in ("off", "stop") or message.take_over)
                and self.may(message)
            ):
                self.lease = message.holder
        self.out += out
        return out

    def may(self, order: ModeCommand) -> bool:
        return order.take_over or self.lease in ("", order.holder)

    def ask(self, page: int, request: object) -> str:
        return self.arbiter.ask(page, request, self.now)  # type: ignore[arg-type]

    def hold(self, page: int, press: int, beats: int = 5, **wish: float) -> list[Message]:
        """Hold the pad for some beats of 50 ms."""
        out = []
        for _ in range(beats):
            assert self.ask(page, drive(press, **wish)) == ""
            out += self.beat(50 * MS)
        return out


def of(kind: type[Message], messages: list[Message]) -> list[Message]:
    return [m for m in messages if isinstance(m, kind)]


def velocities(messages: list[Message]) -> list[VelocityCommand]:
    return [m for m in messages if isinstance(m, VelocityCommand)]


def orders(messages: list[Message]) -> list[str]:
    """Return orders in the order in which they were first sent."""
    return [m.mode for m in {m.sequence: m for m in messages if isinstance(m, ModeCommand)}.values()]


@pytest.fixture
def office() -> Office:
    made = Office()
    assert made.arbiter.arrive(1, made.now) == 1
    made.beat()
    return made


def test_held_pad_commands_walk_and_release_stops(office: Office) -> None:
    out = office.hold(1, press=1, beats=20)
    assert orders(out) == ["walk"]
    sent = velocities(out)
    assert 18 <= len(sent) <= 20, "about every 50 ms"
    for command in sent:
        np.testing.assert_allclose(command.velocity, [0.1, 0.0])
        assert (command.yaw_rate, command.body_height, command.lift, command.gait) == (0.1, 0.1, 0.04, "ripple")
    office.ask(1, Release())
    after = office.beat(1 * MS)
    assert orders(after) == ["stop"]
    assert [list(v.velocity) for v in velocities(after)] == [[0.0, 0.0]]
    later = [m for _ in range(50) for m in office.beat()]
    assert all(not v.velocity.any() for v in velocities(later))
    assert velocities([m for _ in range(20) for m in office.beat()]) == []


def test_commanded_speed_is_limited_to_robot_speed(office: Office) -> None:
    sent = velocities(office.hold(1, press=1, beats=4, forward=0.6, left=-0.8))
    for command in sent:
        np.testing.assert_allclose(command.velocity, [0.072, -0.096])


@pytest.mark.parametrize("silence_ms", [301, 5000])
def test_silent_page_stops_robot_and_needs_new_press(office: Office, silence_ms: int) -> None:
    office.hold(1, press=1)
    begun, out = office.now, []
    while office.now - begun < silence_ms * MS:
        out += office.beat(20 * MS)
    stopped = next(m for m in out if isinstance(m, ModeCommand) and m.mode == "stop")
    assert DEAD_MAN_NS - 50 * MS < stopped.stamp_ns - begun <= DEAD_MAN_NS + 20 * MS
    assert "press it again" in office.ask(1, drive(1)), "it was frozen, and goes on where it was"
    for _ in range(10):
        assert office.ask(1, drive(1)) == "", "which is reported once"
        assert all(not v.velocity.any() for v in velocities(office.beat(50 * MS)))
    assert any(v.velocity.any() for v in velocities(office.hold(1, press=2)))


def test_late_messages_of_lapsed_press_are_ignored(office: Office) -> None:
    office.hold(1, press=1)
    office.now += 2 * DEAD_MAN_NS  # no beat came between: the process was stopped
    for _ in range(10):
        office.ask(1, drive(1))
    assert all(not v.velocity.any() for v in velocities([m for _ in range(30) for m in office.beat()]))
    assert orders(office.out)[-1] == "stop"


def test_closed_page_stops_its_walk(office: Office) -> None:
    office.hold(1, press=1)
    office.arbiter.leave(1, office.now)
    assert orders(office.beat())[-1] == "stop"
    assert "was closed" in " ".join(office.arbiter.drain_words())
    assert office.arbiter.seats == ()


def test_page_without_lease_may_stop_and_turn_torque_off_only(office: Office) -> None:
    office.arbiter.arrive(2, office.now)
    office.hold(1, press=1)
    assert office.lease == "console 1 at here"
    assert "page 1 is in control of the robot; take over first" in office.ask(2, Command("stand"))
    assert "page 1 is in control" in office.ask(2, drive(1))
    assert office.ask(2, GO) != ""
    before = len(office.out)
    assert office.ask(2, Command("stop")) == ""
    office.beat()
    assert [m.holder for m in of(ModeCommand, office.out[before:]) if m.mode == "stop"] == ["console 2 at here"]  # type: ignore[attr-defined]
    for _ in range(5):  # the stop has also ended the press
        office.ask(1, drive(1))
        assert all(not v.velocity.any() for v in velocities(office.beat(50 * MS)))
    assert office.ask(2, Command("off")) == ""
    assert orders(office.beat())[-1] == "off"


def test_takeover_of_lease_causes_no_motion(office: Office) -> None:
    office.arbiter.arrive(2, office.now)
    office.hold(1, press=1)
    assert office.ask(2, TakeOver()) == ""
    (taken,) = (m for m in office.beat() if isinstance(m, ModeCommand) and m.holder == "console 2 at here")
    assert (taken.mode, taken.take_over) == ("stop", True)
    assert office.lease == "console 2 at here"
    office.beat()  # the actuator has confirmed it
    assert "page 2 is in control" in office.ask(1, drive(2))
    assert any(v.velocity.any() for v in velocities(office.hold(2, press=1)))


def test_lease_taken_by_other_client_ends_press(office: Office) -> None:
    office.hold(1, press=1)
    office.lease = "bench"
    office.beat()
    assert office.arbiter.at_the_pad == 0
    assert velocities([m for _ in range(5) for m in (office.ask(1, drive(1)), *office.beat(50 * MS)) if m]) == []
    assert "bench has taken over" in " ".join(office.arbiter.drain_words())


def test_same_page_number_of_other_console_is_another_client(office: Office) -> None:
    there = ControlArbiter(max_speed=0.12, place="there")
    there.arrive(1, office.now)
    office.hold(1, press=1)
    assert office.lease == "console 1 at here"
    there.beat(office.now, office.state(), office.status())
    assert there.ask(1, drive(1), office.now) == "console 1 at here is in control of the robot; take over first"
    assert not [m for m in there.beat(office.now + 50 * MS, office.state(), office.status()) if isinstance(m, VelocityCommand)]


def test_gait_auto_leaves_the_speed_to_the_planner_too(office: Office) -> None:
    def auto(request: Drive | GoTo) -> Drive | GoTo:
        return replace(request, walk=replace(request.walk, gait="auto"))

    office.hold(1, press=1)
    assert not any(command.auto_speed for command in velocities(office.out))
    assert office.ask(1, auto(drive(1))) == ""
    (command,) = velocities(office.beat(50 * MS))
    assert (command.gait, command.auto_speed) == ("auto", True)
    office.ask(1, Release())
    assert office.ask(1, auto(GO)) == ""
    goals = [m for _ in range(20) for m in (office.ask(1, Heartbeat()), *office.beat()) if isinstance(m, Goal)]
    assert {(goal.gait, goal.auto_speed) for goal in goals} == {("auto", True)}


def test_goal_is_repeated_until_arrival(office: Office) -> None:
    assert office.ask(1, GO) == ""
    out = [m for _ in range(50) for m in (office.ask(1, Heartbeat()), *office.beat()) if m]
    goals = [m for m in out if isinstance(m, Goal)]
    assert 4 <= len(goals) <= 6, "five a second"
    np.testing.assert_array_equal(goals[0].waypoints, [[1.0, 0.5]])
    assert goals[0].speed == 0.12, "no faster than the robot"
    assert orders(out) == ["walk"]
    office.beat(status=replace(office.status("arrived"), path=np.array([[0.9, 0.5]])))
    assert office.arbiter.goal is not None, "the planner has not received this goal yet"
    office.beat(status=replace(office.status("arrived"), path=np.array([[1.0, 0.5]])))
    assert office.arbiter.goal is None
    assert orders(office.beat())[-1:] in ([], ["stop"])
    assert orders(office.out)[-1] == "stop"


def test_goal_ends_on_cancel_pad_press_or_silent_page(office: Office) -> None:
    office.ask(1, GO)
    office.beat()
    office.ask(1, CancelGoal())
    office.beat()
    assert office.arbiter.goal is None
    office.ask(1, GO)
    office.beat()
    office.hold(1, press=1)
    assert office.arbiter.goal is None
    office.ask(1, Release())
    office.ask(1, GO)
    for _ in range(300):
        office.beat()
    assert office.arbiter.goal is None
    assert "no message from" in " ".join(office.arbiter.drain_words())
    assert of(ModeCommand, office.beat(1000 * MS)) == [], "nor does it keep the lease"


@pytest.mark.parametrize("mode", [Mode.OFF, Mode.READY, Mode.SIT, Mode.FAULT])
def test_refused_walk_names_mode(office: Office, mode: Mode) -> None:
    office.mode = mode
    office.beat()
    assert f"its mode is {mode}" in office.ask(1, drive(1))
    assert f"its mode is {mode}" in office.ask(1, GO)
    assert office.ask(1, Command("stand")) == ""


def test_no_page_leads_without_actuator_state(office: Office) -> None:
    office.arbiter.beat(office.now, None, None)
    assert "no message from the actuator" in office.ask(1, drive(1))
    assert office.ask(1, Command("off")) == "", "but it may be released"


def test_torque_off_is_repeated_until_torque_is_off(office: Office) -> None:
    office.ask(1, Command("off"))
    sent = of(ModeCommand, [m for _ in range(50) for m in office.beat()])
    assert 10 <= len(sent) <= 11
    assert len({m.sequence for m in sent}) == 1  # type: ignore[attr-defined]
    office.mode = Mode.OFF
    office.ask(1, Heartbeat())
    assert of(ModeCommand, [m for _ in range(40) for m in office.beat()]), "it may have been off before"
    for mode in (Mode.OFF, Mode.STAND):
        office.mode = mode
        office.ask(1, Heartbeat())
        heard = [m for _ in range(100) for m in office.beat()]
        assert not of(ModeCommand, heard[5:]), "a restarted stop path would obey it again"


def test_torque_off_overridden_by_other_client_is_not_repeated(office: Office) -> None:
    """Send an order of torque off only once if another operator overrides it.

    An actuator or a stop path that restarts would obey a repeated order, and the robot would fall.
    """
    office.ask(1, Command("off"))
    office.beat()
    for mode in (Mode.OFF, Mode.STAND):
        office.mode = mode
        office.beat(100 * MS)
    office.ask(1, Heartbeat())
    assert not of(ModeCommand, [m for _ in range(100) for m in office.beat()])


@pytest.mark.parametrize("order", ["stand", "ready", "sit", "stop"])
def test_order_given_before_torque_off_is_not_repeated(office: Office, order: str) -> None:
    """Stop repeating an order after torque went off.

    An actuator that restarts does not know earlier orders, and would take a repeated one for new.
    """
    office.ask(1, Command(order))  # type: ignore[arg-type]
    assert of(ModeCommand, office.beat())
    office.mode = Mode.OFF
    office.beat(2100 * MS)
    for mode in (Mode.OFF, Mode.HOLD):
        office.mode = mode
        office.ask(1, Heartbeat())
        assert not of(ModeCommand, [m for _ in range(100) for m in office.beat()])


def test_stand_from_torque_off_is_repeated_until_followed(office: Office) -> None:
    office.mode = Mode.OFF
    office.ask(1, Command("stand"))
    assert len(of(ModeCommand, [m for _ in range(90) for m in office.beat()])) >= 4


def test_stop_of_page_without_lease_is_repeated_briefly(office: Office) -> None:
    office.lease = "another"
    office.ask(1, Command("stop"))
    assert len(of(ModeCommand, [m for _ in range(90) for m in office.beat()])) >= 4
    office.ask(1, Heartbeat())
    office.beat(400 * MS)
    assert not of(ModeCommand, [m for _ in range(100) for m in office.beat()])


def test_sequence_follows_restarted_robot_clock(office: Office) -> None:
    office.ask(1, Command("stand"))
    office.beat()
    office.now = 10 * MS
    office.ask(1, Heartbeat())
    office.ask(1, Command("sit"))
    sit = next(m for m in office.beat() if isinstance(m, ModeCommand) and m.mode == "sit")
    assert sit.sequence <= office.now + 2000 * MS


def test_sequence_increases_over_pages_and_restarts(office: Office) -> None:
    office.arbiter.arrive(2, office.now)
    for k in range(6):
        office.ask(1 + k % 2, Command("stop"))
    sequences = [m.sequence for m in office.beat() if isinstance(m, ModeCommand)]
    assert sequences == sorted(set(sequences))
    assert sequences[0] >= office.now - 20 * MS, "above those of a console that ran before"


def test_page_without_free_seat_may_only_view_and_stop(office: Office) -> None:
    for page in range(2, SEATS + 1):
        assert office.arbiter.arrive(page, office.now) == page
    assert office.arbiter.arrive(99, office.now) == 0
    office.beat()
    assert "8 other pages may control the robot; close one, and reload this page" in office.ask(99, drive(1))
    assert office.ask(99, TakeOver()) == office.ask(99, drive(2))
    assert office.ask(99, Command("stop")) == ""
    office.arbiter.leave(3, office.now)
    assert office.arbiter.arrive(100, office.now) == 3, "a seat is taken again: the actuator remembers sixteen holders alone"


def test_page_name_is_shown_in_its_seat(office: Office) -> None:
    office.ask(1, Name("Ann"))
    office.hold(1, press=1)
    (seat,) = office.arbiter.seats
    assert (seat.name, seat.leads) == ("Ann", True)


ASKED = [Release(), Command("stop"), Command("off"), TakeOver(), GO, CancelGoal(), Heartbeat()]


class Anything(RuleBasedStateMachine):
    """Any actions of pages, in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.office = Office()
        self.heard: dict[int, int] = {}  # last time each page held its pad with a valid press
        self.lapsed: dict[int, int] = {}
        self.pages: set[int] = set()

    @initialize()
    def two_pages(self) -> None:
        for page in (1, 2):
            self.office.arbiter.arrive(page, self.office.now)
            self.pages.add(page)
        self.office.beat()

    @rule(page=st.sampled_from([1, 2]), press=st.integers(0, 4))
    def pad_held(self, page: int, press: int) -> None:
        if page in self.pages and self.office.ask(page, drive(press)) == "":
            self.heard[page] = self.office.now

    @rule(page=st.sampled_from([1, 2]), what=st.sampled_from(ASKED))
    def request_sent(self, page: int, what: object) -> None:
        if page in self.pages:
            self.office.ask(page, what)

    @rule(page=st.sampled_from([1, 2]))
    def page_reloaded(self, page: int) -> None:
        self.office.arbiter.leave(page, self.office.now)
        self.office.arbiter.arrive(page, self.office.now)

    @rule(after=st.sampled_from([1, 20, 49, 301, 6000]), mode=st.sampled_from([Mode.HOLD, Mode.WALK, Mode.OFF]))
    def time_passes(self, after: int, mode: Mode) -> None:
        self.office.mode = mode
        out = self.office.beat(after * MS)
        for command in velocities(out):
            if command.velocity.any():
                fresh = [page for page, at in self.heard.items() if self.office.now - at <= DEAD_MAN_NS]
                assert any(self.office.lease == f"console {page} at here" for page in fresh), "who leads holds the pad"
        assert not of(Goal, out) or self.office.arbiter.goal is not None

    @invariant()
    def at_most_one_page_holds_pad(self) -> None:
        assert self.office.arbiter.at_the_pad in (0, 1, 2)


TestAnything = Anything.TestCase
TestAnything.settings = settings(max_examples=60, stateful_step_count=40, deadline=None, derandomize=True)
