"""The page of a run: its port, and a browser that opens it once."""

import socket

import pytest

from sextant.deploy.live.page import Page, has_display, page_port
from sextant.shared.wire.ports import free_port


@pytest.fixture
def listening():
    """Listen on a free port."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


def test_free_usual_port_is_used():
    said: list[str] = []
    usual = free_port()
    assert page_port(said.append, usual) == usual
    assert said == []


def test_taken_port_is_replaced_and_named(listening):
    said: list[str] = []
    port = page_port(said.append, listening)
    assert port != listening
    assert said == [f"port {listening} is taken, so the operator's page is on {port}"]


def test_browser_opens_once_the_page_is_served():
    opened: list[str] = []
    page = Page(free_port(), opened.append)
    page.show()
    assert opened == [], "nobody listens yet"
    with socket.create_server(("127.0.0.1", page.port)):
        page.show()
        page.show()
    assert opened == [page.url] == [f"http://127.0.0.1:{page.port}/"]


@pytest.mark.parametrize(
    ("platform", "display", "expected"), [("linux", "", False), ("linux", ":0", True), ("darwin", "", True)]
)
def test_display_is_found(platform, display, expected, monkeypatch):
    monkeypatch.setattr("sys.platform", platform)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", display)
    assert has_display() == expected
