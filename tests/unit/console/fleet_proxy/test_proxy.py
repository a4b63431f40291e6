"""The fleet proxy: one address for two consoles, with a client that is no browser."""

import asyncio
import contextlib
import http.client
import json
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from sextant.services.console.config import Settings as ConsoleSettings
from sextant.services.console.fleet_proxy.config import Settings
from sextant.services.console.fleet_proxy.proxy import HEAD_BYTES, FleetProxy
from sextant.services.console.web.origin_policy import PROTOCOL
from sextant.services.console.web.requests import Command
from sextant.services.console.web.server import PageServer
from sextant.shared.files.config import ConfigError, build
from tests.support.served import Serving

PATIENCE_S = 20.0
TOKEN = "a long and secret word"


class Site:
    """Two consoles served by threads, with the fleet proxy before them.

    This class is a context manager.
    """

    def __init__(self, token: str = "") -> None:
        self.token = token
        self.names = ("alpha", "beta")

    def __enter__(self) -> "Site":
        with contextlib.ExitStack() as stack:
            self.consoles, self.turns, self.ends = {}, {}, {}
            for name in self.names:
                server = PageServer(ConsoleSettings(port=0, token=self.token), time.monotonic_ns)
                self.ends[name] = stack.enter_context(contextlib.ExitStack())
                self.consoles[name] = self.ends[name].enter_context(server)
                self.turns[name] = self.ends[name].enter_context(Serving(server.wait))
            ports = {name: server.port for name, server in self.consoles.items()}
            self._loop = asyncio.new_event_loop()
            stack.callback(self._loop.close)
            front = FleetProxy(Settings(token=self.token, robots={**ports, "away": _closed_port()}))
            made = asyncio.start_server(front.meet, "127.0.0.1", 0, limit=HEAD_BYTES)
            server_ = self._loop.run_until_complete(made)
            self.port = server_.sockets[0].getsockname()[1]
            thread = threading.Thread(target=self._loop.run_forever, daemon=True)
            thread.start()
            stack.callback(thread.join, PATIENCE_S)
            stack.callback(lambda: asyncio.run_coroutine_threadsafe(self._end(server_), self._loop))
            self._held = stack.pop_all()
        return self

    async def _end(self, server: asyncio.Server) -> None:
        server.close()
        mine = asyncio.current_task()
        others = [task for task in asyncio.all_tasks() if task is not mine]
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)
        self._loop.call_soon(self._loop.stop)

    def __exit__(self, *error: Any) -> None:
        self._held.close()

    def get(self, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        with contextlib.closing(connection):
            connection.request("GET", path, headers=headers)
            answer = connection.getresponse()
            return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()

    def page(self, name: str, query: str = "", *more: str, **options: Any) -> ClientConnection:
        words: Any = [PROTOCOL, *more]
        return connect(f"ws://127.0.0.1:{self.port}/{name}/socket{query}", subprotocols=words, compression=None, **options)

    def events(self, name: str, count: int) -> list[object]:
        found: list[object] = []
        limit, turn = time.monotonic() + PATIENCE_S, threading.Event()
        while len(found) < count:
            assert time.monotonic() < limit, found
            with self.turns[name].turn:
                found += [event.what for event in self.consoles[name].drain()]
            turn.wait(0.005)
        return found

    def post(self, name: str, text: str) -> None:
        with self.turns[name].turn:
            self.consoles[name].post("state", text, [1])
            self.consoles[name].flush()


def _closed_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as closed:
        return int(closed.getsockname()[1])


@pytest.fixture
def site() -> Iterator[Site]:
    with Site() as made:
        yield made


def test_robot_pages_are_below_their_names_and_overview_at_root(site: Site) -> None:
    overview, own = site.get("/"), site.get("/alpha/")
    assert b'id="robots"></ul>' in overview[2]
    assert b'id="scene"' in own[2]
    assert site.get("/beta/")[2] == own[2] == site.get("/index.html")[2]
    assert site.get("/alpha/js/main.js") == site.get("/beta/js/main.js")
    status, headers, _ = site.get("/alpha?speed=1")
    assert (status, headers["location"]) == (301, "/alpha/?speed=1")
    for status, headers, _ in (overview, own):
        assert (status, headers["x-frame-options"], headers["content-type"]) == (200, "DENY", "text/html; charset=utf-8")


def test_page_receives_list_of_robots(site: Site) -> None:
    names = ["alpha", "beta", "away"]
    assert json.loads(site.get("/robots.json")[2]) == {"robots": names, "here": ""}
    assert json.loads(site.get("/beta/robots.json")[2]) == {"robots": names, "here": "beta"}


def test_messages_of_a_robot_page_reach_only_that_robot(site: Site) -> None:
    with site.page("beta") as beta, site.page("alpha", "?glance") as alpha:
        assert site.events("beta", 1) == ["arrived"]
        assert site.events("alpha", 1) == ["glances"]
        beta.send(json.dumps({"type": "order", "order": "off"}))
        assert site.events("beta", 1) == [Command("off")]
        site.post("beta", "of beta")
        site.post("alpha", "of alpha")
        assert (beta.recv(PATIENCE_S), alpha.recv(PATIENCE_S)) == ("of beta", "of alpha")
    assert site.events("beta", 1) == ["left"]
    with site.turns["alpha"].turn:
        assert [event.what for event in site.consoles["alpha"].drain()] in ([], ["left"])


def test_large_message_arrives_complete(site: Site) -> None:
    with site.page("alpha", max_size=None) as page:
        site.events("alpha", 1)
        text = "0123456789" * 200_000
        site.post("alpha", text)
        assert page.recv(PATIENCE_S) == text


def test_ended_console_disconnects_only_its_own_pages(site: Site) -> None:
    with site.page("alpha") as alpha, site.page("beta") as beta:
        site.events("alpha", 1)
        site.events("beta", 1)
        site.ends["alpha"].close()
        with pytest.raises(ConnectionClosed):
            alpha.recv(PATIENCE_S)
        site.post("beta", "still here")
        assert beta.recv(PATIENCE_S) == "still here"


def test_unreachable_console_is_named(site: Site) -> None:
    status, _, body = site.get("/away/")
    assert status == 502
    assert body == b"the console of away does not answer; is it running?"
    with pytest.raises(InvalidStatus), site.page("away"):
        pass


@pytest.mark.parametrize(
    ("path", "status", "words"),
    [
        ("/gamma/", 404, b"the robots are alpha, beta, away"),
        ("/alpha/nothing", 404, b"no such file"),
        ("/../alpha/", 404, b"no such"),
    ],
)
def test_unknown_path_returns_404_with_reason(site: Site, path: str, status: int, words: bytes) -> None:
    found = site.get(path)
    assert found[0] == status
    assert words in found[2]


def test_foreign_origin_and_foreign_host_are_refused(site: Site) -> None:
    assert site.get("/", Host=f"evil.example:{site.port}")[0] == 403
    assert site.get("/alpha/", Host="evil.example")[0] == 403
    with pytest.raises(InvalidStatus), site.page("alpha", origin="http://evil.example"):
        pass
    with site.page("alpha", origin=f"http://127.0.0.1:{site.port}"):
        assert site.events("alpha", 1) == ["arrived"]


def test_console_requires_token_through_fleet_proxy() -> None:
    with Site(TOKEN.replace(" ", "-")) as site:
        with pytest.raises(InvalidStatus), site.page("alpha"):
            pass
        with site.page("alpha", "", f"token.{site.token}"):
            assert site.events("alpha", 1) == ["arrived"]


@pytest.mark.parametrize(
    "head",
    [
        b"POST /alpha/ HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET alpha HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET / HTTP/1.0\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET / HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET /alpha/\xff HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    ],
)
def test_malformed_request_returns_400(site: Site, head: bytes) -> None:
    assert raw(site, head).startswith(b"HTTP/1.1 400 ")


def test_too_long_request_closes_only_its_connection(site: Site) -> None:
    with contextlib.suppress(ConnectionError):
        assert raw(site, b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * HEAD_BYTES + b"\r\n") == b""
    assert site.get("/")[0] == 200


def raw(site: Site, data: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", site.port), timeout=PATIENCE_S) as speaker:
        speaker.sendall(data)
        said = b""
        while piece := speaker.recv(65_536):
            said += piece
        return said


@pytest.mark.parametrize(
    "robots", [{}, {"a b": 8101}, {"": 8101}, {"-a": 8101}, {"alpha": 0}, {"alpha": 70_000}, {"al/pha": 8101}]
)
def test_invalid_robot_names_and_ports_are_refused(robots: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match="robot"):
        build({"robots": robots}, Settings, "fleet_proxy")


def test_an_open_fleet_proxy_requires_a_token() -> None:
    with pytest.raises(ConfigError, match="token"):
        build({"host": "0.0.0.0", "robots": {"alpha": 8101}}, Settings, "fleet_proxy")
