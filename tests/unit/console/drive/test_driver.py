"""Keys and sticks against a scripted robot: the robot walks only while an input is held."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.console.drive import driver as driver_module
from sextant.services.console.drive.driver import SPEEDS, TURN_RAD_S, Driver, TerminalLostError
from sextant.services.console.drive.gamepad import Gamepad, GamepadError
from sextant.services.console.drive.keyboard import FIRST_REPEAT_NS, REPEAT_NS, Wish
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Message, Mode, ModeCommand, PlannerStatus, StopOrder, Tick, VelocityCommand
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
FASTEST = PROFILE.stance.max_speed
MS = 1_000_000
BEAT_MS = 33
AHEAD_NS = 5_000_000 * MS  # of the robot's clock
NAME = "drive 1 at here"
NOW = (Mode.HOLD, Mode.WALK)


class FakeTerminal:
    def __init__(self) -> None:
        self.typed = b""
        self.lost = ""

    def fileno(self) -> int:
        raise AssertionError("no test waits")

    def read(self) -> bytes:
        if self.lost:
            raise TerminalLostError(self.lost)
        typed, self.typed = self.typed, b""
        return typed


class FakeGamepad(Gamepad):
    def __init__(self, path: str = "js0"):
        self.path = path
        self.moved: Wish | None = None
        self.pressed = False
        self.gone = ""

    def read(self) -> bool:
        if self.gone:
            raise GamepadError(self.gone)
        pressed, self.pressed = self.pressed, False
        return pressed

    def wish(self) -> Wish | None:
        return self.moved

    def close(self) -> None:
        pass


class Rig:
    """A driver and a robot that obeys its orders as the guard does."""

    def __init__(self, gamepad: Gamepad | None = None, barred: Callable[[Inbox], str] = lambda _: ""):
        self.terminal = FakeTerminal()
        self.driver = Driver(PROFILE, "here", self.terminal, gamepad, "ripple", barred)
        self.inbox = Inbox(self.driver.subscribes, self.driver.stages)
        self.now = 1000 * MS
        self.state = actuator_state(PROFILE, mode=Mode.HOLD, lease="", reason="standing")
        self.ahead_ns = AHEAD_NS
        self.silent = False
        self.sent: list[Message] = []
        self.step()

    def step(self, keys: str = "", after_ms: int = BEAT_MS) -> list[Message]:
        """Let time pass, type keys, and return what the driver sends."""
        self.now += after_ms * MS
        self.terminal.typed += keys.encode()
        self.inbox.now_ns = self.now
        if not self.silent:
            for topic, message in (
                (topics.ACTUATOR_STATE, self.state),
                (topics.PLANNER_STATUS, PlannerStatus(0, "stepping", "ground is flat", 0, 0, -1)),
            ):
                stamped = replace(message, stamp_ns=self.now + self.ahead_ns)
                self.inbox.receive(topic, codec.encode(stamped), self.now)
        sent = list(self.driver.step(Tick(self.now), self.inbox))
        for message in sent:
            self.obey(message)
        self.sent += sent
        return sent

    def obey(self, message: Message) -> None:
        if isinstance(message, ModeCommand):
            free = self.state.lease in ("", message.holder) or message.take_over
            if free and (message.mode not in ("off", "stop") or message.take_over):
                self.state = replace(self.state, lease=message.holder)
            modes = {"walk": Mode.WALK, "stop": Mode.HOLD, "stand": Mode.HOLD, "sit": Mode.READY, "off": Mode.OFF}
            if free or message.mode in ("off", "stop"):
                self.state = replace(self.state, mode=modes[message.mode])
        if isinstance(message, StopOrder) and self.state.mode is Mode.WALK:
            self.state = replace(self.state, mode=Mode.HOLD)

    def run(self, seconds: float, keys: str = "") -> list[Message]:
        """Repeat keys, or none, for a time."""
        return [message for _ in range(round(seconds * 1000 / BEAT_MS)) for message in self.step(keys)]

    def hold(self, key: str = "w", seconds: float = 1.0) -> list[Message]:
        """Press a key and hold it: the terminal repeats it after half a second."""
        return [*self.step(key), *self.run(0.5), *self.run(seconds, key)]


def velocities(messages: list[Message]) -> list[list[float]]:
    return [[*m.velocity.tolist(), m.yaw_rate] for m in messages if isinstance(m, VelocityCommand)]


def orders(messages: list[Message]) -> list[str]:
    """Return the orders, without repetitions."""
    return [m.mode for m in {m.sequence: m for m in messages if isinstance(m, ModeCommand)}.values()]


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_held_key_walks_and_its_release_stops(rig: Rig) -> None:
    out = rig.hold()
    assert orders(out) == ["walk"]
    assert velocities(out)
    for velocity in velocities(out):
        assert velocity == pytest.approx([0.5 * FASTEST, 0.0, 0.0])
    (first, *_) = (m for m in out if isinstance(m, VelocityCommand))
    assert (first.gait, first.body_height) == ("ripple", PROFILE.stance.body_height)
    begun = rig.now
    after = []
    while rig.state.mode is Mode.WALK:
        after += rig.step()
    assert REPEAT_NS - BEAT_MS * MS <= rig.now - begun <= REPEAT_NS + 2 * BEAT_MS * MS
    assert orders(after)[-1] == "stop"
    assert any(isinstance(m, StopOrder) for m in after)
    assert not any(map(any, velocities(rig.run(2.0))))


def test_character_alone_moves_nothing(rig: Rig) -> None:
    assert orders(rig.step("w") + rig.run(2.0)) == []


@pytest.mark.parametrize(
    ("key", "motion"),
    [("w", (1, 0, 0)), ("s", (-1, 0, 0)), ("a", (0, 1, 0)), ("d", (0, -1, 0)), ("q", (0, 0, 1)), ("\x1b[C", (0, 0, -1))],
)
def test_each_key_commands_its_motion_within_the_bounds_of_the_profile(rig: Rig, key: str, motion: Wish) -> None:
    for _ in range(2 * SPEEDS):
        rig.step("+")
    assert rig.driver.speed == SPEEDS
    expected = np.array(motion) * [FASTEST, FASTEST, TURN_RAD_S]
    for velocity in velocities(rig.hold(key)):
        np.testing.assert_allclose(velocity, expected)
    rig.run(1.0)
    for _ in range(2 * SPEEDS):
        rig.step("-")
    assert rig.driver.speed == 1
    np.testing.assert_allclose(velocities(rig.hold(key))[-1], expected / SPEEDS)


@pytest.mark.parametrize("key", [" ", "z", "\x1b", "\x1b[5~", "\x1a", "ü", "w" * 20, "o"])
def test_every_other_key_stops_at_once_and_the_key_has_to_be_pressed_again(rig: Rig, key: str) -> None:
    rig.hold()
    sent = rig.step(key) + (rig.step() if key == "\x1b" else [])
    assert "stop" in orders(sent)
    assert rig.state.mode is Mode.HOLD
    assert not any(map(any, velocities(rig.run(0.5, "w"))))
    rig.run(0.5)
    assert any(map(any, velocities(rig.hold())))


@pytest.mark.parametrize("key", ["x", "\x03", "\x04"])
def test_quit_stops_the_robot_before_the_end(rig: Rig, key: str) -> None:
    rig.hold()
    assert "stop" in orders(rig.step(key))
    rig.run(0.5)
    assert rig.driver.finished
    assert rig.driver.failed == ""


def test_lost_terminal_stops_the_robot_and_ends_with_the_reason(rig: Rig) -> None:
    rig.hold()
    rig.terminal.lost = "the terminal is closed"
    assert "stop" in orders(rig.step())
    rig.run(0.5)
    assert rig.driver.finished
    assert rig.driver.failed == "the terminal is closed"


def test_silent_robot_is_given_up_after_two_seconds(rig: Rig) -> None:
    rig.hold()
    rig.silent = True
    rig.step("x")
    rig.run(1.5)
    assert not rig.driver.finished
    rig.run(1.0)
    assert rig.driver.finished


def test_paused_process_stops_and_ignores_the_keys_of_the_pause(rig: Rig) -> None:
    rig.hold()
    assert "stop" in orders(rig.step("w", after_ms=400))
    assert "paused for 0.4 s" in rig.driver.status()
    assert not any(map(any, velocities(rig.run(1.0, "w")))), "the key is still held"


def test_suspended_process_ends(rig: Rig) -> None:
    rig.hold()
    rig.driver.end("this process was suspended")
    assert "stop" in orders(rig.step("w"))
    rig.run(0.5, "w")
    assert rig.driver.finished
    assert rig.driver.failed == "this process was suspended"


def test_other_holder_of_the_lease_is_named_and_taken_over_by_a_key(rig: Rig) -> None:
    rig.state = replace(rig.state, lease="console 1 at home:8080")
    assert orders(rig.hold()) == []
    assert "console 1 at home:8080 is in control of the robot; take over first" in rig.driver.status()
    rig.step("t")
    assert rig.state.lease == NAME
    rig.run(0.5)
    assert any(map(any, velocities(rig.hold())))


def test_lost_lease_ends_the_motion_until_the_key_is_pressed_again(rig: Rig) -> None:
    rig.hold()
    rig.state = replace(rig.state, lease="another")
    rig.step("w")
    assert not any(map(any, velocities(rig.run(1.0, "w"))))
    assert "another has taken over" in rig.driver.status()
    assert rig.state.lease == "another"
    rig.state = replace(rig.state, lease="")
    assert not any(map(any, velocities(rig.run(1.0, "w")))), "the key is still held"
    rig.run(1.0)
    assert any(map(any, velocities(rig.hold())))


def test_refusal_of_a_walk_names_mode_and_reason(rig: Rig) -> None:
    rig.state = replace(rig.state, mode=Mode.READY, reason="sitting")
    assert velocities(rig.hold()) == []
    assert "the robot cannot walk, its mode is ready: sitting" in rig.driver.status()


@pytest.mark.parametrize(("key", "order"), [("u", "stand"), ("j", "sit"), ("O", "off"), (" ", "stop")])
def test_letters_order_modes(rig: Rig, key: str, order: str) -> None:
    assert orders(rig.step(key)) == [order]


def test_status_states_mode_lease_speed_motion_and_reason(rig: Rig) -> None:
    assert rig.driver.status() == f"hold | lease: free | speed 6.0 of {100 * FASTEST:.1f} cm/s | no motion\nstanding"
    rig.hold("a")
    rig.step("a")
    expected = f"walk | lease: yours | speed 6.0 of {100 * FASTEST:.1f} cm/s | left 6.0 cm/s\nplanner: ground is flat"
    assert rig.driver.status() == expected
    rig.silent = True
    rig.run(1.0)
    assert rig.driver.status().startswith("no state of the robot for 0.5 s")


def test_command_to_stop_needs_no_state_of_the_robot() -> None:
    rig = Rig.__new__(Rig)
    rig.step, step = lambda *_: [], rig.step  # type: ignore[method-assign, assignment]
    rig.__init__()  # type: ignore[misc]
    rig.step, rig.silent = step, True  # type: ignore[method-assign]
    sent = rig.step("O")
    assert [type(message) for message in sent] == [StopOrder]


def test_robot_clock_that_restarts_ends_the_press(rig: Rig) -> None:
    rig.hold()
    rig.ahead_ns = -500 * MS
    rig.run(5.0, "w")
    assert not any(map(any, velocities(rig.run(0.5, "w"))))
    assert "clock has restarted" in rig.driver.status()


def test_router_that_refuses_commands_is_the_reason() -> None:
    rig = Rig(barred=lambda _: "this certificate (viewer) may not send operator/mode")
    rig.hold()
    assert "this certificate (viewer) may not send operator/mode" in rig.driver.status()


def test_interrupted_command_withdraws_its_motion(rig: Rig) -> None:
    assert rig.driver.withdraw() == ()
    rig.hold()
    withdrawn = rig.driver.withdraw()
    assert {"stop"} == {m.mode for m in withdrawn if isinstance(m, ModeCommand | StopOrder)}
    assert any(isinstance(m, StopOrder) for m in withdrawn)


def test_gamepad_drives_in_arcs_and_a_button_stops() -> None:
    pad = FakeGamepad()
    rig = Rig(pad)
    pad.moved = (0.6, 0.0, -0.5)
    np.testing.assert_allclose(velocities(rig.run(0.5))[-1], [0.3 * FASTEST, 0.0, -0.25 * TURN_RAD_S])
    pad.pressed = True
    assert "stop" in orders(rig.step())
    assert not any(map(any, velocities(rig.run(1.0)))), "the stick is still held"
    pad.moved = None
    rig.step()
    pad.moved = (1.0, 1.0, 0.0)
    speed = np.hypot(*velocities(rig.run(0.5))[-1][:2])
    assert speed == pytest.approx(0.5 * FASTEST)
    pad.moved = None
    assert "stop" in orders(rig.step())


def test_unplugged_gamepad_stops_and_is_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    pad = FakeGamepad()
    rig = Rig(pad)
    pad.moved = (1.0, 0.0, 0.0)
    rig.run(0.5)
    pad.gone = "js0: unplugged"
    assert "stop" in orders(rig.step())
    assert "stopped: js0: unplugged" in rig.driver.status()
    back: list[Any] = []

    def opened(path: str) -> FakeGamepad:
        back.append(FakeGamepad(path))
        if len(back) == 1:
            raise GamepadError("still away")
        return back[-1]

    monkeypatch.setattr(driver_module, "Gamepad", opened)
    rig.run(3.0)
    assert [one.path for one in back] == ["js0", "js0"]
    assert "the gamepad is back" in rig.driver.status()
    rig.driver.close()


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from(["", "w", "w", "w", "d", " ", "z", "+", "t", "\x1b[A"]), st.integers(10, 290)), max_size=40
    )
)
def test_robot_moves_only_after_a_repeated_key_of_the_last_moment(typed: list[tuple[str, int]]) -> None:
    rig = Rig()
    moves: list[int] = []  # times of keys of motion since the last other key
    for key, after_ms in typed:
        sent = rig.step(key, after_ms)
        if key in ("w", "d", "\x1b[A"):
            moves.append(rig.now)
        elif key not in ("", "+"):
            moves.clear()
        if any(map(any, velocities(sent))):
            assert len(moves) >= 2
            assert rig.now - moves[-1] <= FIRST_REPEAT_NS
