"""Two machines joined by a radio: the commands of docs/two_machines.md, and cuts."""

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import pytest

from benchmarks.net_testbed.link_outages import BACK_S, HOLD_S, OLDEST_S
from benchmarks.net_testbed.namespace import NetTestbedError
from benchmarks.net_testbed.testbed import PORT, TLS_PORT, Namespaces, NetTestbed, OneMachine
from benchmarks.net_testbed.two_machines import TwoMachines
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.scenario import Link
from tests.support.commands import PATIENCE_S, ROOT, Command, skip_where_taken, write_course
from tests.test_readme import commands

pytestmark = pytest.mark.live
PAGE = (ROOT / "docs" / "two_machines.md").read_text(encoding="utf-8")
LINK = Link(20.0, 20.0, 0.0)
CUT_S = 5.0  # longer than Zenoh waits for the other end


@pytest.fixture
def two_machines() -> Iterator[NetTestbed]:
    """Yield two network namespaces, or a relay where this user may make none."""
    with contextlib.ExitStack() as stack:
        try:
            made: NetTestbed = stack.enter_context(Namespaces(LINK))
        except NetTestbedError:
            skip_where_taken(PORT)
            made = stack.enter_context(OneMachine(LINK))
        yield made


@pytest.fixture
def bed() -> Iterator[NetTestbed]:
    with contextlib.ExitStack() as stack:
        try:
            made = stack.enter_context(Namespaces(LINK))
        except NetTestbedError as error:
            pytest.skip(str(error))
        yield made


def test_documented_commands_walk_on_two_machines(two_machines: NetTestbed, tmp_path: Path) -> None:
    walk_by_documented_commands(two_machines, tmp_path)


@pytest.mark.rare
def test_documented_commands_walk_through_relay(tmp_path: Path) -> None:
    skip_where_taken(PORT)
    with OneMachine(LINK) as bed:
        walk_by_documented_commands(bed, tmp_path)


def documented_command(words: list[str], bed: NetTestbed, folder: Path) -> tuple[str, ...]:
    """Return a command of the page without its first word.

    The testbed's values replace the reader's own ones.
    """
    own = {
        "keys": str(folder / "keys"),
        "keys/robot": str(folder / "keys" / "robot"),
        "keys/base": str(folder / "keys" / "base"),
        "robot.local": bed.robot_address,
        f"tls/robot.local:{TLS_PORT}": f"tls/{bed.seen(TLS_PORT)}",
    }
    assert words[0] == "sextant"
    command, *rest = words[1:]
    return (command, *(own.get(word, word) for word in rest))


def walk_by_documented_commands(bed: NetTestbed, tmp_path: Path) -> None:
    make_keys, *up = (documented_command(words, bed, tmp_path) for words in islice(commands(PAGE), 3))
    with Command(*make_keys, cwd=tmp_path) as new:
        assert new.status() == 0
    course = str(write_course(tmp_path, "beyond", 0.3))
    with TwoMachines(bed, tmp_path / "keys", course, 1000) as halves:
        assert list(halves.commands) == up
        halves.meet(PATIENCE_S)
        client = bed.on_base(sys.executable, "-I", str(ROOT / "docs" / "walk_client.py"), bed.base_router)

        def walked() -> bool:  # a servo of a busy machine may answer late: the robot then refuses to stand
            subprocess.run(client, capture_output=True, check=False, timeout=PATIENCE_S)
            return len({heard.step for heard in halves.heard if heard.walks}) > 2

        halves.until(walked, PATIENCE_S, "a walk commanded by the base")
        assert bed.carried().from_robot > 0


@pytest.mark.rare
def test_camera_is_calibrated_from_the_base_only(two_machines: NetTestbed, tmp_path: Path) -> None:
    bed, own = two_machines, tmp_path / "my_robot.toml"
    make_keys = documented_command(next(commands(PAGE)), bed, tmp_path)
    with Command(*make_keys, cwd=tmp_path) as new:
        assert new.status() == 0
    words = (sys.executable, "-m", "sextant.deploy.cli", "camera", "calibrate", "--out", str(own), "--connect")
    with TwoMachines(bed, tmp_path / "keys", "flat+usual", 1000) as halves:
        halves.meet(PATIENCE_S)
        on_robot = subprocess.run(bed.on_robot(*words, bed.robot_router), capture_output=True, text=True, check=False)
        assert "no message of the planner arrives here" in on_robot.stderr
        assert not any(heard.walks for heard in halves.heard)

        def calibrated() -> bool:  # a servo of a busy machine may answer late, which ends a calibration
            return subprocess.run(bed.on_base(*words, bed.base_router), capture_output=True, check=False).returncode == 0

        halves.until(calibrated, 3.0 * PATIENCE_S, "a calibration from the base")
    assert len(load_profile(str(own)).calibration) >= 4


@pytest.mark.rare
@pytest.mark.usefixtures("bed")
def test_robot_holds_during_radio_outage_and_resumes(tmp_path: Path) -> None:
    """Hold during cuts, and walk on; here the machine may be busy.

    The same command with more cuts measures the times.
    """
    words = ("link", "--cuts", "2", "--longest", "0.9", "--seed", "1000", "--out", str(tmp_path / "out"))
    with Command(*words, cwd=tmp_path, module="benchmarks") as bench:
        assert bench.status() == 0
        bench.gone()
        assert "2 cuts of" in bench.text()
    found = json.loads((tmp_path / "out" / "cuts.json").read_text(encoding="utf-8"))
    assert "network namespaces" in found["bed"]
    assert len(found["cuts"]) == 2
    for cut in found["cuts"]:
        assert cut["held_s"] is not None or cut["lasted_s"] <= HOLD_S
        assert cut["back_s"] is not None
        assert cut["oldest_s"] <= OLDEST_S, "no plan is taken that is stale"


_SPEAKS = """
import sys, threading
from sextant.deploy.security.tcp_timeout import TcpTimeout
from sextant.shared.wire import topics
from sextant.shared.wire.transport import LEASE_MS, Endpoints, Router, ZenohLink
silence = TcpTimeout(1e-3 * LEASE_MS)
here = "tcp/127.0.0.1:7447"
over = threading.Event()
threading.Thread(target=lambda: (sys.stdin.read(), over.set()), daemon=True).start()
with Router((here,), (sys.argv[1],)), ZenohLink(Endpoints((here,))) as link:
    while not over.wait(0.02):
        silence.look()
        link.send(topics.STEP_PLAN, b"a word")
"""
_HEARS = """
import sys, time
from sextant.deploy.security.tcp_timeout import TcpTimeout
from sextant.shared.wire import topics
from sextant.shared.wire.transport import LEASE_MS, Endpoints, Router, ZenohLink
with Router(("tcp/0.0.0.0:7447",)), ZenohLink(Endpoints(("tcp/127.0.0.1:7447",))) as link:
    TcpTimeout(1e-3 * LEASE_MS).look()
    link.subscribe(topics.STEP_PLAN, lambda topic, frame: print(time.monotonic_ns(), flush=True))
    sys.stdin.read()
"""


def test_routers_reconnect_soon_after_outage(bed: NetTestbed) -> None:
    """Connect again soon after a cut that killed the connection.

    Its sockets were closed with unsent data and must not delay the new ones. Without a limit they do so for 3 s.
    """
    piped = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    hears = subprocess.Popen(bed.on_robot(sys.executable, "-c", _HEARS), **piped)  # type: ignore[call-overload]
    words = bed.on_base(sys.executable, "-c", _SPEAKS, f"tcp/{bed.seen(PORT)}")
    with hears, subprocess.Popen(words, **piped) as speaks:  # type: ignore[call-overload]
        assert hears.stdout.readline(), "the first word"
        bed.cut()
        time.sleep(CUT_S)
        mended = bed.mend()
        back = next(at_ns for line in hears.stdout if (at_ns := int(line)) > mended.at_ns)
        for process in (speaks, hears):
            process.stdin.close()
        hears.stdout.read()
    assert (back - mended.at_ns) * 1e-9 < BACK_S
