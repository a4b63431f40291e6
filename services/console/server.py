"""The web server, in a thread of its own: files of the page, and a socket for each page that is open.

It listens on this machine alone unless told otherwise, and believes nobody. A thread that dies or hangs
is noticed by `check`.
"""

import asyncio
import contextlib
import logging
import math
import socket
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Collection
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Self, TypeAlias

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request as HttpRequest
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from services.console import view
from services.console.config import Settings
from services.console.desk import DEAD_MAN_NS
from services.console.door import PROTOCOL, Door
from services.console.files import HEADERS, headers_of, page_files
from services.console.pages import Page
from services.console.requests import MAX_BYTES, Drive, Here, Request, RequestError, Seen, parse

log = logging.getLogger(__name__)

_PING_S = 5.0
_STOP_S = 2.0
_OVERDUE_S = DEAD_MAN_NS * 1e-9 + 0.001
_WAITING = 4096  # requests that may wait for the next beat: more are a flood, and the oldest go
_HUNG_S = 10.0  # without an answer of the thread, after which it hangs
_LOOKS = 5  # in that time at least: else it is the whole process that stood still


@dataclass(frozen=True, slots=True)
class Event:
    """Something that came from a page."""

    page: int
    what: Request | Literal["arrived", "left"]
    at_ns: int  # when it came


_Poster: TypeAlias = Callable[[Page], object]


class PageServer:
    """Serves the page; a context manager. `drain` and the `post`s may be called from another thread."""

    def __init__(self, settings: Settings, clock: Callable[[], int], stir: Callable[[], object] = lambda: None):
        """Listen.

        Args:
            settings: Where.
            clock: [ns] by which what comes from pages is stamped.
            stir: Is called, from the server's thread, when something urgent has come.

        Raises:
            OSError: The address cannot be listened on.
        """
        self._settings, self._clock, self._stir = settings, clock, stir
        self._door = Door(settings)
        self._pages: dict[int, Page] = {}
        self._count = 0
        self._events: deque[Event] = deque(maxlen=_WAITING)
        self._files = page_files()
        family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
        try:
            self._socket = socket.create_server((settings.host, settings.port), family=family)
        except OSError as error:
            words = f"the page cannot be served on {settings.host} port {settings.port}: {error.strerror}"
            raise OSError(f"{words}; is another console running? --set port=8081 takes another") from None
        self.port = int(self._socket.getsockname()[1])
        self._loop: asyncio.AbstractEventLoop | None = None
        self._overdue: asyncio.TimerHandle | None = None  # stirs when the pad must have been heard of again
        self._failure: BaseException | None = None  # what has ended the thread
        self._called_s = math.nan  # when it was last called, as long as it has not answered
        self._looks = 0  # since then
        self._thread = threading.Thread(target=self._serve, name="page server", daemon=True)
        self._server = uvicorn.Server(
            uvicorn.Config(
                Starlette(routes=self._routes(), lifespan=self._lifespan),
                loop="auto",
                http="h11",
                ws="websockets-sansio",
                ws_max_size=MAX_BYTES,
                ws_ping_interval=_PING_S,
                ws_ping_timeout=_PING_S,
                ws_per_message_deflate=False,
                log_config=None,
                access_log=False,
                timeout_graceful_shutdown=1,
            )
        )

    @property
    def url(self) -> str:
        """Where a browser finds the page."""
        host = f"[{self._settings.host}]" if ":" in self._settings.host else self._settings.host
        return f"http://{host}:{self.port}/" + (f"#{self._settings.token}" if self._settings.token else "")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._server.should_exit = True
        self._thread.join(_STOP_S)
        self._socket.close()

    def drain(self) -> list[Event]:
        """What has come from pages since this was last asked, in order."""
        events = []
        while self._events:
            events.append(self._events.popleft())
        return events

    def post(self, kind: str, text: str, pages: Collection[int]) -> None:
        """Have a text sent to some pages."""
        self._on(lambda found: found.post(kind, text), pages)

    def show(self, kind: str, frame: bytes, pages: Collection[int]) -> None:
        """Have a frame sent to some pages."""
        self._on(lambda found: found.show(kind, frame), pages)

    def check(self) -> None:
        """See whether the thread still does anything; to be called about once a second.

        Raises:
            RuntimeError: It has ended, or does not answer.
        """
        if self._thread.ident is not None and not self._thread.is_alive():
            raise RuntimeError("the page's server has ended") from self._failure
        self._looks += 1
        if math.isnan(self._called_s):
            self._called_s, self._looks = time.monotonic(), 0
        elif self._looks >= _LOOKS and time.monotonic() - self._called_s > _HUNG_S:
            raise RuntimeError(f"the page's server hangs: it has not answered for {_HUNG_S:g} s")
        self._call(self._answer)

    # ------------------------------------------------------------------------------------------------- the server's thread

    def _on(self, act: _Poster, pages: Collection[int]) -> None:
        numbers = tuple(pages)

        def run() -> None:
            for number in numbers:
                found = self._pages.get(number)
                if found is not None:
                    act(found)

        self._call(run)

    def _call(self, act: Callable[[], object]) -> None:
        """Have the thread do something, once it is up."""
        loop = self._loop
        if loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed: the server is on its way out
                loop.call_soon_threadsafe(act)

    def _answer(self) -> None:
        self._called_s = math.nan

    def _serve(self) -> None:
        try:
            self._server.run(sockets=[self._socket])
        except BaseException as error:  # noqa: BLE001 - `check` raises it again in the thread that can end the process
            self._failure = error

    @contextlib.asynccontextmanager
    async def _lifespan(self, _app: Starlette) -> AsyncIterator[None]:
        self._loop = asyncio.get_running_loop()
        yield
        self._loop = None

    def _routes(self) -> list[Route | WebSocketRoute]:
        return [Route("/{path:path}", self._file, methods=["GET", "HEAD"]), WebSocketRoute("/socket", self._talk)]

    async def _file(self, request: HttpRequest) -> Response:
        if not self._door.is_own(request.headers.get("host", "")):
            return PlainTextResponse("this address is not the console's own", 403, HEADERS)
        path = request.path_params["path"] or "index.html"
        content = self._files.get(path)
        if content is None:
            return PlainTextResponse("no such file", 404, HEADERS)
        return Response(content, headers=headers_of(path))

    async def _talk(self, ws: WebSocket) -> None:
        """One page, for as long as it is open."""
        refusal = self._door.refusal(ws.headers, list(ws.scope.get("subprotocols", [])), len(self._pages))
        if refusal:
            log.warning("a page was refused: %s", refusal)
            await ws.close(1008, refusal)
            return
        await ws.accept(subprotocol=PROTOCOL)
        self._count += 1
        page = self._pages[self._count] = Page(self._count)
        self._tell(page, "arrived")
        sending = asyncio.create_task(self._send(ws, page))
        try:
            while True:
                self._hear(page, await ws.receive_text())
        except (WebSocketDisconnect, KeyError):  # a KeyError: bytes where text was expected
            pass
        finally:
            sending.cancel()
            del self._pages[page.number]
            self._tell(page, "left")

    def _tell(self, page: Page, what: Request | Literal["arrived", "left"]) -> None:
        self._events.append(Event(page.number, what, self._clock()))
        if isinstance(what, Drive):
            if self._overdue is not None:
                self._overdue.cancel()
            self._overdue = asyncio.get_running_loop().call_later(_OVERDUE_S, self._stir)  # it may be the last
        if not isinstance(what, Here):
            self._stir()

    def _hear(self, page: Page, text: str) -> None:
        try:
            request = parse(text)
        except RequestError as error:
            page.post("refused", view.text(view.answer(str(error))))
            return
        if isinstance(request, Seen):
            page.seen(request.what)
        else:
            self._tell(page, request)

    async def _send(self, ws: WebSocket, page: Page) -> None:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # it is gone; whoever listens to it sees to that
            while True:
                for message in await page.next():
                    await (ws.send_text(message) if isinstance(message, str) else ws.send_bytes(message))
