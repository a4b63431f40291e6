"""The next message for a page: the newest of each, and no more than it can draw."""

from sextant.services.console.web.pages import Page


def test_of_states_the_newest_is_sent_and_of_the_log_every_line() -> None:
    page = Page(1)
    for k in range(5):
        page.post("state", f"state {k}")
        page.post("log", f"line {k}")
    page.post("hello", "hello")
    assert page.take() == ["hello", "state 4", *(f"line {k}" for k in range(5))]
    assert page.take() == []


def test_the_next_frame_waits_until_the_last_one_is_drawn_and_is_then_the_newest() -> None:
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


def test_a_log_that_nobody_takes_does_not_grow() -> None:
    page = Page(1)
    for k in range(1000):
        page.post("log", f"{k}")
    lines = page.take()
    assert len(lines) <= 64
    assert lines[-1] == "999"
