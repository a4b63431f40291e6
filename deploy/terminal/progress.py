"""Progress of a run on a terminal, or as lines in a log."""

import atexit
import contextlib
import os
import re
import shutil
from importlib.util import find_spec
from typing import TYPE_CHECKING, TextIO, cast

from sextant.evaluation.observers.monitor import View
from sextant.evaluation.observers.progress import Progress

if TYPE_CHECKING:
    from rich.console import RenderableType

_MOST_WARNINGS = 200  # most kinds of warnings per run, because they quote text of services
_REAL_TIME = 0.95  # [1] share of real time below which the speed of simulated time is shown
_LINE_EVERY_S = 5.0  # [s] simulated time between two plain lines of the position
_CHANGE_EVERY_S = 1.0  # [s] shortest simulated time between two plain lines of one service
_ATTENDING = ("operator", "scorer")  # once the robot is up, their status repeats speed and way to the goal
_WIDTH = 100  # [characters] of the widest table


class _Output:
    """A stream that ignores write errors, so that they never end a run."""

    def __init__(self, stream: TextIO):
        self._stream = stream
        self.encoding = stream.encoding

    def write(self, text: str) -> int:
        """Write a text; ignore errors."""
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream; ignore errors."""
        with contextlib.suppress(OSError):
            self._stream.flush()


class Lines:
    """Plain lines for logs and pipes: each change and each warning, and the position at intervals."""

    def __init__(self, stream: TextIO):
        self._stream = _Output(stream)
        self._next_s = 0.0
        self._warned: set[str] = set()
        self._told: dict[str, tuple[str, float]] = {}  # service -> kind of its status, and when it was written [s]
        self._compiling = False
        self._quarters = 0  # compiled quarters of the functions that were written

    def update(self, view: View) -> None:
        """Write new warnings, what services do now, and every few simulated seconds where the robot is."""
        for warning in view.warnings:
            if _kind(warning) not in self._warned and len(self._warned) < _MOST_WARNINGS:
                self._warned.add(_kind(warning))
                self.say(f"{view.time_s:6.1f} s  warning: {warning}")
        if not view.up:
            return
        for name, doing in view.doing.items():
            kind, before = _kind(_first_clause(doing)), self._told.get(name)
            changed = before is None or (kind != before[0] and view.time_s - before[1] >= _CHANGE_EVERY_S)
            if changed and name not in _ATTENDING:
                self._told[name] = kind, view.time_s
                self.say(f"{view.time_s:6.1f} s  {name}: {doing}")
        if view.time_s >= self._next_s:
            self._next_s = view.time_s + _LINE_EVERY_S
            self.say(f"{view.time_s:6.1f} s  {'  '.join(_motion(view))}")

    def compiled(self, done: int, total: int) -> None:
        """Write that functions are being compiled: at the beginning, and at each quarter."""
        if not self._compiling:
            self._compiling = True
            self.say("compiling the inner loops; the first start takes half a minute")
        elif total and done * 4 // total > self._quarters:
            self._quarters = done * 4 // total
            self.say(f"compiled {done} of up to {total} functions")

    def say(self, text: str) -> None:
        """Write one line."""
        self._stream.write(text + "\n")
        self._stream.flush()

    def finish(self) -> None:
        """Do nothing: no line is open."""


class Terminal:
    """A table at the bottom of a terminal, redrawn in place; it has colours unless NO_COLOR is set."""

    def __init__(self, stream: TextIO):
        from rich.console import Console
        from rich.live import Live

        self._console = Console(
            file=cast(TextIO, _Output(stream)), force_terminal=True, highlight=False, markup=False, emoji=False
        )
        self._live = Live(console=self._console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False)
        atexit.register(self._live.stop)  # an error shows the cursor again

    def update(self, view: View) -> None:
        """Redraw the table."""
        self._show(table(view))

    def compiled(self, done: int, total: int) -> None:
        """Show how many functions are compiled."""
        from rich.text import Text

        so_far = f": {done} of up to {total}" if total else ""
        self._show(Text(f"compiling the inner loops{so_far}; the first start takes half a minute", "cyan"))

    def say(self, text: str) -> None:
        """Write a line above the table."""
        self._console.print(text, soft_wrap=True)

    def finish(self) -> None:
        """Keep the last table on the screen."""
        self._live.stop()

    def _show(self, content: "RenderableType") -> None:
        self._console.width = min(shutil.get_terminal_size().columns, _WIDTH)
        self._live.start()
        self._live.update(content, refresh=True)


def progress_for(stream: TextIO) -> Progress:
    """Return a table that is redrawn on a terminal, or plain lines.

    Lines are for a stream that is no terminal, a terminal that cannot move its cursor, and an installation without rich.
    """
    redrawn = stream.isatty() and os.environ.get("TERM") != "dumb" and find_spec("rich") is not None
    return Terminal(stream) if redrawn else Lines(stream)


def table(view: View) -> "RenderableType":
    """Return the state of a run as a table with a line for each service and warning."""
    from rich.progress_bar import ProgressBar
    from rich.table import Table
    from rich.text import Text

    state = f"{view.time_s:6.1f} s   {'   '.join(_motion(view))}" if view.up else "waiting for the robot to start"
    services = Table.grid(padding=(0, 2), expand=True)
    services.add_column(style="cyan", no_wrap=True)
    services.add_column(no_wrap=True, overflow="ellipsis", ratio=1)
    for name, doing in view.doing.items():
        if not (view.up and name in _ATTENDING):
            services.add_row(f"  {name}", Text(doing))
    for warning in view.warnings:
        services.add_row(Text("  warning", "yellow"), Text(warning, "yellow", no_wrap=False, overflow="fold"))
    whole = Table.grid(expand=True)
    whole.add_row(Text(state, "bold", no_wrap=True, overflow="ellipsis"))
    if view.up and view.to_goal is not None:
        way = view.walked + view.to_goal
        whole.add_row(ProgressBar(max(way, 1e-9), view.walked if way > 0 else 1e-9, complete_style="green"))
    whole.add_row(services)
    return whole


def _motion(view: View) -> list[str]:
    """Return speed and way to the goal as texts."""
    slower = [f"at {view.of_real_time:.2f} of real time"] if view.of_real_time < _REAL_TIME else []
    goal = [] if view.to_goal is None else [f"{view.to_goal:.2f} m to the goal"]
    return [*slower, f"{view.speed:.3f} m/s", *goal]


def _first_clause(doing: str) -> str:
    """Return what a service does without details that change all the time."""
    return re.split("[,;]", doing, maxsplit=1)[0]


def _kind(text: str) -> str:
    """Return a text without its numbers; new numbers are no news."""
    return re.sub(r"\d+(\.\d+)?", "#", text)
