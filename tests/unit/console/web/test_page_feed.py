"""Page feed: pages receive what they show, and only what has changed."""

import json
from collections.abc import Collection
from typing import Any

import pytest

from sextant.services.console.web.page_feed import PageFeed
from sextant.services.console.web.requests import Watch
from sextant.shared.recording.event_log import EventLog
from sextant.shared.runtime.service import Inbox, Stages
from sextant.shared.wire import codec, topics
from tests.unit.console.web.test_frames import terrain

MS = 1_000_000


class Sent:
    """A sender that keeps the messages."""

    def __init__(self) -> None:
        self.messages: list[tuple[str, Any, list[int]]] = []

    def post(self, kind: str, text: str, pages: Collection[int]) -> None:
        self.messages.append((kind, json.loads(text), list(pages)))

    def show(self, kind: str, frame: bytes, pages: Collection[int]) -> None:
        self.messages.append((kind, frame, list(pages)))

    def of(self, kind: str) -> list[list[int]]:
        """Return the pages of each message of a kind."""
        return [pages for name, _, pages in self.messages if name == kind]


@pytest.fixture
def sent() -> Sent:
    return Sent()


@pytest.fixture
def feed(sent: Sent) -> PageFeed:
    return PageFeed(sent, Stages())


def inbox_with_map(now_ns: int) -> Inbox:
    inbox = Inbox([topics.TERRAIN, topics.PREVIEW], Stages())
    inbox.receive(topics.TERRAIN, codec.encode(terrain()), now_ns)
    return inbox


def test_state_is_sent_only_if_it_has_changed(feed: PageFeed, sent: Sent) -> None:
    feed.open(1)
    for value in (1, 1, 2):
        feed.post_state({"value": value})
    assert sent.of("state") == [[1], [1]]
    feed.open(2)
    feed.post_state({"value": 2})
    assert sent.of("state")[-1] == [1, 2], "a new page needs it"


def test_summary_goes_to_fleet_pages_alone(feed: PageFeed, sent: Sent) -> None:
    feed.open(1)
    feed.open_fleet_page(2)
    for _ in range(2):
        feed.post_glance({"value": 1})
    assert sent.of("glance") == [[2]]
    assert len(feed) == 2
    feed.close(2)
    assert not feed.has_fleet_pages
    assert feed.has_pages


def test_only_new_log_entries_are_sent(feed: PageFeed, sent: Sent) -> None:
    log = EventLog()
    log.note(0, "console", "before any page")
    feed.post_log(0, log)
    feed.open(1)
    log.note(0, "console", "first")
    log.note(0, "console", "second")
    for _ in range(2):
        feed.post_log(0, log)
    ((_, message, pages),) = sent.messages
    assert [entry["words"] for entry in message["entries"]] == ["first", "second"]
    assert pages == [1]


def test_page_receives_the_newest_map_when_it_opens_or_changes_its_layer(feed: PageFeed, sent: Sent) -> None:
    feed.open(1)
    assert sent.of("map") == [], "there is none yet"
    feed.show_frames(0, inbox_with_map(0))
    feed.open(2)
    feed.watch(2, Watch(layer="variance"))
    feed.watch(2, Watch(layer="variance"))
    assert sent.of("map") == [[1], [2], [2]]


def test_maps_are_sent_at_most_four_times_a_second(feed: PageFeed, sent: Sent) -> None:
    feed.open(1)
    for now_ms in range(0, 1000, 50):
        feed.show_frames(now_ms * MS, inbox_with_map(now_ms * MS))
    assert 4 <= len(sent.of("map")) <= 5


def test_new_page_alone_receives_the_last_calibration(feed: PageFeed, sent: Sent) -> None:
    feed.open(1)
    for value in (1, 1, 2):
        feed.post_calibration({"value": value})
    feed.open(2)
    feed.post_calibration({"value": 2})
    assert sent.of("calibration") == [[1], [1], [2]]
    feed.post_calibration({"value": 3})
    assert sent.of("calibration")[-1] == [1, 2]
