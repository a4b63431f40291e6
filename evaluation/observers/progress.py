"""Display of a run's progress, as a run sees it."""

from typing import Protocol

from sextant.evaluation.observers.monitor import View


class Progress(Protocol):
    """Display of a run's progress."""

    def update(self, view: View) -> None:
        """Show the current state of the run."""
        ...

    def compiled(self, done: int, total: int) -> None:
        """Show how many functions are compiled before the run."""
        ...

    def say(self, text: str) -> None:
        """Show one event permanently."""
        ...

    def finish(self) -> None:
        """Leave the terminal ready for further output."""
        ...


class Silent:
    """Display that shows nothing."""

    def update(self, view: View) -> None:
        """Do nothing."""

    def compiled(self, done: int, total: int) -> None:
        """Do nothing."""

    def say(self, text: str) -> None:
        """Do nothing."""

    def finish(self) -> None:
        """Do nothing."""
