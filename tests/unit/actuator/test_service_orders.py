"""Actuator service and orders that outlive it or arrive late.

The tests cover the latch, the walk in force, and a computer that slept.
"""

from pathlib import Path

import numpy as np
import pytest

from sextant.services.actuator.safety.command_ordering import WalkOrder
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.services.actuator.safety.walk_authorization import WalkAuthorization
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.wire.messages import Mode, ModeCommand, StopOrder
from tests.support.actuator_rig import STILL, Rig


def test_torque_turns_off_with_warning_while_order_cannot_be_latched(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    rig = Rig(latch=Latch(folder / "off"))
    rig.cycle(2)
    rig.command("off")
    state = rig.cycle(2)
    assert (state.mode, rig.torque) == (Mode.OFF, False)
    words = "torque is off, but the order cannot be stored for a restarted actuator: "
    assert any(warning.startswith(words) for warning in state.warnings)
    folder.mkdir()
    state = rig.cycle(3)
    assert not any(warning.startswith(words) for warning in state.warnings)
    rig.start()
    assert rig.cycle(2).mode is Mode.OFF


def test_unreadable_latch_gives_warning_and_keeps_torque_and_off_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(path: Path) -> None:
        raise OSError(5, "Input/output error")

    rig = Rig(latch=Latch(tmp_path / "off"))
    rig.walking()
    monkeypatch.setattr(Path, "lstat", broken)
    state = rig.cycle(3)
    assert (state.mode, rig.torque) == (Mode.HOLD, True)
    words = "cannot read the torque-off latch: [Errno 5] Input/output error"
    assert words in state.warnings
    rig.command("off")
    assert rig.cycle(2).mode is Mode.OFF
    assert not rig.torque
    rig.command("stand")
    state = rig.cycle(2)
    assert not rig.torque, "who cannot see the latch does not open it"
    monkeypatch.undo()
    rig.command("stand")
    state = rig.cycle(2)
    assert rig.torque
    assert words not in state.warnings


def test_torque_stays_off_if_latch_cannot_be_opened(tmp_path: Path) -> None:
    latch = Latch(tmp_path / "off")
    latch.paths[0].mkdir()  # a folder cannot be unlinked
    rig = Rig(torque=False, latch=latch)
    rig.cycle(2)
    rig.command("ready")
    for _ in range(10):
        state = rig.cycle()
        assert not rig.torque
    assert state.mode is Mode.OFF
    assert any(
        warning.startswith("torque stays off, because the torque-off latch cannot be opened: ") for warning in state.warnings
    )


@pytest.mark.slow
def test_stand_order_repeated_across_restart_does_not_undo_torque_off(tmp_path: Path) -> None:
    latch = Latch(tmp_path / "off")
    rig = Rig(torque=False, latch=latch)
    rig.cycle(2)
    rig.command("stand")  # the rig repeats the order in every cycle
    rig.cycle(250)
    assert rig.torque
    rig.hear(StopOrder(rig.now_ns, "off", 1, "a terminal"))
    rig.cycle(100)
    rig.start()
    for _ in range(200):
        state = rig.cycle()
        assert not rig.torque
        assert latch.closed
    assert state.mode is Mode.OFF
    assert any("it was given before torque went off; order it again" in words for words in state.warnings)
    rig.command("stand")
    rig.cycle(2)
    assert rig.torque
    assert not latch.closed


@pytest.mark.parametrize("stops_only", [False, True])
def test_torque_off_takes_precedence_over_earlier_stand_in_one_batch(tmp_path: Path, stops_only: bool) -> None:
    rig = Rig(torque=False, latch=Latch(tmp_path / "off"))
    rig.leads = False
    rig.cycle(2)
    heard: list[bytes] = []
    rig.bus.overhear = lambda data, _: heard.append(data)
    rig.command("stand")
    later = rig.now_ns + 5_000_000
    rig.hear(StopOrder(later, "off", 1, "b") if stops_only else ModeCommand(later, "off", later, "b"))
    assert rig.cycle(5).mode is Mode.OFF
    written = [bytes(data[5:]) for data in heard if data[4] in (dxl.Instruction.WRITE, dxl.Instruction.SYNC_WRITE)]
    assert {data[0] for data in written} == {dxl.TORQUE_ENABLE.address}
    assert not rig.torque


def test_torque_off_with_slow_clock_overrides_stand_in_one_batch(tmp_path: Path) -> None:
    rig = Rig(torque=False, latch=Latch(tmp_path / "off"))
    rig.leads = False
    rig.cycle(2)
    rig.now_ns += 100_000_000
    rig.command("stand")
    rig.hear(ModeCommand(rig.now_ns, "off", rig.order - 50_000_000, "b"))
    for _ in range(5):
        assert rig.cycle().mode is Mode.OFF
        assert not rig.torque


@pytest.mark.parametrize("order", ["walk", "stand"])
def test_orders_from_before_suspend_are_not_resumed(order: str) -> None:
    """Check that sleep ends all orders, although it stops the monotonic clock.

    An order from an hour ago would otherwise look new.
    """
    rig = Rig(torque=order == "walk")
    rig.suspended_ns = 5_000_000_000  # before this actuator started, so it does not count
    rig.start()
    rig.cycle(2)
    rig.command("stand" if order == "stand" else "walk")
    assert rig.cycle(5).mode is (Mode.STAND if order == "stand" else Mode.HOLD)
    rig.suspended_ns += 3_600_000_000_000
    rig.command(order)  # the order arrived just before
    state = rig.cycle(2)
    assert state.mode is (Mode.READY if order == "stand" else Mode.HOLD)
    assert state.lease == ""
    assert any(words.endswith("before the computer was suspended; order it again") for words in state.warnings)
    goals = rig.goals
    assert rig.cycle(20).lease == "", "repeated"
    np.testing.assert_allclose(rig.goals, goals, atol=STILL)
    rig.command(order)
    assert rig.cycle(2).lease == "operator"


def test_torque_off_order_from_before_suspend_is_obeyed() -> None:
    rig = Rig()
    rig.cycle(2)
    rig.suspended_ns = 10**12
    rig.command("off")
    assert rig.cycle(2).mode is Mode.OFF
    assert not rig.torque


@pytest.mark.slow
@pytest.mark.parametrize("stopped", [False, True])
def test_restart_resumes_walk_order_only_if_not_stopped(stopped: bool, tmp_path: Path) -> None:
    """Check a client that repeats its walk order: it missed or ignores the stop."""
    rig = Rig(latch=Latch(tmp_path / "off"))
    rig.authorization = WalkAuthorization(tmp_path / "walk")
    rig.start()
    rig.cycle(2)
    rig.walking()
    assert rig.authorization.order == WalkOrder("operator", rig.order)
    if stopped:
        rig.hear(StopOrder(rig.now_ns, "stop", 1, "viewer"))
        rig.cycle(100)
    rig.authorization = WalkAuthorization(tmp_path / "walk")  # as the next process finds it
    rig.start()
    rig.running = None
    state = rig.cycle(100)
    assert state.mode is Mode.HOLD
    assert state.lease == ("" if stopped else "operator")
    told = any("was not in force at that time; order it again" in warning for warning in state.warnings)
    assert told == stopped


def test_rising_robot_ignores_late_latch_of_an_older_off_order(tmp_path: Path) -> None:
    latch = Latch(tmp_path / "off")
    rig = Rig(torque=False, latch=latch)
    rig.cycle(2)
    rig.command("off")
    off_ns = rig.order
    rig.cycle(5)
    rig.command("stand")
    rig.cycle(20)
    assert rig.torque
    latch.close(off_ns)  # by a stop path that was stopped in the meantime
    rig.cycle(20)
    assert rig.torque
    assert not latch.closed, "nor after a restart"
    latch.close(rig.order + 1)
    assert rig.cycle(5).mode is Mode.OFF
    assert not rig.torque


@pytest.mark.parametrize("since_ns", [0, 10**18])
def test_latch_without_valid_time_counts_as_closed_now(tmp_path: Path, since_ns: int) -> None:
    latch = Latch(tmp_path / "off")
    latch.close(since_ns)
    rig = Rig(torque=True, latch=latch)
    before = rig.actuator._guard.off_ns - 1
    rig.hear(ModeCommand(rig.now_ns, "stand", before, "a"))
    assert rig.cycle(2).mode is Mode.OFF
    assert not rig.torque
    rig.command("stand")
    rig.cycle(2)
    assert rig.torque
    assert not latch.closed


def test_torque_off_ordered_during_torque_on_wins(tmp_path: Path) -> None:
    class Closing(Latch):
        def open(self, given_ns: int | None = None, now_ns: int = 0) -> bool:
            self.close((given_ns or 0) + 1)  # by the stop path, just now
            return super().open(given_ns, now_ns)

    rig = Rig(torque=False, latch=Closing(tmp_path / "off"))
    rig.cycle(2)
    rig.command("ready")
    state = rig.cycle()
    assert "torque stays off, because it was ordered off in the meantime; order it again" in state.warnings
    assert rig.cycle(5).mode is Mode.OFF
    assert not rig.torque
