"""What a page is sent next: the newest of everything, and no more than it can draw."""

import asyncio
from collections.abc import Sequence

import pytest

from services.console.pages import Page


def waiting(page: Page) -> Sequence[str | bytes]:
    """What it would be sent now; nothing where it would have to wait."""

    async def ask() -> Sequence[str | bytes]:
        try:
            async with asyncio.timeout(0.0):
                return await page.next()
        except TimeoutError:
            return []

    return asyncio.run(ask())


def test_of_states_the_newest_is_sent_and_of_the_log_every_line() -> None:
    page = Page(1)
    for k in range(5):
        page.post("state", f"state {k}")
        page.post("log", f"line {k}")
    page.post("hello", "hello")
    assert waiting(page) == ["hello", "state 4", *(f"line {k}" for k in range(5))]
    assert waiting(page) == []


def test_the_next_frame_waits_until_the_last_one_is_drawn_and_is_then_the_newest() -> None:
    page = Page(1)
    page.show("map", b"1")
    assert waiting(page) == [b"1"]
    for frame in (b"2", b"3", b"4"):
        page.show("map", frame)
    assert waiting(page) == [], "it is still drawing"
    page.show("picture", b"p")
    assert waiting(page) == [b"p"], "of another kind"
    page.seen("map")
    assert waiting(page) == [b"4"]


def test_a_log_that_nobody_takes_does_not_grow() -> None:
    page = Page(1)
    for k in range(1000):
        page.post("log", f"{k}")
    lines = waiting(page)
    assert len(lines) <= 64
    assert lines[-1] == "999"


def test_who_waits_is_woken() -> None:
    async def run() -> Sequence[str | bytes]:
        page = Page(1)
        sent = asyncio.create_task(page.next())
        await asyncio.sleep(0)
        page.post("state", "news")
        return await asyncio.wait_for(sent, 5.0)

    assert asyncio.run(run()) == ["news"]


@pytest.mark.parametrize("kind", ["map", "picture"])
def test_what_was_never_sent_can_be_seen_without_harm(kind: str) -> None:
    page = Page(1)
    page.seen(kind)
    assert waiting(page) == []
