"""Commands of `sextant.Client` to a scripted actuator: result, refusal, lost lease, silence."""

import contextlib
import runpy
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sextant import client
from sextant.client import PATIENCE_S, Client, ClientError, Commander
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic, Inbox
from sextant.shared.wire import codec, topics
from sextant.shared.wire.access import ROLE_NAMED, ROUTER_OF
from sextant.shared.wire.messages import (
    BodyPose,
    Goal,
    Health,
    Message,
    Mode,
    ModeCommand,
    PlannerStatus,
    PostureCommand,
    StopOrder,
    Tick,
    VelocityCommand,
)
from sextant.shared.wire.transport import TransportError
from tests.support.states import actuator_state, frame_of_version_0_1

MS = 1_000_000
BEAT_NS = 50 * MS
PROFILE = load_profile("phantomx_mk2")
NOWHERE = np.zeros(0)
MODES = {"off": Mode.OFF, "stand": Mode.HOLD, "walk": Mode.WALK, "sit": Mode.READY}


class Robot(threading.Condition):
    """A robot and its clock: in each wait of the client, 50 ms pass, it obeys what was sent, and publishes its state."""

    def __init__(self) -> None:
        super().__init__()
        self.now_ns = 1_000_000 * MS
        self.state = actuator_state(PROFILE, mode=Mode.READY, lease="", reason="sitting")
        self.planner = PlannerStatus(0, "waiting", "", 0, 0, -1)
        self.pose: BodyPose | None = BodyPose(0, np.eye(4), np.eye(4), np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6)))
        self.ahead_ns = 0  # offset of the robot's clock from the client's
        self.silent = False
        self.sent: list[Message] = []
        self.obey: Callable[[ModeCommand | StopOrder], object] = self.obeys
        self.then: Callable[[], object] = lambda: None  # what else happens in each period
        self.heard: list[tuple[AnyTopic, Message]] = []  # other messages that the client receives in the next period

    def commander(self, *args: Any, **options: Any) -> Commander:
        made = Commander(*args, **options)
        made.changed = self
        self.inbox = Inbox(made.subscribes, made.stages)
        self.made = made
        return made

    def wait(self, timeout: float | None = None) -> bool:
        self.now_ns += BEAT_NS
        self.inbox.now_ns = self.now_ns
        self.then()
        if not self.silent:
            self.publish(topics.ACTUATOR_STATE, self.state)
            self.publish(topics.PLANNER_STATUS, self.planner)
            if self.pose is not None:
                self.publish(topics.BODY_POSE, self.pose)
        for topic, message in self.heard:
            self.publish(topic, message)
        self.heard.clear()
        for message in self.made.step(Tick(self.now_ns), self.inbox):
            self.sent.append(message)
            if isinstance(message, ModeCommand | StopOrder) and not self.silent:
                self.obey(message)
        return True

    def publish(self, topic: AnyTopic, message: Message) -> None:
        self.inbox.receive(topic, codec.encode(replace(message, stamp_ns=self.now_ns + self.ahead_ns)), self.now_ns)

    def set(self, **changes: Any) -> None:
        self.state = replace(self.state, **changes)

    def obeys(self, order: ModeCommand | StopOrder) -> None:
        if isinstance(order, ModeCommand):
            mode = MODES.get(order.mode, Mode.HOLD)
            self.set(mode=mode, lease=order.holder, warnings=(), reason="obeyed")
        elif order.mode == "off":
            self.set(mode=Mode.OFF)
        elif self.state.mode is Mode.WALK:
            self.set(mode=Mode.HOLD)

    def refuses(self, order: ModeCommand | StopOrder) -> None:
        if isinstance(order, ModeCommand) and order.mode == "walk":
            self.set(warnings=("`walk` refused: the mode is ready, order `stand` first",))

    def orders(self) -> list[str]:
        """The orders that were sent, without repetitions of the same one."""
        numbered = dict.fromkeys((m.mode, m.sequence) for m in self.sent if isinstance(m, ModeCommand | StopOrder))
        return [mode for mode, _ in numbered]


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch) -> Robot:
    made = Robot()
    monkeypatch.setattr(client, "Commander", made.commander)
    monkeypatch.setattr(client, "ZenohLink", lambda _: contextlib.nullcontext())
    monkeypatch.setattr(client, "run_live", lambda *_, **__: None)
    monkeypatch.setattr(client.time, "monotonic", lambda: made.now_ns * 1e-9)
    return made


def test_status_is_readable_from_other_threads_while_messages_are_decoded(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Client():
        robot.wait()
        fresh, seen = robot.inbox.fresh, []

        def looked(topic: AnyTopic, within_s: float | None = None) -> Message | None:
            seen.append(robot.made.newest)
            return fresh(topic, within_s)

        monkeypatch.setattr(robot.inbox, "fresh", looked)
        robot.wait()
    assert len(seen) >= 3
    assert all(status is not None for status in seen)


def test_walk_is_stopped_when_client_disconnects(robot: Robot) -> None:
    with Client(name="me") as me:
        me.stand()
        me.walk(0.08)
        assert me.state.mode is Mode.WALK
        assert robot.state.lease == "me"
    assert robot.orders() == ["stand", "walk", "stop"]
    assert robot.state.mode is Mode.HOLD


def test_refusal_is_raised_with_reason_and_command_is_not_repeated(robot: Robot) -> None:
    robot.obey = robot.refuses
    with Client(name="me") as me:
        for _ in range(2):  # the second refusal has the words of the first
            began_ns = robot.now_ns
            with pytest.raises(ClientError, match="order `stand` first"):
                me.walk(0.08)
            assert robot.now_ns - began_ns < 2_000 * MS
        sent = len(robot.sent)
        for _ in range(100):
            robot.wait()
        assert len(robot.sent) == sent
    assert robot.orders() == ["walk", "walk"], "there is no walk to be stopped"


def test_unanswered_command_fails_with_state_of_robot(robot: Robot) -> None:
    robot.obey = lambda _: None
    with (
        Client(name="me") as me,
        pytest.raises(ClientError, match=r"`sit` is not done within 20 s: the robot is in mode ready \(sitting\)"),
    ):
        me.sit()


def test_interrupted_motion_raises_its_cause_at_once(robot: Robot) -> None:
    began_ns = robot.now_ns

    def then() -> None:
        if robot.now_ns - began_ns > 1_000 * MS:
            robot.set(mode=Mode.FAULT, reason="no servo answers")

    robot.obey = lambda _: robot.set(mode=Mode.STAND, lease="me", reason="standing up")
    robot.then = then
    with Client(name="me") as me:
        with pytest.raises(ClientError, match="`stand` was interrupted: no servo answers; then order it again"):
            me.stand()
        assert robot.now_ns - began_ns < 2_000 * MS


def test_client_names_another_version_of_the_robot(robot: Robot) -> None:
    robot.silent = True
    robot.then = lambda: robot.inbox.receive(topics.ACTUATOR_STATE, frame_of_version_0_1(PROFILE), robot.now_ns)
    with pytest.raises(ClientError, match="found ActuatorState:5576558f: sender and receiver need the same version"):
        Client(name="me")


def test_silent_actuator_has_no_state(robot: Robot) -> None:
    with Client(name="me") as me:
        me.stand()
        robot.silent = True
        for _ in range(50):
            robot.wait()
        for read in (lambda: me.state, lambda: me.status, me.sit):
            with pytest.raises(ClientError, match="published no state for 2 s"):
                read()
        robot.silent = False
        robot.wait()
        assert me.state.mode is Mode.HOLD


def test_client_waits_for_pose_and_planner(robot: Robot) -> None:
    pose, robot.pose = robot.pose, None
    with Client(name="me") as me:
        assert me.status.pose is None
        missing = r"not ready within 3 s: the robot is in mode ready \(sitting\); no pose from perception"
        with pytest.raises(ClientError, match=missing):
            me.wait_until_ready(3.0)
        began_ns = robot.now_ns
        robot.then = lambda: setattr(robot, "pose", pose) if robot.now_ns > began_ns + 2_000 * MS else None
        me.wait_until_ready()
        assert me.status.pose is not None
        assert robot.now_ns - began_ns < 2_200 * MS


def test_endpoint_without_actuator_is_an_error(robot: Robot) -> None:
    robot.silent = True
    with pytest.raises(ClientError, match=r"no actuator publishes its state at tcp/127\.0\.0\.1:7447, namespace sextant"):
        Client()


def walks_to(robot: Robot, me: Client, *, arrives_after: int = 10**9, **during: Any) -> None:
    """Go to a place; `during` changes the robot's state after 20 periods, and it arrives after more."""
    periods = 0

    def then() -> None:
        nonlocal periods
        periods += 1
        if periods == 20:
            robot.set(**during)
        if periods == arrives_after:
            robot.planner = replace(robot.planner, state="arrived", path=np.array([[1.0, 0.5]]))

    robot.then = then
    me.goto(1.0, 0.5)


def test_goto_ends_with_stop_at_goal(robot: Robot) -> None:
    with Client(name="me") as me:
        me.stand()
        walks_to(robot, me, arrives_after=100)
    assert robot.orders() == ["stand", "walk", "stop"]
    assert any(isinstance(m, Goal) and m.waypoints.tolist() == [[1.0, 0.5]] for m in robot.sent)


def test_goto_ignores_arrival_at_earlier_goal(robot: Robot) -> None:
    robot.planner = replace(robot.planner, state="arrived", path=np.array([[0.99, 0.5]]))
    with Client(name="me") as me, pytest.raises(ClientError, match="not reached within 5 s"):
        me.goto(1.0, 0.5, within_s=5.0)
    assert robot.orders() == ["walk", "stop"]


@pytest.mark.parametrize("mode", [Mode.FAULT, Mode.OFF, Mode.READY])
def test_goto_ends_when_robot_no_longer_walks(robot: Robot, mode: Mode) -> None:
    with Client(name="me") as me:
        me.stand()
        robot.obey = lambda order: robot.obeys(order) if robot.state.mode in (Mode.HOLD, Mode.WALK) else None
        with pytest.raises(ClientError, match=f"the robot is in mode {mode}: a servo is silent"):
            walks_to(robot, me, mode=mode, reason="a servo is silent")


def test_goto_raises_first_failure_if_stop_fails_too(robot: Robot) -> None:
    with Client(name="me") as me:
        me.stand()
        robot.planner = replace(robot.planner, state="blocked", reason="a gap of 0.3 m")
        robot.obey = lambda order: robot.obeys(order) if order.mode == "walk" else None
        with pytest.raises(ClientError, match=r"no way to the goal: a gap of 0.3 m") as failed:
            me.goto(1.0, 0.5)
        robot.obey = robot.obeys
    assert failed.value.__notes__[0].startswith("afterwards: `stop` is not done within 20 s")


def test_goto_ends_without_stop_when_other_client_takes_over(robot: Robot) -> None:
    with Client(name="me") as me:
        me.stand()
        robot.obey = lambda order: robot.obeys(order) if robot.state.lease != "you" else None
        with pytest.raises(ClientError, match="you has taken over the robot"):
            walks_to(robot, me, lease="you")
        sent = len(robot.sent)
        for _ in range(100):
            robot.wait()
        assert len(robot.sent) == sent, "it gives way"
    assert robot.orders() == ["stand", "walk"]


def test_goto_fails_without_path_or_planner_status(robot: Robot) -> None:
    with Client(name="me") as me:
        me.stand()
        robot.planner = replace(robot.planner, state="blocked", reason="a gap of 0.3 m")
        began_ns = robot.now_ns
        with pytest.raises(ClientError, match=r"no way to the goal: a gap of 0.3 m"):
            me.goto(1.0, 0.5)
        assert robot.now_ns - began_ns == pytest.approx((PATIENCE_S + 1.0) * 1e9, abs=1e9)
        with pytest.raises(ClientError, match=r"no way to the goal: a gap of 0.3 m"):
            me.goto(1.0, 0.5, patience_s=2.0)
        robot.planner = replace(robot.planner, state="stepping", reason="")
        robot.then = lambda: setattr(robot, "silent", robot.state.mode is Mode.WALK)
        with pytest.raises(ClientError, match="published no state"):
            me.goto(1.0, 0.5)


def test_silent_endpoint_gives_client_error(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: object) -> None:
        raise TransportError("nothing answers at tcp/127.0.0.1:7447")

    monkeypatch.setattr(client, "ZenohLink", refuse)
    with pytest.raises(ClientError, match="nothing answers at"):
        Client(name="me")


def test_goto_raises_invalid_command_at_once(robot: Robot) -> None:
    reason = "a body height of 0.085 to 0.15 m expected, 0.5 m commanded"
    with Client(name="me") as me:
        me.stand()
        robot.planner = replace(robot.planner, state="blocked", reason=reason, invalid_command=True)
        began_ns = robot.now_ns
        with pytest.raises(ClientError, match=reason):
            me.goto(1.0, 0.5, body_height_m=0.5)
        assert robot.now_ns - began_ns < 2e9
        with pytest.raises(ValueError, match="finite"):
            me.goto(float("nan"), 0.5)


def test_client_without_lease_stops_robot_once_and_leaves_lease(robot: Robot) -> None:
    robot.set(mode=Mode.WALK, lease="you")
    robot.obey = lambda order: robot.obeys(order) if isinstance(order, StopOrder) else None
    with Client(name="me") as me:
        me.stop()
        assert robot.state.mode is Mode.HOLD
        assert robot.state.lease == "you"
        robot.set(mode=Mode.WALK)
        sent = len(robot.sent)
        for _ in range(100):
            robot.wait()
        assert len(robot.sent) == sent


def test_lease_of_another_client_is_refused_with_the_way_to_take_it_over(robot: Robot) -> None:
    refused = "`stand` of me refused: you holds the lease; take it over, or wait until it expires"
    robot.set(lease="you")
    robot.obey = lambda _: robot.set(warnings=(refused,))
    with Client(name="me") as me, pytest.raises(ClientError, match=r"Client\(\.\.\., take=True\) takes it over"):
        me.stand()


def test_client_commands_nothing_while_another_client_of_its_name_leads(robot: Robot) -> None:
    robot.set(mode=Mode.WALK, lease="me")
    with Client(name="me", take=True) as me:
        taken = r"another client named 'me' leads the robot; .* Client\(\.\.\., name=\.\.\.\)"
        for command in (me.stand, me.sit, lambda: me.walk(0.08), lambda: me.goto(1.0, 0.5), me.posture):
            with pytest.raises(ClientError, match=taken):
                command()
        assert robot.sent == []
        me.stop()
        assert robot.state.mode is Mode.HOLD
    assert all(isinstance(message, ModeCommand | StopOrder) and message.mode == "stop" for message in robot.sent)


def test_client_waits_for_the_lease_of_an_earlier_program_of_its_name(robot: Robot) -> None:
    robot.set(lease="me")
    began_ns = robot.now_ns
    robot.then = lambda: robot.set(lease="") if began_ns + 3_000 * MS <= robot.now_ns < began_ns + 3_100 * MS else None
    with Client(name="me") as me:
        me.stand()
        assert robot.state.mode is Mode.HOLD
        assert robot.now_ns - began_ns > 3_000 * MS


def test_certificate_without_walk_permission_may_stop(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    viewer = ROLE_NAMED["viewer"]
    monkeypatch.setattr(client.Keys, "load", lambda _: SimpleNamespace(role=viewer, refusal=viewer.refusal))
    robot.set(mode=Mode.WALK, lease="you")
    with Client("tls/robot.local:7448", keys="keys", name="me") as me:
        began_ns = robot.now_ns
        for command in (me.stand, me.sit, lambda: me.walk(0.08), lambda: me.goto(1.0, 0.5), me.posture):
            with pytest.raises(ClientError, match="this certificate"):
                command()
        assert robot.now_ns == began_ns, "at once"
        me.stop()
        me.torque_off()
    assert robot.state.mode is Mode.OFF
    assert all(isinstance(message, StopOrder) for message in robot.sent)


def test_router_refusal_is_given_as_reason(robot: Robot) -> None:
    refused = Health(0, f"{ROUTER_OF}viewer", "listening", 0, 0, 0, "", (), NOWHERE, NOWHERE)
    robot.obey = lambda _: None
    robot.then = lambda: robot.heard.append((topics.HEALTH_OF["viewer"], refused))
    with Client(name="me") as me, pytest.raises(ClientError, match="use the keys of another role"):
        me.stand()


def test_velocity_is_repeated_while_walk_is_ordered(robot: Robot) -> None:
    with Client(name="me") as me:
        me.stand()
        me.walk(0.08, yaw_rate_rad_s=0.1)
        for _ in range(20):
            robot.wait()
        me.stop()
        sent = [m for m in robot.sent if isinstance(m, VelocityCommand)]
        assert len(sent) >= 20
        assert {(*m.velocity.tolist(), m.yaw_rate) for m in sent} == {(0.08, 0.0, 0.1)}
        robot.sent.clear()
        robot.wait()
        assert not any(isinstance(m, VelocityCommand) for m in robot.sent)


def test_posture_is_repeated_until_another_command(robot: Robot) -> None:
    def then() -> None:
        if any(isinstance(message, PostureCommand) for message in robot.sent):
            robot.planner = replace(robot.planner, state="stepping" if robot.now_ns < reached_ns else "arrived")

    robot.planner, robot.then = replace(robot.planner, state="arrived"), then  # in an earlier posture
    with Client(name="me") as me:
        me.stand()
        reached_ns = robot.now_ns + 2_000 * MS
        me.posture(0.01, up_m=-0.02, pitch_rad=0.1)
        assert robot.now_ns >= reached_ns
        sent = [m for m in robot.sent if isinstance(m, PostureCommand)]
        assert {(*m.place.tolist(), *m.rpy.tolist()) for m in sent} == {(0.01, 0.0, -0.02, 0.0, 0.1, 0.0)}
        for _ in range(20):
            robot.wait()
        assert len([m for m in robot.sent if isinstance(m, PostureCommand)]) >= len(sent) + 4
    assert robot.orders() == ["stand", "walk", "stop"]


def test_posture_out_of_reach_raises_reason_and_stops(robot: Robot) -> None:
    robot.planner = replace(robot.planner, state="blocked", reason="posture: the left front leg does not reach it")
    with Client(name="me") as me:
        me.stand()
        with pytest.raises(ClientError, match="posture: the left front leg"):
            me.posture(0.5)
        assert robot.orders() == ["stand", "walk", "stop"]
        robot.planner = replace(robot.planner, state="stepping", reason="moving")
        with pytest.raises(ClientError, match="the posture is not reached within 2 s"):
            me.posture(0.01, within_s=2.0)
        with pytest.raises(ValueError, match="finite"):
            me.posture(float("inf"))


def test_restarted_robot_clock_cancels_command(robot: Robot) -> None:
    with Client(name="me") as me:
        me.stand()
        me.walk(0.08)
        robot.ahead_ns = -100_000 * MS
        for _ in range(400):
            robot.wait()
        assert robot.made.status() == ""
        me.walk(0.08)


def test_example_leads_the_robot_to_its_place(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def sleep(seconds: float) -> None:
        for _ in range(round(seconds * 1e9 / BEAT_NS)):
            robot.wait()

    def then() -> None:
        if any(isinstance(message, Goal) for message in robot.sent):
            place = np.eye(4)
            place[0, 3] = 0.8
            robot.pose = replace(robot.pose, T_world_body=place)
            robot.planner = replace(robot.planner, state="arrived", path=np.array([[0.8, 0.0]]))

    robot.then = then
    monkeypatch.setattr(client.time, "sleep", sleep)
    script = Path(__file__).parents[2] / "examples" / "lead_robot.py"
    monkeypatch.setattr(sys, "argv", [str(script), "tcp/127.0.0.1:7447", "0.8"])
    runpy.run_path(str(script), run_name="__main__")
    assert robot.orders() == ["stand", "walk", "walk", "stop", "sit"]
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("standing: ")
    assert printed[1:] == ["arrived at x 0.80, y 0.00 m", "ready: obeyed"]
    robot.obey = robot.refuses
    robot.set(mode=Mode.HOLD)
    with pytest.raises(SystemExit, match="the robot did not obey: "):
        runpy.run_path(str(script), run_name="__main__")


def test_program_that_does_not_close_its_client_stops_the_robot_at_its_end(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_exit: list[Callable[[], None]] = []
    monkeypatch.setattr(client.atexit, "register", at_exit.append)
    me = Client(name="me")
    me.stand()
    me.walk(0.08)
    (close,) = at_exit
    close()
    assert robot.state.mode is Mode.HOLD
    assert robot.orders()[-1] == "stop"
