"""Stop path: it latches each new order to turn torque off.

No message that it receives opens the latch.
"""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.actuator.estop.config import Settings
from sextant.services.actuator.estop.service import EmergencyStop
from sextant.services.actuator.safety import torque_off_latch as latch_files
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ModeCommand, StopOrder, Tick

PROFILE = load_profile("phantomx_mk2")
PORT = "/dev/ttyUSB0"


@pytest.fixture
def latch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Latch:
    monkeypatch.setattr(latch_files, "FOLDERS", (tmp_path,))
    return Latch.of_port(PORT)


def say(stop: EmergencyStop, mode: str, sequence: int, holder: str = "operator") -> None:
    hear(stop, ModeCommand(0, mode, sequence, holder))  # type: ignore[arg-type]


def hear(stop: EmergencyStop, order: ModeCommand | StopOrder) -> None:
    inbox = Inbox(stop.subscribes, stop.stages)
    inbox.receive(topics.OF_TYPE[type(order)], codec.encode(order), 0)
    assert list(stop.step(Tick(0), inbox)) == []


def test_each_new_order_to_let_go_is_latched_once(latch: Latch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
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
    stop = EmergencyStop(PROFILE, Settings(PORT))
    hear(stop, StopOrder(0, "stop", 7, "viewer"))
    assert not latch.closed
    hear(stop, StopOrder(0, "off", 8, "viewer"))
    assert latch.closed
    latch.open()
    hear(stop, StopOrder(0, "off", 8, "viewer"))
    assert not latch.closed, "an order counts once"
    hear(stop, StopOrder(0, "off", 3, "viewer"))
    assert latch.closed, "a viewer whose machine has restarted counts from the start"
    for k in range(1000):
        hear(stop, StopOrder(0, "off", k, f"viewer {k}"))
    assert len(stop._stops) <= 64


@pytest.mark.parametrize("mode", ["stop", "sit", "walk", "stand"])
def test_an_order_to_let_go_is_latched_with_its_time_whatever_comes_after_it(latch: Latch, mode: str) -> None:
    """Check that the latch keeps the time of the order: a later order may undo it.

    The actuator decides whether that has happened.
    """
    stop = EmergencyStop(PROFILE, Settings(PORT))
    inbox = Inbox(stop.subscribes, stop.stages)
    for sequence, order in ((5, "off"), (9, mode), (5, "off"), (3, "off")):
        inbox.receive(topics.MODE, codec.encode(ModeCommand(0, order, sequence, "a")), 0)  # type: ignore[arg-type]
    assert list(stop.step(Tick(20), inbox)) == []
    assert latch.since_ns == 5


def test_an_order_to_let_go_that_comes_after_a_newer_one_is_latched_when_it_is_heard_where_it_is_of_now(latch: Latch) -> None:
    """Check a late order to turn torque off, which the guard obeys, too."""
    second = 1_000_000_000
    stop = EmergencyStop(PROFILE, Settings(PORT))
    inbox = Inbox(stop.subscribes, stop.stages)

    def put(mode: str, sequence: int, stamp_ns: int) -> None:
        inbox.receive(topics.MODE, codec.encode(ModeCommand(stamp_ns, mode, sequence, "a")), 0)  # type: ignore[arg-type]
        assert list(stop.step(Tick(9 * second), inbox)) == []

    put("walk", 8 * second, 9 * second)
    put("off", 7 * second, 6 * second)
    assert not latch.closed, "recorded, and published again"
    put("off", 7 * second, 8 * second)
    assert latch.since_ns == 9 * second
    latch.open()
    put("off", 7 * second, 9 * second)
    put("off", 6 * second, 9 * second)
    assert not latch.closed, "an order counts once, and none that is older than the last"


def test_a_repetition_is_latched_no_second_time_whatever_numbers_its_holder_has_stopped_by_since(latch: Latch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
    say(stop, "off", 9)
    hear(stop, StopOrder(0, "off", 3, "operator"))
    latch.open()
    say(stop, "off", 9)
    assert not latch.closed


def test_an_order_to_let_go_that_comes_by_a_late_clock_is_latched_as_one_after_what_it_takes_back(latch: Latch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
    say(stop, "stand", 9, "a")
    say(stop, "off", 5, "b")
    assert latch.since_ns == 10


def test_numbers_that_are_no_times_bar_no_later_orders_way(latch: Latch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
    say(stop, "off", 10**18)
    assert latch.closed
    latch.open()
    say(stop, "off", 10**18)
    assert not latch.closed, "an order counts once"
    say(stop, "off", 1)
    assert latch.closed


def test_it_tries_again_where_the_latch_cannot_be_closed(latch: Latch, monkeypatch: pytest.MonkeyPatch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
    with monkeypatch.context() as patched:
        patched.setattr(Latch, "close", lambda *_: (_ for _ in ()).throw(OSError("no such folder")))
        say(stop, "off", 3)
        assert "cannot latch a torque-off order: no such folder" in stop.doing()
    assert list(stop.step(Tick(0), Inbox(stop.subscribes, stop.stages))) == []
    assert latch.since_ns == 3
    assert stop.doing() == "torque is latched off"


def test_a_disk_that_is_full_has_room_for_a_latch(latch: Latch, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "write_text", lambda *_: (_ for _ in ()).throw(OSError("no space left")))
    latch.close(5)
    assert (latch.closed, latch.since_ns) == (True, 0)
    assert [path.name for path in latch.paths[0].parent.iterdir()] == [latch.paths[0].name]


def test_it_is_not_opened_by_an_order_of_before_it_was_closed(latch: Latch) -> None:
    latch.close(100)
    latch.close(50)
    assert latch.since_ns == 100, "the newest counts"
    assert latch.paths[0].exists()
    assert not latch.open(99, 100)
    assert latch.closed
    assert latch.open(100, 1000)
    assert not latch.closed
    assert latch.since_ns == 0
    assert latch.open(0, 1000), "nothing is in the way"
    latch.close(2000)
    assert latch.open(1, 1000), "that was before the machine was switched on"
    latch.paths[0].write_bytes(b"\xff\xfe")
    assert (latch.closed, latch.since_ns) == (True, 0)
    assert latch.open(1, 1000)
    assert list(latch.paths[0].parent.iterdir()) == []


def test_who_closes_it_while_it_is_taken_off_is_not_lost(latch: Latch, monkeypatch: pytest.MonkeyPatch) -> None:
    latch.close(100)
    replace = Path.replace

    def close_first(path: Path, target: Path) -> Path:
        patched.undo()
        latch.close(200)
        return replace(path, target)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", close_first)
        assert not latch.open(150, 1000)
    assert latch.since_ns == 200


def test_no_order_opens_it(latch: Latch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
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
    for path in Latch.of_port(port).paths:
        assert path.parent in latch_files.FOLDERS
        assert len(os.fsencode(path.name)) < 200


def test_names_that_are_cut_stay_those_of_their_port() -> None:
    long = "/dev/serial/by-id/" + 200 * "x"
    assert Latch.of_port(long + "1").paths != Latch.of_port(long + "2").paths


def test_a_device_has_one_latch_for_all_users_and_a_port_of_the_network_one_for_each(monkeypatch: pytest.MonkeyPatch) -> None:
    device, network = Latch.of_port(PORT).paths, Latch.of_port("socket://127.0.0.1:7000").paths
    monkeypatch.setattr(os, "getuid", lambda: 4242)
    assert Latch.of_port(PORT).paths == device
    assert Latch.of_port("socket://127.0.0.1:7000").paths != network


def test_who_knows_a_port_by_another_of_its_names_has_the_same_latch(latch: Latch, monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that all names of one port share a latch.

    This includes an adapter that returns under another name, or was unplugged at start-up.
    """
    devices = latch.paths[0].parent / "dev"
    (devices / "serial" / "by-id").mkdir(parents=True)
    monkeypatch.setattr(latch_files, "_DEVICES", devices)
    actuator, stop = Latch.of_port(str(devices / "ttyUSB0")), Latch.of_port(str(devices / "serial/by-id/adapter"))
    (devices / "ttyUSB0").touch()
    (devices / "servos").symlink_to(devices / "ttyUSB0")
    (devices / "serial/by-id/adapter").symlink_to(devices / "ttyUSB0")
    Latch.of_port(str(devices / "servos")).close(1)
    for one in (actuator, stop):
        assert one.closed
    assert actuator.open(1, 1)
    assert not stop.closed
    known = Latch.of_port(str(devices / "ttyUSB0"))
    (devices / "ttyUSB0").rename(devices / "ttyUSB1")
    for link in (devices / "servos", devices / "serial/by-id/adapter"):
        link.unlink()
        link.symlink_to(devices / "ttyUSB1")
    Latch.of_port(str(devices / "ttyUSB1")).close(2)
    assert known.closed
    known.open()
    assert not Latch.of_port(str(devices / "ttyUSB1")).closed


def test_several_ports_are_let_go_by_the_latch_of_any(latch: Latch) -> None:
    both = Latch.of_port(f"{PORT}, /dev/ttyUSB1")
    Latch.of_port("/dev/ttyUSB1").close(5)
    assert (both.closed, both.since_ns) == (True, 5)
    assert both.open(6, 10)
    assert not Latch.of_port("/dev/ttyUSB1").closed


def test_it_is_closed_where_any_of_its_files_says_so_and_open_where_none_does(tmp_path: Path) -> None:
    shared, private = tmp_path / "shared", tmp_path / "private"
    latch = Latch(shared / "off", private / "off")
    with pytest.raises(FileNotFoundError, match=str(shared)):
        latch.close(1)
    private.mkdir()
    latch.close(1)
    assert (latch.closed, latch.since_ns) == (True, 1)
    shared.mkdir()  # a service manager has created it since
    latch.close(3)
    assert [(path.parent / "off").read_text() for path in latch.paths] == ["3", "3"]
    Latch(shared / "off").close(5)  # by a process that does not see the other folder
    assert latch.since_ns == 5
    assert not latch.open(4, 10)
    assert latch.closed
    assert latch.open(5, 10)
    assert [*shared.iterdir(), *private.iterdir()] == []


def test_one_that_cannot_be_looked_at_is_neither_open_nor_closed(latch: Latch, monkeypatch: pytest.MonkeyPatch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
    with monkeypatch.context() as patched:
        patched.setattr(Path, "lstat", broken)
        with pytest.raises(OSError, match="Input/output error"):
            _ = latch.closed
        with pytest.raises(OSError, match="Input/output error"):
            latch.open()
        assert latch.since_ns == 0
        assert stop.doing() == "cannot read the torque-off latch: [Errno 5] Input/output error"
    assert not latch.closed


def broken(path: Path) -> os.stat_result:
    raise OSError(5, "Input/output error")


@pytest.mark.parametrize(("heard_ns", "since_ns"), [(700_000_000, 100), (2_000_000_101, 2_000_000_101), (50, 50)])
def test_a_stop_that_is_heard_late_counts_from_when_it_was_said(latch: Latch, heard_ns: int, since_ns: int) -> None:
    """Check that a late stop counts from its stamp, or from now if its clock differs.

    Otherwise a robot that stands up after a newer order would fall.
    """
    stop = EmergencyStop(PROFILE, Settings(PORT))
    inbox = Inbox(stop.subscribes, stop.stages)
    inbox.receive(topics.STOP, codec.encode(StopOrder(100, "off", 1, "viewer")), 0)
    assert list(stop.step(Tick(heard_ns), inbox)) == []
    assert latch.since_ns == since_ns


def test_many_holders_take_no_more_room(latch: Latch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
    for k in range(1000):
        say(stop, "off", k, f"holder {k}")
    assert len(stop._newest) <= 64


def test_a_latch_that_cannot_be_closed_is_said_and_the_stop_path_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(latch_files, "FOLDERS", (tmp_path / "gone",))
    stop = EmergencyStop(PROFILE, Settings(PORT))
    say(stop, "off", 1)
    assert stop.doing().startswith("cannot latch a torque-off order: ")
    (tmp_path / "gone").mkdir()
    say(stop, "off", 2)
    assert stop.doing() == "torque is latched off"
