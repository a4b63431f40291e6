"""Backtracking: return from a dead end by the steps of the crossing so far."""

from collections.abc import Sequence

import numpy as np

from sextant.services.planner.roadmap.roadmap import PassageStep, Stance
from sextant.shared.geometry import Array

_BACK = 0.12  # [m] of body travel
_OFTEN = 3  # maximum number of returns in one crossing


class StepHistory:
    """Executed steps of the last section, and the number of returns."""

    def __init__(self) -> None:
        """Start without steps."""
        self._root: Stance | None = None
        self._steps: tuple[PassageStep, ...] = ()
        self._times = 0

    def begin(self, root: Stance, steps: tuple[PassageStep, ...]) -> None:
        """Start to record a section from its first stance."""
        self._root, self._steps = root, steps

    def ended(self, done: int) -> None:
        """Keep only the number of steps that were executed."""
        self._steps = self._steps[:done]

    def back(self, gone: Sequence[Array], radius: float) -> tuple[PassageStep, ...]:
        """Return the steps back, until the body is far enough away to try other steps.

        Return no steps if there are none or the limit of returns is reached. The tests of a step also hold for its reverse: it
        has the same stances, the same reach, and a swing between the same ends.

        Args:
            gone: (3,) [m] {strip} places that no longer carry a foot; the return ends before a foot would step there.
            radius: [m] around them.
        """
        if self._root is None or not self._steps or self._times == _OFTEN:
            return ()
        feet, body, yaw, way = self._root.feet.copy(), self._root.body, self._root.yaw, list[PassageStep]()
        for step in self._steps:
            place = feet[step.leg].copy() if step.leg >= 0 else body
            way.append(PassageStep(step.leg, place, step.clearance, body, step.margin, yaw))
            if step.leg >= 0:
                feet[step.leg] = step.touchdown
            body, yaw = step.body, step.yaw
        back = list[PassageStep]()
        for step in reversed(way):
            if step.leg >= 0 and any(np.hypot(*(step.touchdown - place)[:2]) < radius for place in gone):
                break
            back.append(step)
            if step.body[0] <= body[0] - _BACK:
                break
        self._root, self._steps, self._times = None, (), self._times + 1
        return tuple(back)
