"""Address of the operator's page, and a browser that shows it."""

import os
import sys
import webbrowser
from collections.abc import Callable

from sextant.shared.wire.ports import free_port, port_taken

PORT = 8080


def page_port(say: Callable[[str], object], usual: int = PORT) -> int:
    """Return the port for the page: the usual one, or a free one if that is taken."""
    if not port_taken(usual):
        return usual
    port = free_port()
    say(f"port {usual} is taken, so the operator's page is on {port}")
    return port


def has_display() -> bool:
    """Return whether a browser of this machine has a display to open on."""
    return sys.platform in ("darwin", "win32") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))


class Page:
    """Page of a run on this machine."""

    def __init__(self, port: int, open_browser: Callable[[str], object] | None = None):
        """Initialize for a port.

        Args:
            port: TCP port of 127.0.0.1.
            open_browser: Opens an address; by default the browser where there is a display, else nothing.
        """
        self.port = port
        self._open = open_browser or (webbrowser.open if has_display() else None)

    @property
    def url(self) -> str:
        """Return the address."""
        return f"http://127.0.0.1:{self.port}/"

    def show(self) -> None:
        """Open the page in a browser, once, as soon as the console serves it; call it repeatedly."""
        if self._open is not None and port_taken(self.port):
            self._open(self.url)
            self._open = None
