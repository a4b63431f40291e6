"""Repeated requests to a servo: a busy host or a spike on the wire loses one occasionally."""

from collections.abc import Callable
from typing import TypeVar

ATTEMPTS = 3  # per request

T = TypeVar("T")


def retry(question: Callable[[], T | None]) -> T | None:
    """Repeat a request until there is an answer, three times at most."""
    for _ in range(ATTEMPTS):
        if (answer := question()) is not None:
            return answer
    return None
