"""The table that `sextant up` draws on a terminal."""

import contextlib
import sys
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Self

import pytest

from sextant.deploy import cli
from sextant.deploy.commands import up
from sextant.deploy.launch import host_launcher
from sextant.deploy.security.router_security import Gate
from sextant.evaluation.observers.monitor import View
from sextant.shared.runtime.service import Every
from sextant.shared.runtime.zenoh_runner import run_live
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Endpoints, Router, ZenohLink
from tests.support.commands import eventually
from tests.support.screen import Screen
from tests.support.scripted_service import Scripted


class FakeLauncher:
    """Processes of which one fails after some beats."""

    names = ("mapper",)
    has_started = True

    def __init__(self, *arguments: Any) -> None:
        self._tell: Callable[[str], object] = arguments[-1]
        self._beats = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def where(self) -> str:
        return "router somewhere"

    def beat(self, _: float) -> str:
        self._beats += 1
        if self._beats == 2:
            self._tell("mapper: a line of its log")
        return "mapper keeps failing" if self._beats == 4 else ""


@pytest.mark.parametrize("terminal", [True, False])
def test_status_of_services_is_a_table_below_their_output_on_a_terminal(
    terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(host_launcher, "HostLauncher", FakeLauncher)
    monkeypatch.setattr(up, "_SHOW_S", 0.0)
    view = View(up=True, to_goal=None, doing={"mapper": "mapping"})
    monkeypatch.setattr(up, "_monitor", lambda *_: contextlib.nullcontext(SimpleNamespace(view=view)))
    screen = Screen()
    if terminal:
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.setattr(sys, "stdout", screen)
        monkeypatch.setattr(sys, "stderr", screen)
    assert cli.main(["up", "all", "--scenario", "flat", "--no-page"]) == 1
    if terminal:
        lines = screen.lines()
        assert lines[2] == "ready after 0 s: mapper run"
        assert lines[3] == "mapper: a line of its log"
        assert lines[-2:] == ["  mapper  mapping", "sextant up: mapper keeps failing"]
        assert "to the goal" not in screen.getvalue()
    else:
        printed = capsys.readouterr()
        assert "mapping" not in printed.out
        assert printed.out.splitlines()[-1] == "ready after 0 s: mapper run"
        assert printed.err.splitlines() == ["mapper: a line of its log", "sextant up: mapper keeps failing"]


def test_monitor_receives_the_status_of_running_services() -> None:
    endpoint, stop = f"tcp/127.0.0.1:{free_port()}", threading.Event()
    gated = Gate((endpoint,), "table")
    with Router((endpoint,)), ZenohLink(Endpoints((endpoint,), namespace="table")) as link:
        mapper = threading.Thread(target=run_live, args=(Scripted("mapper", Every.hz(10.0)), link, stop))
        mapper.start()
        try:
            with up._monitor(gated, "all") as monitor:
                eventually(lambda: "mapper" in monitor.view.doing, "the mapper's status")
        finally:
            stop.set()
            mapper.join()
