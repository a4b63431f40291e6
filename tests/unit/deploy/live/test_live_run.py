import json
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from sextant.deploy.launch.launcher import host_router
from sextant.deploy.live.live_run import Faults, ObserverThread, ServiceLog, Speed
from sextant.evaluation import report as reports
from sextant.evaluation.observers.run_observers import RunObservers
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Fault
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Message, ModeCommand, Tick

PATIENCE_S = 20.0


class OrderPublisher:
    """A service that orders the robot to stand, fifty times a second."""

    name = "caller"
    trigger = Every.hz(50.0)
    subscribes: tuple[AnyTopic, ...] = ()
    publishes: tuple[AnyTopic, ...] = (topics.MODE,)

    def __init__(self) -> None:
        self.stages = Stages()

    def step(self, tick: Tick, _: Inbox) -> Iterator[Message]:
        yield ModeCommand(tick.stamp_ns, "stand", 1)

    def status(self) -> str:
        return "calling"


class OrderSubscriber:
    """A service that receives orders, and fails after enough of them."""

    name = "listener"
    trigger = topics.MODE
    subscribes: tuple[AnyTopic, ...] = ()
    publishes: tuple[AnyTopic, ...] = ()

    def __init__(self, breaks: bool = False) -> None:
        self.stages = Stages()
        self.heard = threading.Event()
        self._breaks = breaks

    def step(self, order: ModeCommand, _: Inbox) -> Iterable[Message]:
        self.heard.set()
        if self._breaks:
            raise ValueError(f"cannot {order.mode}")
        return ()

    def status(self) -> str:
        return "listening"


def test_observers_exchange_messages_and_end() -> None:
    listener = OrderSubscriber()
    with (
        host_router() as endpoints,
        ObserverThread({"caller": OrderPublisher(), "listener": listener}, endpoints) as attendants,
    ):
        assert listener.heard.wait(PATIENCE_S)
        attendants.check()
    assert not [t for t in threading.enumerate() if t.name in ("caller", "listener")]


def test_observer_exception_is_raised_by_check() -> None:
    listener = OrderSubscriber(breaks=True)
    with (
        host_router() as endpoints,
        ObserverThread({"caller": OrderPublisher(), "listener": listener}, endpoints) as attendants,
    ):
        assert listener.heard.wait(PATIENCE_S)
        for thread in threading.enumerate():
            if thread.name == "listener":
                thread.join(PATIENCE_S)
        with pytest.raises(ValueError, match="cannot stand"):
            attendants.check()


class FakeLauncher:
    """A replacement for the launcher that records its calls."""

    def __init__(self) -> None:
        self.acts: list[tuple[str, str]] = []

    def kill(self, name: str) -> None:
        self.acts.append(("kill", name))

    def freeze(self, name: str) -> None:
        self.acts.append(("freeze", name))

    def thaw(self, name: str) -> None:
        self.acts.append(("thaw", name))


def test_faults_trigger_once_at_their_time() -> None:
    hand = FakeLauncher()
    camera = Fault(1.0, "camera", "blind")  # the simulator handles its own fault
    faults = Faults((Fault(5.0, "planner", "hang", for_s=2.0), Fault(6.0, "mapper"), camera))
    told = []
    for tenth in range(100):
        told += faults.act(tenth / 10, hand)  # type: ignore[arg-type]
        assert len(hand.acts) == (tenth >= 50) + (tenth >= 60) + (tenth >= 70)
    assert hand.acts == [("freeze", "planner"), ("kill", "mapper"), ("thaw", "planner")]
    assert len(told) == 3
    assert "kill mapper" in told[1]


class Clock:
    """A clock that a test moves [ns]."""

    def __init__(self) -> None:
        self.now_ns = 0

    def __call__(self) -> int:
        return self.now_ns


def test_simulated_time_speed_is_relative_to_real_time() -> None:
    simulated, real = Clock(), Clock()
    speed = Speed(simulated, real)
    assert (speed.mean(), speed.newest(), speed.words({})) == (1.0, 1.0, "")
    for share in (1.0, 0.25):
        for _ in range(100):
            speed.update()
            real.now_ns += 100_000_000
            simulated.now_ns += round(share * 100_000_000)
    speed.update()
    assert speed.mean() == pytest.approx(0.625)
    assert speed.newest() == pytest.approx(0.25)
    assert speed.words({}) == "simulated time ran at 0.62 of real time: this computer is too slow"
    waited_s = {"mapper": 31.4, "servo bus": 0.1, "planner": 2.0, "actuator": 12.0}
    held = "held for inputs or cycles of mapper (31 s), actuator (12 s)"
    words = f"simulated time ran at 0.62 of real time, {held}: this computer is too slow"
    assert speed.words(waited_s) == words


def test_interprocess_overhead_is_not_reported_as_slow_computer() -> None:
    simulated, real = Clock(), Clock()
    speed = Speed(simulated, real)
    for _ in range(100):
        speed.update()
        real.now_ns += 100_000_000
        simulated.now_ns += 85_000_000
    speed.update()
    assert not speed.words({"mapper": 0.4})
    assert "held for inputs or cycles of mapper (1 s)" in speed.words({"mapper": 1.0})


SLOW = "this computer is too slow: maps are 1.6 s old, 0.8 s allowed"


@pytest.mark.parametrize(
    ("late_s", "slowed_down", "reason", "too_slow"),
    [
        (0.0, "", "time limit", ""),
        (1.0, "", "time limit", SLOW),  # a short delay is no reason of a failure
        (20.0, "", f"time limit; {SLOW}", SLOW),
        (0.0, "simulated time ran at 0.40 of real time: this computer is too slow", "time limit", None),
    ],
)
def test_failed_run_with_late_inputs_reports_slow_computer(
    late_s: float, slowed_down: str, reason: str, too_slow: str | None
) -> None:
    attendance = RunObservers(load_profile("phantomx_mk2"), load_scenario("flat"), 0, live=True)
    attendance.monitor.lateness.late_s = late_s
    attendance.monitor.lateness.words = SLOW if late_s else ""
    report = attendance.judge(1.0, "time limit", slowed_down=slowed_down)
    assert (report.success, report.reason) == (False, reason)
    assert report.too_slow == (slowed_down if too_slow is None else too_slow)
    assert report.late_s == late_s
    assert not reports.check(json.loads(reports.to_json(report)))


def test_unwritable_service_log_is_reported(tmp_path: Path) -> None:
    (tmp_path / "services.log").symlink_to("/dev/full")
    for path in (tmp_path / "services.log", tmp_path / "gone" / "services.log"):
        log = ServiceLog(path)
        log.hear("mapper", "mapper: mapping")
        log.hear("mapper", "mapper: mapping still")
        log.close()
        log.hear("mapper", "mapper: too late")
        assert log.problem.startswith(f"{path} cannot be written: ")


def test_service_log_is_written_immediately(tmp_path: Path) -> None:
    log = ServiceLog(tmp_path / "services.log")
    log.hear("mapper", "mapper: käme")
    assert (tmp_path / "services.log").read_text(encoding="utf-8") == "mapper: käme\n"
    log.close()
    assert log.problem == ""
