"""What was heard and truly happened around one fault, as arrays: what the scoring goes by."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.deploy.faults.wire import Goals, Outside, Switch
from sextant.shared.geometry import Array
from sextant.shared.wire.messages import Mode

STALE_S = 0.25  # [s] after which an actuator that says nothing is not known to walk


class Word(NamedTuple):
    """What the actuator said at a time."""

    t_s: float
    mode: Mode
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The robot as it truly was, a row per sample."""

    t: Array  # (n,) [s]
    q: Array  # (n, 6, 3) [rad]
    feet: Array  # (n, 6, 3) [m] {world} centres
    contact: NDArray[np.bool_]  # (n, 6)
    body: Array  # (n, 4, 4) {world}
    shutdown: NDArray[np.bool_]  # (n, 6, 3)


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """One injection, from its beginning until it was watched no more."""

    begin_s: float
    end_s: float  # of the fault
    servo: int  # that was drawn, -1 for none
    phase: float  # of the step, at the beginning
    words: tuple[Word, ...]  # the newest before the beginning is the first of them
    truth: Truth
    goals: tuple[Goals, ...]
    switches: tuple[Switch, ...]
    outside: tuple[Outside, ...]
    pulls: NDArray[np.bool_]  # (18,) servos whose torque was on in the end
    ordered_s: float = np.nan  # when torque was ordered off
    returned_s: float = np.nan  # when bus and actuator were there again to do so, if they were not
    empty_s: float = np.nan  # when the battery was
    plans: int = 0  # that were fuzzed
    walked: int = 0  # of them, at least: of those of one cycle the last is heard of
    voltage: float = np.nan  # [V] in the end
    lost_s: float = np.nan  # of a recording, before its recorder was killed
    stuck: str = ""  # why it did not walk on for long afterwards, in words, or nothing
