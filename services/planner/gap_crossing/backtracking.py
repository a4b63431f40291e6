"""The way that a robot has come in a passage, to back off by from where nothing leads on."""

from collections.abc import Sequence

import numpy as np

from sextant.services.planner.gap_crossing.roadmap import PassageStep, Stance
from sextant.shared.geometry import Array

_BACK = 0.12  # [m] of the body's way
_OFTEN = 3  # at most in one passage


class Trail:
    """The steps of the newest section as they were walked, and how often the robot has gone back by them."""

    def __init__(self) -> None:
        """With nothing to go back by."""
        self._root: Stance | None = None
        self._steps: tuple[PassageStep, ...] = ()
        self._times = 0

    def begin(self, root: Stance, steps: tuple[PassageStep, ...]) -> None:
        """Follow a section from where it was planned."""
        self._root, self._steps = root, steps

    def ended(self, done: int) -> None:
        """So many steps of the section were walked."""
        self._steps = self._steps[:done]

    def back(self, gone: Sequence[Array], radius: float) -> tuple[PassageStep, ...]:
        """The way back, until the body has gone far enough for other steps; nothing where there is none, or it was gone often.

        What was tested of a step holds of the same step backward: its stances, its reach, its swing between the same ends.

        Args:
            gone: (3,) [m] {strip} places that carry nothing any more: the way ends before a foot gets there.
            radius: [m] around them.
        """
        if self._root is None or not self._steps or self._times == _OFTEN:
            return ()
        feet, body, way = self._root.feet.copy(), self._root.body, list[PassageStep]()
        for step in self._steps:
            place = feet[step.leg].copy() if step.leg >= 0 else body
            way.append(PassageStep(step.leg, place, step.clearance, body, step.margin))
            if step.leg >= 0:
                feet[step.leg] = step.touchdown
            body = step.body
        back = list[PassageStep]()
        for step in reversed(way):
            if step.leg >= 0 and any(np.hypot(*(step.touchdown - place)[:2]) < radius for place in gone):
                break
            back.append(step)
            if step.body[0] <= body[0] - _BACK:
                break
        self._root, self._steps, self._times = None, (), self._times + 1
        return tuple(back)
