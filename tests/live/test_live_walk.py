"""Walks of real processes over Zenoh, as users start them, and their failures."""

import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
import urllib.request
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import sextant
from sextant import deploy
from sextant.deploy.launch.compose import KEYS, NOTIFY_SOCKET, RECORDINGS, WARM_UP
from sextant.deploy.launch.launcher import Launcher
from sextant.deploy.launch.process_table import BUS_PORT
from sextant.deploy.launch.process_table import Command as LaunchedCommand
from sextant.evaluation.report import check
from sextant.shared.recording.reader import Recording
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Health, Mode
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Endpoints
from tests.support.commands import PATIENCE_S, ROOT, Command, Ear, environment, eventually, skip_where_taken, write_course
from tests.support.composed import commands_of

pytestmark = pytest.mark.live

ORDERS = 3  # at most
KILLED = ("perception",)  # takes most to go on; walks in lockstep kill each service
ENDS_WITHIN_S = 6.0  # [s] after Ctrl-C; a quiet machine takes less than two
ROUTER_PORT = 7447
PAGE_PORT = 8080


def report_in(out: Path) -> dict[str, object]:
    table = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert not check(table)
    assert isinstance(table, dict)
    return table


def killed_and_restarted(command: Command, service: str) -> Callable[[], bool]:
    """Return a condition: the command reported a kill and restarted the service."""
    return lambda: f"{service} ended (killed by SIGKILL)" in command.text() and command.service(service) is not None


def test_killed_services_are_reported_and_restarted(tmp_path: Path) -> None:
    """Kill services: the walk goes on after each kill, or ends with a reason."""
    course, out = write_course(tmp_path, "long", 0.8), tmp_path / "out"
    killed: list[str] = []
    with Command("run", str(course), "--seed", "1001", "--out", str(out), cwd=tmp_path) as command:
        with Ear.at(command.endpoints()) as ear:
            command.wait_for(lambda: ear.walked(2), "the walk")
            for service in KILLED:
                victim = command.service(service)
                assert victim is not None
                os.kill(victim.pid, signal.SIGKILL)
                killed.append(service)
                command.wait_for(killed_and_restarted(command, service), f"the end of {service}")
                ear.forget()
                eventually(lambda: ear.walked(2) or not command.running(), f"the walk going on after {service}")
                if not command.running():
                    break
        status = command.status()
        command.gone()
        lines = [line for line in command.said if "ended (killed by SIGKILL)" in line]
    assert [line.split()[0] for line in lines] == killed
    assert all("started again" in line for line in lines)
    assert all("last output: " in line or "without output" in line for line in lines)
    report = report_in(out)
    assert report["falls"] == 0
    assert (status == 0) == report["success"]
    assert report["success"] or "no pose from perception" in str(report["reason"]), report["reason"]
    if report["success"]:
        assert killed == list(KILLED)


def test_parallel_runs_are_isolated_and_leave_no_orphans(tmp_path: Path) -> None:
    """End one run with Ctrl-C; the other walks on to its goal."""
    courses = {"left": 8.0, "right": 0.5}
    outs = {name: tmp_path / name for name in courses}
    words = {
        name: ("run", str(write_course(tmp_path, name, distance)), "--seed", "1002", "--out", str(outs[name]))
        for name, distance in courses.items()
    }
    with Command(*words["left"], cwd=tmp_path) as left, Command(*words["right"], cwd=tmp_path) as right:
        with Ear.at(left.endpoints()) as ear, Ear.at(right.endpoints()) as other:
            left.wait_for(lambda: ear.walked(1), "the left walk")
            right.wait_for(lambda: other.mode is not None, "the right robot")
            began = time.monotonic()
            left.interrupt()
            assert left.status() == 130
            left.gone()
            took = time.monotonic() - began
            assert took <= ENDS_WITHIN_S, f"everything has ended {took:.2f} s after Ctrl-C"
        assert right.status() == 0, right.text()
        right.gone()
        assert "success: goal reached" in right.text()
    stopped, arrived = (report_in(outs[name]) for name in courses)
    assert stopped["success"] is False
    assert "stopped by the operator" in str(stopped["reason"])
    assert arrived["success"] is True
    assert (arrived["scenario"], arrived["seed"], arrived["falls"], arrived["shutdowns"]) == ("right", 1002, 0, 0)
    assert {path.name for path in outs["right"].iterdir()} >= {"report.json", "summary.png", "walk.png", "recording.mcap"}
    assert (outs["right"] / "summary.png").read_bytes().startswith(b"\x89PNG")
    for name, out in outs.items():
        recording = Recording(out / "recording.mcap")
        counts = recording.counts()
        assert recording.complete
        assert all(counts[topic.key] for topic in (topics.ACTUATOR_STATE, topics.BODY_POSE, topics.STEP_PLAN, topics.TERRAIN))
        health = [m for _, m, _ in recording.messages((topics.HEALTH,)) if isinstance(m, Health)]
        said = {m.status for m in health if m.service == "simulator"}
        assert said
        assert all(f"simulating {name}," in words for words in said), "it heard its own simulator alone"


def page_is_served(url: str) -> bool:
    """Return whether the page is available."""
    try:
        with urllib.request.urlopen(url, timeout=5.0) as answer:
            return b"Sextant" in answer.read()
    except OSError:
        return False


def walk_by_the_client_of_the_docs(endpoint: str) -> None:
    """Walk the robot with the client of docs/keys.md, which is independent of Sextant.

    On a busy machine it may have to run again: the robot refuses to stand if a servo answers late.
    """
    client = [sys.executable, "-I", str(ROOT / "docs" / "walk_client.py"), endpoint]
    with Ear.at(Endpoints((endpoint,))) as ear:
        until, told = time.monotonic() + PATIENCE_S, [""]
        while len(ear.steps) <= 2 and time.monotonic() < until:
            eventually(lambda: ear.lease == "", "the end of the last order's lease")
            ear.forget()
            ran = subprocess.run(client, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
            told = [*ran.stdout.splitlines(), *ran.stderr.splitlines()]
    for words in ("stand: standing up", "hold: standing", "walk: walking"):
        assert any(line.startswith(words) for line in told), told
    assert told[-1].startswith("ready: ")
    assert len(ear.steps) > 2
    assert ear.places[-1][0] - ear.places[0][0] > 0.1, "it has gone forward"


def walk_by_the_public_client(endpoint: str) -> None:
    """Make the robot stand up, walk and stop by a program, which also receives the reason of a refusal."""

    def place() -> NDArray[np.float64]:
        pose = robot.status.pose
        return np.full(2, np.nan) if pose is None else np.array(pose.T_world_body[:2, 3])

    with sextant.Client(endpoint, name="program", take=True) as robot:
        with pytest.raises(sextant.ClientError, match="order `stand` first"):
            robot.walk(0.05)
        robot.wait_until_ready()
        robot.stand()
        taken = pytest.raises(sextant.ClientError, match="another client named 'program' leads")
        with sextant.Client(endpoint, name="program") as other, taken:
            other.stand()
        begin = place()
        robot.walk(0.08)
        eventually(lambda: np.linalg.norm(place() - begin) > 0.1, "a walk")
        robot.stop()
        assert robot.state.mode is Mode.HOLD


def walk_by_the_program_of_the_readme(endpoint: str) -> None:
    shown = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert shown is not None
    program = textwrap.dedent(shown[1]).replace("tcp/127.0.0.1:7447", endpoint)
    with Ear.at(Endpoints((endpoint,))) as ear:
        eventually(lambda: ear.lease == "", "the end of the last order's lease")
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.startswith("ready ")


def send_order(order: str, status: int, folder: Path, *meet: str) -> str:
    """Return the output of `sextant order` with the expected exit status.

    The order is repeated if a servo of a busy machine answered late.
    """
    told: list[str] = []
    for _ in range(ORDERS):
        with Command("order", order, "--take", "--holder", order, *meet, cwd=folder) as given:
            ended = given.status()
        told.append(given.text())
        if ended == status or status != 0:  # an order that must be refused is sent once
            break
    assert ended == status, "\n".join(told)
    return told[-1]


_GOAL = """
name = "shared"
time_limit_s = 120.0
[goal]
distance = 0.3
route = true
[[terrain]]
kind = "plane"
"""


def test_attached_run_walks_with_running_services(tmp_path: Path) -> None:
    skip_where_taken(BUS_PORT)
    course, out = str(tmp_path / "shared.toml"), tmp_path / "out"
    Path(course).write_text(_GOAL, encoding="utf-8")
    meet = ("--namespace", "sextant")
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Command("up", "all", "--scenario", course, "--listen", endpoint, *meet, cwd=tmp_path) as up:
        up.wait_for(lambda: up.service("actuator"), "the services")
        up.wait_for(lambda: re.search(r"ready after \d+ s: the simulated robot takes commands", up.text()), "ready services")
        up.wait_for(lambda: re.search(r"the operator's page: (\S+)", up.text()), "where the page is")
        address = re.search(r"the operator's page: (\S+)", up.text())
        up.wait_for(lambda: address is not None and page_is_served(address[1]), "the page")
        with Command("run", course, "--connect", endpoint, *meet, "--out", str(out), cwd=tmp_path) as run:
            assert run.status() == 0
            assert len(run.family()) == 0
        assert up.running(), "who joined leaves the services alone"

        def order(what: str, status: int = 0) -> str:
            return send_order(what, status, tmp_path, "--connect", endpoint, *meet)

        assert "ready: sitting" in order("sit")
        assert "the mode is ready, order `stand` first" in order("walk", 1)
        walk_by_the_program_of_the_readme(endpoint)
        walk_by_the_public_client(endpoint)
        assert "off: ordered off" in order("off")
        up.interrupt()
        assert up.status() == 130
        up.gone()
    report = report_in(out)
    assert (report["success"], report["falls"], report["collisions"]) == (True, 0, 0)
    counts = Recording(out / "recording.mcap").counts()
    assert counts[topics.GOAL.key]
    assert not counts.get(topics.VELOCITY.key), "nobody steers it"


def test_onboard_and_offboard_start_in_either_order(tmp_path: Path) -> None:
    """Start the off-board half first: it has its own router and waits for the robot."""
    course, out = str(write_course(tmp_path, "split", 0.3)), tmp_path / "out"
    robot, base = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
    meet = ("--namespace", "split")
    with Command("up", "offboard", "--listen", base, "--connect", robot, *meet, cwd=tmp_path) as offboard:
        offboard.wait_for(lambda: "waiting for the robot" in offboard.text(), "a base that waits")
        with Command("up", "onboard", "--scenario", course, "--listen", robot, *meet, cwd=tmp_path) as onboard:
            for one, other in ((offboard, "onboard"), (onboard, "offboard")):
                one.wait_for(
                    lambda one=one, other=other: f"({other}) has connected, running " in one.text(), f"the {other} half"
                )
            with Command("run", course, "--connect", base, *meet, "--out", str(out), cwd=tmp_path) as run:
                assert run.status() == 0, run.text()
            with Command("up", "offboard", "--connect", robot, "--with", "perception", *meet, cwd=tmp_path) as second:
                assert second.status() == 1
                assert re.search(r"already runs perception|already runs mapper, planner", second.text())
            assert offboard.running()
            assert onboard.running()
        offboard.process.kill()
        offboard.gone()
    assert report_in(out)["success"] is True


def composed(file: str, mounts: dict[str, str], **variables: str) -> tuple[LaunchedCommand, ...]:
    """Return the commands of a compose file, without its warm-up.

    The functions are compiled already on this machine.
    """
    found = commands_of((Path(deploy.__file__).resolve().parent / file).read_text(encoding="utf-8"), variables, mounts)
    return tuple(replace(c, after=tuple(n for n in c.after if n != WARM_UP)) for c in found if c.name != WARM_UP)


def test_compose_services_walk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Walk a shorter course than that of the file; all else is unchanged."""
    skip_where_taken(ROUTER_PORT, BUS_PORT)
    written = composed("compose.yaml", {NOTIFY_SOCKET: str(tmp_path / "NAME.notify")})
    other = {"steps": str(write_course(tmp_path, "low", 0.3))}
    other["scenario=steps"] = f"scenario={other['steps']}"
    commands = [replace(c, arguments=tuple(other.get(word, word) for word in c.arguments)) for c in written]
    assert [c.name for c, was in zip(commands, written, strict=True) if c != was] == ["simulator", "operator"]
    monkeypatch.chdir(tmp_path)
    for name, value in environment().items():
        monkeypatch.setenv(name, value)
    said: list[str] = []
    ended: dict[str, str] = {}
    with Launcher(commands, hear=lambda name, line: said.append(f"{name}: {line}")) as launcher:

        def over() -> bool:
            ended.update({e.name: e.how for e in launcher.wait(0.2) if not e.restarted})
            return bool(ended)

        eventually(over, "the operator's end")
        assert ended == {"operator": "exit status 0"}, "\n".join(said[-30:])
    report = report_in(tmp_path / "runs" / "compose")
    assert report["success"] is True
    assert report["scenario"] == "low"


def test_offboard_compose_services_walk_secured_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    skip_where_taken(ROUTER_PORT, PAGE_PORT)
    keys, course = tmp_path / "keys", str(write_course(tmp_path, "beside", 0.3))
    with Command("keys", "new", str(keys), "--robot-address", "127.0.0.1", cwd=tmp_path) as new:
        assert new.status() == 0
    near, robot = (f"{kind}/127.0.0.1:{free_port()}" for kind in ("tcp", "tls"))
    seen = {KEYS: str(keys / "base"), RECORDINGS: str(tmp_path / "recordings"), NOTIFY_SOCKET: str(tmp_path / "NAME.notify")}
    commands = composed("compose.offboard.yaml", seen, SEXTANT_ROBOT=robot, SEXTANT_KEYS=str(keys / "base"))
    monkeypatch.chdir(tmp_path)
    for name, value in environment().items():
        monkeypatch.setenv(name, value)
    said: list[str] = []
    words = ("--scenario", course, "--listen", near, "--listen", robot, "--keys", str(keys / "robot"))
    with Launcher(commands, hear=lambda name, line: said.append(f"{name}: {line}")) as launcher:
        eventually(lambda: launcher.poll() or len(launcher.names()) == len(commands), "the start of all")
        with Command("up", "onboard", *words, cwd=tmp_path) as onboard:
            onboard.wait_for(lambda: onboard.service("perception"), "the robot")
            base = f"tcp/127.0.0.1:{ROUTER_PORT}"
            with Ear.at(Endpoints((base,))) as ear:
                eventually(lambda: ear.mode is not None, "the robot's state at the base", alive=onboard.running)
            walk_by_the_client_of_the_docs(base)
            assert launcher.poll() == [], "\n".join(said[-30:])
            for command in commands:
                check = [
                    sys.executable,
                    "-m",
                    "sextant.deploy.launch.healthcheck",
                    *(("--port", str(ROUTER_PORT)) if command.ready_port else ()),
                ]
                around = {**os.environ, **command.environment}
                done = subprocess.run(check, env=around, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
                assert done.returncode == 0, f"{command.name}: {done.stderr}"
