"""Reverse proxy for the consoles of a fleet.

`/NAME/` is the page of one robot, `/` is the overview of all robots. After the request head, the proxy forwards all bytes
unchanged in both directions. The lease, refusals and the dead-man time therefore remain with each robot's console.
"""

import asyncio
import contextlib
import json
import logging
import re
from http import HTTPStatus
from typing import NamedTuple

from sextant.services.console.fleet_proxy.config import Settings
from sextant.services.console.web.origin_policy import OriginPolicy
from sextant.services.console.web.page_files import HEADERS, KINDS, headers_of, page_files

log = logging.getLogger(__name__)

MOST_CONNECTIONS = 256
HEAD_BYTES = 16_384  # maximum size of a request head
_PATIENCE_S = 5.0  # [s] timeout for a request and for a connection to a console
_SENDING_S = 30.0  # [s] timeout for sending a file
_PIECE_BYTES = 65_536
_REQUEST = re.compile(rb"GET (/[!-~]*) HTTP/1\.1\r\n")
_HOST = re.compile(rb"^host:[ \t]*([!-~]*)[ \t]*\r$", re.IGNORECASE | re.MULTILINE)
_OVERVIEW = "fleet.html"
_LIST = "robots.json"


class _Answer(NamedTuple):
    status: HTTPStatus
    headers: dict[str, str]
    body: bytes = b""


class _Way(NamedTuple):
    """Robot to which a request is forwarded, and the request head to send."""

    robot: str
    head: bytes


class FleetProxy:
    """Request handler: serves the overview and forwards requests for one robot."""

    def __init__(self, settings: Settings):
        """Create the handler, which checks hosts against the proxy's address."""
        self._robots = settings.robots
        self._origin_policy = OriginPolicy(settings.web_settings())
        self._files = page_files()
        self._count = 0

    async def meet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one connection until it ends."""
        self._count += 1
        try:
            if self._count <= MOST_CONNECTIONS:
                await self._serve(reader, writer)
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # the browser disconnected, sent nothing or sent no HTTP; no answer is possible
        finally:
            self._count -= 1
            writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with asyncio.timeout(_PATIENCE_S):
            found = self.answer(await reader.readuntil(b"\r\n\r\n"))
        if isinstance(found, _Answer):
            await _send(writer, found)
            return
        port = self._robots[found.robot]
        try:
            async with asyncio.timeout(_PATIENCE_S):
                behind = await asyncio.open_connection("127.0.0.1", port)
        except (OSError, TimeoutError):
            await _send(writer, _plain(HTTPStatus.BAD_GATEWAY, f"the console of {found.robot} does not answer; is it running?"))
            return
        behind[1].write(found.head)
        try:
            await _join((reader, writer), behind)
            await _hang_up(writer)
        finally:
            behind[1].transport.abort()

    def answer(self, head: bytes) -> "_Answer | _Way":
        """Return the answer to a request head, or the robot to which to forward it."""
        request, hosts = _REQUEST.match(head), _HOST.findall(head)
        if request is None:
            return _plain(HTTPStatus.BAD_REQUEST, "GET, a path and HTTP/1.1 expected")
        if len(hosts) != 1:
            return _plain(HTTPStatus.BAD_REQUEST, f"one Host expected, found {len(hosts)}")
        if not self._origin_policy.is_own(hosts[0].decode("ascii")):
            return _plain(HTTPStatus.FORBIDDEN, "this address is not an address of the console")
        target = request[1].decode("ascii")
        path, mark, query = target.removeprefix("/").partition("?")
        name, slash, rest = path.partition("/")
        if name in self._robots and not slash:
            return _Answer(HTTPStatus.MOVED_PERMANENTLY, {**HEADERS, "Location": f"/{name}/{mark}{query}"})
        if name in self._robots and rest != _LIST:
            return _Way(name, b"GET /%s HTTP/1.1\r\n%s" % (f"{rest}{mark}{query}".encode("ascii"), head[request.end() :]))
        if path == _LIST or (name in self._robots and rest == _LIST):
            known = {"robots": list(self._robots), "here": name if slash else ""}
            return _Answer(HTTPStatus.OK, {**HEADERS, "Content-Type": KINDS[".json"]}, json.dumps(known).encode())
        content = self._files.get(path or _OVERVIEW)
        if content is None:
            return _plain(HTTPStatus.NOT_FOUND, f"no such file or robot; the robots are {', '.join(self._robots)}")
        return _Answer(HTTPStatus.OK, headers_of(path or _OVERVIEW), content)


async def _join(
    one: tuple[asyncio.StreamReader, asyncio.StreamWriter], other: tuple[asyncio.StreamReader, asyncio.StreamWriter]
) -> None:
    """Forward bytes in both directions until both streams end or one fails."""
    ways = [asyncio.ensure_future(_pass_on(one[0], other[1])), asyncio.ensure_future(_pass_on(other[0], one[1]))]
    try:
        done, _ = await asyncio.wait(ways, return_when=asyncio.FIRST_EXCEPTION)
        for way in done:
            way.result()
    finally:
        for way in ways:
            way.cancel()
        await asyncio.gather(*ways, return_exceptions=True)


async def _pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(_PIECE_BYTES):
        writer.write(data)
        await writer.drain()  # a slow receiver slows down the sender (backpressure)
    if writer.can_write_eof():
        writer.write_eof()


async def _send(writer: asyncio.StreamWriter, answer: _Answer) -> None:
    fields = {**answer.headers, "Connection": "close", "Content-Length": str(len(answer.body))}
    words = "".join(f"{name}: {value}\r\n" for name, value in fields.items())
    writer.write(f"HTTP/1.1 {answer.status.value} {answer.status.phrase}\r\n{words}\r\n".encode("ascii") + answer.body)
    await _hang_up(writer)


async def _hang_up(writer: asyncio.StreamWriter) -> None:
    """Close a stream after its remaining bytes are sent, within a timeout."""
    writer.close()
    with contextlib.suppress(OSError, TimeoutError):
        async with asyncio.timeout(_SENDING_S):
            await writer.wait_closed()


def _plain(status: HTTPStatus, words: str) -> _Answer:
    return _Answer(status, {**HEADERS, "Content-Type": KINDS[".txt"]}, words.encode())
