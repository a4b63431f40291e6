"""Timeline of a recorded run: poses, plans and states at each moment.

The robot is drawn at its true pose if the simulator recorded it; no service that steers it receives that pose. Otherwise it is
drawn at its estimated pose.
"""

import bisect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from sextant.shared.errors import SextantError
from sextant.shared.geometry import Array, apply, interpolate, inverse
from sextant.shared.recording.reader import Recording
from sextant.shared.wire import topics
from sextant.shared.wire.messages import (
    ActuatorState,
    BodyPose,
    CameraState,
    GroundTruth,
    Message,
    Odometry,
    PlannerStatus,
    StepPlan,
    TerrainMap,
)

M = TypeVar("M", bound=Message)
_HEARD = (
    topics.TRUTH,
    topics.ACTUATOR_STATE,
    topics.ODOMETRY,
    topics.BODY_POSE,
    topics.STEP_PLAN,
    topics.PLANNER_STATUS,
    topics.CAMERA_STATE,
)
_FOR_CONTACT_NS = 40_000_000  # [ns] to both sides: scraping feet hop briefly and still carry
_SPEED_OVER_NS = 1_000_000_000  # [ns] to both sides
_FRESH_NS = 2_000_000_000  # [ns] for which a message is valid


class Track(Generic[M]):
    """Messages of one topic in order of arrival."""

    def __init__(self) -> None:
        self.at_ns: list[int] = []  # [ns] when each was recorded
        self.said: list[M] = []

    def add(self, message: M, at_ns: int) -> None:
        """Append a message."""
        self.at_ns.append(at_ns)
        self.said.append(message)

    def __len__(self) -> int:
        return len(self.said)

    def newest(self, t_ns: int, fresh_for_ns: int | None = None) -> M | None:
        """Return the newest message at a time; None if it is too old or missing."""
        k = bisect.bisect_right(self.at_ns, t_ns) - 1
        if k < 0 or (fresh_for_ns is not None and t_ns - self.at_ns[k] > fresh_for_ns):
            return None
        return self.said[k]

    def between(self, from_ns: int, to_ns: int) -> list[M]:
        """Return the messages between two times."""
        return self.said[bisect.bisect_left(self.at_ns, from_ns) : bisect.bisect_right(self.at_ns, to_ns)]

    def by_stamp(self) -> None:
        """Reorder messages by stamp, and shift their times by the median latency."""
        if self.said:
            late = int(np.median([at - m.stamp_ns for at, m in zip(self.at_ns, self.said, strict=True)]))
            order = sorted(range(len(self.said)), key=lambda k: self.said[k].stamp_ns)
            self.said = [self.said[k] for k in order]
            self.at_ns = [m.stamp_ns + late for m in self.said]

    def around(self, t_ns: int) -> tuple[M, M, float]:
        """Return the messages before and after a time, and the fraction between them.

        At the ends it is the last one, twice.
        """
        k = bisect.bisect_right(self.at_ns, t_ns)
        if k == 0 or k == len(self.said):
            only = self.said[0 if k == 0 else -1]
            return only, only, 0.0
        before, after = self.at_ns[k - 1], self.at_ns[k]
        return self.said[k - 1], self.said[k], (t_ns - before) / max(after - before, 1)


@dataclass(frozen=True, slots=True)
class Moment:
    """The run at one time.

    {scene} is the simulator's world if the truth is drawn, otherwise {world}.
    """

    time_s: float  # [s] since the recording began
    T_scene_body: Array  # (4, 4)
    T_scene_world: Array  # (4, 4) aligns the robot's estimate with the scene
    q: Array  # (6, 3) [rad]
    carries: NDArray[np.bool_]  # (6,)
    speed: float  # [m/s]
    mode: str  # of the actuator; empty before its first state
    planner: str  # state of the planner; empty before its first status
    trouble: str  # why it waits or refuses; empty if it goes on
    footholds: Array  # (n, 3) [m] {scene} planned foot centres
    footholds_world: Array  # (n, 3) [m] {world}
    path: Array  # (m, 2) [m] {world} corners of the path to the goal

    @property
    def T_world_body(self) -> Array:
        """The estimated pose (4, 4)."""
        return inverse(self.T_scene_world) @ self.T_scene_body


class TimelineError(SextantError, ValueError):
    """A recording that cannot be drawn."""


@dataclass(slots=True)
class Timeline:
    """All messages that are drawn, except the maps, which need too much memory."""

    truth: Track[GroundTruth] = field(default_factory=Track)
    actuator: Track[ActuatorState] = field(default_factory=Track)
    odometry: Track[Odometry] = field(default_factory=Track)
    poses: Track[BodyPose] = field(default_factory=Track)
    plans: Track[StepPlan] = field(default_factory=Track)
    planner: Track[PlannerStatus] = field(default_factory=Track)
    camera: Track[CameraState] = field(default_factory=Track)
    true: bool = True  # whether the robot is drawn at its true, not its estimated, pose
    began_ns: int = 0
    ended_ns: int = 0

    @classmethod
    def read(cls, recording: Recording) -> "Timeline":
        """Read a recording; a truncated one up to its end.

        Raises:
            TimelineError: It does not contain a robot.
        """
        story = cls()
        tracks: dict[str, Track[Any]] = {
            topics.TRUTH.key: story.truth,
            topics.ACTUATOR_STATE.key: story.actuator,
            topics.ODOMETRY.key: story.odometry,
            topics.BODY_POSE.key: story.poses,
            topics.STEP_PLAN.key: story.plans,
            topics.PLANNER_STATUS.key: story.planner,
            topics.CAMERA_STATE.key: story.camera,
        }
        for topic, message, at_ns in recording.messages(_HEARD):
            tracks[topic.key].add(message, at_ns)
        for track in (story.truth, story.actuator, story.odometry, story.poses):
            track.by_stamp()
        if not (len(story.truth) or len(story.actuator)):
            words = "it has neither simulator/truth nor actuator/state, so the positions of the legs are unknown"
            raise TimelineError(f"{recording.path}: nothing to draw: {words}; `sextant recording info` lists its topics")
        story.draw_truth(bool(len(story.truth)))
        return story

    def draw_truth(self, true: bool) -> None:
        """Choose whether to draw the robot at its true or its estimated pose."""
        self.true = true
        track: Track[Any] = self.truth if true else self.actuator
        self.began_ns, self.ended_ns = track.at_ns[0], track.at_ns[-1]

    def feet_off(self, height_at: Callable[[Array], Array], radius: float) -> float:
        """Return the median distance [m] of loaded feet from a ground, by the truth.

        `radius` is the foot radius [m]; the result is 0 if no foot is loaded.
        """
        feet = [m.feet[m.contact] for m in self.truth.said[::10]]
        standing = np.concatenate(feet) if feet else np.zeros((0, 3))
        if not len(standing):
            return 0.0
        off = np.abs(standing[:, 2] - radius - height_at(standing[:, :2]))
        return float(np.median(np.minimum(off, 1.0)))

    @property
    def duration_s(self) -> float:
        """Duration of the recording [s]."""
        return (self.ended_ns - self.began_ns) * 1e-9

    def pose(self, t_ns: int) -> Array:
        """Return T_scene_body (4, 4)."""
        if self.true:
            before, after, s = self.truth.around(t_ns)
            return interpolate(before.T_world_body, after.T_world_body, s)
        return self.believed(t_ns)

    def believed(self, t_ns: int) -> Array:
        """Return the robot's estimate of T_world_body (4, 4)."""
        T = np.eye(4)
        if len(self.odometry):
            one, other, s = self.odometry.around(t_ns)
            T = interpolate(one.T_odom_body, other.T_odom_body, s)
        elif len(self.actuator):
            before, after, s = self.actuator.around(t_ns)
            T = interpolate(before.T_odom_body, after.T_odom_body, s)
        if not len(self.poses):
            return T
        earlier, later, s = self.poses.around(t_ns)
        return interpolate(earlier.T_world_odom, later.T_world_odom, s) @ T

    def moment(self, t_ns: int) -> Moment:
        """Return the run at a time [ns]."""
        T_scene_body = self.pose(t_ns)
        T_world_body = self.believed(t_ns)
        state = self.actuator.newest(t_ns)
        status = self.planner.newest(t_ns, _FRESH_NS)
        q, carries = self._legs(t_ns)
        footholds, footholds_world = self._footholds(t_ns)
        far = self.pose(t_ns + _SPEED_OVER_NS)[:2, 3] - self.pose(t_ns - _SPEED_OVER_NS)[:2, 3]
        over_ns = min(t_ns + _SPEED_OVER_NS, self.ended_ns) - max(t_ns - _SPEED_OVER_NS, self.began_ns)
        return Moment(
            time_s=(t_ns - self.began_ns) * 1e-9,
            T_scene_body=T_scene_body,
            T_scene_world=T_scene_body @ inverse(T_world_body),
            q=q,
            carries=carries,
            speed=float(np.linalg.norm(far)) / max(over_ns * 1e-9, 1e-9),
            mode="" if state is None else state.mode.value,
            planner="" if status is None else status.state,
            trouble=self._trouble(t_ns, state, status),
            footholds=footholds,
            footholds_world=footholds_world,
            path=np.zeros((0, 2)) if status is None else status.path,
        )

    def _legs(self, t_ns: int) -> tuple[Array, NDArray[np.bool_]]:
        track: Track[Any] = self.truth if self.true else self.actuator
        before, after, s = track.around(t_ns)
        told = "carries_load" if self.true else "contact"
        carries = np.array(getattr(before, told))
        for message in track.between(t_ns - _FOR_CONTACT_NS, t_ns + _FOR_CONTACT_NS):
            carries |= getattr(message, told)
        return (1.0 - s) * before.q + s * after.q, carries

    def _footholds(self, t_ns: int) -> tuple[Array, Array]:
        """Return the next touchdowns (n, 3) [m] in {scene} and {world}.

        They are those of the current and of the next step.
        """
        state = self.actuator.newest(t_ns, _FRESH_NS)
        none = np.zeros((0, 3))
        if state is None or state.mode.value != "walk":
            return none, none
        ahead: dict[int, StepPlan] = {}
        for plan in self.plans.between(t_ns - _FRESH_NS, t_ns):
            if plan.step >= state.step and plan.epoch == state.epoch:
                ahead[plan.step] = plan  # the newest revision
        scene, world = [none], [none]
        for plan in ahead.values():
            if plan.step == state.step and state.phase >= 1.0:
                continue
            world.append(plan.touchdown[plan.swing])
            scene.append(apply(self._laid(plan), plan.touchdown[plan.swing]))
        return np.concatenate(scene), np.concatenate(world)

    def _laid(self, plan: StepPlan) -> Array:
        """Return T_scene_world for a plan.

        Its footholds are relative to the odometry pose when the plan was made.
        """
        if not self.true or not len(self.odometry):
            return np.eye(4)
        one, other, s = self.odometry.around(plan.stamp_ns)
        before, after, s_true = self.truth.around(plan.stamp_ns)
        T_odom_body = interpolate(one.T_odom_body, other.T_odom_body, s)
        T_scene_body = interpolate(before.T_world_body, after.T_world_body, s_true)
        return T_scene_body @ inverse(T_odom_body) @ inverse(plan.T_world_odom)

    def _trouble(self, t_ns: int, state: ActuatorState | None, status: PlannerStatus | None) -> str:
        camera = self.camera.newest(t_ns, _FRESH_NS)
        if state is not None and state.mode.value == "fault":
            return f"actuator: {state.reason}"
        if camera is not None and not camera.ok:
            return f"camera: {camera.reason}"
        if status is not None and status.state in ("waiting", "blocked"):
            return f"planner {status.state}: {status.reason}"
        if state is not None and state.plan_refusal:
            return f"actuator refuses the plan: {state.plan_refusal}"
        return ""


class Maps:
    """Iterates over the maps of a recording as time advances."""

    def __init__(self, recording: Recording):
        self._coming: Iterator[Any] = iter(recording.messages((topics.TERRAIN,)))
        self._next: tuple[TerrainMap, int] | None = self._take()
        self.newest: TerrainMap | None = None

    def until(self, t_ns: int) -> TerrainMap | None:
        """Return the newest map at a time; None before the first. Times must not decrease."""
        while self._next is not None and self._next[1] <= t_ns:
            self.newest = self._next[0]
            self._next = self._take()
        return self.newest

    def _take(self) -> tuple[TerrainMap, int] | None:
        for _, message, at_ns in self._coming:
            if isinstance(message, TerrainMap):
                return message, at_ns
        return None


def trail(story: Timeline, t_ns: Sequence[int]) -> Array:
    """Return T_scene_body (n, 4, 4) at times [ns]."""
    return np.array([story.pose(t) for t in t_ns]).reshape(-1, 4, 4)
