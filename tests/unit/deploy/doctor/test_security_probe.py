"""The doctor's checks from outside the robot.

With certificates every unauthorized client is refused; an open router is reported.
"""

import contextlib
import json
import socket
import ssl
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from sextant.deploy import cli
from sextant.deploy.doctor import security_probe
from sextant.deploy.doctor.check import Check, Level
from sextant.deploy.security import authority
from sextant.deploy.security.hosting import hosted
from sextant.deploy.security.router_security import Gate
from sextant.shared.wire import topics
from sextant.shared.wire.access import AUTHORITY, CERTIFICATE, KEY
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Router
from tests.support.gated import NAMESPACE, Inside


def find_no_endpoints(_seconds: float) -> list[str]:
    return []


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys") / "keys"
    authority.new(folder)
    return folder


@pytest.fixture(scope="module")
def guarded(keys: Path) -> Iterator[str]:
    here = Gate((f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}"), NAMESPACE, keys / "robot")
    with hosted(here):
        yield here.listen[1]


def by_name(checks: list[Check]) -> dict[str, Check]:
    return {check.name.removeprefix("stranger "): check for check in checks}


def test_secured_router_refuses_every_probe(guarded: str, keys: Path) -> None:
    found = by_name(security_probe.examine(guarded, keys, find_no_endpoints, listen_s=0.5))
    assert list(found) == [
        "without TLS",
        "without a certificate",
        "with a certificate of a foreign authority",
        "with an expired certificate",
        "that scouts",
    ]
    assert {name: check.level for name, check in found.items()} == dict.fromkeys(found, Level.OK), found
    assert "asks for a certificate" in found["without a certificate"].found
    assert "does not trust the authority" in found["with a certificate of a foreign authority"].found
    assert "has expired" in found["with an expired certificate"].found


def refuse_late(listener: socket.socket, keys: Path, late_s: float) -> None:
    """Require a certificate, and refuse a client without one only after a delay."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(keys / "robot" / CERTIFICATE, keys / "robot" / KEY)
    context.load_verify_locations(keys / "robot" / AUTHORITY)
    context.verify_mode = ssl.CERT_REQUIRED
    heard, says = ssl.MemoryBIO(), ssl.MemoryBIO()
    end = context.wrap_bio(heard, says, server_side=True)
    client, _ = listener.accept()
    with client:
        heard.write(client.recv(1 << 14))
        with contextlib.suppress(ssl.SSLWantReadError):
            end.do_handshake()
        client.sendall(says.read())
        heard.write(client.recv(1 << 14))  # the client has sent everything by then
        threading.Event().wait(late_s)
        with contextlib.suppress(ssl.SSLError):
            end.do_handshake()
        client.sendall(says.read())


def test_late_refusal_is_not_reported_as_admission(keys: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        robot = threading.Thread(target=refuse_late, args=(listener, keys, 0.5))
        robot.start()
        found = security_probe._shown(f"tls/127.0.0.1:{listener.getsockname()[1]}", "late", None)
        robot.join()
    assert found.level is Level.OK
    assert "asks for a certificate" in found.found


def test_skipped_probe_is_reported(guarded: str) -> None:
    found = by_name(security_probe.examine(guarded, None, find_no_endpoints, listen_s=0.5))
    assert found["with an expired certificate"].level is Level.WARN
    assert "not tried" in found["with an expired certificate"].found


def test_open_router_is_detected_by_received_messages() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Router((endpoint,)):
        inside = Inside(endpoint)
        try:
            inside.link.wanted(topics.ACTUATOR_STATE)  # this declares the publisher
            (plain, scouts) = security_probe.examine(endpoint, None, lambda _: [endpoint, "tcp/10.0.0.9:7447"], listen_s=0.5)
        finally:
            inside.close()
    assert plain.level is Level.FAIL
    assert "accepted, and may publish on any key" in plain.found
    assert "start the robot with --keys DIR" in plain.advice
    assert scouts.level is Level.FAIL, "it is the robot that answers"


def test_accepted_certificate_is_reported_as_failure(guarded: str, keys: Path) -> None:
    assert security_probe._shown(guarded, "console", keys / "console").level is Level.FAIL
    assert security_probe._scouting(guarded, lambda _: ["tcp/10.0.0.9:7447"]).level is Level.WARN


def test_doctor_command_reports_probe_results(
    guarded: str, keys: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        security_probe, "_scouting", lambda _endpoint, _find: Check("stranger that scouts", Level.OK, "no answer")
    )
    assert cli.main(["doctor", "--stranger", guarded, "--keys", str(keys), "--json"]) == 0
    assert {check["level"] for check in json.loads(capsys.readouterr().out)} == {"OK"}
    nowhere = f"tls/127.0.0.1:{free_port()}"
    assert cli.main(["doctor", "--stranger", nowhere]) == 1
    assert "cannot be reached" in capsys.readouterr().out
    assert cli.main(["doctor", "--stranger", "hexapod"]) == 2
    assert "PROTOCOL/HOST:PORT expected" in capsys.readouterr().err
