"""Timeline of one fault: received messages and ground truth as arrays."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.faults.bus_log import Goals, Outside, Switch
from sextant.shared.geometry import Array
from sextant.shared.wire.messages import Mode

STALE_S = 0.25  # [s] without a message after which an actuator does not count as walking


class Word(NamedTuple):
    """An actuator state and its time."""

    t_s: float
    mode: Mode
    reason: str
    warnings: tuple[str, ...] = ()


class Status(NamedTuple):
    """A planner's state, its reason, and the time."""

    t_s: float
    state: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Ground truth of the robot, one row per sample."""

    t: Array  # (n,) [s]
    q: Array  # (n, 6, 3) [rad]
    feet: Array  # (n, 6, 3) [m] {world} centres
    contact: NDArray[np.bool_]  # (n, 6)
    body: Array  # (n, 4, 4) {world}
    shutdown: NDArray[np.bool_]  # (n, 6, 3)


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """One injection, from its start to the end of the observation."""

    begin_s: float
    end_s: float  # end of the fault
    servo: int  # ID of the random servo, -1 for none
    phase: float  # phase of the step at the start
    words: tuple[Word, ...]  # the first is the newest before the start
    truth: Truth
    goals: tuple[Goals, ...]
    switches: tuple[Switch, ...]
    outside: tuple[Outside, ...]
    pulls: NDArray[np.bool_]  # (18,) servos with torque on at the end
    ordered_s: float = np.nan  # time of the torque-off order
    returned_s: float = np.nan  # time when bus and actuator were available again to execute it, if they were not
    empty_s: float = np.nan  # time when the battery was empty
    plans: int = 0  # number of fuzzed plans
    walked: int = 0  # minimum number of executed ones: only the last of each cycle is reported
    voltage: float = np.nan  # [V] at the end
    lost_s: float = np.nan  # duration missing at the end of a recording, before its recorder was killed
    stuck: str = ""  # why it did not walk on afterwards, or empty
    statuses: tuple[Status, ...] = ()  # of the planner, on a course
    place_m: float = np.nan  # [m] change of the error of the estimated position, on a course
    ended: str = ""  # "walks", "arrived", "stands" or "fell", on a course
