"""Twists move the robot while they arrive, by the rules of all operators.

The robot stops when they stop.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.deploy.ros2.lead import DEAD_MAN_NS, Lead, Walk
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import ActuatorState, Message, Mode, ModeCommand, VelocityCommand
from tests.support.states import actuator_state

MS = 1_000_000
PROFILE = load_profile("phantomx_mk2")


class LeadBench:
    """A lead in beats of 20 ms, and an actuator that gives the lease to each sender."""

    def __init__(self, ahead: int = 0, **state: Any) -> None:
        self.lead = Lead(Walk(max_speed=0.1, body_height=0.11))
        self.now = 1_000 * MS
        self.ahead = ahead  # offset of the robot's clock ahead of this machine's
        found = {"lease": "", "mode": Mode.HOLD, "reason": "standing", **state}
        self.state: ActuatorState | None = actuator_state(PROFILE, stamp_ns=0, **found)
        self.said: list[Message] = []
        self.words: list[str] = []
        self.beat()

    def beat(self) -> None:
        self.now += 20 * MS
        if self.state is not None:
            self.state = replace(self.state, stamp_ns=self.now + self.ahead)
        made = self.lead.beat(self.now, self.state)
        for message in made:
            if isinstance(message, ModeCommand) and message.mode == "walk" and self.state is not None:
                self.state = replace(self.state, lease=self.state.lease or message.holder)
        self.said += made
        self.words += self.lead.drain_words()

    def drive(self, beats: int, x: float = 0.05, y: float = 0.0, turn: float = 0.0) -> None:
        """Receive a Twist in each beat."""
        for _ in range(beats):
            self.lead.twist(np.array([x, y]), turn, self.now)
            self.beat()

    def rest(self, beats: int) -> None:
        for _ in range(beats):
            self.beat()

    def velocities(self) -> list[VelocityCommand]:
        return [m for m in self.said if isinstance(m, VelocityCommand)]

    def orders(self) -> list[str]:
        return [m.mode for m in self.said if isinstance(m, ModeCommand)]


def test_twists_become_velocity_commands_and_renew_lease() -> None:
    desk = LeadBench()
    desk.drive(100, x=0.04, y=-0.02, turn=0.3)
    found = desk.velocities()
    assert 45 <= len(found) <= 51, "every 40 ms"
    assert all(v.velocity.tolist() == [0.04, -0.02] and v.yaw_rate == 0.3 and v.body_height == 0.11 for v in found)
    orders = [m for m in desk.said if isinstance(m, ModeCommand)]
    assert {(m.mode, m.holder, m.take_over) for m in orders} == {("walk", "ros2", False)}
    assert len({m.sequence for m in orders}) == 1, "one order, repeated"
    assert 4 <= len(orders) <= 5, "twice a second"


def test_commands_are_stamped_with_robot_clock_after_its_restart() -> None:
    hour = 3_600_000 * MS
    desk = LeadBench(ahead=hour)
    desk.drive(60)
    orders = [m for m in desk.said if isinstance(m, ModeCommand)]
    assert len(orders) >= 2
    assert all(0 <= desk.now + hour - m.stamp_ns <= 61 * 20 * MS for m in desk.said)
    assert orders[0].sequence > hour
    desk.ahead = 0
    desk.drive(102)  # two seconds in which the reset is only a claim, and some more
    assert desk.words[-1].startswith("the robot's clock has restarted"), "the Twists that come now move nothing"
    assert not desk.lead.leading
    desk.rest(30)
    desk.said.clear()
    desk.drive(2)
    (order,) = [m for m in desk.said if isinstance(m, ModeCommand)]
    assert order.stamp_ns == desk.now - 20 * MS
    assert order.sequence < hour, "another bridge would count on from here"


def test_twist_timeout_sends_one_zero_velocity_and_stop() -> None:
    desk = LeadBench()
    desk.drive(20)
    desk.said.clear()
    before = desk.now
    desk.rest(60)
    zeros = [v for v in desk.velocities() if not v.velocity.any() and v.yaw_rate == 0.0]
    assert len(zeros) == 1
    assert DEAD_MAN_NS - 40 * MS <= zeros[0].stamp_ns - before <= DEAD_MAN_NS + 40 * MS
    assert desk.orders()[-1] == "stop"
    assert desk.orders().count("stop") == 1
    after = [m for m in desk.said if m.stamp_ns > zeros[0].stamp_ns]
    assert after == []
    assert "no Twist for 0.3 s" in desk.words[-1]


def test_drive_resumes_after_pause_with_newer_order() -> None:
    desk = LeadBench()
    for _ in range(2):
        desk.drive(20)
        desk.rest(30)
    orders = {m.sequence: m.mode for m in desk.said if isinstance(m, ModeCommand)}
    assert list(orders.values()) == ["walk", "stop", "walk", "stop"]
    assert list(orders) == sorted(orders)


def test_zero_twist_does_not_start_walking() -> None:
    desk = LeadBench()
    desk.drive(50, x=0.0)
    assert desk.said == []
    desk.drive(20)
    desk.drive(50, x=0.0)  # while the lead holds, zero is a velocity like others
    assert desk.lead.leading
    assert not desk.velocities()[-1].velocity.any()


@pytest.mark.parametrize(
    ("state", "words"),
    [
        ({"lease": "console 1"}, "console 1 holds the lease"),
        ({"mode": Mode.READY, "reason": "sitting"}, "in mode ready: sitting; run `sextant order stand`"),
        ({"mode": Mode.OFF, "reason": "ordered off"}, "in mode off"),
    ],
)
def test_refusal_is_logged_once_and_requires_released_stick(state: dict[str, Any], words: str) -> None:
    desk = LeadBench(**state)
    desk.drive(50)
    assert desk.said == []
    assert len(desk.words) == 1
    assert words in desk.words[0]
    assert desk.state is not None
    desk.state = replace(desk.state, lease="", mode=Mode.HOLD)
    desk.drive(50)
    assert desk.said == [], "the stick is still held: it has to be released first"
    desk.rest(20)
    desk.drive(5)
    assert desk.orders() == ["walk"]


def test_no_commands_without_actuator_state() -> None:
    desk = LeadBench()
    desk.state = None
    desk.beat()
    desk.drive(10)
    assert desk.said == []
    assert "is it running?" in desk.words[0]


@pytest.mark.parametrize("change", [{"lease": "console 2"}, {"mode": Mode.OFF, "reason": "torque off"}])
def test_lost_lease_or_torque_off_ends_drive_without_commands(change: dict[str, Any]) -> None:
    desk = LeadBench()
    desk.drive(20)
    assert desk.state is not None
    desk.state = replace(desk.state, **change)
    desk.said.clear()
    desk.drive(50)
    assert desk.said == [], "neither a velocity nor an order, though Twists go on"
    assert not desk.lead.leading
    desk.state = replace(desk.state, lease="", mode=Mode.HOLD)
    desk.drive(1, x=0.0)  # a Twist of zeros is a released stick
    desk.drive(5)
    assert desk.orders() == ["walk"]


def test_velocities_are_sent_only_after_lease_is_granted() -> None:
    desk = LeadBench()
    assert desk.state is not None
    desk.lead.twist(np.array([0.05, 0.0]), 0.0, desk.now)
    made = desk.lead.beat(desk.now + 20 * MS, desk.state)
    assert [type(m) for m in made] == [ModeCommand], "the actuator has not given it yet"


def test_denied_lease_is_reported_with_reason() -> None:
    desk = LeadBench()
    assert desk.state is not None
    refused = "`walk` of ros2 refused: a newer order was given under this name; each client needs its own name"
    for _ in range(60):
        desk.state = replace(desk.state, lease="", warnings=(refused,))
        desk.drive(1)
    assert desk.velocities() == []
    assert not desk.lead.leading
    assert desk.words[-1] == f"the actuator does not grant the lease; {refused}"


def test_release_stops_driven_robot() -> None:
    desk = LeadBench()
    assert desk.lead.release(desk.now) == []
    desk.drive(10)
    zero, stop = desk.lead.release(desk.now)
    assert isinstance(zero, VelocityCommand)
    assert not zero.velocity.any()
    assert isinstance(stop, ModeCommand)
    assert stop.mode == "stop"


@given(st.lists(st.tuples(st.floats(-1e300, 1e300), st.floats(-1e300, 1e300), st.floats(-1e300, 1e300)), max_size=20))
@settings(deadline=None)
def test_velocity_commands_are_clipped_to_robot_limits(asked: list[tuple[float, float, float]]) -> None:
    desk = LeadBench()
    for x, y, turn in asked:
        desk.drive(2, x, y, turn)
    for found in desk.velocities():
        assert np.linalg.norm(found.velocity) <= 0.1 + 1e-9
        assert abs(found.yaw_rate) <= 1.0
