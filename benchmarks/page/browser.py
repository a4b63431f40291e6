"""Headless Chromium that leads the robot by its page, as an operator does."""

import contextlib
import os
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_ARGUMENTS = (
    "--no-sandbox",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-quic",
    "--disable-sync",
    "--no-first-run",
    "--enable-unsafe-swiftshader",  # WebGL without a graphics card
)
DESKTOP, SMALL, PHONE = (1440, 900), (960, 640), (390, 844)


def find() -> str:
    """Return the path of the browser, or an empty string."""
    return next((path for name in BROWSERS if (path := shutil.which(name))), "")


@contextlib.contextmanager
def browser() -> Iterator[Any]:
    """Start a Playwright browser; many pages may be opened in it.

    Raises:
        FileNotFoundError: None is found.
        ImportError: Playwright is missing.
    """
    path = find()
    if not path:
        raise FileNotFoundError(f"no browser found: install Chromium (tried: {', '.join(BROWSERS)})")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        made = playwright.chromium.launch(executable_path=path, args=list(_ARGUMENTS))
        try:
            yield made
        finally:
            made.close()


_NOTE_INPUT = """for (const name of ["pointerdown", "pointerup"])
    addEventListener(name, (event) => { window.newestInput = event.timeStamp; }, true);"""
_LOOKS = 20  # readings of the page's clock, of which the fastest counts


class Hand:
    """Mouse on one page; create it before the page is opened."""

    def __init__(self, page: Any):
        """Use a Playwright page."""
        self.page = page
        page.add_init_script(_NOTE_INPUT)

    def newest_input_s(self) -> float:
        """Time [s] of the newest press or release in the browser.

        It is on this process's monotonic clock. The time that a script takes to move a mouse through several processes does not
        count.
        """
        looks = []
        for _ in range(_LOOKS):
            began = time.monotonic()
            at_ms = self.page.evaluate("performance.now()")
            ended = time.monotonic()
            looks.append((ended - began, 0.5 * (began + ended) - 1e-3 * at_ms))
        return float(min(looks)[1] + 1e-3 * self.page.evaluate("window.newestInput"))

    def press_at(self, selector: str, x: float = 0.5, y: float = 0.5) -> None:
        """Move to a position on an element, given as shares of its size, and press."""
        self.move_to(selector, x, y)
        self.page.mouse.down()

    def move_to(self, selector: str, x: float = 0.5, y: float = 0.5) -> None:
        """Move to a position on an element, and scroll it into view."""
        element = self.page.locator(selector)
        element.scroll_into_view_if_needed()
        box = element.bounding_box()
        self.page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])

    def release(self) -> None:
        """Release the button."""
        self.page.mouse.up()

    def click(self, selector: str) -> None:
        """Press and release."""
        self.press_at(selector)
        self.release()

    def hold_forward(self) -> None:
        """Hold the pad for walking straight ahead."""
        self.press_at("#pad")
        self.move_to("#pad", 0.5, 0.05)

    def holds(self) -> bool:
        """Return whether the page regards the pad as held.

        A page that did not run for a moment releases it until the next press.
        """
        return bool(self.page.evaluate("window.sextant.pad.held"))

    def until_says(self, selector: str, words: str) -> None:
        """Wait until an element says some words; a busy page draws later than the robot moves."""
        self.page.wait_for_function(
            "([one, words]) => document.querySelector(one).textContent === words", arg=[selector, words]
        )

    def says(self, selector: str) -> str:
        """Return the text of an element."""
        return str(self.page.inner_text(selector))


def _descendants(parent: int) -> set[int]:
    children: dict[int, list[int]] = {}
    names: dict[int, str] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                stat = (entry / "stat").read_text(encoding="utf-8")
                name, fields = stat[stat.index("(") + 1 : stat.rindex(")")], stat[stat.rindex(")") + 2 :].split()
                children.setdefault(int(fields[1]), []).append(int(entry.name))
                names[int(entry.name)] = name
    found: set[int] = set()
    front = [parent]
    while front:
        for child in children.get(front.pop(), []):
            front.append(child)
            if "chrom" in names[child]:
                found.add(child)
    return found


@contextlib.contextmanager
def frozen() -> Iterator[None]:
    """Stop all browsers started by this process for the duration of the block."""
    stopped = _descendants(os.getpid())
    if not stopped:
        raise ProcessLookupError("this process has no running browser")
    try:
        for pid in stopped:
            os.kill(pid, signal.SIGSTOP)
        yield
    finally:
        for pid in stopped:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
