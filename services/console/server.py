"""The web server, in a thread of its own: files of the page, and a socket for each page that is open.

It listens on this machine alone unless told otherwise, and believes nobody: a page of another site that a browser has open
could reach it as well, so requests must name an address that is its own, and come from its own page.
"""

import asyncio
import contextlib
import hmac
import logging
import socket
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from importlib import resources
from types import TracebackType
from typing import Any, Literal, Self, TypeAlias
from urllib.parse import urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request as HttpRequest
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from services.console import view
from services.console.config import Settings
from services.console.desk import DEAD_MAN_NS
from services.console.pages import Page
from services.console.requests import MAX_BYTES, Drive, Here, Request, RequestError, Seen, parse

log = logging.getLogger(__name__)

PROTOCOL = f"sextant.{view.PROTOCOL}"
_LOCAL = ("127.0.0.1", "localhost", "[::1]")
_MOST_PAGES = 32
_PING_S = 5.0
_STOP_S = 2.0
_OVERDUE_S = DEAD_MAN_NS * 1e-9 + 0.001
_WAITING = 4096  # requests that may wait for the next beat: more are a flood, and the oldest go
_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}
_HEADERS = {
    "Cache-Control": "no-cache",
    "Content-Security-Policy": "default-src 'self'; connect-src 'self'; img-src 'self' blob: data:; style-src 'self'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


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
        self._pages: dict[int, Page] = {}
        self._count = 0
        self._events: deque[Event] = deque(maxlen=_WAITING)
        self._files = _page_files()
        family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
        try:
            self._socket = socket.create_server((settings.host, settings.port), family=family)
        except OSError as error:
            words = f"the page cannot be served on {settings.host} port {settings.port}: {error.strerror}"
            raise OSError(f"{words}; is another console running? --set port=8081 takes another") from None
        self.port = int(self._socket.getsockname()[1])
        self._loop: asyncio.AbstractEventLoop | None = None
        self._overdue: asyncio.TimerHandle | None = None  # stirs when the pad must have been heard of again
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

    def post(self, kind: str, text: str, page: int | None = None) -> None:
        """Have a text sent to all pages, or to one."""
        self._on(lambda found: found.post(kind, text), page)

    def show(self, kind: str, frame: bytes, page: int) -> None:
        """Have a frame sent to a page."""
        self._on(lambda found: found.show(kind, frame), page)

    # ------------------------------------------------------------------------------------------------- the server's thread

    def _on(self, act: _Poster, page: int | None) -> None:
        loop = self._loop
        if loop is None:
            return

        def run() -> None:
            for number, found in self._pages.items():
                if page in (None, number):
                    act(found)

        with contextlib.suppress(RuntimeError):  # the loop is closed: the server is on its way out
            loop.call_soon_threadsafe(run)

    def _serve(self) -> None:
        self._server.run(sockets=[self._socket])

    @contextlib.asynccontextmanager
    async def _lifespan(self, _app: Starlette) -> AsyncIterator[None]:
        self._loop = asyncio.get_running_loop()
        yield
        self._loop = None

    def _routes(self) -> list[Route | WebSocketRoute]:
        return [Route("/{path:path}", self._file, methods=["GET", "HEAD"]), WebSocketRoute("/socket", self._talk)]

    async def _file(self, request: HttpRequest) -> Response:
        if not self._is_own(request.headers.get("host", "")):
            return PlainTextResponse("this address is not the console's own", 403, _HEADERS)
        path = request.path_params["path"] or "index.html"
        content = self._files.get(path)
        if content is None:
            return PlainTextResponse("no such file", 404, _HEADERS)
        return Response(content, headers={**_HEADERS, "Content-Type": _KINDS[path[path.rindex(".") :]]})

    def _is_own(self, host: str) -> bool:
        """Whether a request names this server: a name that somebody has turned to its address is none."""
        name = host.rpartition(":")[0] if host.rpartition(":")[2].isdigit() else host
        return bool(self._settings.token) or name in (*_LOCAL, self._settings.host)

    def _refusal(self, headers: Any, offered: list[str]) -> str:
        """Why a page may not connect, in words, or nothing."""
        host, origin = headers.get("host", ""), headers.get("origin")
        if not self._is_own(host):
            return "this address is not the console's own"
        if origin is not None and urlsplit(origin).netloc != host:
            return "the page of another site may not connect"
        if PROTOCOL not in offered:
            return f"{PROTOCOL} is spoken here; load the page anew"
        if self._settings.token:
            token = next((word.removeprefix("token.") for word in offered if word.startswith("token.")), "")
            if not hmac.compare_digest(token.encode(), self._settings.token.encode()):
                return "the token is wrong, or missing; open the address with #TOKEN behind it"
        if len(self._pages) >= _MOST_PAGES:
            return f"{_MOST_PAGES} pages are open already; close one"
        return ""

    async def _talk(self, ws: WebSocket) -> None:
        """One page, for as long as it is open."""
        refusal = self._refusal(ws.headers, list(ws.scope.get("subprotocols", [])))
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


def _page_files() -> dict[str, bytes]:
    """All files of the page by their paths: they are few, and what is not here is not served."""
    files: dict[str, bytes] = {}

    def gather(folder: Any, below: str) -> None:
        for item in folder.iterdir():
            if item.is_dir():
                gather(item, f"{below}{item.name}/")
            elif item.name[item.name.rfind(".") :] in _KINDS:
                files[below + item.name] = item.read_bytes()

    gather(resources.files("services.console") / "page", "")
    return files
