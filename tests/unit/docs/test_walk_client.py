"""docs/walk_client.py: frames that decode, refused orders given again, and the reason if one is not done."""

import contextlib
import runpy
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire import codec
from sextant.shared.wire.messages import Mode, ModeCommand, VelocityCommand
from tests.support.states import actuator_state

SCRIPT = Path(__file__).parents[3] / "docs" / "walk_client.py"
OBEYED = {"stand": (Mode.HOLD, "standing"), "walk": (Mode.WALK, "walking"), "stop": (Mode.HOLD, "standing")}
LATE = "`stand` refused: a servo answered late"


class Robot(contextlib.AbstractContextManager["Robot"]):
    """A Zenoh session with a robot that refuses some orders to stand; its clock is the client's."""

    def __init__(self, refuses: int) -> None:
        self.refuses = refuses
        self.now_s = 100.0
        self.silent = False
        self.orders: list[tuple[str, int]] = []
        self.speeds: set[float] = set()
        self.state = actuator_state(load_profile("phantomx_mk2"), mode=Mode.READY, reason="sitting", lease="")

    def __exit__(self, *_: object) -> None:
        pass

    def declare_subscriber(self, key: str, _channel: object) -> "Robot":
        assert key == "sextant/actuator/state"
        return self

    def try_recv(self) -> Any:
        frame = codec.encode(replace(self.state, stamp_ns=round(self.now_s * 1e9)))
        return None if self.silent else SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: frame))

    def put(self, key: str, frame: bytes) -> None:
        if key == "sextant/operator/velocity":
            self.speeds.add(float(codec.decode(frame, VelocityCommand)[0].velocity[0]))
            return
        assert key == "sextant/operator/mode"
        order, _ = codec.decode(frame, ModeCommand)
        if (order.mode, order.sequence) in self.orders:
            return
        self.orders.append((order.mode, order.sequence))
        if order.mode == "stand" and self.refuses:
            self.refuses -= 1
            self.state = replace(self.state, warnings=(LATE,))
        else:
            mode, reason = OBEYED.get(order.mode, (Mode.READY, "sitting"))
            self.state = replace(self.state, mode=mode, reason=reason, lease=order.holder, warnings=())

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


def run(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    config = SimpleNamespace(from_json5=lambda text: text)
    channels = SimpleNamespace(RingChannel=lambda size: size)
    fake = SimpleNamespace(Config=config, handlers=channels, open=lambda _: robot)
    monkeypatch.setitem(sys.modules, "zenoh", fake)  # type: ignore[arg-type]
    clock = SimpleNamespace(monotonic=lambda: robot.now_s, sleep=robot.sleep)
    monkeypatch.setitem(sys.modules, "time", clock)  # type: ignore[arg-type]
    monkeypatch.setattr(sys, "argv", [str(SCRIPT)])
    runpy.run_path(str(SCRIPT), run_name="__main__")


def test_refused_order_is_given_again_as_a_new_one(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    robot = Robot(refuses=2)
    run(robot, monkeypatch)
    assert [mode for mode, _ in robot.orders] == ["stand", "stand", "stand", "walk", "stop", "sit"]
    numbers = [number for _, number in robot.orders]
    assert all(later - number > 1_000_000_000 for number, later in pairwise(numbers[:3]))
    assert robot.speeds == {0.0, 0.06}
    printed = capsys.readouterr().out.splitlines()
    assert printed[1] == f"ready: sitting; {LATE}"
    assert printed[-1] == "ready: sitting"


def test_order_that_is_not_done_ends_the_program_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Robot(refuses=1000)
    with pytest.raises(SystemExit, match=f"`stand` is not done within 15 s: ready: sitting; {LATE}"):
        run(robot, monkeypatch)
    robot = Robot(refuses=0)
    robot.silent = True
    with pytest.raises(SystemExit, match="`stand` is not done within 15 s: no message from the robot"):
        run(robot, monkeypatch)
    assert robot.orders == []
