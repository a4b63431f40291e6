"""Zenoh's log of refusals becomes text and counters.

They appear on the terminal, in health messages, and thus on the console.
"""

import io
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from sextant.deploy.launch.launcher import free_port, port_taken
from sextant.deploy.security.access_log import RouterHealthReporter
from sextant.deploy.security.refusals import Refusals, RefusedConnections
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Health
from sextant.shared.wire.transport import Endpoints, ZenohLink
from tests.support import gated
from tests.support.gated import NAMESPACE, PATIENCE_S, session, stranger, tls_of

VIEWER, OWN = "5e8de63f1c", "a1b2c3d4e5"
ON = "Interface(lo)+CertCommonName(viewer)+Transport(Tls)"


def log_line(words: str, thread: str = "rx-0 ThreadId(08)", level: str = "TRACE", target: str = "access_control") -> str:
    target = f"net::routing::interceptor::{target}" if target else "net::routing::interceptor"
    return f"\x1b[2m2026-11-23T04:24:58.183770Z\x1b[0m {level}  {thread} zenoh::{target}: {words}\n"


KEPT = log_line("Msg intercepted!", target="")


@pytest.mark.parametrize(
    ("log", "kind"),
    [
        (
            log_line(f"{VIEWER} on {ON}+{VIEWER} is unauthorized to Put (ingress) on here/operator/mode") + KEPT,
            "viewer may not publish operator/mode",
        ),
        (
            log_line(f"{VIEWER} on {ON}+{VIEWER} is unauthorized to Query (ingress) on here/camera/depth")
            + log_line(f"Using cached result: {VIEWER} is unauthorized to Declare Subscriber (ingress) on here/camera/depth")
            + KEPT,
            "viewer may not subscribe to camera/depth",
        ),
    ],
)
def test_refusals_are_counted_by_kind(log: str, kind: str) -> None:
    refusals = Refusals("here")
    assert list(refusals.read(log)) == []
    assert list(refusals.read(log)) == []
    assert refusals.count == {kind: 2}
    assert refusals.newest == kind
    assert refusals.words() == f"{kind}: 2 times"


def test_message_flood_is_counted_and_burst_after_stall_is_not() -> None:
    too_soon = (
        log_line(f"{VIEWER} on {ON}+{VIEWER} is authorized to Put (ingress) on here/operator/stop")
        + log_line(
            "Message dropped by the downsampling interceptor: Push(here/operator/stop) from:south:0:client/5e8de63f:3",
            target="downsampling",
        )
        + KEPT
    )
    refusals = Refusals("here")
    for second in range(10, 20):
        assert list(refusals.read(60 * too_soon.replace("04:24:58", f"04:24:{second}"))) == []
    assert refusals.count.total() == 0
    assert list(refusals.read(1000 * too_soon)) == []
    assert refusals.count == {"operator/stop comes too often from viewer": 1000}


@pytest.mark.parametrize(
    "log",
    [
        # Zenoh looks up the rules for all kinds of messages before it authorizes one.
        log_line(f"{VIEWER} on {ON}+{VIEWER} is unauthorized to Put (ingress) on here/actuator/state")
        + log_line(f"Using cached result: {VIEWER} is authorized to Declare Subscriber (ingress) on here/actuator/state"),
        # Kept from a client that could not want it.
        log_line(f"{VIEWER} on {ON}+{VIEWER} is unauthorized to Declare Subscriber (egress) on here/operator/mode") + KEPT,
        # Two threads at once: each line belongs to its own thread.
        log_line(f"{VIEWER} on {ON}+{VIEWER} is unauthorized to Put (ingress) on here/actuator/state")
        + log_line("Msg intercepted!", thread="rx-1 ThreadId(09)", target=""),
        # Presence of another machine's processes.
        log_line(f"{VIEWER} on {ON}+{VIEWER} is unauthorized to Put (ingress) on here/machine/presence/viewer") + KEPT,
    ],
)
def test_other_log_lines_are_not_counted(log: str) -> None:
    refusals = Refusals("here")
    assert list(refusals.read(log)) == []
    assert refusals.count.total() == 0


def test_publishing_under_another_role_is_a_refusal() -> None:
    refusals = Refusals("here")
    line = log_line(f"{VIEWER} on {ON}+{VIEWER} is unauthorized to Put (ingress) on here/health/robot") + KEPT
    assert list(refusals.read(line)) == []
    assert refusals.count.total() == 1


def test_unrelated_log_lines_are_passed_on() -> None:
    refusals = Refusals("here")
    assert list(refusals.read("thread 'rx-0' panicked at\nsomewhere\n")) == ["thread 'rx-0' panicked at", "somewhere"]


def test_refusals_of_many_keys_are_summarized() -> None:
    refusals = Refusals("here")
    for number in range(1000):
        line = log_line(f"{VIEWER} on {ON}+{VIEWER} is unauthorized to Put (ingress) on here/key/{number}") + KEPT
        assert list(refusals.read(line)) == []
    assert len(refusals.count) == 65
    assert refusals.count.total() == 1000
    assert refusals.newest == "other kinds"


@given(st.text())
def test_arbitrary_log_text_raises_no_error(text: str) -> None:
    list(Refusals("here").read(text + log_line(text) + KEPT))


def test_health_is_published_each_second_and_soon_after_refusal() -> None:
    log, said, out = [""], list[Health](), io.StringIO()
    connections = RefusedConnections()
    keeper = RouterHealthReporter(lambda: log.pop(), said.append, "router", "here", "listening", out, connections.take)
    assert keeper.look(0) == ""
    log.append("")
    connections.add("a client without a certificate")
    assert keeper.look(250_000_000) == "refused: a client without a certificate"
    assert [(word.refused, word.last_refusal) for word in said] == [(0, ""), (1, "refused: a client without a certificate")]
    assert said[-1].doing == "listening; refused: a client without a certificate: 1 times"
    log.append("")
    connections.add("a client without a certificate")
    assert keeper.look(300_000_000) == "", "each kind is reported once on the terminal"
    log.append("")
    keeper.look(600_000_000)
    assert len(said) == 2
    log.append("something else\n")
    keeper.look(1_300_000_000)
    assert said[-1].refused == 2
    assert out.getvalue() == "something else\n"


CATCH = """
import os, sys
sys.path.insert(0, {root!r})
from sextant.deploy.security.access_log import CaughtOutput
with CaughtOutput() as caught:
    found = []
    for k in range(40):
        os.write(1, b"line %d\\n" % k + b"x" * 100_000 + b"\\n")
        found += [line for line in caught.take().splitlines() if line.startswith("line")]
    os.write(1, b"half a")
    assert caught.take() == ""
    os.write(1, b" line\\n")
    assert caught.take() == "half a line\\n"
    size = os.fstat(caught._file).st_size
print(len(found), size < 3_000_000)
"""


def test_captured_log_is_consumed_with_bounded_size() -> None:
    root = str(Path(__file__).parents[4])
    done = subprocess.run(
        [sys.executable, "-c", CATCH.format(root=root)], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "40 True\n"


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return gated.make_keys(tmp_path_factory.mktemp("keys"))


@pytest.fixture
def router(keys: Path) -> Iterator[tuple[str, str]]:
    """Run a router in a separate process; yield its endpoints."""
    plain, secure = (f"{kind}/127.0.0.1:{free_port()}" for kind in ("tcp", "tls"))
    words = ["--listen", plain, "--listen", secure, "--keys", str(keys / "robot"), "--namespace", NAMESPACE]
    process = subprocess.Popen(
        [sys.executable, "-m", "sextant.deploy.launch.router", *words, "--parent", str(os.getpid())],
        cwd=Path(__file__).parents[4],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    with process.stderr:
        assert "listening on" in process.stderr.readline()
        assert port_taken(int(plain.rpartition(":")[2]))
        yield plain, secure
        process.terminate()
        assert process.wait(PATIENCE_S) == 0
        said = process.stderr.read()
    assert "router: refused: " in said
    assert "viewer may not publish operator/mode" in said


def test_router_health_reports_refused_clients(router: tuple[str, str], keys: Path) -> None:
    plain, secure = router
    told, words = threading.Event(), list[Health]()

    def hear(_topic: object, frame: bytes) -> None:
        words.append(codec.decode(frame, Health)[0])
        if "a certificate of a foreign authority" in words[-1].doing and "viewer may not publish" in words[-1].doing:
            told.set()

    with ZenohLink(Endpoints((plain,), namespace=NAMESPACE)) as link:
        link.subscribe(topics.HEALTH, hear)
        with session(secure, tls_of(keys / "viewer")) as viewer:
            viewer.put(f"{NAMESPACE}/operator/mode", b"walk")
            with pytest.raises(zenoh.ZError):
                stranger(secure, tls_of(keys / "foreign", trusted=keys / "robot"))
            assert told.wait(PATIENCE_S), [word.doing for word in words[-3:]]
    assert "viewer may not publish operator/mode: 1 times" in words[-1].doing
    assert words[-1].service == "router of robot"
