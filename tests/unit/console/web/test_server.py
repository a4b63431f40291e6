"""The web server and its sockets, with a client that is no browser."""

import contextlib
import hashlib
import http.client
import json
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from sextant.services.console.config import Settings
from sextant.services.console.web.control_arbiter import DEAD_MAN_NS
from sextant.services.console.web.origin_policy import PROTOCOL
from sextant.services.console.web.requests import Drive, Release, Walk
from sextant.services.console.web.server import Event, PageServer
from tests.support.served import Serving

PAGE = Path("services/console/page")
PATIENCE_S = 20.0
CLOSE_S = 0.1  # [s] timeout of a page that closes with unread messages
WALK = {"height": 0.1, "lift": 0.04, "gait": "wave", "blind_walking": False}
DRIVE = {"type": "drive", "press": 1, "forward": 0.1, "left": 0.0, "turn": 0.0, **WALK}


class Served(PageServer):
    """A server that a thread runs, except during the test's turn."""

    def __enter__(self) -> Self:
        super().__enter__()
        self.serving = Serving(self.wait)
        self.serving.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self.serving.__exit__(*error)
        super().__exit__(*error)

    def drain(self) -> list[Event]:
        with self.serving.turn:
            return super().drain()

    def say(self, what: Callable[..., object], *words: Any) -> None:
        with self.serving.turn:
            what(*words)
            self.flush()


@pytest.fixture
def server() -> Iterator[Served]:
    with Served(Settings(port=0), time.monotonic_ns) as made:
        yield made


def get(server: Served, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE_S)
    with contextlib.closing(connection):
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()


def page(server: Served, protocols: tuple[str, ...] = (PROTOCOL,), **options: Any) -> ClientConnection:
    words: Any = list(protocols)
    return connect(
        f"ws://127.0.0.1:{server.port}/socket", subprotocols=words, compression=None, close_timeout=CLOSE_S, **options
    )


def within(holds: Callable[[], object]) -> None:
    """Wait until another thread has fulfilled a condition."""
    limit, turn = time.monotonic() + PATIENCE_S, threading.Event()
    while not holds():
        assert time.monotonic() < limit
        turn.wait(0.005)


def events(server: Served, count: int) -> list[object]:
    found: list[object] = []
    within(lambda: found.extend(e.what for e in server.drain()) or len(found) >= count)
    return found


def test_page_and_its_resources_are_served_with_content_types(server: Served) -> None:
    status, headers, index = get(server, "/")
    assert status == 200
    assert headers["content-type"] == "text/html; charset=utf-8"
    pages = index.decode() + get(server, "/fleet.html")[2].decode()
    named = set(re.findall(r'(?:src|href)="([^"]+)"', pages))
    scripts = {f"js/{path.name}" for path in (PAGE / "js").glob("*.js")}
    for script in scripts:
        text = (PAGE / script).read_text(encoding="utf-8")
        named |= {str(Path("js") / name) for name in re.findall(r'from "\./([^"]+)"', text)}
        named |= set(re.findall(r'from "\.\./([^"]+)"', text))
    assert scripts <= {name.replace("js/js/", "js/") for name in named}, "none is left over"
    for name in sorted(named | {"vendor/three/three.core.js", "vendor/three/LICENSE.txt"}):
        status, headers, body = get(server, f"/{name}")
        assert (status, bool(body)) == (200, True), name
        assert headers["x-content-type-options"] == "nosniff"


def test_page_loads_nothing_from_other_hosts() -> None:
    for path in PAGE.rglob("*"):
        if path.is_file() and "vendor" not in path.parts:
            text = path.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
            assert not re.search(r"https?://|//[a-z0-9-]+\.[a-z]{2,}/", text), path


@pytest.mark.parametrize("path", ["/nothing", "/../service.py", "/js/../../service.py", "/%2e%2e/service.py", "/vendor"])
def test_files_outside_page_folder_are_not_served(server: Served, path: str) -> None:
    assert get(server, path)[0] == 404


def test_foreign_host_header_is_refused(server: Served) -> None:
    assert get(server, "/", Host=f"evil.example:{server.port}")[0] == 403
    assert get(server, "/", Host=f"localhost:{server.port}")[0] == 200


def test_foreign_origin_may_not_connect(server: Served) -> None:
    for origin in ("http://evil.example", "null", f"http://127.0.0.1:{server.port + 1}"):
        with pytest.raises(InvalidStatus), page(server, origin=origin):
            pass
    with page(server, origin=f"http://127.0.0.1:{server.port}"):
        assert events(server, 1) == ["arrived"]


def test_other_protocol_version_is_refused(server: Served) -> None:
    with pytest.raises(InvalidStatus), page(server, protocols=("sextant.0",)):
        pass


def test_requests_arrive_in_order_and_invalid_ones_get_reason(server: Served) -> None:
    with page(server) as socket:
        socket.send(json.dumps(DRIVE))
        socket.send("nonsense")
        socket.send(json.dumps({"type": "release"}))
        assert events(server, 3) == ["arrived", Drive(1, 0.1, 0.0, 0.0, Walk(0.1, 0.04, "wave"), False), Release()]
        answer = json.loads(socket.recv(timeout=PATIENCE_S))
        assert answer == {"type": "refused", "words": "a request in JSON expected"}
    assert events(server, 1) == ["left"]


@pytest.mark.parametrize("data", [b"\x00\x01", "x" * 5000])
def test_binary_or_oversized_message_closes_only_its_connection(server: Served, data: str | bytes) -> None:
    with page(server) as good, page(server) as bad:
        assert events(server, 2) == ["arrived", "arrived"]
        bad.send(data)
        assert events(server, 1) == ["left"]
        with pytest.raises(ConnectionClosed):
            bad.recv(timeout=PATIENCE_S)
        server.say(server.post, "state", "still here", (1, 2))
        assert good.recv(timeout=PATIENCE_S) == "still here"


def test_slow_page_receives_newest_map_after_drawing_last(server: Served) -> None:
    with page(server) as socket:
        found: list[int] = []
        within(lambda: found.extend(e.page for e in server.drain()) or found)
        for k in range(50):
            server.say(server.show, "map", b"%d" % k, found)
        first = socket.recv(timeout=PATIENCE_S)
        server.say(server.post, "state", "between", found)
        assert socket.recv(timeout=PATIENCE_S) == "between", "no other map before it has been drawn"
        server.say(server.show, "map", b"newest", found)
        socket.send(json.dumps({"type": "seen", "what": "map"}))
        assert socket.recv(timeout=PATIENCE_S) == b"newest"
        assert first != b"newest"


def test_urgent_request_or_lapsed_press_ends_wait(server: Served) -> None:
    with page(server) as socket:
        events(server, 1)
        with server.serving.turn:
            begun = time.monotonic()
            socket.send(json.dumps({"type": "here"}))  # not urgent
            for said in ({"type": "order", "order": "off"}, DRIVE):
                socket.send(json.dumps(said))
                server.wait(PATIENCE_S)
            assert time.monotonic() - begun < PATIENCE_S
            socket.send(json.dumps(DRIVE))  # the press goes on
            pressed = time.monotonic()
            server.wait(PATIENCE_S)
            assert DEAD_MAN_NS * 1e-9 <= time.monotonic() - pressed < PATIENCE_S, "after the dead-man's time"
        assert len(events(server, 4)) == 4


def test_page_that_reads_nothing_does_not_block_others(server: Served) -> None:
    frame = bytes(400_000)
    with page(server) as deaf, page(server) as good:
        numbers = []
        within(lambda: numbers.extend(e.page for e in server.drain()) or len(numbers) == 2)
        for _ in range(40):
            server.say(server.show, "map", frame, numbers)
            assert good.recv(timeout=PATIENCE_S) == frame
            good.send(json.dumps({"type": "seen", "what": "map"}))
            deaf.send(json.dumps({"type": "seen", "what": "map"}))  # it acknowledges a map that it has not read
        server.say(server.post, "state", "still here", numbers)
        assert good.recv(timeout=PATIENCE_S) == "still here"


@pytest.mark.parametrize(
    "nonsense",
    [
        b"\x16\x03\x01\x02\x00",
        b"GET\r\n\r\n",
        b"POST / HTTP/1.1\r\n\r\n",
        b"GET / " + 9000 * b"x",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nand more in the same breath",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: 127.0.0.1",
        b"GET /socket HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://[[",
    ],
)
def test_non_http_connection_is_closed(server: Served, nonsense: bytes) -> None:
    with socket.create_connection(("127.0.0.1", server.port), PATIENCE_S) as stranger:
        stranger.sendall(nonsense + b"\r\n\r\n")
        answer = b""
        while data := stranger.recv(4096):
            answer += data
    assert b" 200 " not in answer
    assert get(server, "/")[0] == 200


def test_configured_token_is_required() -> None:
    token = "a-token-that-nobody-guesses"
    with Served(Settings(port=0, token=token), time.monotonic_ns) as server:
        assert server.url.endswith(f"/#{token}")
        for protocols in ((PROTOCOL,), (PROTOCOL, "token.wrong")):
            with pytest.raises(InvalidStatus), page(server, protocols=protocols):
                pass
        with page(server, protocols=(PROTOCOL, f"token.{token}")):
            assert events(server, 1) == ["arrived"]


def test_page_on_all_interfaces_requires_token() -> None:
    with pytest.raises(ValueError, match="ssh -L"):
        Settings(host="0.0.0.0")
    with pytest.raises(ValueError, match="at least 16 characters"):
        Settings(host="0.0.0.0", token="short")
    Settings(host="0.0.0.0", token="a-token-that-nobody-guesses")


def test_taken_port_is_reported(server: Served) -> None:
    with pytest.raises(OSError, match=r"is another console running\? choose another port with --set port=8081"):
        PageServer(Settings(port=server.port), time.monotonic_ns)


def test_vendored_files_match_checksums() -> None:
    folder = PAGE / "vendor" / "three"
    kept = dict(line.split()[::-1] for line in (folder / "SHA256SUMS").read_text(encoding="utf-8").splitlines())
    found = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir() if path.name != "SHA256SUMS"}
    assert kept == found
    assert "LICENSE.txt" in found
