"""One connection of a browser.

It is an HTTP request for one file, or the WebSocket of an open page. It uses the protocol classes of the package `websockets`,
but not its server, which takes twice as long per message.
"""

import asyncio
import logging
from collections.abc import Iterator
from http import HTTPStatus
from typing import Protocol, cast

from websockets.datastructures import Headers
from websockets.frames import Frame, Opcode
from websockets.http11 import Request as HttpRequest
from websockets.http11 import Response
from websockets.protocol import State
from websockets.server import ServerProtocol

from sextant.services.console.web.origin_policy import PROTOCOL, OriginPolicy, RejectionLog
from sextant.services.console.web.page_files import HEADERS, headers_of
from sextant.services.console.web.pages import Page
from sextant.services.console.web.requests import MAX_BYTES

log = logging.getLogger(__name__)

SOCKET = "/socket"
GLANCE = "glance"  # query string of a page of the fleet, which receives only a summary of each robot
_REQUEST_TIMEOUT_S = 5.0  # [s] for a browser to send its request
_FILE_TIMEOUT_S = 30.0  # [s] for a browser to receive a file
_PING_S = 5.0  # [s] period of pings; a ping without an answer within this time ends the connection
_CLOSE_TIMEOUT_S = 1.0  # [s] for a browser to close the connection
_protocol_log = logging.getLogger("websockets.server")


class PageHost(Protocol):
    """Interface of the server that owns the connections and pages."""

    origin_policy: OriginPolicy
    rejection_log: RejectionLog
    files: dict[str, bytes]

    def opened(self, connection: "Connection") -> None:
        """Register a new connection."""
        ...

    def closed(self, connection: "Connection") -> None:
        """Remove a closed connection."""
        ...

    def pages_open(self) -> int:
        """Return the number of open pages."""
        ...

    def page_opened(self, connection: "Connection", glances: bool) -> Page:
        """Register a new page; a page with `glances` receives only a summary."""
        ...

    def page_closed(self, page: Page) -> None:
        """Remove a page that has disconnected."""
        ...

    def receive_text(self, page: Page, text: str) -> None:
        """Process a text that a page has sent."""
        ...


class Connection(asyncio.Protocol):
    """Protocol of one connection of a browser."""

    def __init__(self, host: PageHost):
        """Create a connection that waits for its request."""
        _protocol_log.setLevel(logging.WARNING)
        self._host = host
        self._protocol = ServerProtocol(subprotocols=[PROTOCOL], max_size=MAX_BYTES, logger=_protocol_log)  # type: ignore[list-item]
        self._loop = asyncio.get_running_loop()
        self._page: Page | None = None
        self._send_buffer_full = False
        self._ping_answered = True  # of the newest ping

    # --------------------------------------------------------------------------------------------- asyncio.Protocol methods

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Wait for a request, with a timeout."""
        self._transport = cast(asyncio.Transport, transport)
        self._timer = self._loop.call_later(_REQUEST_TIMEOUT_S, self._transport.abort)
        self._host.opened(self)

    def data_received(self, data: bytes) -> None:
        """Process received bytes."""
        self._protocol.receive_data(data)
        for event in self._protocol.events_received():
            if isinstance(event, HttpRequest):
                self._handle_request(event)
            elif isinstance(event, Frame):
                self._handle_frame(event)
        self._flush()

    def eof_received(self) -> None:
        """Process the end of the browser's stream."""
        self._protocol.receive_eof()
        self._flush()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer, and remove the connection and its page from the server."""
        self._timer.cancel()
        self._host.closed(self)
        if self._page is not None:
            self._host.page_closed(self._page)
            self._page = None

    def pause_writing(self) -> None:
        """Stop sending because the send buffer is full."""
        self._send_buffer_full = True

    def resume_writing(self) -> None:
        """Continue sending because the send buffer has room again."""
        self._send_buffer_full = False
        self.send()

    # --------------------------------------------------------------------------------------------- methods for the server

    def send(self) -> None:
        """Send the waiting messages of the page, unless the send buffer is full."""
        if self._page is None or self._send_buffer_full or self._protocol.state is not State.OPEN:
            return
        for message in self._page.take():
            if isinstance(message, str):
                self._protocol.send_text(message.encode())
            else:
                self._protocol.send_binary(message)
        self._flush()

    def close(self, code: int) -> None:
        """Start the closing handshake of the WebSocket with a status code."""
        if self._protocol.state is State.OPEN:
            self._protocol.send_close(code)
            self._flush()

    def abort(self) -> None:
        """Close the transport at once."""
        self._transport.abort()

    # ------------------------------------------------------------------------------------------------------------- private

    def _handle_request(self, request: HttpRequest) -> None:
        """Answer the request: with a file, or by opening the page's WebSocket."""
        if self._protocol.parser_exc is not None:  # bytes after the request are not WebSocket frames: no answer is possible
            self.abort()
            return
        response = self._answer(request)
        self._protocol.send_response(response)
        self._timer.cancel()
        if response.status_code == HTTPStatus.SWITCHING_PROTOCOLS:
            self._page = self._host.page_opened(self, request.path.partition("?")[2] == GLANCE)
            self._timer = self._loop.call_later(_PING_S, self._ping)
        else:
            self._timer = self._loop.call_later(_FILE_TIMEOUT_S, self._transport.abort)

    def _answer(self, request: HttpRequest) -> Response:
        path, hosts = request.path.partition("?")[0], request.headers.get_all("Host")
        if len(hosts) != 1:
            return _plain(HTTPStatus.BAD_REQUEST, f"one Host expected, found {len(hosts)}")
        return self._open(request) if path == SOCKET else self._file(path, hosts[0])

    def _open(self, request: HttpRequest) -> Response:
        headers = {name.lower(): value for name, value in request.headers.raw_items()}
        offered = [word.strip() for words in request.headers.get_all("Sec-WebSocket-Protocol") for word in words.split(",")]
        refusal = self._host.origin_policy.refusal(headers, offered, self._host.pages_open())
        if refusal:
            if words := self._host.rejection_log.words(refusal, self._loop.time()):
                log.warning("%s", words)
            return self._protocol.reject(HTTPStatus.FORBIDDEN, refusal)
        return self._protocol.accept(request)

    def _file(self, path: str, host: str) -> Response:
        if not self._host.origin_policy.is_own(host):
            return _plain(HTTPStatus.FORBIDDEN, "this address is not an address of the console")
        name = path.removeprefix("/") or "index.html"
        content = self._host.files.get(name)
        if content is None:
            return _plain(HTTPStatus.NOT_FOUND, "no such file")
        return _response(HTTPStatus.OK, headers_of(name), content)

    def _handle_frame(self, frame: Frame) -> None:
        """Pass a text of the page on, and refuse frames that a page does not send."""
        match frame.opcode:
            case Opcode.TEXT if frame.fin and self._page is not None:
                try:
                    text = bytes(frame.data).decode()
                except UnicodeDecodeError:
                    self._protocol.fail(1007, "a text in UTF-8 expected")
                    return
                self._host.receive_text(self._page, text)
            case Opcode.TEXT | Opcode.BINARY | Opcode.CONT:
                self._protocol.fail(1003, "an unfragmented text message expected")
            case Opcode.PONG:
                self._ping_answered = True

    def _ping(self) -> None:
        """Send a ping, or end the connection if the last one was not answered."""
        if not self._ping_answered:
            self._transport.abort()
            return
        self._ping_answered = False
        if self._protocol.state is State.OPEN:
            self._protocol.send_ping(b"")
            self._flush()
        self._timer = self._loop.call_later(_PING_S, self._ping)

    def _flush(self) -> None:
        """Write what the protocol has to send, and wait only briefly for the end of a closing connection."""
        for data in self._protocol.data_to_send():
            if data:
                self._transport.write(data)
            elif self._transport.can_write_eof():
                self._transport.write_eof()
        if self._page is not None and self._protocol.close_expected():
            self._timer.cancel()
            self._timer = self._loop.call_later(_CLOSE_TIMEOUT_S, self._transport.abort)


def _plain(status: HTTPStatus, words: str) -> Response:
    return _response(status, {**HEADERS, "Content-Type": "text/plain; charset=utf-8"}, words.encode())


def _response(status: HTTPStatus, headers: dict[str, str], body: bytes) -> Response:
    fields: Iterator[tuple[str, str]] = iter({**headers, "Connection": "close", "Content-Length": str(len(body))}.items())
    return Response(status.value, status.phrase, Headers(fields), body)
