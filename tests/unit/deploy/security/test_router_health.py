"""Refusals have their reasons: in the router's health and on its terminal, and for orders that its role may not send."""

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from sextant.deploy import cli
from sextant.deploy.security.router_health import RefusedConnections, RouterHealthReporter
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Health
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Endpoints, ZenohLink
from tests.support import gated
from tests.support.gated import NAMESPACE, PATIENCE_S, stranger, tls_of


def test_health_is_published_each_second_and_soon_after_refusal() -> None:
    said, refused = list[Health](), RefusedConnections()
    reporter = RouterHealthReporter(refused, said.append, "router", "listening")
    assert reporter.beat(0) == ""
    refused.add("a client without a certificate")
    assert reporter.beat(250_000_000) == "refused: a client without a certificate"
    assert [(word.refused, word.last_refusal) for word in said] == [(0, ""), (1, "refused: a client without a certificate")]
    assert said[-1].status == "listening; refused: a client without a certificate: 1 times"
    refused.add("a client without a certificate")
    assert reporter.beat(300_000_000) == "", "each kind is reported once on the terminal"
    reporter.beat(600_000_000)
    assert len(said) == 2
    reporter.beat(1_300_000_000)
    assert said[-1].refused == 2


def test_kinds_of_refusals_are_bounded() -> None:
    said, refused = list[Health](), RefusedConnections()
    for number in range(1000):
        refused.add(f"fault {number}")
    RouterHealthReporter(refused, said.append, "router", "listening").beat(0)
    count, newest = refused.read()
    assert (len(count), count.total(), newest) == (65, 1000, "other kinds")
    assert (said[0].refused, len(said[0].status)) == (1000, 500)
    assert said[0].status.startswith("listening; refused: other kinds: 936 times, fault 0: 1 times")


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return gated.make_keys(tmp_path_factory.mktemp("keys"))


@contextlib.contextmanager
def running_router(folder: Path, *words: str) -> Iterator[tuple[str, Callable[[], str]]]:
    """Run a router in a separate process; yield its endpoint for local processes, and a function that ends it.

    The function returns what the router has printed.
    """
    plain = f"tcp/127.0.0.1:{free_port()}"
    words = ("--listen", plain, "--keys", str(folder), *words, "--parent", str(os.getpid()))
    process = subprocess.Popen(
        [sys.executable, "-m", "sextant.deploy.launch.router", *words],
        cwd=Path(__file__).parents[4],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None

    def end() -> str:
        process.terminate()
        assert process.wait(PATIENCE_S) == 0
        assert process.stderr is not None
        return process.stderr.read()

    with process.stderr:
        try:
            assert "listening on" in process.stderr.readline()
            yield plain, end
        finally:
            process.kill()
            process.wait()


def test_router_reports_refused_connections(keys: Path) -> None:
    secure = f"tls/127.0.0.1:{free_port()}"
    told, words = threading.Event(), list[Health]()

    def hear(_topic: object, frame: bytes) -> None:
        words.append(codec.decode(frame, Health)[0])
        if "a certificate of a foreign authority" in words[-1].status:
            told.set()

    with running_router(keys / "robot", "--listen", secure, "--namespace", NAMESPACE) as (plain, end):
        with ZenohLink(Endpoints((plain,), namespace=NAMESPACE)) as link:
            link.subscribe(topics.HEALTH, hear)
            with pytest.raises(zenoh.ZError):
                stranger(secure, tls_of(keys / "foreign", trusted=keys / "robot"))
            assert told.wait(PATIENCE_S), [word.status for word in words[-3:]]
        printed = end()
    assert words[-1].last_refusal == "refused: a certificate of a foreign authority"
    assert words[-1].service == "router of robot"
    assert "router: refused: a certificate of a foreign authority" in printed


@pytest.mark.slow
def test_order_through_router_that_may_only_stop_is_refused_with_reason(keys: Path, capsys: pytest.CaptureFixture[str]) -> None:
    secure = f"tls/127.0.0.1:{free_port()}"
    with (
        running_router(keys / "robot", "--listen", secure),
        running_router(keys / "viewer", "--connect", secure) as (plain, _),
    ):
        assert cli.main(["order", "stand", "--connect", plain]) == 1
    printed = capsys.readouterr()
    assert "this certificate (viewer: a viewer's computer" in printed.err + printed.out
    assert (
        "may not send operator/mode, only operator/stop; use the keys of another role: base, console"
        in printed.err + printed.out
    )
