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


def send_mode(stop: EmergencyStop, mode: str, sequence: int, holder: str = "operator") -> None:
    receive_order(stop, ModeCommand(0, mode, sequence, holder))  # type: ignore[arg-type]


def receive_order(stop: EmergencyStop, order: ModeCommand | StopOrder) -> None:
    inbox = Inbox(stop.subscribes, stop.stages)
    inbox.receive(topics.OF_TYPE[type(order)], codec.encode(order), 0)
    assert list(stop.step(Tick(0), inbox)) == []


def test_each_new_torque_off_order_is_latched_once(latch: Latch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
    send_mode(stop, "walk", 1)
    assert not latch.closed
    send_mode(stop, "off", 2)
    assert latch.closed
    assert stop.status() == "torque is latched off"
    latch.open()  # the actuator was ordered to stand
    send_mode(stop, "off", 2)
    send_mode(stop, "off", 1)
    assert not latch.closed, "an order counts once"
    send_mode(stop, "off", 1, "another")
    assert latch.closed


@pytest.mark.slow
def test_viewer_stop_order_off_is_latched_once_per_sequence(latch: Latch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
    receive_order(stop, StopOrder(0, "stop", 7, "viewer"))
    assert not latch.closed
    receive_order(stop, StopOrder(0, "off", 8, "viewer"))
    assert latch.closed
    latch.open()
    receive_order(stop, StopOrder(0, "off", 8, "viewer"))
    assert not latch.closed, "an order counts once"
    receive_order(stop, StopOrder(0, "off", 3, "viewer"))
    assert latch.closed, "a viewer whose machine has restarted counts from the start"
    for k in range(1000):
        receive_order(stop, StopOrder(0, "off", k, f"viewer {k}"))
    assert len(stop._stops) <= 64


@pytest.mark.parametrize("mode", ["stop", "sit", "walk", "stand"])
def test_torque_off_in_batch_is_latched_with_its_own_time(latch: Latch, mode: str) -> None:
    """Check that the latch keeps the time of the order: a later order may undo it.

    The actuator decides whether that has happened.
    """
    stop = EmergencyStop(PROFILE, Settings(PORT))
    inbox = Inbox(stop.subscribes, stop.stages)
    for sequence, order in ((5, "off"), (9, mode), (5, "off"), (3, "off")):
        inbox.receive(topics.MODE, codec.encode(ModeCommand(0, order, sequence, "a")), 0)  # type: ignore[arg-type]
    assert list(stop.step(Tick(20), inbox)) == []
    assert latch.since_ns == 5


def test_late_torque_off_order_is_latched_only_with_a_recent_stamp(latch: Latch) -> None:
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


def test_repeated_torque_off_is_not_latched_again_after_stop_order(latch: Latch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
    send_mode(stop, "off", 9)
    receive_order(stop, StopOrder(0, "off", 3, "operator"))
    latch.open()
    send_mode(stop, "off", 9)
    assert not latch.closed


def test_torque_off_with_slow_clock_is_latched_later_than_stand_order(latch: Latch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
    send_mode(stop, "stand", 9, "a")
    send_mode(stop, "off", 5, "b")
    assert latch.since_ns == 10


def test_implausible_sequence_number_does_not_block_later_orders(latch: Latch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
    send_mode(stop, "off", 10**18)
    assert latch.closed
    latch.open()
    send_mode(stop, "off", 10**18)
    assert not latch.closed, "an order counts once"
    send_mode(stop, "off", 1)
    assert latch.closed


def test_closing_the_latch_is_retried_after_os_error(latch: Latch, monkeypatch: pytest.MonkeyPatch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
    with monkeypatch.context() as patched:
        patched.setattr(Latch, "close", lambda *_: (_ for _ in ()).throw(OSError("no such folder")))
        send_mode(stop, "off", 3)
        assert "cannot latch a torque-off order: no such folder" in stop.status()
    assert list(stop.step(Tick(0), Inbox(stop.subscribes, stop.stages))) == []
    assert latch.since_ns == 3
    assert stop.status() == "torque is latched off"


def test_latch_closes_on_full_disk(latch: Latch, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "write_text", lambda *_: (_ for _ in ()).throw(OSError("no space left")))
    latch.close(5)
    assert (latch.closed, latch.since_ns) == (True, 0)
    assert [path.name for path in latch.paths[0].parent.iterdir()] == [latch.paths[0].name]


def test_latch_is_not_opened_by_order_older_than_its_closing(latch: Latch) -> None:
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


def test_latch_closed_during_opening_stays_closed(latch: Latch, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_no_mode_command_opens_the_latch(latch: Latch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
    send_mode(stop, "off", 1)
    for sequence, mode in enumerate(("stop", "ready", "stand", "walk", "sit"), 2):
        send_mode(stop, mode, sequence)
    assert latch.closed


def test_latch_persists_across_processes_and_applies_to_one_port(latch: Latch) -> None:
    latch.close()
    latch.close()
    assert Latch.of_port(PORT).closed
    assert not Latch.of_port("/dev/ttyUSB1").closed
    latch.open()
    latch.open()
    assert not Latch.of_port(PORT).closed


@given(st.text(min_size=1, max_size=200))
def test_any_port_name_gives_a_valid_latch_file_name(port: str) -> None:
    for path in Latch.of_port(port).paths:
        assert path.parent in latch_files.FOLDERS
        assert len(os.fsencode(path.name)) < 200


def test_truncated_latch_file_names_stay_unique_per_port() -> None:
    long = "/dev/serial/by-id/" + 200 * "x"
    assert Latch.of_port(long + "1").paths != Latch.of_port(long + "2").paths


def test_device_latch_is_shared_by_users_and_network_port_latch_per_user(monkeypatch: pytest.MonkeyPatch) -> None:
    device, network = Latch.of_port(PORT).paths, Latch.of_port("socket://127.0.0.1:7000").paths
    monkeypatch.setattr(os, "getuid", lambda: 4242)
    assert Latch.of_port(PORT).paths == device
    assert Latch.of_port("socket://127.0.0.1:7000").paths != network


def test_all_names_of_one_port_share_a_latch(latch: Latch, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_latch_of_any_port_turns_torque_off_on_all_ports(latch: Latch) -> None:
    both = Latch.of_port(f"{PORT}, /dev/ttyUSB1")
    Latch.of_port("/dev/ttyUSB1").close(5)
    assert (both.closed, both.since_ns) == (True, 5)
    assert both.open(6, 10)
    assert not Latch.of_port("/dev/ttyUSB1").closed


def test_latch_is_closed_if_any_of_its_files_exists(tmp_path: Path) -> None:
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


def test_unreadable_latch_raises_os_error_and_is_reported(latch: Latch, monkeypatch: pytest.MonkeyPatch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
    with monkeypatch.context() as patched:
        patched.setattr(Path, "lstat", broken)
        with pytest.raises(OSError, match="Input/output error"):
            _ = latch.closed
        with pytest.raises(OSError, match="Input/output error"):
            latch.open()
        assert latch.since_ns == 0
        assert stop.status() == "cannot read the torque-off latch: [Errno 5] Input/output error"
    assert not latch.closed


def broken(path: Path) -> os.stat_result:
    raise OSError(5, "Input/output error")


@pytest.mark.parametrize(("heard_ns", "since_ns"), [(700_000_000, 100), (2_000_000_101, 2_000_000_101), (50, 50)])
def test_late_stop_order_is_latched_with_its_stamp(latch: Latch, heard_ns: int, since_ns: int) -> None:
    """Check that a late stop counts from its stamp, or from now if its clock differs.

    Otherwise a robot that stands up after a newer order would fall.
    """
    stop = EmergencyStop(PROFILE, Settings(PORT))
    inbox = Inbox(stop.subscribes, stop.stages)
    inbox.receive(topics.STOP, codec.encode(StopOrder(100, "off", 1, "viewer")), 0)
    assert list(stop.step(Tick(heard_ns), inbox)) == []
    assert latch.since_ns == since_ns


@pytest.mark.slow
def test_remembered_holders_are_bounded(latch: Latch) -> None:
    stop = EmergencyStop(PROFILE, Settings(PORT))
    for k in range(1000):
        send_mode(stop, "off", k, f"holder {k}")
    assert len(stop._newest) <= 64


def test_stop_path_continues_after_reporting_a_failed_latch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latch_files, "FOLDERS", (tmp_path / "gone",))
    stop = EmergencyStop(PROFILE, Settings(PORT))
    send_mode(stop, "off", 1)
    assert stop.status().startswith("cannot latch a torque-off order: ")
    (tmp_path / "gone").mkdir()
    send_mode(stop, "off", 2)
    assert stop.status() == "torque is latched off"
