"""Unauthorized clients at an exact rate, and the table of the measurements."""

import json
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from benchmarks.access.strangers import Found, Silent, from_json, in_words, to_json
from sextant.deploy.security.authority import Authority

ROOT = Path(__file__).parents[3]
PATIENCE_S = 60.0
FOUND = Found(
    rate_hz=1000.0,
    strangers={"closed": 300, "silent": 300},
    strangers_s=0.6,
    back_s=(0.5, 2.5, 0.7),
    handshake_s=(0.002,),
    refused="refused: a client that hung up: 300 times",
    shared="",
    silent=500,
    alone_s=(),
    joined_s=(),
)


def test_strangers_table_shows_measurements_and_round_trips() -> None:
    assert from_json(to_json(FOUND)) == FOUND
    assert FOUND.late == 1
    table = in_words(FOUND)
    assert "| the radio's return, 1000 strangers a second: the base is back | 3 | 0.700 | 2.140 | 2.500 | 2.0 |" in table
    assert "Strangers: 300 closed, 300 silent; 1000 a second for 1 s." in table
    assert "actuator" not in table


def accept_connections(server: socket.socket, kept: list[socket.socket], said: dict[bytes, int]) -> None:
    """Accept all connections, and close those that send data."""

    def hear(connection: socket.socket) -> None:
        with connection:
            try:
                first = connection.recv(2)
            except OSError:
                first = b""
        said[first] = said.get(first, 0) + 1

    while True:
        try:
            connection, _ = server.accept()
        except OSError:
            return
        kept.append(connection)
        threading.Thread(target=hear, args=(connection,), daemon=True).start()


def test_stranger_load_has_exact_rate_and_all_kinds(tmp_path: Path) -> None:
    Authority(days=1).issue(tmp_path / "foreign", "console")
    kept, said = list[socket.socket](), dict[bytes, int]()
    with socket.create_server(("127.0.0.1", 0), backlog=1000) as server:
        threading.Thread(target=accept_connections, args=(server, kept, said), daemon=True).start()
        words = ["--port", str(server.getsockname()[1]), "--rate", "200", "--keys", str(tmp_path / "foreign"), "--seconds", "1"]
        command = [sys.executable, "-m", "benchmarks.access.stranger_load", *words]
        with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            found = json.loads(process.stdout.readline())
            assert process.wait(PATIENCE_S) == 0
        server.shutdown(socket.SHUT_RDWR)
    assert sum(found["count"].values()) + found["left_out"] == pytest.approx(200, abs=40)
    assert set(found["count"]) == {"closed", "silent", "garbage", "foreign"}
    assert max(found["count"].values()) - min(found["count"].values()) <= 1
    assert said.get(b"\x16\x03", 0) > 0, "those of TLS"
    assert len(said) > 3, "and garbage"


def test_dropped_silent_connections_are_reopened() -> None:
    kept = list[socket.socket]()
    with socket.create_server(("127.0.0.1", 0), backlog=100) as server:
        with Silent([server.getsockname()[1]], 20):
            for _ in range(20):
                kept.append(server.accept()[0])
            for connection in kept[:5]:
                connection.close()
            for _ in range(5):
                kept.append(server.accept()[0])
        server.settimeout(0.0)
        with pytest.raises(BlockingIOError):
            server.accept()
    for connection in kept:
        connection.close()
