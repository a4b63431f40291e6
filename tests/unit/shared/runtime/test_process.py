"""The process of a service: settings, arguments, exit status, and end."""

import ctypes
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.shared.files.config import ConfigError
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime import process, shutdown
from sextant.shared.runtime.service import Every, Inbox, Stages
from sextant.shared.runtime.simulated_time import SimulatedTime
from sextant.shared.wire.messages import Message
from sextant.shared.wire.transport import Endpoints, TransportError
from tests.support.states import frame_of_version_0_1

PATIENCE_S = 180.0  # for anything that may take long on a busy machine


@dataclass(frozen=True, slots=True)
class Registration:
    """A nested table."""

    method: str = "projective"
    iterations: int = 10


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of every kind that a service may have."""

    port: int = 7000
    host: str = "localhost"
    blind: bool = False
    scale: float = 1.0
    gait: Literal["tripod", "wave"] = "tripod"
    pair: tuple[float, float] = (0.0, 1.0)
    registration: Registration = field(default_factory=Registration)
    limit: float | None = None


def test_help_names_the_module_that_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def make(_profile: RobotProfile, _settings: Settings) -> Any:
        raise AssertionError

    running = ModuleType("__main__")
    running.__spec__ = ModuleSpec("some.package.module", None)
    monkeypatch.setitem(sys.modules, "__main__", running)
    for defined_in, program in (("__main__", "some.package.module"), ("another.package.service", "another.package")):
        make.__module__ = defined_in
        with pytest.raises(SystemExit, match="0"):
            process.run("sketch", Settings, make, shutdown.ShutdownRequested(), ["--help"])
        assert capsys.readouterr().out.startswith(f"usage: python -m {program} [-h]")


# ------------------------------------------------------------------------------------------------- settings


def test_no_assignment_gives_defaults() -> None:
    assert process.load_settings(Settings, None, []) == Settings()
    assert process.assignments(Settings()) == []


@pytest.mark.parametrize(
    ("assignment", "expected"),
    [
        ("port=1", Settings(port=1)),
        ("port = 1", Settings(port=1)),
        ("blind=true", Settings(blind=True)),
        ("scale=2", Settings(scale=2.0)),
        ("scale=1e-3", Settings(scale=0.001)),
        ('host="a b"', Settings(host="a b")),
        ("host=robot.local", Settings(host="robot.local")),  # a bare word is a text
        ("host=tcp/127.0.0.1:7447", Settings(host="tcp/127.0.0.1:7447")),
        ("host=", Settings(host="")),
        ("pair=[1, 2.5]", Settings(pair=(1.0, 2.5))),
        ('registration.method="kiss-icp"', Settings(registration=Registration("kiss-icp"))),
        ("registration.method=kiss-icp", Settings(registration=Registration("kiss-icp"))),
        ("registration.iterations=3", Settings(registration=Registration(iterations=3))),
    ],
)
def test_assignment_sets_one_value(assignment: str, expected: Settings) -> None:
    assert process.load_settings(Settings, None, [assignment]) == expected


def test_later_assignments_override_earlier_ones_and_file(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text('port = 5\nhost = "file"\n[registration]\nmethod = "kiss-icp"\niterations = 7\n')
    assert process.load_settings(Settings, str(path), []) == Settings(5, "file", registration=Registration("kiss-icp", 7))
    found = process.load_settings(Settings, str(path), ["port=6", "port=8", "registration.iterations=9"])
    assert found == Settings(8, "file", registration=Registration("kiss-icp", 9))  # one value of the nested table, not all


@pytest.mark.parametrize(
    ("assignments", "words"),
    [
        (["prot=1"], "prot: unknown key; did you mean 'port'?"),
        (["port=high"], "port: a whole number expected, found 'high'"),
        (["port"], "--set: key=value expected, found 'port'"),
        ([""], "--set: key=value expected, found ''"),
        (["=1"], "--set: key=value expected"),
        (["# comment=1"], "--set: key=value expected"),
        (["po rt=1"], "--set: key=value expected"),
        (["port.number=1"], "port"),
        (["gait=trot"], "gait: one of 'tripod', 'wave' expected"),
        (["prot=1", "blind=2"], "blind: true or false expected, found 2"),
        (["registration.method.name=1"], "registration.method"),
    ],
)
def test_invalid_assignment_is_named(assignments: list[str], words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        process.load_settings(Settings, None, assignments)
    assert words in str(caught.value)


def test_missing_settings_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        process.load_settings(Settings, str(tmp_path / "none.toml"), [])


texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
awkward = st.sampled_from(
    ["1", "true", "1.5", "", " ", "a=b", '"', "\\", "'", "#", "\n", "[1]", "2024-01-01", "nan", "\x7f", "\x00"]
)
numbers = st.floats(allow_nan=False, allow_infinity=False)


@given(
    st.builds(
        Settings,
        port=st.integers(-(10**9), 10**9),
        host=texts | awkward,
        blind=st.booleans(),
        scale=numbers,
        gait=st.sampled_from(["tripod", "wave"]),
        pair=st.tuples(numbers, numbers),
        registration=st.builds(Registration, texts | awkward, st.integers(0, 9)),
        limit=st.none() | numbers,
    )
)
def test_assignments_reproduce_settings(settings: Settings) -> None:
    arguments = process.assignments(settings)
    assert set(arguments[::2]) <= {"--set"}
    assert process.load_settings(Settings, None, arguments[1::2]) == settings


def test_assignments_omit_defaults() -> None:
    assert process.assignments(Settings(port=1)) == ["--set", "port=1"]


# ----------------------------------------------------------------------------------------------------- running


class NoLink:
    """A replacement for the network."""

    opened: list[Endpoints]
    closed: int
    astray, last_astray = 0, ""

    def __init__(self, endpoints: Endpoints) -> None:
        NoLink.opened.append(endpoints)

    def __enter__(self) -> "NoLink":
        return self

    def __exit__(self, *_: object) -> None:
        NoLink.closed += 1

    def send(self, topic: Any, frame: bytes) -> None: ...

    def subscribe(self, topic: Any, receive: Any) -> Any: ...

    def wanted(self, topic: Any) -> bool:
        return True


@dataclass
class Beating:
    """A service that calls a test's function at each beat."""

    act: Callable[[], None]
    name: str = "beating"
    trigger: Every = field(default_factory=lambda: Every.hz(500))
    subscribes: tuple[Any, ...] = ()
    publishes: tuple[Any, ...] = ()
    stages: Stages = field(default_factory=Stages)
    open: bool = False

    def __enter__(self) -> "Beating":
        self.open = True
        return self

    def __exit__(self, *_: object) -> None:
        self.open = False

    def step(self, message: Any, inbox: Inbox) -> Iterable[Message]:
        assert self.open
        self.act()
        return ()

    def status(self) -> str:
        return "beating"


@pytest.fixture(autouse=True)
def fake_network(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    NoLink.opened, NoLink.closed = [], 0
    monkeypatch.setattr(process, "ZenohLink", NoLink)
    monkeypatch.setattr(shutdown, "_END_S", PATIENCE_S)  # otherwise the process of all tests would end
    switching_s = sys.getswitchinterval()
    yield
    sys.setswitchinterval(switching_s)


def end_self() -> None:
    os.kill(os.getpid(), signal.SIGTERM)


CONNECT = ["--connect", "tcp/127.0.0.1:1"]


def run(make: Any, argv: list[str], compile_functions: Any = None) -> int:
    with shutdown.ShutdownRequested() as told:
        return process.run("planner", Settings, make, told, argv, compile_functions)


def test_signal_ends_process_with_status_0_and_closes_all() -> None:
    made: list[Any] = []

    def make(profile: RobotProfile, settings: Settings) -> Beating:
        made.append((profile.name, settings))
        service = Beating(end_self)
        made.append(service)
        return service

    assert run(make, [*CONNECT, "--set", "port=3", "--namespace", "here"]) == 0
    assert made[0] == ("phantomx_mk2", Settings(port=3))
    assert not made[1].open
    assert NoLink.opened == [Endpoints(("tcp/127.0.0.1:1",), namespace="here")]
    assert NoLink.closed == 1


def test_functions_are_compiled_before_link_opens() -> None:
    heard: list[Any] = []

    def compile_functions(profile: RobotProfile, settings: Settings) -> None:
        heard.append((profile.name, settings, list(NoLink.opened)))

    assert run(lambda *_: Beating(end_self), [*CONNECT, "--set", "port=3"], compile_functions) == 0
    assert heard == [("phantomx_mk2", Settings(port=3), [])]
    assert len(NoLink.opened) == 1


def test_priority_is_lowered_before_compilation_except_in_simulated_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> Beating:
        raise ConnectionError("no servos")

    heard: list[object] = []
    monkeypatch.setattr(os, "nice", heard.append)
    SimulatedTime.create(tmp_path / "time", [])
    for words in ([], ["--simulated-time", str(tmp_path / "time")]):
        assert run(fail, [*CONNECT, "--nice", "5", *words], lambda *_: heard.append("compile")) == 1
    assert heard == [5, "compile", "compile", 5]


def test_signal_during_compilation_ends_process_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """End at once on a signal during the compilation.

    Compilation cannot be interrupted, and takes up to a minute.
    """
    left: list[int] = []
    ended = threading.Event()

    def leave(status: int) -> None:
        left.append(status)
        ended.set()

    def compile_(*_: object) -> None:
        end_self()
        assert ended.wait(PATIENCE_S), "another thread ends the process"
        raise ValueError("the rest is what a process that has ended does not do")

    monkeypatch.setattr(shutdown.os, "_exit", leave)
    run(lambda *_: Beating(end_self), CONNECT, compile_)
    assert left == [0]
    assert not NoLink.opened


def test_long_compilation_is_explained(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    monkeypatch.setattr(process, "_PATIENCE_S", 0.0)
    told = threading.Event()
    monkeypatch.setattr(process.logging, "info", lambda words: (logging.getLogger().info(words), told.set()))
    assert run(lambda *_: Beating(end_self), CONNECT, lambda *_: told.wait(PATIENCE_S)) == 0
    assert "compiling the inner loops takes half a minute, the first time only" in caplog.text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([*CONNECT, "--set", "prot=1"], "did you mean 'port'?"),
        ([*CONNECT, "--robot", "phantom"], "no profile 'phantom'"),
        ([*CONNECT, "--config", "/nowhere.toml"], "no such file"),
        ([], "an endpoint to connect to is needed"),
    ],
)
def test_caller_error_is_reported_with_status_2(arguments: list[str], words: str, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.ERROR):
        assert run(lambda *_: Beating(end_self), arguments) == 2
    assert words in caplog.text


def test_missing_network_exits_with_status_2(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    def fail(_: object) -> None:
        raise TransportError("could not open Zenoh")

    monkeypatch.setattr(process, "ZenohLink", fail)
    assert run(lambda *_: Beating(end_self), CONNECT) == 2
    assert "could not open Zenoh" in caplog.text


def test_missing_device_exits_with_status_1_and_reason(caplog: pytest.LogCaptureFixture) -> None:
    def fail(*_: object) -> Beating:
        raise ConnectionError("cannot open servo port /dev/ttyUSB0")

    assert run(fail, CONNECT) == 1
    assert "cannot open servo port" in caplog.text
    assert "Traceback" not in caplog.text


def test_exception_in_step_ends_with_traceback() -> None:
    def bug() -> None:
        raise ValueError("shapes do not match")

    with pytest.raises(ValueError, match="shapes do not match"):
        run(lambda *_: Beating(bug), CONNECT)
    assert NoLink.closed == 1


def test_unknown_argument_exits_with_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        run(lambda *_: Beating(end_self), ["--conect", "x"])
    assert caught.value.code == 2
    assert "--conect" in capsys.readouterr().err


def test_process_without_its_parent_does_not_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda _: type("libc", (), {"prctl": staticmethod(lambda *_: 0)}))
    with pytest.raises(SystemExit) as caught:
        run(lambda *_: Beating(end_self), [*CONNECT, "--parent", str(os.getppid() + 1)])
    assert caught.value.code == 1


def test_robot_of_another_version_is_named(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    class Robot:
        def subscribe(self, topic: object, hear: Callable[[object, bytes], None]) -> None:
            hear(topic, frame_of_version_0_1(load_profile("phantomx_mk2")))

    monkeypatch.setattr(process.clock, "go_by", lambda _clock: None)
    monkeypatch.setattr(process.clock.RobotClock, "known", True)
    process._follow_robot(Robot(), threading.Event(), lambda _now_ns: None)
    (line,) = [record.message for record in caplog.records if record.levelno == logging.WARNING]
    assert "found ActuatorState:5576558f: the robot runs another version of Sextant" in line
