"""The services of one machine, with presences of other machines.

A presence may prevent a start; it never ends a running service.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sextant.deploy.launch import host_launcher, peer_handshake, process_table
from sextant.deploy.launch.host_launcher import HostLauncher
from sextant.deploy.launch.launcher import Ended
from sextant.deploy.launch.process_table import Choices, Role
from sextant.deploy.security.router_security import Gate
from sextant.evaluation.provenance import version
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics

OWN = "tcp/127.0.0.1:7447"


class FakeLink:
    """A link by which the test acts as the other machines."""

    def __init__(self, *_: Any):
        self.frames: dict[str, list[bytes]] = {}

    def __enter__(self) -> "FakeLink":
        return self

    def __exit__(self, *_: object) -> None: ...

    def send(self, topic: AnyTopic, frame: bytes) -> None: ...

    def collect(self, topic: AnyTopic) -> Callable[[], list[bytes]]:
        return lambda: self.frames.pop(topic.key, [])


class FakeLauncher:
    """A launcher that starts no process."""

    started: list[str] = []  # noqa: RUF012 - by all launchers
    ended: list[Ended] = []  # noqa: RUF012 - to be reported

    def __init__(self, commands: Any, hear: Any):
        self.names = [command.name for command in commands]

    def __enter__(self) -> "FakeLauncher":
        FakeLauncher.started += self.names
        return self

    def __exit__(self, *_: object) -> None:
        for name in self.names:
            FakeLauncher.started.remove(name)

    def wait(self, timeout_s: float) -> list[Ended]:
        ended, FakeLauncher.ended = FakeLauncher.ended, []
        return ended


@pytest.fixture
def link(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeLink]:
    made = FakeLink()
    now = [0]

    def clock() -> int:
        now[0] += 100_000_000
        return now[0]

    monkeypatch.setattr(host_launcher, "Launcher", FakeLauncher)
    monkeypatch.setattr(host_launcher, "ZenohLink", lambda _: made)
    monkeypatch.setattr(host_launcher, "_host", lambda *_: None)
    monkeypatch.setattr(host_launcher.time, "monotonic_ns", clock)
    monkeypatch.setattr(host_launcher.time, "sleep", lambda _: None)
    monkeypatch.setattr(host_launcher.time, "monotonic", lambda: now[0] * 1e-9)
    FakeLauncher.started.clear()
    yield made
    assert FakeLauncher.started == []


def claim(link: FakeLink, role: str, *services: str) -> None:
    """Receive a presence of an older start of the same services, under a role's key."""
    made = peer_handshake.presence("another-1", "onboard", version(), services, 1e9, 1)
    link.frames[topics.PRESENCE_OF[role].key] = [codec.encode(made)]


def make_host_launcher(role: Role, upstream: tuple[str, ...]) -> HostLauncher:
    rows = process_table.rows(role, simulated=False)
    return HostLauncher(role, rows, Choices(), {}, Gate((OWN,), upstream=upstream, open=True), lambda _: None)


@pytest.mark.parametrize("role", topics.ROLE_NAMES)
def test_running_robot_ignores_presence_claims(link: FakeLink, role: str) -> None:
    with make_host_launcher("onboard", ()) as running:
        assert {"actuator", "stop"} <= set(FakeLauncher.started), "at once, for others come to it"
        for _ in range(60):
            claim(link, role, "actuator", "stop", "perception")
            assert running.beat(0.0) == ""
        assert {"actuator", "stop"} <= set(FakeLauncher.started)


def test_running_base_ignores_presence_claims(link: FakeLink) -> None:
    with make_host_launcher("offboard", ("tcp/10.0.0.1:7447",)) as running:
        while "planner" not in FakeLauncher.started:
            assert running.beat(0.0) == ""
        claim(link, "robot", "planner")
        assert [running.beat(0.0) for _ in range(60)] == [""] * 60


def test_base_does_not_start_service_running_elsewhere(link: FakeLink) -> None:
    with make_host_launcher("offboard", ("tcp/10.0.0.1:7447",)) as starting:
        assert starting.beat(0.0) == ""
        assert FakeLauncher.started == [], "the others are waited for"
        with pytest.raises(KeyError):
            starting.pid("planner")
        claim(link, "base", "planner")
        assert "another-1 (onboard) already runs planner" in starting.beat(0.0)
        assert FakeLauncher.started == []


def test_late_process_failure_keeps_actuator_and_stop_running(link: FakeLink) -> None:
    with make_host_launcher("onboard", ()) as running:
        FakeLauncher.ended = [Ended("perception", "exit status 1", "", restarted=False)]
        assert "perception keeps failing" in running.beat(0.0), "it was never started rightly"
    with make_host_launcher("onboard", ()) as running:
        for _ in range(700):
            assert running.beat(0.0) == ""
        FakeLauncher.ended = [Ended("perception", "exit status 1", "", restarted=False)]
        assert running.beat(0.0) == ""
        FakeLauncher.ended = [Ended("actuator", "exit status 1", "", restarted=False)]
        assert "actuator keeps failing" in running.beat(0.0)
    with make_host_launcher("onboard", ()) as running:
        FakeLauncher.ended = [Ended("actuator", "exit status 2", "actuator: no such port", restarted=False)]
        assert "actuator does not start with this input, see above" in running.beat(0.0)


def test_console_claim_cannot_prevent_robot_start(link: FakeLink) -> None:
    with make_host_launcher("onboard", ("tcp/10.0.0.1:7447",)) as starting:
        while "actuator" not in FakeLauncher.started:
            claim(link, "console", "actuator", "stop", "perception")
            assert starting.beat(0.0) == ""


def test_processes_publish_under_machine_role(tmp_path: Path, link: FakeLink) -> None:
    robot, base = make_host_launcher("onboard", ()), make_host_launcher("offboard", ("tcp/10.0.0.1:7447",))
    assert not any("--role" in command.arguments for command in robot.commands), "the robot's, which it is by itself"
    for command in base.commands:
        assert command.arguments[command.arguments.index("--role") + 1] == "base"
