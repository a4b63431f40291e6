"""Messages of commands that cannot reach the robot: one sentence, without Zenoh's."""

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from sextant.deploy import cli
from sextant.shared.wire import endpoint, transport
from sextant.shared.wire.ports import free_port

COMMANDS = (
    ["order", "stand"],
    ["order", "off"],
    ["topics", "hz", "--seconds", "1"],
    ["topics", "echo", "actuator/state"],
    ["record", "--seconds", "1", "--out", "OUT"],
)


@pytest.fixture(autouse=True)
def short_connect_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "_CONNECT_MS", 100)


@pytest.fixture
def occupied_port() -> Iterator[int]:
    """Yield a port on which another program listens that is no router."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        yield other.getsockname()[1]


def run_and_read_stderr(words: list[str], where: str, out: Path, capsys: pytest.CaptureFixture[str], status: int) -> str:
    words = [str(out / "recording") if word == "OUT" else word for word in words]
    assert cli.main([*words, "--connect", where]) == status
    text = capsys.readouterr().err
    assert ".rs:" not in text
    assert "Zenoh" not in text
    assert len([line for line in text.splitlines() if where in line]) == 1, text
    return text


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_endpoint_without_port_is_refused(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "the port is missing: usually 7447 for tcp" in run_and_read_stderr(words, "tcp/127.0.0.1", tmp_path, capsys, 2)


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_unknown_host_is_reported(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(endpoint.socket, "getaddrinfo", unknown)
    text = run_and_read_stderr(words, "tcp/hexapot.local:7447", tmp_path, capsys, 1)
    assert "the host 'hexapot.local' is not known; check its name, or give its IP address" in text


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_closed_port_is_reported(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = free_port()
    text = run_and_read_stderr(words, f"tcp/127.0.0.1:{port}", tmp_path, capsys, 1)
    assert f"nothing listens on port {port} of 127.0.0.1; is the robot up (`sextant up`), and is this its port?" in text


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_non_sextant_program_on_port_is_reported(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], occupied_port: int
) -> None:
    text = run_and_read_stderr(words, f"tcp/127.0.0.1:{occupied_port}", tmp_path, capsys, 1)
    assert "takes the connection, but does not answer as a router of Sextant; is another program there" in text


UP = ["up", "all", "--scenario", "flat", "--no-page"]


@pytest.mark.parametrize("open_", [False, True], ids=["alone", "open"])
def test_up_on_occupied_port_is_refused(open_: bool, capsys: pytest.CaptureFixture[str], occupied_port: int) -> None:
    assert cli.main([*UP, "--listen", f"tcp/127.0.0.1:{occupied_port}", *(["--open"] if open_ else [])]) == 1
    text = capsys.readouterr().err
    cause = f"another program has port {occupied_port}, perhaps another `sextant up`"
    assert f"cannot listen on tcp/127.0.0.1:{occupied_port}: {cause}" in text
    assert ".rs:" not in text


@pytest.mark.parametrize("option", ["--listen", "--connect"])
def test_up_with_endpoint_without_port_is_refused(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*UP, option, "tcp/127.0.0.1", "--open"]) == 2
    assert "the port is missing" in capsys.readouterr().err


def test_up_on_foreign_ip_address_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*UP, "--listen", "tcp/192.0.2.1:7447", "--open"]) == 1
    assert "this computer has no address 192.0.2.1; give one that it has" in capsys.readouterr().err
