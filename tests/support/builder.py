"""A scripted user for tests who builds a robot and answers questions."""

from collections.abc import Callable, Iterable

Answer = str | bool | Callable[[], str | bool]


class Builder:
    """An operator whose answers are given in advance.

    An answer that is callable runs when its turn comes, and its result is the answer.
    """

    def __init__(self, answers: Iterable[Answer] = (), absent: bool = False) -> None:
        self.absent = absent
        self.answers = list(answers)
        self.told: list[str] = []
        self.asked: list[str] = []

    def say(self, text: str) -> None:
        self.told.append(text)

    def ask(self, question: str) -> str:
        answer = self._next(question)
        assert isinstance(answer, str), f"{question!r} is no yes or no"
        return answer

    def agree(self, question: str) -> bool:
        answer = self._next(question)
        assert isinstance(answer, bool), f"{question!r} wants yes or no"
        return answer

    def _next(self, question: str) -> str | bool:
        self.asked.append(question)
        assert self.answers, f"no answer is scripted for {question!r}; told: {self.told}"
        answer = self.answers.pop(0)
        return answer() if callable(answer) else answer

    @property
    def all_told(self) -> str:
        return "\n".join(self.told)
