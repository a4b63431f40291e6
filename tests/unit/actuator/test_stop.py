"""The stop path: it latches each new order to let go, and nothing that it hears opens the latch."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.actuator.latch import Latch
from services.actuator.stop.config import Settings
from services.actuator.stop.service import Stop
from shared import codec, topics
from shared.messages import ModeCommand, StopOrder, Tick
from shared.profiles import load_profile
from shared.service import Inbox

PROFILE = load_profile("phantomx_mk2")
PORT = "/dev/ttyUSB0"


@pytest.fixture
def latch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Latch:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return Latch.of_port(PORT)


def say(stop: Stop, mode: str, sequence: int, holder: str = "operator") -> None:
    hear(stop, ModeCommand(0, mode, sequence, holder))  # type: ignore[arg-type]


def hear(stop: Stop, order: ModeCommand | StopOrder) -> None:
    inbox = Inbox(stop.reads, stop.stages)
    inbox.receive(topics.OF_TYPE[type(order)], codec.encode(order), 0)
    assert list(stop.step(Tick(0), inbox)) == []


def test_each_new_order_to_let_go_is_latched_once(latch: Latch) -> None:
    stop = Stop(PROFILE, Settings(PORT))
    say(stop, "walk", 1)
    assert not latch.closed
    say(stop, "off", 2)
    assert latch.closed
    assert stop.doing() == "torque is latched off"
    latch.open()  # the actuator was ordered to stand
    say(stop, "off", 2)
    say(stop, "off", 1)
    assert not latch.closed, "an order counts once"
    say(stop, "off", 1, "another")
    assert latch.closed


def test_those_who_may_not_lead_let_go_by_a_key_of_their_own(latch: Latch) -> None:
    stop = Stop(PROFILE, Settings(PORT))
    hear(stop, StopOrder(0, "stop", 7, "viewer"))
    assert not latch.closed
    hear(stop, StopOrder(0, "off", 8, "viewer"))
    assert latch.closed
    latch.open()
    hear(stop, StopOrder(0, "off", 8, "viewer"))
    assert not latch.closed, "an order counts once"
    hear(stop, StopOrder(0, "off", 3, "viewer"))
    assert latch.closed, "a viewer whose machine began anew counts anew"
    for k in range(1000):
        hear(stop, StopOrder(0, "off", k, f"viewer {k}"))
    assert len(stop._stops) <= 64


@pytest.mark.parametrize("mode", ["stop", "sit", "walk", "stand"])
def test_an_order_to_let_go_is_latched_with_its_time_whatever_comes_after_it(latch: Latch, mode: str) -> None:
    """The actuator knows whether it was taken back since."""
    stop = Stop(PROFILE, Settings(PORT))
    inbox = Inbox(stop.reads, stop.stages)
    for sequence, order in ((5, "off"), (9, mode), (7, "off")):
        inbox.receive(topics.MODE, codec.encode(ModeCommand(0, order, sequence, "a")), 0)  # type: ignore[arg-type]
    assert list(stop.step(Tick(20), inbox)) == []
    assert latch.since_ns == 5


def test_an_order_to_let_go_that_comes_by_a_late_clock_is_latched_as_one_after_what_it_takes_back(latch: Latch) -> None:
    stop = Stop(PROFILE, Settings(PORT))
    say(stop, "stand", 9, "a")
    say(stop, "off", 5, "b")
    assert latch.since_ns == 10


def test_numbers_that_are_no_times_bar_no_later_orders_way(latch: Latch) -> None:
    stop = Stop(PROFILE, Settings(PORT))
    say(stop, "off", 10**18)
    assert latch.closed
    latch.open()
    say(stop, "off", 10**18)
    assert not latch.closed, "an order counts once"
    say(stop, "off", 1)
    assert latch.closed


def test_it_tries_again_where_the_latch_cannot_be_closed(latch: Latch, monkeypatch: pytest.MonkeyPatch) -> None:
    stop = Stop(PROFILE, Settings(PORT))
    with monkeypatch.context() as patched:
        patched.setattr(Latch, "close", lambda *_: (_ for _ in ()).throw(OSError("no such folder")))
        say(stop, "off", 3)
        assert "cannot be latched: no such folder" in stop.doing()
    assert list(stop.step(Tick(0), Inbox(stop.reads, stop.stages))) == []
    assert latch.since_ns == 3
    assert stop.doing() == "torque is latched off"


def test_a_disk_that_is_full_has_room_for_a_latch(latch: Latch, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "write_text", lambda *_: (_ for _ in ()).throw(OSError("no space left")))
    latch.close(5)
    assert (latch.closed, latch.since_ns) == (True, 0)
    assert [path.name for path in latch.path.parent.iterdir()] == [latch.path.name]


def test_it_is_not_opened_by_an_order_of_before_it_was_closed(latch: Latch) -> None:
    latch.close(100)
    latch.close(50)
    assert latch.since_ns == 100, "the newest counts"
    assert latch.path.exists()
    assert not latch.open(99, 100)
    assert latch.closed
    assert latch.open(100, 1000)
    assert not latch.closed
    assert latch.since_ns == 0
    assert latch.open(0, 1000), "nothing is in the way"
    latch.close(2000)
    assert latch.open(1, 1000), "that was before the machine was switched on"
    latch.path.write_bytes(b"\xff\xfe")
    assert (latch.closed, latch.since_ns) == (True, 0)
    assert latch.open(1, 1000)
    assert list(latch.path.parent.iterdir()) == []


def test_who_closes_it_while_it_is_taken_off_is_not_lost(latch: Latch, monkeypatch: pytest.MonkeyPatch) -> None:
    latch.close(100)
    replace = Path.replace

    def close_first(path: Path, target: Path) -> Path:
        monkeypatch.undo()
        latch.close(200)
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", close_first)
    assert not latch.open(150, 1000)
    assert latch.since_ns == 200


def test_no_order_opens_it(latch: Latch) -> None:
    stop = Stop(PROFILE, Settings(PORT))
    say(stop, "off", 1)
    for sequence, mode in enumerate(("stop", "ready", "stand", "walk", "sit"), 2):
        say(stop, mode, sequence)
    assert latch.closed


def test_it_outlives_the_process_and_belongs_to_one_port(latch: Latch) -> None:
    latch.close()
    latch.close()
    assert Latch.of_port(PORT).closed
    assert not Latch.of_port("/dev/ttyUSB1").closed
    latch.open()
    latch.open()
    assert not Latch.of_port(PORT).closed


@given(st.text(min_size=1, max_size=200))
def test_every_port_has_a_file_name(port: str) -> None:
    name = Latch.of_port(port).path.name
    assert "/" not in name
    assert len(os.fsencode(name)) < 255


def test_many_holders_take_no_more_room(latch: Latch) -> None:
    stop = Stop(PROFILE, Settings(PORT))
    for k in range(1000):
        say(stop, "off", k, f"holder {k}")
    assert len(stop._newest) <= 64


def test_a_latch_that_cannot_be_closed_is_said_and_the_stop_path_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "gone"))
    stop = Stop(PROFILE, Settings(PORT))
    say(stop, "off", 1)
    assert stop.doing().startswith("an order to let go cannot be latched: ")
    (tmp_path / "gone").mkdir()
    say(stop, "off", 2)
    assert stop.doing() == "torque is latched off"
