"""Topic table: key, type, rate, delivery, lane, size limit and latency per topic.

Lockstep delays each message by `latency_s`: the time from the start of the step that makes it to its receipt, including
computation. The defaults are 99th percentiles of live runs on two cores: of one run of `steps` on a quiet machine (version
0.1.0, November 2026) for depth images, odometry, state, pose, scans, maps, step plans and planner status; of five runs, the
median, for the others. `sextant run steps --json` prints these percentiles under stages_ms. Topics that such a run does not
carry (colour, IMU) or does not time (health) have the latency of a similar topic.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import numpy as np

from sextant.shared import spelling
from sextant.shared.wire import messages as m

M = TypeVar("M", bound=m.Message)
ROLE_NAMES = ("robot", "base", "console", "viewer", "site")  # of machines, by certificate (`sextant.shared.wire.access`)


class Delivery(Enum):
    """Delivery of a topic.

    LATEST keeps only the newest message (state). EVERY keeps all messages in order (events, increments).
    """

    LATEST = "latest"
    EVERY = "every"


class Lane(Enum):
    """Lane of a topic.

    Each lane has its own session, so a large frame never delays a command.
    """

    BULK = "bulk"
    CONTROL = "control"


@dataclass(frozen=True, slots=True, eq=False)  # two rows differ; a hash of all fields would cost more than most look-ups
class Topic(Generic[M]):
    """One row of the topic table."""

    key: str
    type: type[M]
    rate_hz: float
    delivery: Delivery
    lane: Lane
    max_bytes: int  # larger frames are refused without decoding
    latency_s: float
    more: str = ""  # what is sent besides `rate_hz`, as text

    @property
    def fresh_for_ns(self) -> int:
        """Age [ns] from which a message is stale: three periods."""
        return int(3e9 / self.rate_hz)

    @property
    def rate(self) -> str:
        """Rate as text, such as "25 Hz and at each change"."""
        return f"{self.rate_hz:g} Hz{self.more}"

    def address(self, namespace: str) -> str:
        """Return the key with a robot's namespace as its prefix.

        Every frame carries this address (`sextant.shared.wire.transport`).
        """
        return f"{namespace}/{self.key}"


_KIB = 1024
_CHANGES = " and at each change"

DEPTH = Topic("camera/depth", m.DepthImage, 30.0, Delivery.LATEST, Lane.BULK, 4496 * _KIB, 0.008)
COLOR = Topic("camera/color", m.ColorImage, 5.0, Delivery.LATEST, Lane.BULK, 8192 * _KIB, 0.015)
CAMERA_STATE = Topic("camera/state", m.CameraState, 4.0, Delivery.LATEST, Lane.CONTROL, 16 * _KIB, 0.003)
PREVIEW = Topic("camera/preview", m.Preview, 5.0, Delivery.LATEST, Lane.BULK, 300 * _KIB, 0.010)
IMU = Topic("imu", m.Imu, 100.0, Delivery.EVERY, Lane.CONTROL, 2 * _KIB, 0.003)
ODOMETRY = Topic("actuator/odometry", m.Odometry, 50.0, Delivery.EVERY, Lane.CONTROL, 4 * _KIB, 0.017)
ACTUATOR_STATE = Topic("actuator/state", m.ActuatorState, 25.0, Delivery.LATEST, Lane.CONTROL, 64 * _KIB, 0.019, _CHANGES)
HORN_ERRORS = Topic("actuator/horns", m.HornErrors, 5.0, Delivery.LATEST, Lane.CONTROL, 4 * _KIB, 0.003)
BODY_POSE = Topic("perception/pose", m.BodyPose, 15.0, Delivery.LATEST, Lane.CONTROL, 8 * _KIB, 0.015)
EXTERNAL_POSE = Topic("external/pose", m.ExternalPose, 30.0, Delivery.LATEST, Lane.CONTROL, 4 * _KIB, 0.004)
EXTERNAL_DEPTH = Topic("external/depth", m.ExternalDepth, 30.0, Delivery.LATEST, Lane.BULK, 4496 * _KIB, 0.008)
CAMERA_ERRORS = Topic("perception/camera", m.CameraErrors, 2.0, Delivery.LATEST, Lane.CONTROL, 4 * _KIB, 0.003)
FLOOR = Topic("perception/floor", m.FloorView, 10.0, Delivery.LATEST, Lane.CONTROL, 16 * _KIB, 0.015)
SCAN = Topic("perception/scan", m.Scan, 15.0, Delivery.LATEST, Lane.BULK, 128 * _KIB, 0.018)
SCAN_RECEIPT = Topic("mapper/receipt", m.ScanReceipt, 15.0, Delivery.LATEST, Lane.CONTROL, 1 * _KIB, 0.004)
TERRAIN = Topic("mapper/terrain", m.TerrainMap, 15.0, Delivery.LATEST, Lane.BULK, 8192 * _KIB, 0.030)
PASSAGE_REQUEST = Topic("passage/request", m.PassageRequest, 2.0, Delivery.LATEST, Lane.CONTROL, 2 * _KIB, 0.004)
PASSAGE = Topic("mapper/passage", m.PassageMap, 2.0, Delivery.LATEST, Lane.BULK, 2048 * _KIB, 0.090)
PASSAGE_PLAN = Topic("planner/passage", m.PassagePlan, 2.0, Delivery.EVERY, Lane.BULK, 512 * _KIB, 0.012)
STEP_PLAN = Topic("planner/step", m.StepPlan, 20.0, Delivery.EVERY, Lane.CONTROL, 8 * _KIB, 0.022)
PLANNER_STATUS = Topic("planner/status", m.PlannerStatus, 10.0, Delivery.LATEST, Lane.CONTROL, 16 * _KIB, 0.021)
VELOCITY = Topic("operator/velocity", m.VelocityCommand, 20.0, Delivery.LATEST, Lane.CONTROL, 2 * _KIB, 0.004)
GOAL = Topic("operator/goal", m.Goal, 5.0, Delivery.LATEST, Lane.CONTROL, 4 * _KIB, 0.004)
POSTURE = Topic("operator/posture", m.PostureCommand, 5.0, Delivery.LATEST, Lane.CONTROL, 2 * _KIB, 0.004)
CALIBRATION = Topic("operator/calibration", m.CalibrationState, 2.0, Delivery.LATEST, Lane.CONTROL, 16 * _KIB, 0.003)
MODE = Topic("operator/mode", m.ModeCommand, 2.0, Delivery.EVERY, Lane.CONTROL, 2 * _KIB, 0.003)
STOP = Topic("operator/stop", m.StopOrder, 2.0, Delivery.EVERY, Lane.CONTROL, 2 * _KIB, 0.003)
RECORD = Topic("operator/record", m.RecordCommand, 1.0, Delivery.EVERY, Lane.CONTROL, 2 * _KIB, 0.003)
RECORDER_STATE = Topic("recorder/state", m.RecorderState, 2.0, Delivery.LATEST, Lane.CONTROL, 8 * _KIB, 0.003)
FAULT = Topic("simulator/fault", m.FaultCommand, 2.0, Delivery.EVERY, Lane.CONTROL, 2 * _KIB, 0.003)
TRUTH = Topic("simulator/truth", m.GroundTruth, 50.0, Delivery.EVERY, Lane.BULK, 8 * _KIB, 0.009)


def _per_role(key: str, type_: type[M], sender: str) -> Mapping[str, Topic[M]]:
    """Return one topic per role.

    The access rules let a certificate publish only the key of its own role, so a subscriber knows the sender's role.
    """
    limits = 64 * _KIB, 0.003, f" from each {sender}"
    rows = (Topic(f"{key}/{role}", type_, 1.0, Delivery.EVERY, Lane.CONTROL, *limits) for role in ROLE_NAMES)
    return MappingProxyType(dict(zip(ROLE_NAMES, rows, strict=True)))


HEALTH_OF = _per_role("health", m.Health, "process")
PRESENCE_OF = _per_role("machine/presence", m.Presence, "machine")
HEALTH, PRESENCE = HEALTH_OF["robot"], PRESENCE_OF["robot"]

TOPICS: tuple[Topic[Any], ...] = (
    DEPTH,
    COLOR,
    CAMERA_STATE,
    PREVIEW,
    IMU,
    ODOMETRY,
    ACTUATOR_STATE,
    HORN_ERRORS,
    BODY_POSE,
    EXTERNAL_POSE,
    EXTERNAL_DEPTH,
    CAMERA_ERRORS,
    FLOOR,
    SCAN,
    SCAN_RECEIPT,
    TERRAIN,
    PASSAGE_REQUEST,
    PASSAGE,
    PASSAGE_PLAN,
    STEP_PLAN,
    PLANNER_STATUS,
    VELOCITY,
    GOAL,
    POSTURE,
    CALIBRATION,
    MODE,
    STOP,
    RECORD,
    RECORDER_STATE,
    FAULT,
    TRUTH,
    *HEALTH_OF.values(),
    *PRESENCE_OF.values(),
)
_HEADER_BYTES = 2048  # maximum size of a map or image message without its arrays


def cells_that_fit(topic: Topic[Any]) -> int:
    """Return how many map cells or pixels, with all layers, fit into a message, besides its grey image."""
    arrays = [detail for _, base, detail in m.schema(topic.type) if base is np.ndarray]
    layers = [(dtype, dims.shape) for dtype, dims in arrays if dims.shape[:2] in (("nx", "ny"), ("h", "w"))]
    gray = sum(dims.lengths[1] ** 2 for _, dims in arrays if dims.optional and dims.lengths)  # [bytes] at most
    per_cell = sum(dtype.itemsize * math.prod(shape[2:]) for dtype, shape in layers)
    return int((topic.max_bytes - _HEADER_BYTES - gray) // per_cell)


def topic_named(key: str, namespace: str = "sextant") -> Topic[Any]:
    """Return the topic of a key, with or without the namespace as its prefix.

    Raises:
        ValueError: There is none; the text names the most similar key.
    """
    bare = key.removeprefix(f"{namespace}/")
    for topic in TOPICS:
        if topic.key == bare:
            return topic
    near = RENAMED.get(bare) or spelling.nearest(bare, (topic.key for topic in TOPICS))
    raise ValueError(f"no topic {key!r}; {f'did you mean {near!r}? ' if near else ''}`sextant topics list` lists all topics")


OF_TYPE = {topic.type: topic for topic in reversed(TOPICS)}  # the robot's topic where each role has its own
RENAMED: Mapping[str, str] = MappingProxyType({"health": HEALTH.key, "machine/presence": PRESENCE.key})  # old key -> key
