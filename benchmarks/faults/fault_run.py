"""Base of fault runs: a monitored walk over level ground, in lockstep or live."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from benchmarks.faults.bus_log import Goals, Outside, Recorder, Switch, WireLog
from benchmarks.faults.cases import Case
from benchmarks.faults.pulse_log import PulseRecorder
from benchmarks.faults.timeline import STALE_S, Status, Timeline, Truth, Word
from sextant.shared.errors import SextantError
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.lockstep import ServiceFailedError
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Plane
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, GroundTruth, Mode

SCENARIO = Scenario("faults", (Plane(),), Goal(12.0), time_limit_s=600.0)
STEADY_S = 0.5  # [s] of walking before a fault,
PHASES_S = 2.0  # [s] and the maximum of a random additional time: more than two steps
LEAST_WATCH_S = 3.0
REPEAT_S = 0.5  # [s] between an order and its repetition


class NoWalkError(SextantError, RuntimeError):
    """The robot does not walk although no fault was injected."""

    exit_status = 1


@dataclass(frozen=True, slots=True)
class Mark:
    """Number of messages received by a time."""

    word: int
    truth: int
    goal: int
    switch: int
    outside: int


@dataclass(frozen=True, slots=True)
class Received:
    """Messages received since a mark, as in a timeline."""

    words: tuple[Word, ...]
    truth: Truth
    goals: tuple[Goals, ...]
    switches: tuple[Switch, ...]
    outside: tuple[Outside, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Results known to the code that injected the fault, as in a timeline."""

    end_s: float
    pulls: NDArray[np.bool_]
    servo: int = -1
    ordered_s: float = np.nan
    returned_s: float = np.nan
    empty_s: float = np.nan
    plans: int = 0
    walked: int = 0
    voltage: float = np.nan
    lost_s: float = np.nan
    stuck: str = ""
    statuses: tuple[Status, ...] = ()
    place_m: float = np.nan
    ended: str = ""


class FaultRun(ABC):
    """A monitored walk: received messages, and waiting for the robot to walk."""

    start_s: float  # timeout [s] for the start of a walk
    phases_s = PHASES_S

    def __init__(self, case: Case, robot: str = SCENARIO.robot):
        """Start without messages.

        Args:
            case: The fault to inject.
            robot: Robot profile by name, or path of a TOML file.
        """
        self.profile = load_profile(robot)
        self.recorder: WireLog = Recorder(self.profile) if self.profile.servo.pulses is None else PulseRecorder(self.profile)
        self.words: list[Word] = []
        self.state: ActuatorState | None = None
        self._case = case
        self._truth: list[GroundTruth] = []

    @property
    @abstractmethod
    def now_s(self) -> float:
        """Time [s]."""

    @abstractmethod
    def look(self, until_s: float = float("inf")) -> None:
        """Wait for at most one interval."""

    @abstractmethod
    def break_and_watch(self, begin: float, rng: np.random.Generator) -> Observed:
        """Inject the faults of the case at `begin` [s].

        Observe until the robot walks again, or for the time given by the case.
        """

    def last_words(self) -> str:
        """Return the last output of the other processes, to explain why it does not walk."""
        return ""

    def inject(self, number: int) -> Timeline:
        """Walk until a phase given by the number, inject the fault, and observe.

        The observation ends when the robot walks again.

        Raises:
            NoWalkError: The robot does not walk without a fault.
        """
        rng = np.random.default_rng([crc32(self._case.name.encode()), number])
        steady_s = 0.0 if self._case.ends_the_walk else STEADY_S  # a fault in a copy has not affected this walk
        self.walk_for(steady_s + self.phases_s * rng.random())
        return self.what_happens(rng)

    def what_happens(self, rng: np.random.Generator) -> Timeline:
        """Inject the fault now, and observe until the robot walks again."""
        mark, begin = self.mark(), self.now_s
        assert self.state is not None
        phase = self.state.phase
        seen = self.break_and_watch(begin, rng)
        heard = self.since(mark)
        return Timeline(
            begin_s=begin,
            phase=phase,
            words=heard.words,
            truth=heard.truth,
            goals=heard.goals,
            switches=heard.switches,
            outside=heard.outside,
            end_s=seen.end_s,
            servo=seen.servo,
            pulls=seen.pulls,
            ordered_s=seen.ordered_s,
            returned_s=seen.returned_s,
            empty_s=seen.empty_s,
            plans=seen.plans,
            walked=seen.walked,
            voltage=seen.voltage,
            lost_s=seen.lost_s,
            stuck=seen.stuck,
            statuses=seen.statuses,
            place_m=seen.place_m,
            ended=seen.ended,
        )

    @abstractmethod
    def __enter__(self) -> Self:
        """Start the walk."""

    @abstractmethod
    def __exit__(self, *_: object) -> None:
        """Clean up."""

    @property
    def walks(self) -> bool:
        """Whether the robot walks on its plans without problems, by a recent state."""
        walking = self.state is not None and self.state.mode is Mode.WALK and self.state.reason == "walking"
        return walking and self.now_s - self.words[-1].t_s < STALE_S

    def walk_for(self, length_s: float) -> None:
        """Wait for `length_s` of walking without a stop, and until the robot walks.

        Raises:
            NoWalkError: The robot does not walk without a fault.
        """
        since, patience = self.now_s, self.now_s + self.start_s + length_s
        while self.now_s < since + length_s or not self.walks:
            if self.now_s > patience:
                said = f"{self.state.mode}: {self.state.reason}" if self.state else "nothing"
                words = f"a walk within {self.start_s:.0f} s expected before {self._case.name}, the actuator reports {said}"
                raise NoWalkError(words + self.last_words())
            self.look()
            if not self.walks:
                since = self.now_s

    def mark(self) -> Mark:
        """Return the number of messages received so far."""
        kept = self.recorder
        return Mark(len(self.words), len(self._truth), len(kept.goals), len(kept.switches), len(kept.outside))

    def since(self, mark: Mark) -> Received:
        """Return the messages received since a mark.

        The last state, truth and goals before it are included.
        """
        kept = self.recorder
        return Received(
            words=tuple(self.words[max(mark.word - 1, 0) :]),
            truth=_as_arrays(self._truth[max(mark.truth - 1, 0) :]),
            goals=tuple(kept.goals[max(mark.goal - 1, 0) :]),
            switches=tuple(kept.switches[mark.switch :]),
            outside=tuple(kept.outside[mark.outside :]),
        )

    def hear_state(self, frame: bytes, at_ns: int | None = None) -> None:
        """Process an actuator state with its time [ns], by default its stamp."""
        self.state = codec.decode(frame, topics.ACTUATOR_STATE.type)[0]
        at = self.state.stamp_ns if at_ns is None else at_ns
        self.words.append(Word(at * 1e-9, self.state.mode, self.state.reason, self.state.warnings))

    def hear_truth(self, frame: bytes) -> None:
        """Process a ground truth message."""
        self._truth.append(codec.decode(frame, topics.TRUTH.type)[0])


def in_walks(
    case: Case, numbers: tuple[int, ...], begin: Callable[[Case, int], FaultRun]
) -> list[tuple[int, int, Timeline, RobotProfile]]:
    """Inject a fault several times, in one walk while the robot keeps walking.

    Args:
        case: The fault.
        numbers: Each determines a phase.
        begin: Creates a walk from a seed.

    Returns:
        For each number: the number, the seed of its walk, the timeline, and the robot.

    Raises:
        NoWalkError: The robot does not walk before any fault.
    """
    found: list[tuple[int, int, Timeline, RobotProfile]] = []
    left = deque(numbers)
    while left:
        seed = 1000 + left[0]
        with begin(case, seed) as walk:
            found.append((left[0], seed, walk.inject(left[0]), walk.profile))
            left.popleft()
            while left and (walk.walks or case.lets_go):
                try:
                    line = walk.inject(left[0])
                except (NoWalkError, ServiceFailedError) as error:
                    number, _, last, profile = found.pop()
                    found.append((number, seed, replace(last, stuck=str(error)), profile))
                    break
                found.append((left.popleft(), seed, line, walk.profile))
    return found


def _as_arrays(truth: list[GroundTruth]) -> Truth:
    return Truth(
        t=np.array([m.stamp_ns for m in truth]) * 1e-9,
        q=np.array([m.q for m in truth]),
        feet=np.array([m.feet for m in truth]),
        contact=np.array([m.contact for m in truth], dtype=np.bool_),
        body=np.array([m.T_world_body for m in truth]),
        shutdown=np.array([m.shutdown for m in truth], dtype=np.bool_),
    )
