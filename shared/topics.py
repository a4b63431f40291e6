"""The topic table: what travels under which key, how often, how it is delivered, and how long it takes.

`latency_s` is what lockstep delays a message by: from the start of the step that makes it to its receipt, computing included.
The defaults are the 99th percentiles of live runs on two cores, the median of five (`sextant run steps --json` prints a run's
under stages_ms); of what such a run does not carry (colour, IMU) or does not time (health), that of its like.
"""

from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

from shared import messages as m

M = TypeVar("M", bound=m.Message)


class Delivery(Enum):
    """LATEST keeps one message and drops the old (state); EVERY keeps all in order (events, increments)."""

    LATEST = "latest"
    EVERY = "every"


class Lane(Enum):
    """BULK and CONTROL travel in sessions of their own, so that a large frame never delays a command."""

    BULK = "bulk"
    CONTROL = "control"


@dataclass(frozen=True, slots=True)
class Topic(Generic[M]):
    """One row of the table."""

    key: str
    type: type[M]
    rate_hz: float
    delivery: Delivery
    lane: Lane
    max_bytes: int  # larger frames are refused unread
    latency_s: float

    @property
    def fresh_for_ns(self) -> int:
        """A message older than three periods is stale."""
        return int(3e9 / self.rate_hz)

    def address(self, namespace: str) -> str:
        """Its key behind the namespace of a robot; it goes with every frame (`shared.transport`)."""
        return f"{namespace}/{self.key}"


_KIB = 1024

DEPTH = Topic("camera/depth", m.DepthImage, 30.0, Delivery.LATEST, Lane.BULK, 4096 * _KIB, 0.010)
COLOR = Topic("camera/color", m.ColorImage, 5.0, Delivery.LATEST, Lane.BULK, 8192 * _KIB, 0.015)
CAMERA_STATE = Topic("camera/state", m.CameraState, 4.0, Delivery.LATEST, Lane.CONTROL, 16 * _KIB, 0.003)
PREVIEW = Topic("camera/preview", m.Preview, 5.0, Delivery.LATEST, Lane.BULK, 300 * _KIB, 0.010)
IMU = Topic("imu", m.Imu, 100.0, Delivery.EVERY, Lane.CONTROL, 2 * _KIB, 0.003)
ODOMETRY = Topic("actuator/odometry", m.Odometry, 50.0, Delivery.EVERY, Lane.CONTROL, 4 * _KIB, 0.013)
ACTUATOR_STATE = Topic("actuator/state", m.ActuatorState, 25.0, Delivery.LATEST, Lane.CONTROL, 64 * _KIB, 0.015)
BODY_POSE = Topic("perception/pose", m.BodyPose, 15.0, Delivery.LATEST, Lane.CONTROL, 8 * _KIB, 0.010)
SCAN = Topic("perception/scan", m.Scan, 15.0, Delivery.LATEST, Lane.BULK, 128 * _KIB, 0.012)
SCAN_RECEIPT = Topic("mapper/receipt", m.ScanReceipt, 15.0, Delivery.LATEST, Lane.CONTROL, 1 * _KIB, 0.004)
TERRAIN = Topic("mapper/terrain", m.TerrainMap, 7.5, Delivery.LATEST, Lane.BULK, 8192 * _KIB, 0.039)
PASSAGE_REQUEST = Topic("passage/request", m.PassageRequest, 2.0, Delivery.LATEST, Lane.CONTROL, 2 * _KIB, 0.004)
PASSAGE = Topic("mapper/passage", m.PassageMap, 2.0, Delivery.LATEST, Lane.BULK, 2048 * _KIB, 0.090)
PASSAGE_PLAN = Topic("planner/passage", m.PassagePlan, 2.0, Delivery.EVERY, Lane.BULK, 512 * _KIB, 0.012)
STEP_PLAN = Topic("planner/step", m.StepPlan, 20.0, Delivery.EVERY, Lane.CONTROL, 8 * _KIB, 0.009)
PLANNER_STATUS = Topic("planner/status", m.PlannerStatus, 10.0, Delivery.LATEST, Lane.CONTROL, 16 * _KIB, 0.007)
VELOCITY = Topic("operator/velocity", m.VelocityCommand, 20.0, Delivery.LATEST, Lane.CONTROL, 2 * _KIB, 0.004)
GOAL = Topic("operator/goal", m.Goal, 5.0, Delivery.LATEST, Lane.CONTROL, 4 * _KIB, 0.004)
MODE = Topic("operator/mode", m.ModeCommand, 2.0, Delivery.EVERY, Lane.CONTROL, 2 * _KIB, 0.003)
STOP = Topic("operator/stop", m.StopOrder, 2.0, Delivery.EVERY, Lane.CONTROL, 2 * _KIB, 0.003)
RECORD = Topic("operator/record", m.RecordCommand, 1.0, Delivery.EVERY, Lane.CONTROL, 2 * _KIB, 0.003)
RECORDER_STATE = Topic("recorder/state", m.RecorderState, 2.0, Delivery.LATEST, Lane.CONTROL, 8 * _KIB, 0.003)
FAULT = Topic("simulator/fault", m.FaultCommand, 2.0, Delivery.EVERY, Lane.CONTROL, 2 * _KIB, 0.003)
TRUTH = Topic("simulator/truth", m.GroundTruth, 50.0, Delivery.EVERY, Lane.BULK, 8 * _KIB, 0.009)
HEALTH = Topic("health", m.Health, 1.0, Delivery.EVERY, Lane.CONTROL, 64 * _KIB, 0.003)
PRESENCE = Topic("machine/presence", m.Presence, 1.0, Delivery.EVERY, Lane.CONTROL, 64 * _KIB, 0.003)

TOPICS: tuple[Topic[m.Message], ...] = (  # type: ignore[assignment]
    DEPTH,
    COLOR,
    CAMERA_STATE,
    PREVIEW,
    IMU,
    ODOMETRY,
    ACTUATOR_STATE,
    BODY_POSE,
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
    MODE,
    STOP,
    RECORD,
    RECORDER_STATE,
    FAULT,
    TRUTH,
    HEALTH,
    PRESENCE,
)
OF_TYPE = {topic.type: topic for topic in TOPICS}  # a message type belongs to one topic
