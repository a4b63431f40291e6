"""A live walk without its processes: commands, endpoints, recovery after a kill."""

import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.faults import cpu_load, live_walk
from benchmarks.faults.cases import BY_NAME, CASES, LIVE_CASES, Away, Case, Hogs, Off, OnBus
from benchmarks.faults.instrumented_robot import Places
from benchmarks.faults.live_walk import LiveWalk
from sextant.deploy.launch import process_table
from sextant.deploy.launch.process_table import Command
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.shared.recording.writer import Recorder
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Health, Message, Mode
from sextant.shared.wire.transport import Endpoints
from tests.support.states import actuator_state
from tests.support.timelines import PROFILE

IDS = PROFILE.servo_ids.ravel().tolist()
OFF = dxl.sync_write(dxl.TORQUE_ENABLE.address, 1, [(i, b"\0") for i in IDS])
NOTHING = np.zeros(0)


def option_values(command: Command, option: str) -> list[str]:
    """Return the word after each occurrence of an option."""
    return [value for word, value in zip(command.arguments, command.arguments[1:], strict=False) if word == option]


def health(service: str, at_s: float) -> Health:
    return Health(round(at_s * 1e9), service, "", 1, 0, 0, "", (), NOTHING, NOTHING)


def at(port: int) -> Endpoints:
    return Endpoints((f"tcp/127.0.0.1:{port}",), namespace="n")


def places(base: Endpoints | None = None, world: Endpoints | None = None) -> Places:
    return Places(at(1), 21000, 22000, base, world)


@pytest.fixture
def walk() -> LiveWalk:
    return LiveWalk(BY_NAME["live-planner-killed"], 1)


def hear(walk: LiveWalk, message: Message) -> None:
    walk.hear(topics.OF_TYPE[type(message)], codec.encode(message))


def test_all_services_use_router_and_actuator_uses_bus_sniffer() -> None:
    made = {one.name: one for one in live_walk.commands(places(), 5)}
    assert made["router"].after == ()
    assert all("router" in one.after for name, one in made.items() if name not in ("router", "tap"))
    services = [one for name, one in made.items() if name not in ("router", "tap")]
    assert all(
        option_values(one, "--connect") == ["tcp/127.0.0.1:1"] and option_values(one, "--namespace") == ["n"]
        for one in services
    )
    assert made["simulator"].ready_port == 21000
    assert option_values(made["tap"], "--servos") == ["21000"]
    assert option_values(made["tap"], "--listen") == ["22000"]
    for name in ("actuator", "stop"):
        assert option_values(made[name], "--set")[-1] == process_table.assignment("port", "socket://127.0.0.1:22000")
    assert {"tap", "simulator"} <= set(made["actuator"].after)
    assert made["simulator"].restarts == 0
    assert all(one.restarts > 100 for name, one in made.items() if name not in ("simulator", "tap")), "killed again and again"


def test_base_services_use_router_chained_to_robot() -> None:
    made = {one.name: one for one in live_walk.commands(places(base=at(2)), 5)}
    assert option_values(made["base router"], "--listen") == ["tcp/127.0.0.1:2"]
    assert option_values(made["base router"], "--connect") == ["tcp/127.0.0.1:1"]
    there = {name for name, one in made.items() if option_values(one, "--connect") == ["tcp/127.0.0.1:2"]}
    assert there == {"mapper", "planner", "operator"}
    assert all("--elsewhere" in made[name].arguments for name in there), "they go by the robot's clock"
    assert made["operator"].after == ("base router",)
    onboard = {"simulator", "actuator", "stop", "perception"}
    assert all(option_values(made[name], "--connect") == ["tcp/127.0.0.1:1"] for name in onboard)
    assert made.keys() == there | onboard | {"router", "base router", "tap"}


def test_simulator_uses_second_router_during_router_fault() -> None:
    made = {one.name: one for one in live_walk.commands(places(world=at(3)), 5)}
    plain = {one.name: one for one in live_walk.commands(places(), 5)}
    assert option_values(made["world router"], "--listen") == ["tcp/127.0.0.1:3"]
    assert option_values(made["world router"], "--connect") == ["tcp/127.0.0.1:1"]
    assert option_values(made["simulator"], "--connect") == ["tcp/127.0.0.1:3"]
    assert made["simulator"].after == ("world router",)
    assert made.keys() - plain.keys() == {"world router"}
    assert all(made[name] == plain[name] for name in plain if name != "simulator"), "no other process connects there"


@pytest.mark.parametrize("name", ["live-router-stopped", "live-planner-stopped"])
def test_ground_truth_is_received_at_unaffected_router(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    met: dict[tuple[str, ...], list[str]] = {}

    class Link:
        def __init__(self, endpoints: Endpoints):
            self.keys = met.setdefault(endpoints.connect, [])

        def __enter__(self) -> "Link":
            return self

        def __exit__(self, *_: object) -> None: ...

        def subscribe(self, topic: AnyTopic, _receive: object) -> None:
            self.keys.append(topic.key)

        def wanted(self, _topic: AnyTopic) -> bool:
            return True

    monkeypatch.setattr(live_walk, "ZenohLink", Link)
    monkeypatch.setattr(live_walk.Launcher, "__enter__", lambda self: self)  # no process is started
    with LiveWalk(BY_NAME[name], 1) as walk:
        simulator = next(one for one in walk.commands if one.name == "simulator")
        router = next(one for one in walk.commands if one.name == "router")
    at = {topic: endpoint for endpoint, keys in met.items() for topic in keys}
    assert at[topics.TRUTH.key] == tuple(option_values(simulator, "--connect"))
    assert at[topics.ACTUATOR_STATE.key] == tuple(option_values(router, "--listen"))
    assert (at[topics.TRUTH.key] == at[topics.ACTUATOR_STATE.key]) == (name == "live-planner-stopped")


@pytest.mark.parametrize("case", LIVE_CASES, ids=lambda case: case.name)
def test_each_faulted_process_is_started(case: Case) -> None:
    names = LiveWalk(case, 1).names
    assert all(deed.service in names for deed in case.deeds if isinstance(deed, Away))
    assert ("base router" in names) == case.halves
    assert ("world router" in names) == any(isinstance(deed, Away) and deed.service == "router" for deed in case.deeds)


def test_killed_service_returns_with_first_health_after_exit(walk: LiveWalk) -> None:
    hear(walk, health("planner", 10.0))
    assert np.isnan(walk.returned("planner", 9.0)), "its end was not seen"
    walk.note_end("planner", 11.0)
    assert np.isnan(walk.returned("planner", 9.0)), "that was the old one"
    hear(walk, health("planner", 11.5))
    hear(walk, health("planner", 12.5))
    assert walk.returned("planner", 9.0) == 11.5
    assert np.isnan(walk.returned("planner", 12.0)), "not of a later fault"
    walk.note_end("planner", 13.0)
    assert np.isnan(walk.returned("planner", 12.0))


def test_killed_actuator_returns_when_it_opens_port(walk: LiveWalk) -> None:
    walk.note_end("actuator", 5.0)
    hear(walk, health("actuator", 5.2))
    assert np.isnan(walk.returned("actuator", 4.0))
    walk.hear_line("tap", "open 5400000000")
    assert walk.returned("actuator", 4.0) == 5.4


def test_suspended_process_is_away_until_resumed_or_replaced(walk: LiveWalk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(walk._launcher, "freeze", lambda _name: None)
    over = walk._begin(Away("actuator", kill=False, for_s=3.5), 10.0, np.random.default_rng(0))
    assert over() == 13.5
    walk.note_end("actuator", 11.6)
    assert over() == 13.5
    walk.hear_line("tap", "open 12100000000")
    assert over() == pytest.approx(12.1)


@pytest.mark.slow
@given(st.lists(st.booleans(), min_size=1, max_size=5))
def test_torque_state_follows_last_torque_command(switched: list[bool]) -> None:
    walk = LiveWalk(BY_NAME["live-off"], 1)
    assert walk.pulls().all()
    for at, on in enumerate(switched):
        data = OFF if not on else dxl.sync_write(dxl.TORQUE_ENABLE.address, 1, [(i, b"\1") for i in IDS])
        walk.hear_line("tap", f"sent {at} {data.hex()}")
    assert walk.pulls().all() == switched[-1]
    assert walk.pulls().any() == switched[-1]


def test_silent_actuator_is_not_walking(walk: LiveWalk) -> None:
    def says_walking(ago_s: float) -> bool:
        stamp = time.monotonic_ns() - round(ago_s * 1e9)
        hear(walk, actuator_state(PROFILE, stamp_ns=stamp, mode=Mode.WALK, reason="walking"))
        return walk.walks

    assert not says_walking(5.0)
    assert says_walking(0.0)


def test_recorded_time_ends_at_last_message_before_kill(
    walk: LiveWalk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(walk, "_recordings", tmp_path)
    killed_s = 100.0
    assert walk._recorded_until(killed_s) == -np.inf, "nothing was recorded"
    for name, ends_s in (("1", 60.0), ("2", 99.7), ("3", 101.0)):  # an earlier walk, the killed one, its successor
        folder = tmp_path / name
        folder.mkdir()
        with Recorder(folder / "recording.mcap", {}) as recorder:
            for at_s in (ends_s - 0.5, ends_s):
                recorder.write(topics.HEALTH, codec.encode(health("planner", at_s)), round(at_s * 1e9))
    assert walk._recorded_until(killed_s) == pytest.approx(99.7)


def test_cpu_load_is_only_in_live_cases() -> None:
    assert {type(deed) for case in LIVE_CASES for deed in case.deeds} == {Away, Hogs, Off, OnBus}
    assert not any(isinstance(deed, Hogs) for case in CASES for deed in case.deeds)
    assert BY_NAME["live-hogs"].for_s == 5.0
    assert len(cpu_load.commands()) >= 1


def test_unstarted_walk_leaves_latch_open(walk: LiveWalk) -> None:
    assert not Latch.of_port(walk.port).closed
