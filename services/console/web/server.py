"""Web server of the console: the files of the page, and one WebSocket per page.

The server has no separate thread. It runs while the service waits for its next tick, which avoids thread switches.
By default it listens on loopback only. All input from browsers is validated.
"""

import asyncio
import socket
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Self

from sextant.services.console.config import Settings
from sextant.services.console.web import view
from sextant.services.console.web.connection import Connection
from sextant.services.console.web.control_arbiter import DEAD_MAN_NS
from sextant.services.console.web.origin_policy import OriginPolicy, RejectionLog
from sextant.services.console.web.page_files import page_files
from sextant.services.console.web.pages import Page
from sextant.services.console.web.requests import Drive, Heartbeat, Request, RequestError, Seen, parse

_OVERDUE_S = DEAD_MAN_NS * 1e-9 + 0.001  # [s] after a drive request, when the dead-man time of the pad has passed
_MAX_EVENTS = 4096  # maximum number of events that wait for the next tick; the oldest are dropped
_SERVICE_RESTART = 1012  # WebSocket close code
_SHUTDOWN_S = 0.05  # [s] for sending the last messages at the shutdown


@dataclass(frozen=True, slots=True)
class Event:
    """Event of a page: a request, or a connection that was opened or closed."""

    page: int  # number of the page
    what: Request | Literal["arrived", "glances", "left"]  # a page of the fleet `glances`: it receives only a summary
    at_ns: int  # [ns] time of arrival


class PageServer:
    """Web server of the page; a context manager. It serves only during `wait`."""

    def __init__(self, settings: Settings, clock: Callable[[], int]):
        """Open the listening socket.

        Args:
            settings: Address, port and token.
            clock: Clock [ns] that stamps events of pages.

        Raises:
            OSError: The address is not available.
        """
        self.origin_policy, self.rejection_log = OriginPolicy(settings), RejectionLog()
        self.files = {**page_files(), "robots.json": b'{"robots":[],"here":""}'}
        self._settings, self._clock = settings, clock
        self._connections: dict[int, tuple[Page, Connection]] = {}  # page number -> page and its connection
        self._open: set[Connection] = set()  # all connections, including those without a page
        self._count = 0
        self._events: deque[Event] = deque(maxlen=_MAX_EVENTS)
        self._touched: set[int] = set()  # numbers of pages with new messages
        self._urgent = False  # whether an event must be processed at once, which ends `wait`
        self._overdue: asyncio.TimerHandle | None = None  # ends `wait` when the dead-man time of the pad has passed
        family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
        try:
            self._socket = socket.create_server((settings.host, settings.port), family=family)
        except OSError as error:
            words = f"the page cannot be served on {settings.host} port {settings.port}: {error.strerror}"
            raise OSError(f"{words}; is another console running? choose another port with --set port=8081") from None
        self.port = int(self._socket.getsockname()[1])
        self._loop = asyncio.new_event_loop()

    @property
    def url(self) -> str:
        """URL of the page, including the token."""
        return self._settings.url(self.port)

    def __enter__(self) -> Self:
        self._server = self._loop.run_until_complete(self._loop.create_server(lambda: Connection(self), sock=self._socket))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._server.close()
        if self._connections:
            for _, connection in self._connections.values():
                connection.close(_SERVICE_RESTART)
            self._serve(_SHUTDOWN_S)
        for connection in self._open:
            connection.abort()
        self._serve(0.0)
        self._loop.close()

    def wait(self, length_s: float) -> None:
        """Serve for a time [s], or until an urgent event."""
        if not self._urgent:
            self._serve(length_s)
        self._urgent = False

    def drain(self) -> list[Event]:
        """Remove and return the events since the last call, in order of arrival."""
        events = []
        while self._events:
            events.append(self._events.popleft())
        return events

    def post(self, kind: str, text: str, pages: Collection[int]) -> None:
        """Queue a text for pages; `flush` sends it."""
        for page in self._pages_with(pages):
            page.post(kind, text)

    def show(self, kind: str, frame: bytes, pages: Collection[int]) -> None:
        """Queue a frame for pages; `flush` sends it."""
        for page in self._pages_with(pages):
            page.show(kind, frame)

    def flush(self) -> None:
        """Send the queued messages of all pages."""
        for number in self._touched & self._connections.keys():
            self._connections[number][1].send()
        self._touched.clear()

    def _pages_with(self, numbers: Collection[int]) -> list[Page]:
        """Return the open pages with these numbers, and mark them for `flush`."""
        self._touched.update(numbers)
        return [self._connections[number][0] for number in numbers if number in self._connections]

    def _serve(self, length_s: float) -> None:
        """Run the event loop for a time [s], or until an urgent event."""
        over = self._loop.call_later(length_s, self._loop.stop)
        self._loop.run_forever()
        over.cancel()

    def _end_wait(self) -> None:
        """End `wait` at once, or prevent the next one."""
        self._urgent = True
        self._loop.stop()

    # ---------------------------------------------------------------------------------------------- methods for connections

    def opened(self, connection: Connection) -> None:
        """Register a new connection."""
        self._open.add(connection)

    def closed(self, connection: Connection) -> None:
        """Remove a closed connection."""
        self._open.discard(connection)

    def pages_open(self) -> int:
        """Return the number of open pages."""
        return len(self._connections)

    def page_opened(self, connection: Connection, glances: bool) -> Page:
        """Register a new page; a page with `glances` receives only a summary."""
        self._count += 1
        page = Page(self._count)
        self._connections[page.number] = page, connection
        self._add_event(page, "glances" if glances else "arrived")
        return page

    def page_closed(self, page: Page) -> None:
        """Remove a page that has disconnected."""
        del self._connections[page.number]
        self._add_event(page, "left")

    def receive_text(self, page: Page, text: str) -> None:
        """Parse a text of a page, and queue the request as an event."""
        try:
            request = parse(text)
        except RequestError as error:
            page.post("refused", view.text(view.answer(str(error))))
            self._connections[page.number][1].send()
            return
        if isinstance(request, Seen):
            page.seen(request.what)
            self._connections[page.number][1].send()
        else:
            self._add_event(page, request)

    def _add_event(self, page: Page, what: Request | Literal["arrived", "glances", "left"]) -> None:
        """Queue an event; all but heartbeats and repeated drive requests end `wait`."""
        self._events.append(Event(page.number, what, self._clock()))
        repeated = False  # of the current press of the pad: such a request can wait for the next tick
        if isinstance(what, Drive):
            if self._overdue is not None:
                self._overdue.cancel()
            self._overdue = self._loop.call_later(_OVERDUE_S, self._end_wait)  # this may be the last message of the press
            repeated, page.press = what.press == page.press, what.press
        if not repeated and not isinstance(what, Heartbeat):
            self._end_wait()
