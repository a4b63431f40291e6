"""The report on a base under the load of robots, and a replayed robot."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.robot import fleet
from benchmarks.robot.fleet import Load
from benchmarks.robot.replayed_robot import Heard, Player
from sextant.shared.recording.writer import Recorder
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, PlannerStatus, ScanReceipt, StepPlan
from tests.support.recorded import scan, terrain
from tests.support.states import actuator_state

MS = 1_000_000
LEGS, FEET = np.zeros(6, dtype=bool), np.zeros((6, 3))
WELL = Heard(scans=100, taken=99, scan_p50=20.0, scan_p99=60.0, plans=300, plan_p99=15.0, pause_max=120.0, late_p99=1.0)
CORES = {"mapper": 0.2, "planner": 0.1, "console": 0.02, "recorder": 0.05, "routers": 0.05}


def load(robots: int, worst: Heard = WELL) -> Load:
    cores = {part: robots * share for part, share in CORES.items()}
    return Load(robots, cores, 0.03 * robots, 0.5 * robots, 400.0 * robots, (*[WELL] * (robots - 1), worst))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, ()),
        ({"pause_max": 351.0, "plan_p99": 300.0}, ("no message of the planner for 351 ms", "plans 300 ms old")),
        ({"scan_p99": 900.0, "taken": 50}, ("scans in the map after 900 ms", "50 % of the scans integrated")),
        ({"plans": 0, "plan_p99": float("inf")}, ("no plan",)),
        ({"scans": 0, "taken": 0, "scan_p99": float("inf")}, ("scans in the map after inf ms", "0 % of the scans integrated")),
    ],
)
def test_load_limits_are_those_of_worst_robot(change: dict[str, float], words: tuple[str, ...]) -> None:
    assert load(3, replace(WELL, **change)).limits == words


def test_fleet_table_shows_capacity_and_limits_and_round_trips() -> None:
    loads = (load(1), load(2), load(3, replace(WELL, pause_max=700.0)))
    words = fleet.in_words(loads)
    assert "supports 2 robots; with 3: no message of the planner for 700 ms, and 1.5 cores of the machine are busy." in words
    assert words.splitlines()[2].startswith(
        "| 1 | 0.20 | 0.10 | 0.02 | 0.05 | 0.05 | 0.03 | 0.50 | 400 | 20 | 60 | 99 % | 15 | 120 |"
    )
    assert "supports 2 robots; larger numbers were not tried." in fleet.in_words(loads[:2])
    assert fleet.from_json(fleet.to_json(loads)) == loads


def test_fleet_load_figure_is_drawn(tmp_path: Path) -> None:
    fleet.draw(tmp_path / "fleet.png", (load(1), load(2)))
    assert (tmp_path / "fleet.png").read_bytes().startswith(b"\x89PNG")


class VirtualTime:
    """A clock that moves only while its owner waits."""

    def __init__(self) -> None:
        self._now_ns = 77

    def now_ns(self) -> int:
        return self._now_ns

    def wait(self, time_s: float) -> None:
        self._now_ns += round(time_s * 1e9)


class Base:
    """A base that receives every scan except the second, and plans after each."""

    def __init__(self) -> None:
        self.sent: list[tuple[AnyTopic, int]] = []
        self._hear: dict[AnyTopic, Callable[[AnyTopic, bytes], None]] = {}

    def subscribe(self, topic: AnyTopic, receive: Callable[[AnyTopic, bytes], None]) -> None:
        self._hear[topic] = receive

    def send(self, topic: AnyTopic, frame: bytes) -> None:
        message, timing = codec.decode(frame, topic.type, topic.max_bytes)
        self.sent.append((topic, timing.sent_ns))
        if topic is topics.SCAN and len(self.sent) != 3:
            self._hear[topics.SCAN_RECEIPT](topics.SCAN_RECEIPT, codec.encode(ScanReceipt(message.stamp_ns)))
            status = PlannerStatus(message.stamp_ns, "stepping", "", 1, 0, -1)
            self._hear[topics.PLANNER_STATUS](topics.PLANNER_STATUS, codec.encode(status))
            plan = StepPlan(message.stamp_ns, 0, 1, 0, np.eye(4), LEGS, FEET, np.zeros(6), np.eye(4), 1.0, False)
            self._hear[topics.STEP_PLAN](topics.STEP_PLAN, codec.encode(plan))


def test_replayed_robot_publishes_on_time_and_counts_replies(tmp_path: Path) -> None:
    path, base = tmp_path / "recording.mcap", Base()
    began_ns = 5_000 * MS  # robots have been up for a while
    said = [(topics.ACTUATOR_STATE, actuator_state(load_profile("phantomx_mk2"), stamp_ns=began_ns), began_ns)]
    said += [(topics.SCAN, scan(began_ns + k * 20 * MS), began_ns + (k * 20 + 3) * MS) for k in range(1, 5)]
    with Recorder(path, {}) as recorder:
        for topic, message, at_ns in said:
            recorder.write(topic, codec.encode(message), at_ns)
        recorder.write(topics.TERRAIN, codec.encode(terrain(began_ns)), began_ns)
    time = VirtualTime()
    heard = Player(path, time.now_ns, time.wait).play(base, after_s=0.030)
    assert base.sent == [(topic, at_ns) for topic, _, at_ns in said], "what a base makes itself is not played"
    assert (heard.scans, heard.taken, heard.plans) == (3, 2, 2)
    assert (heard.scan_p50, heard.scan_p99, heard.plan_p99) == (3.0, 3.0, 3.0)
    assert (heard.pause_max, heard.late_p99) == (33.0, 0.0)


def test_replayed_robot_follows_base_plans_and_ends_other_steps(tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    heard: list[tuple[int, float, int]] = []

    class Planner(Base):
        def send(self, topic: AnyTopic, frame: bytes) -> None:
            state, _ = codec.decode(frame, ActuatorState, topic.max_bytes)
            heard.append((state.step, state.phase, state.plan_ns))
            if state.phase == 1.0 and len(heard) > 2:
                plan = StepPlan(77, 0, state.step + 1, 0, np.eye(4), LEGS, FEET, np.zeros(6), np.eye(4), 1.0, False)
                self._hear[topics.STEP_PLAN](topics.STEP_PLAN, codec.encode(plan))

    walked = [(0, 1.0), (1, 0.2), (1, 0.9), (2, 0.0), (2, 0.5)]
    with Recorder(path, {}) as recorder:
        for k, (step, phase) in enumerate(walked):
            state = actuator_state(load_profile("phantomx_mk2"), stamp_ns=k * MS)
            recorder.write(topics.ACTUATOR_STATE, codec.encode(replace(state, step=step, phase=phase, plan_ns=5)), k * MS)
    time = VirtualTime()
    Player(path, time.now_ns, time.wait).play(Planner(), after_s=0.0)
    assert heard == [(0, 1.0, 5), (1, 1.0, 5), (1, 1.0, 5), (2, 0.0, 77), (2, 0.5, 77)]
