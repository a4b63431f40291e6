"""Dialogue with the person who builds the robot."""

from typing import Protocol


class Operator(Protocol):
    """Person who builds the robot."""

    @property
    def absent(self) -> bool:
        """Whether no person is present: every question gets its default answer.

        Repeating a question changes nothing.
        """
        ...

    def say(self, text: str) -> None:
        """Show a message."""

    def ask(self, question: str) -> str:
        """Return the typed answer, empty for plain Enter."""

    def agree(self, question: str) -> bool:
        """Return whether the answer is yes."""
