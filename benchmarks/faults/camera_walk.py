"""Injection of a fault of the camera into a walk over a course, in lockstep."""

from collections import deque
from dataclasses import replace

import numpy as np

from benchmarks.faults.cases import Case, OnCamera
from benchmarks.faults.fault_run import SCENARIO, Observed
from benchmarks.faults.lockstep_walk import FaultWalk
from benchmarks.faults.timeline import Status
from sextant.shared.runtime.lockstep import ServiceFailedError
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Fault
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import BodyPose

_LASTING_S = 1e5  # [s] duration of a fault that does not end
_WALKED_S = 3.0  # [s] of walking after which the robot walks again
_PHASES_S = 10.0  # [s] maximum time of walking between two injections: two of them fit on a course


class CameraWalk(FaultWalk):
    """A walk in lockstep over a course; its copies have the fault."""

    phases_s = _PHASES_S
    listens_to = (*FaultWalk.listens_to, topics.PLANNER_STATUS, topics.BODY_POSE)

    def __init__(self, case: Case, seed: int, robot: str = SCENARIO.robot):
        """Assemble the walk; see `FaultWalk`."""
        self.scenario = replace(load_scenario(case.course), time_limit_s=600.0)
        self._statuses: list[Status] = []
        self._pose: BodyPose | None = None
        super().__init__(case, seed, robot)

    def break_and_watch(self, begin: float, rng: np.random.Generator) -> Observed:
        """Inject the fault, and observe until the robot walks again or arrives, at most for the time of the case."""
        case = self._case
        for deed in case.deeds:
            assert isinstance(deed, OnCamera)
            if isinstance(deed.what, str):
                for_s = deed.for_s if case.watch_s else _LASTING_S
                self._simulator.disturb(Fault(begin, "camera", deed.what, for_s=for_s))
            else:
                self._simulator.disturb(replace(deed.what, start_s=begin))
        end, before, said = begin + case.for_s, self._place_error(), len(self._statuses)
        last, walked = end + case.watch_s, deque([begin])
        attendance = self._run.attendance
        try:
            while self.now_s < last and not attendance.over():
                self.look(last)
                if not self.walks:
                    walked[0] = self.now_s
                if self.now_s - max(walked[0], end) >= _WALKED_S:
                    break
        except ServiceFailedError as error:
            self._failed = str(error)
        operator = attendance.operator
        arrived = operator.finished and operator.reason.startswith("at the goal")
        if operator.finished and not arrived:
            self._statuses.append(Status(self.now_s, "over", operator.reason))
        ended = "arrived" if arrived else "walks" if self.walks else "stands"
        if attendance.scorer.reason.startswith("fell"):
            ended = "fell"
        return Observed(
            end_s=end,
            pulls=np.zeros(18, dtype=np.bool_),
            stuck=self._failed,
            statuses=tuple(self._statuses[max(said - 1, 0) :]),
            place_m=float(np.linalg.norm(self._place_error() - before)),
            ended=ended,
        )

    def _place_error(self) -> np.ndarray:
        """Return the estimated minus the true position (3,) [m] of the body."""
        if self._pose is None or self.state is None:
            return np.zeros(3)
        T_world_body = self._pose.T_world_odom @ self.state.T_odom_body
        return np.asarray(T_world_body[:3, 3] - self._truth[-1].T_world_body[:3, 3])

    def _hear(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        super()._hear(topic, frame, at_ns)
        if topic is topics.PLANNER_STATUS:
            status = codec.decode(frame, topics.PLANNER_STATUS.type)[0]
            self._statuses.append(Status(at_ns * 1e-9, status.state, status.reason))
        elif topic is topics.BODY_POSE:
            self._pose = codec.decode(frame, topics.BODY_POSE.type)[0]
