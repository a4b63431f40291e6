"""Operator's page without a browser: it sends requests and stores the replies."""

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from sextant.services.console.web.origin_policy import PROTOCOL

_REPEAT_S = 0.05  # [s] between two messages while the pad is held
_WALK = {"height": 0.1, "lift": 0.025, "gait": "tripod"}


class ScriptedPage:
    """A page of a console; a context manager."""

    def __init__(self, url: str):
        """Connect to the console at `url`."""
        self.told: dict[str, Any] = {}  # the newest message of each kind
        self.lines: list[tuple[float, str]] = []  # of the log, with the time [s] of their receipt
        self._url = url.replace("http://", "ws://") + "socket"
        self._press = 0

    def __enter__(self) -> Self:
        self._socket = connect(self._url, subprotocols=[Subprotocol(PROTOCOL)], compression=None, max_size=None)
        self._thread = threading.Thread(target=self._listen, name="page", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._socket.close()
        self._thread.join()

    def ask(self, kind: str, **fields: Any) -> None:
        """Send a request."""
        self._socket.send(json.dumps({"type": kind, **fields}))

    @contextmanager
    def held(self, forward: float) -> Iterator[None]:
        """Hold the pad at a speed [m/s] for the duration of the block."""
        self._press += 1
        drive = {"press": self._press, "forward": forward, "left": 0.0, "turn": 0.0, "blind_walking": False, **_WALK}
        let_go = threading.Event()

        def hold() -> None:
            while not let_go.wait(_REPEAT_S):
                self.ask("drive", **drive)

        thread = threading.Thread(target=hold, name="pad", daemon=True)
        thread.start()
        try:
            yield
        finally:
            let_go.set()
            thread.join()
            self.ask("release")

    def said_after(self, words: str, since_s: float) -> float | None:
        """Return how long [s] after a time a log line with a text arrived, or None."""
        return next((at_s - since_s for at_s, line in list(self.lines) if at_s >= since_s and words in line), None)

    def _listen(self) -> None:
        try:
            for data in self._socket:
                if isinstance(data, bytes):
                    length = int.from_bytes(data[:4], "little")
                    self.ask("seen", what=json.loads(data[4 : 4 + length])["type"])
                    continue
                message = json.loads(data)
                self.told[message["type"]] = message
                if message["type"] == "log":
                    self.lines += [(time.monotonic(), f"{e['who']}: {e['words']}") for e in message["entries"]]
        except ConnectionClosed:
            return
