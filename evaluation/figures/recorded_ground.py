"""Runs without ground truth: the robot's own estimates and maps replace it."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from sextant.shared.geometry import Array, apply
from sextant.shared.recording.reader import Recording
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Plane
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, BodyPose, GroundTruth, TerrainMap

Frame = tuple[AnyTopic, bytes, int]  # topic, frame, time [ns]

NAME, SEED = "recorded", 0  # of the scenario that represents such a run
WORDS = "no ground truth: values called true are the robot's own estimates"
_LEAST = 0.1  # [m] least length of a course
_MAP_S = 2.0  # [s] between two maps that are kept


class MappedGround:
    """The ground by a robot's own maps, the newest on top."""

    def __init__(self, maps: Sequence[TerrainMap]):
        self._maps = tuple(reversed(maps))

    def height_at(self, xy: Array) -> Array:
        """Return heights (n,) [m] at (n, 2) [m] {world}; NaN where no map is known."""
        z = np.full(len(xy), np.nan)
        for known in self._maps:
            open_ = np.flatnonzero(np.isnan(z))
            if not len(open_):
                break
            i, j = np.round((xy[open_] - known.origin) / known.resolution).astype(np.int64).T
            inside = (i >= 0) & (j >= 0) & (i < known.elevation.shape[0]) & (j < known.elevation.shape[1])
            z[open_[inside]] = known.elevation[i[inside], j[inside]]
        return z


def ground_of(recording: Recording) -> MappedGround:
    """Return the ground of a recorded run by its own maps."""
    maps: list[TerrainMap] = []
    for _, message, _ in recording.messages((topics.TERRAIN,)):
        if isinstance(message, TerrainMap) and (not maps or message.stamp_ns - maps[-1].stamp_ns >= _MAP_S * 1e9):
            maps.append(message)
    return MappedGround(maps)


def scenario_of(recording: Recording, robot: str) -> Scenario:
    """Return a scenario for such a run; its goal is the estimated distance.

    The distance is the farthest x of the body relative to its first position.
    """
    x: list[float] = []
    for _, message, _ in recording.messages((topics.BODY_POSE,)):
        if isinstance(message, BodyPose):
            x.append(float(message.T_world_body[0, 3]))
    far = max(x, default=0.0) - (x[0] if x else 0.0)
    return Scenario(NAME, (Plane(),), Goal(max(far, _LEAST)), robot=robot, time_limit_s=1e6)


def with_truth(frames: Iterable[Frame], robot: str) -> Iterator[Frame]:
    """Yield all frames, and after each actuator state the truth it would imply.

    Raises:
        DecodeError: An actuator state or a pose that this version cannot read.
    """
    correction: Array | None = None  # T_world_odom
    for topic, frame, at_ns in frames:
        yield topic, frame, at_ns
        if topic is topics.BODY_POSE:
            correction = codec.decode(frame, BodyPose, topic.max_bytes)[0].T_world_odom
        elif topic is topics.ACTUATOR_STATE:
            state, _ = codec.decode(frame, ActuatorState, topic.max_bytes)
            T = (state.T_world_odom if correction is None else correction) @ state.T_odom_body
            yield topics.TRUTH, codec.encode(_truth(state, T, robot)), at_ns


def _truth(state: ActuatorState, T_world_body: Array, robot: str) -> GroundTruth:
    return GroundTruth(
        stamp_ns=state.stamp_ns,
        T_world_body=T_world_body,
        q=state.q,
        torque=state.load_nm,
        feet=apply(T_world_body, state.feet),
        contact=state.contact,
        carries_load=state.contact,
        shutdown=np.zeros((6, 3), dtype=np.bool_),
        voltage=state.voltage,
        temperature=state.temperature,
        scenario=NAME,
        seed=SEED,
        robot=robot,
    )
