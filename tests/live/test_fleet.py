"""A base of two robots that the test simulates.

Each robot receives its own messages only, and failures of one do not affect the other.
"""

import contextlib
import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from benchmarks.page import browser as browsers
from benchmarks.page.browser import SMALL
from benchmarks.robot import fleet
from sextant.deploy.launch import peer_handshake
from sextant.services.console.web.origin_policy import PROTOCOL
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Mode, ModeCommand, StopOrder
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Endpoints, Router, ZenohLink
from tests.support.commands import Command, Process, eventually, write_course
from tests.support.states import actuator_state

pytestmark = pytest.mark.live
PROFILE = load_profile("phantomx_mk2")


class Robot:
    """A router and an actuator that reports its state and records its orders.

    This class is a context manager.
    """

    def __init__(self, name: str, mode: Mode, reason: str):
        self.name, self.mode, self.reason = name, mode, reason
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.told: list[str] = []
        self.rival = False  # another machine claims an older start of this robot's mapper
        self._over = threading.Event()

    def __enter__(self) -> "Robot":
        with contextlib.ExitStack() as stack:
            stack.enter_context(Router((self.endpoint,)))
            self._link = stack.enter_context(ZenohLink(Endpoints((self.endpoint,), namespace=self.name)))
            for topic in (topics.MODE, topics.STOP):
                self._link.subscribe(topic, self._hear)
            thread = threading.Thread(target=self._speak, daemon=True)
            thread.start()
            stack.callback(thread.join)
            stack.callback(self._over.set)
            self._held = stack.pop_all()
        return self

    def __exit__(self, *error: Any) -> None:
        self._held.close()

    def _hear(self, topic: AnyTopic, frame: bytes) -> None:
        order, _ = codec.decode(frame, topic.type, topic.max_bytes)
        assert isinstance(order, ModeCommand | StopOrder)
        self.told.append(order.mode)

    def _speak(self) -> None:
        while not self._over.wait(0.04):
            now = time.monotonic_ns()
            state = actuator_state(PROFILE, stamp_ns=now, mode=self.mode, reason=self.reason)
            self._link.send(topics.ACTUATOR_STATE, codec.encode(state, codec.Timing(now, now)))
            if self.rival:
                word = peer_handshake.presence("a rival", "offboard", "1", ["mapper"], 1e6, now)
                self._link.send(topics.PRESENCE, codec.encode(word, codec.Timing(now, now)))


@pytest.fixture
def robots() -> Iterator[dict[str, Robot]]:
    alpha, beta = Robot("alpha", Mode.HOLD, "standing as ordered"), Robot("beta", Mode.FAULT, "servo 7 (LF femur) is silent")
    with alpha, beta:
        yield {"alpha": alpha, "beta": beta}


def write_fleet_file(folder: Path, robots: dict[str, Robot], port: int, without: str = '"planner"') -> Path:
    tables = [f'[robots.{name}]\nconnect = ["{robot.endpoint}"]\nwithout = [{without}]\n' for name, robot in robots.items()]
    path = folder / "fleet.toml"
    path.write_text("".join(tables) + f"[page]\nport = {port}\n", encoding="utf-8")
    return path


def open_status_socket(port: int, name: str) -> ClientConnection:
    words: Any = [PROTOCOL]
    return connect(f"ws://127.0.0.1:{port}/{name}/socket?glance", subprotocols=words, compression=None)


def shows_mode(port: int, name: str, mode: str) -> bool:
    with contextlib.suppress(Exception), open_status_socket(port, name) as page:
        return json.loads(page.recv(5.0)).get("mode") == mode  # raises while the console is not up or has no state
    return False


def process(base: Command, module: str, name: str = "") -> Process | None:
    return next((p for p in base.family() if module in p.words and (not name or name in p.words)), None)


def test_failure_of_one_robot_does_not_affect_others(robots: dict[str, Robot], tmp_path: Path) -> None:
    port = free_port()
    with Command("fleet", str(write_fleet_file(tmp_path, robots, port)), cwd=tmp_path) as base:
        # 1. One address shows the state of each robot.
        base.wait_for(lambda: shows_mode(port, "alpha", Mode.HOLD), "the page of alpha")
        base.wait_for(lambda: shows_mode(port, "beta", Mode.FAULT), "the page of beta")
        assert f"page of all robots: http://127.0.0.1:{port}/" in base.text()
        # 2. An order there reaches its robot only.
        with open_status_socket(port, "alpha") as page:
            page.send(json.dumps({"type": "order", "order": "off"}))
            base.wait_for(lambda: "off" in robots["alpha"].told, "the order at alpha")
        assert robots["beta"].told == []
        # 3. Killed processes are started again, also the page of all robots.
        for module, name in (("sextant.services.mapper", "alpha"), ("sextant.services.console.fleet_proxy", "")):
            found = process(base, module, name)
            assert found is not None
            os.kill(found.pid, signal.SIGKILL)
            base.wait_for(lambda m=module, n=name, old=found: process(base, m, n) not in (None, old), f"{module} again")
        base.wait_for(lambda: "alpha: mapper ended (killed by SIGKILL)" in base.text(), "the word of it")
        base.wait_for(lambda: shows_mode(port, "beta", Mode.FAULT), "the page, again")
        # 4. A machine that claims the same services is reported, and ends no process.
        mapper = process(base, "sextant.services.mapper", "alpha")
        robots["alpha"].rival = True
        base.wait_for(lambda: "alpha: a rival (offboard) already runs mapper" in base.text(), "the report of a rival")
        # 5. Services of one robot that keep failing are ended with the reason, and the other robot goes on.
        while "the other robots continue" not in base.text():
            found = process(base, "sextant.services.mapper", "alpha")
            if found is not None:
                assert mapper is None or found.pid == mapper.pid, "still the same"
                os.kill(found.pid, signal.SIGKILL)
                mapper = None
                base.wait_for(lambda old=found: process(base, "sextant.services.mapper", "alpha") != old, "its end")
        eventually(lambda: process(base, "sextant.services.mapper", "alpha") is None, "alpha's processes gone")
        assert shows_mode(port, "beta", Mode.FAULT)
        assert process(base, "sextant.services.mapper", "beta") is not None
        # 6. Ctrl-C ends all of it.
        base.interrupt()
        assert base.status() == 130
        base.gone()


@pytest.mark.skipif(not browsers.find(), reason=f"no browser found of {', '.join(browsers.BROWSERS)}: install Chromium")
def test_fleet_page_shows_all_robots_and_opens_each(
    robots: dict[str, Robot], tmp_path: Path, pytestconfig: pytest.Config
) -> None:
    """Draw the picture of the docs.

    pytest tests/live/test_fleet.py -k page --pictures docs
    """
    folder, port = Path(pytestconfig.getoption("--pictures") or tmp_path), free_port()
    file = write_fleet_file(tmp_path, robots, port, '"mapper", "planner", "recorder"')
    with Command("fleet", str(file), cwd=tmp_path) as base, browsers.browser() as chromium:
        base.wait_for(lambda: shows_mode(port, "beta", Mode.FAULT), "the page of beta")
        page = chromium.new_context(viewport={"width": SMALL[0], "height": 320}).new_page()
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(f"http://127.0.0.1:{port}/")
        page.wait_for_function("() => document.getElementById('count').textContent === '2 of 2 robots are connected'")
        page.screenshot(path=folder / "fleet_page.png")
        cards = page.locator(".robot")
        assert [card.locator(".mode").inner_text().lower() for card in cards.all()] == ["hold", "fault"]
        assert cards.nth(1).locator(".reason").inner_text() == "servo 7 (LF femur) is silent"
        # 1. Torque goes off for one robot, then for all.
        cards.nth(1).locator(".off").click()
        base.wait_for(lambda: "off" in robots["beta"].told, "the order at beta")
        assert robots["alpha"].told == []
        page.keyboard.press("Shift+Escape")
        base.wait_for(lambda: "off" in robots["alpha"].told, "the order at alpha")
        # 2. From a robot's own page to another's.
        page.click("text=alpha")
        page.wait_for_function("() => document.getElementById('mode-word').textContent === 'hold'")
        assert page.locator("#robots").input_value() == "alpha"
        page.select_option("#robots", "beta")
        page.wait_for_url(f"http://127.0.0.1:{port}/beta/")
        page.wait_for_function("() => document.getElementById('mode-word').textContent === 'fault'")
        page.click("#all-robots")
        page.wait_for_url(f"http://127.0.0.1:{port}/")
        assert errors == []


@pytest.mark.rare
def test_fleet_benchmark_loads_base_with_recorded_robot(tmp_path: Path) -> None:
    """Load a base for a short time; here the machine may be busy.

    The same command measures the capacity of a base.
    """
    course = str(write_course(tmp_path, "there", 0.8))
    words = ("fleet", "--robots", "1", "--course", course, "--out", str(tmp_path / "out"))
    with Command(*words, cwd=tmp_path, module="benchmarks") as bench:
        assert bench.status() == 0
        bench.gone()
    (load,) = fleet.from_json((tmp_path / "out" / "fleet.json").read_text(encoding="utf-8"))
    (heard,) = load.heard
    assert heard.scans > 10
    assert heard.taken > 0, "scans are taken in"
    assert heard.plans > 0, "plans come back"
    assert heard.plan_p99 < 5000.0, "by the robot's own clock"
    assert load.memory_mb > 100.0
    assert set(load.cores) == {"mapper", "planner", "console", "recorder", "routers"}
    assert (tmp_path / "out" / "fleet.png").read_bytes().startswith(b"\x89PNG")
    assert "supports" in bench.text()
