"""The web server: files of the page, and a socket for each page that is open.

It has no thread: it serves while its process waits for the next beat, so that nobody has to be woken to hand anything over. It
listens on this machine alone unless told otherwise, and believes nobody.
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
from sextant.services.console.web.origin_policy import Door, Porter
from sextant.services.console.web.page_files import page_files
from sextant.services.console.web.pages import Page
from sextant.services.console.web.requests import Drive, Here, Request, RequestError, Seen, parse

_OVERDUE_S = DEAD_MAN_NS * 1e-9 + 0.001
_WAITING = 4096  # requests that may wait for the next beat: more are a flood, and the oldest go
_SERVICE_RESTART = 1012
_FAREWELL_S = 0.05  # for what was said last to go out


@dataclass(frozen=True, slots=True)
class Event:
    """Something that came from a page."""

    page: int
    what: Request | Literal["arrived", "glances", "left"]
    at_ns: int  # when it came


class PageServer:
    """Serves the page, while it is waited for; a context manager."""

    def __init__(self, settings: Settings, clock: Callable[[], int]):
        """Listen.

        Args:
            settings: Where.
            clock: [ns] by which what comes from pages is stamped.

        Raises:
            OSError: The address cannot be listened on.
        """
        self.door, self.porter = Door(settings), Porter()
        self.files = {**page_files(), "robots.json": b'{"robots":[],"here":""}'}
        self._settings, self._clock = settings, clock
        self._connections: dict[int, tuple[Page, Connection]] = {}  # of pages, by their numbers
        self._open: set[Connection] = set()  # of these and of others
        self._count = 0
        self._events: deque[Event] = deque(maxlen=_WAITING)
        self._touched: set[int] = set()  # pages for which there is something new
        self._urgent = False  # something has come that cannot wait
        self._overdue: asyncio.TimerHandle | None = None  # makes it urgent that the pad must have been heard of again
        family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
        try:
            self._socket = socket.create_server((settings.host, settings.port), family=family)
        except OSError as error:
            words = f"the page cannot be served on {settings.host} port {settings.port}: {error.strerror}"
            raise OSError(f"{words}; is another console running? --set port=8081 takes another") from None
        self.port = int(self._socket.getsockname()[1])
        self._loop = asyncio.new_event_loop()

    @property
    def url(self) -> str:
        """Where a browser finds the page."""
        return self._settings.url(self.port)

    def __enter__(self) -> Self:
        self._server = self._loop.run_until_complete(self._loop.create_server(lambda: Connection(self), sock=self._socket))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._server.close()
        if self._connections:
            for _, connection in self._connections.values():
                connection.close(_SERVICE_RESTART)
            self._serve(_FAREWELL_S)
        for connection in self._open:
            connection.abort()
        self._serve(0.0)
        self._loop.close()

    def wait(self, length_s: float) -> None:
        """Serve for a time [s], or until something has come that cannot wait."""
        if not self._urgent:
            self._serve(length_s)
        self._urgent = False

    def drain(self) -> list[Event]:
        """What has come from pages since this was last asked, in order."""
        events = []
        while self._events:
            events.append(self._events.popleft())
        return events

    def post(self, kind: str, text: str, pages: Collection[int]) -> None:
        """Have a text sent to some pages, at the next `flush`."""
        for page in self._those(pages):
            page.post(kind, text)

    def show(self, kind: str, frame: bytes, pages: Collection[int]) -> None:
        """Have a frame sent to some pages, at the next `flush`."""
        for page in self._those(pages):
            page.show(kind, frame)

    def flush(self) -> None:
        """Send what there is to be sent now."""
        for number in self._touched & self._connections.keys():
            self._connections[number][1].send()
        self._touched.clear()

    def _those(self, numbers: Collection[int]) -> list[Page]:
        self._touched.update(numbers)
        return [self._connections[number][0] for number in numbers if number in self._connections]

    def _serve(self, length_s: float) -> None:
        over = self._loop.call_later(length_s, self._loop.stop)
        self._loop.run_forever()
        over.cancel()

    def _stir(self) -> None:
        self._urgent = True
        self._loop.stop()

    # ------------------------------------------------------------------------------------------- what its connections call

    def opened(self, connection: Connection) -> None:
        """Somebody has connected."""
        self._open.add(connection)

    def closed(self, connection: Connection) -> None:
        """And has gone."""
        self._open.discard(connection)

    def pages_open(self) -> int:
        """How many pages there are."""
        return len(self._connections)

    def arrived(self, connection: Connection, glances: bool) -> Page:
        """A page has connected, to see all there is or only how the robot fares."""
        self._count += 1
        page = Page(self._count)
        self._connections[page.number] = page, connection
        self._tell(page, "glances" if glances else "arrived")
        return page

    def left(self, page: Page) -> None:
        """It has gone."""
        del self._connections[page.number]
        self._tell(page, "left")

    def hear(self, page: Page, text: str) -> None:
        """It has said something."""
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
            self._tell(page, request)

    def _tell(self, page: Page, what: Request | Literal["arrived", "glances", "left"]) -> None:
        self._events.append(Event(page.number, what, self._clock()))
        again = False  # it is a press that goes on, which the next beat sees to
        if isinstance(what, Drive):
            if self._overdue is not None:
                self._overdue.cancel()
            self._overdue = self._loop.call_later(_OVERDUE_S, self._stir)  # it may be the last
            again, page.press = what.press == page.press, what.press
        if not again and not isinstance(what, Here):
            self._stir()
