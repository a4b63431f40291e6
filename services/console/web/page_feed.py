"""Feed of the pages: which pages are open, what each shows, and what they have received."""

from collections.abc import Collection
from typing import Any, Protocol

from sextant.services.console.web import frames, view
from sextant.services.console.web.requests import Watch
from sextant.shared.recording.event_log import KEPT, EventLog
from sextant.shared.runtime.service import Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import TerrainMap

_MAP_NS = 240_000_000  # [ns] minimum period of maps


class PageSender(Protocol):
    """Sender of messages to pages, implemented by `PageServer`."""

    def post(self, kind: str, text: str, pages: Collection[int]) -> None:
        """Queue a text message for pages."""
        ...

    def show(self, kind: str, frame: bytes, pages: Collection[int]) -> None:
        """Queue a binary message for pages."""
        ...


class PageFeed:
    """Sends changes of the robot's state to the pages that show them."""

    def __init__(self, sender: PageSender, stages: Stages):
        """Start without pages; `stages` collects durations of the work."""
        self._sender, self._stages = sender, stages
        self._watched: dict[int, Watch] = {}  # page number -> what the page shows
        self._glancing: set[int] = set()  # fleet pages, which receive only a summary
        self._state = self._glance = ""  # last state and last summary sent
        self._calibration: dict[str, Any] | None = None  # last one sent
        self._logged = 0  # number of event log entries sent
        self._map: TerrainMap | None = None  # newest map sent
        self._map_due_ns = 0  # time from which the next map may be sent
        self._pictured_ns = -1  # stamp of the newest picture sent

    def __len__(self) -> int:
        return len(self._watched) + len(self._glancing)

    @property
    def has_pages(self) -> bool:
        """Return whether a page of the robot is open; fleet pages do not count."""
        return bool(self._watched)

    @property
    def has_fleet_pages(self) -> bool:
        """Return whether a fleet page is open."""
        return bool(self._glancing)

    def open(self, page: int) -> None:
        """Add a page of the robot, which receives the state, the last calibration and the newest map."""
        self._watched[page] = Watch()
        self._state = ""  # sends the state to all pages again
        if self._calibration is not None:
            self.post("calibration", self._calibration, page)
        self._draw(page)

    def open_fleet_page(self, page: int) -> None:
        """Add a fleet page, which receives the summary."""
        self._glancing.add(page)
        self._glance = ""  # sends the summary to all fleet pages again

    def close(self, page: int) -> None:
        """Remove a page."""
        self._watched.pop(page, None)
        self._glancing.discard(page)

    def watch(self, page: int, watch: Watch) -> None:
        """Set what a page shows."""
        before, self._watched[page] = self._watched.get(page, Watch()), watch
        if before.layer != watch.layer:
            self._draw(page)

    def post(self, kind: str, message: dict[str, Any], page: int | None = None) -> None:
        """Queue a message for one page, or for all pages of the robot."""
        self._sender.post(kind, view.text(message), self._watched if page is None else [page])

    def post_state(self, message: dict[str, Any]) -> None:
        """Queue the state for all pages of the robot if it has changed."""
        text = view.text(message)
        if text != self._state:
            self._state = text
            self._sender.post("state", text, self._watched)

    def post_calibration(self, message: dict[str, Any] | None) -> None:
        """Queue the progress or the result of a calibration for all pages of the robot if it has changed."""
        if message is not None and message != self._calibration:
            self._calibration = message
            self.post("calibration", message)

    def post_glance(self, message: dict[str, Any]) -> None:
        """Queue the summary for all fleet pages if it has changed."""
        text = view.text(message)
        if text != self._glance:
            self._glance = text
            self._sender.post("glance", text, self._glancing)

    def post_log(self, now_ns: int, event_log: EventLog) -> None:
        """Queue the new entries of the event log for all pages of the robot."""
        new = min(event_log.count - self._logged, KEPT)
        self._logged = event_log.count
        if new and self._watched:
            self.post("log", view.log(list(event_log.entries)[-new:], now_ns))

    def show_frames(self, now_ns: int, inbox: Inbox) -> None:
        """Queue the newest map and picture for the pages that show them."""
        terrain = inbox.latest(topics.TERRAIN) if now_ns >= self._map_due_ns else None
        if terrain is not None and terrain is not self._map:
            self._map, self._map_due_ns = terrain, now_ns + _MAP_NS
            with self._stages("map"):
                for layer in {watch.layer for watch in self._watched.values()}:
                    pages = [page for page, watch in self._watched.items() if watch.layer == layer]
                    self._sender.show("map", frames.map_frame(terrain, layer), pages)
        pages = [page for page, watch in self._watched.items() if watch.picture]
        picture = inbox.latest(topics.PREVIEW) if pages else None
        if picture is not None and picture.stamp_ns != self._pictured_ns:
            self._pictured_ns = picture.stamp_ns
            self._sender.show("picture", frames.picture_frame(picture), pages)

    def _draw(self, page: int) -> None:
        """Queue the newest map for a page."""
        if self._map is not None:
            self._sender.show("map", frames.map_frame(self._map, self._watched[page].layer), [page])
