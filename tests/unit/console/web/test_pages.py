"""The next message for a page: the newest of each, and no more than it can draw."""

from sextant.services.console.web.pages import Page


def test_newest_state_and_every_log_line_are_sent() -> None:
    page = Page(1)
    for k in range(5):
        page.post("state", f"state {k}")
        page.post("log", f"line {k}")
    page.post("hello", "hello")
    assert page.take() == ["hello", "state 4", *(f"line {k}" for k in range(5))]
    assert page.take() == []


def test_newest_frame_is_sent_after_page_acknowledges_last() -> None:
    page = Page(1)
    page.show("map", b"1")
    assert page.take() == [b"1"]
    for frame in (b"2", b"3", b"4"):
        page.show("map", frame)
    assert page.take() == [], "it is still drawing"
    page.show("picture", b"p")
    assert page.take() == [b"p"], "of another kind"
    page.seen("map")
    assert page.take() == [b"4"]


def test_unread_log_is_bounded() -> None:
    page = Page(1)
    for k in range(1000):
        page.post("log", f"{k}")
    lines = page.take()
    assert len(lines) <= 64
    assert lines[-1] == "999"
