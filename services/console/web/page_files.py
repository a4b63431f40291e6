"""Files of the page and their HTTP headers.

The server serves only these files, from memory.
"""

from importlib import resources
from typing import Any

KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}
HEADERS = {
    "Cache-Control": "no-cache",
    "Content-Security-Policy": "default-src 'self'; connect-src 'self'; img-src 'self' blob: data:; style-src 'self'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


def headers_of(path: str) -> dict[str, str]:
    """Return the HTTP headers of a file of the page."""
    return {**HEADERS, "Content-Type": KINDS[_ending(path)]}


def page_files() -> dict[str, bytes]:
    """Return the contents of all files of the page by path."""
    files: dict[str, bytes] = {}

    def gather(folder: Any, below: str) -> None:
        for item in folder.iterdir():
            if item.is_dir():
                gather(item, f"{below}{item.name}/")
            elif _ending(item.name) in KINDS:
                files[below + item.name] = item.read_bytes()

    gather(resources.files("sextant.services.console") / "page", "")
    return files


def _ending(path: str) -> str:
    return path[path.rfind(".") :]
