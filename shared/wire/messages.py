"""Every message on the wire: frozen dataclasses and nothing else.

A field's annotation is its contract: `Annotated[NDArray[np.float32], Dims("nx", "ny", finite=False)]` is a float32 array whose
two lengths agree wherever the same names stand in the message. Construction checks it, so a message that exists is well
formed, on the sending side as on the receiving one.

Poses are (4, 4) [m]; {world} is fixed where the robot started, {odom} is what the legs alone believe, {body} moves along.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any, Literal, TypeAlias, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import from_millimetres

MAX_TEXT = 2000  # characters of a text field
MAX_ITEMS = 256  # entries of a tuple field
_MAX_INT = 1 << 63
UNKNOWN = 127  # of the evaluation function: never seen
HAZARDS = ("", "water", "loose ground", "no ground by touch")  # by the numbers of TerrainMap.hazard
MAX_LENGTH = 4_000_000  # elements along an array
MAX_WAYPOINTS = 32  # of a goal
MAX_PATH = 64  # corners of a planned way
MAX_SECTION = 512  # steps of a planned section of a passage
MAX_PREVIEW = 1 << 17  # bytes of a picture for people
MAX_TREE = 8000  # edges of the tree it was found in, as far as they are sent


@dataclass(frozen=True, slots=True)
class Dims:
    """Shape of an array field: numbers are exact lengths, names are free lengths that agree within one message.

    A packed array of whole numbers crosses the wire as its differences along the first axis, compressed. An optional one may be
    left empty: all its free lengths are then 0, whatever they are elsewhere.
    """

    shape: tuple[int | str, ...]
    finite: bool
    packed: bool
    optional: bool
    most: int | None = dataclasses.field(repr=False)  # its largest value; no part of what the wire looks like
    lengths: tuple[int, int] | None = dataclasses.field(repr=False)  # within which the free ones lie; no part of it either

    def __init__(
        self,
        *shape: int | str,
        finite: bool = True,
        packed: bool = False,
        optional: bool = False,
        most: int | None = None,
        lengths: tuple[int, int] | None = None,
    ):
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "finite", finite)
        object.__setattr__(self, "packed", packed)
        object.__setattr__(self, "optional", optional)
        object.__setattr__(self, "most", most)
        object.__setattr__(self, "lengths", lengths)


Pose: TypeAlias = Annotated[NDArray[np.float64], Dims(4, 4)]
Vector3: TypeAlias = Annotated[NDArray[np.float64], Dims(3)]
PerLeg: TypeAlias = Annotated[NDArray[np.float64], Dims(6)]
PerJoint: TypeAlias = Annotated[NDArray[np.float64], Dims(6, 3)]
LegFlags: TypeAlias = Annotated[NDArray[np.bool_], Dims(6)]
GaitName: TypeAlias = Literal["tripod", "ripple", "wave"]
FaultTarget: TypeAlias = Literal["bytes", "packets", "servo", "bus", "supply"]
FaultKind: TypeAlias = Literal[
    "silent", "stuck", "garbage", "wrong", "slow", "intermittent", "jammed", "overload", "heat", "hot", "gone", "sag", "drain"
]
BrokenPart: TypeAlias = Literal["value", "id", "length", "error", "two bits", "two bytes"]
_POINTS_WITHOUT_COLOR, _CELLS_WITHOUT_COLOR = np.zeros((0, 3), np.uint8), np.zeros((0, 0, 3), np.uint8)
_NO_SIGHTS = np.zeros((0, 3), dtype=np.int16)
_NO_CELLS = np.zeros((0, 0), np.uint8)
_NEVER, _NOWHERE, _NONE = np.full(6, -1, dtype=np.int64), np.zeros((6, 3)), np.zeros(6, dtype=np.bool_)
_NO_PATH = np.zeros((0, 2))
_NO_INPUTS = np.zeros(0)


class Mode(StrEnum):
    """What the actuator is doing; it alone decides."""

    OFF = "off"  # no torque; only an operator's act leads out
    READY = "ready"  # torque on, the legs stay where they are; `stand` leads on
    STAND = "stand"  # moving to the resting stance
    WALK = "walk"  # executing an accepted plan
    HOLD = "hold"  # standing where the last step ended, torque on, ready for the next plan
    SIT = "sit"  # lowering the body to the ground
    FAULT = "fault"  # something is broken; holding as far as it can, until it is whole again


@dataclass(frozen=True, slots=True)
class Message:
    """Base of all messages: what is checked is what the annotations say.

    A text that is too long is cut: reasons quote names and reasons of others, and must not end the service that gives them. A
    frame with such a text is refused (`sextant.shared.wire.codec`).
    """

    stamp_ns: int  # [ns] when the world was as described; copied through every stage

    def contradiction(self) -> str:
        """How fields contradict each other, or empty; a frame with such a message is refused (`sextant.shared.wire.codec`)."""
        return ""

    def __post_init__(self) -> None:
        lengths: dict[str, int] = {}
        for name, check in _checks(type(self)):
            problem = check(getattr(self, name), lengths)
            if problem and (fitted := _fitted(getattr(self, name))) is not None:
                object.__setattr__(self, name, fitted)
                problem = check(fitted, lengths)
            if problem:
                raise ValueError(f"{type(self).__name__}.{name}: {problem}")


@dataclass(frozen=True, slots=True)
class Tick(Message):
    """The beat of a service that is paced by its own clock; never on the wire."""


@dataclass(frozen=True, slots=True)
class DepthImage(Message):
    """One frame of the depth camera; camera -> perception. The intrinsics are the profile's."""

    depth: Annotated[NDArray[np.uint16], Dims("h", "w")]  # raw units of the sensor's depth_scale, 0 = no return


@dataclass(frozen=True, slots=True)
class ColorImage(Message):
    """One colour frame, pixel for pixel over the depth frame of the same stamp; camera -> perception."""

    rgb: Annotated[NDArray[np.uint8], Dims("h", "w", 3)]


@dataclass(frozen=True, slots=True)
class Preview(Message):
    """What the camera sees, small and for people's eyes, as JPEG; perception -> console. The colour is empty without one."""

    depth_jpeg: Annotated[NDArray[np.uint8], Dims("depth", lengths=(0, MAX_PREVIEW))]  # near red, far blue, black unknown
    color_jpeg: Annotated[NDArray[np.uint8], Dims("color", lengths=(0, MAX_PREVIEW))]


@dataclass(frozen=True, slots=True)
class CameraState(Message):
    """How the depth camera fares, a few times a second; camera -> planner, console."""

    device: str  # what it is, in words
    ok: bool  # False: no pictures come, or what comes is of no use and is held back
    reason: str  # why, in words; empty when all is well


@dataclass(frozen=True, slots=True)
class Imu(Message):
    """Angular rate and specific force; imu -> actuator."""

    gyro: Vector3  # [rad/s] {body}
    specific_force: Vector3  # [m/s^2] {body}, +g up at rest


@dataclass(frozen=True, slots=True)
class Odometry(Message):
    """How the body moved by the measured joints of its stance legs; actuator -> perception, planner."""

    T_odom_body: Pose
    travelled: float  # [m] path length so far
    turned: float  # [rad] summed absolute heading change so far
    stance: LegFlags  # legs it stood on
    reliable: bool  # False while fewer than three legs carry


@dataclass(frozen=True, slots=True)
class ActuatorState(Message):
    """What the legs do and how far the plan is; actuator -> planner, console."""

    mode: Mode
    reason: str  # why this mode, in words
    lease: str  # who may move the legs; empty while nobody may
    epoch: int  # of {odom}: plans that were made before it began are refused
    pace: float  # [1] share of the usual speed that the servos can bear for long
    refused: str  # why the last plan was refused, in words; empty when the last was accepted
    refused_ns: int  # stamp of the newest plan that was refused for what it asks of the legs; -1 for none
    plan_ns: int  # stamp of the plan that is being walked, or was last; -1 before the first
    step: int  # number of the step being walked, or of the last one finished
    phase: float  # [1] 0 to 1 through the step, 1 when it is done
    swing: LegFlags  # legs in the air by plan
    contact: LegFlags  # legs that carry by their measured load
    q: PerJoint  # [rad] measured
    load_nm: PerJoint  # [N m] motor torque behind present load
    feet: PerJoint  # (6, 3) [m] {body} measured foot centres
    T_odom_body: Pose  # measured, the same as the odometry's
    body_ref: Pose  # {odom} where the body should be now
    T_world_odom: Pose  # correction under which the newest accepted plan was made; what a perception that begins anew goes by
    voltage: float  # [V] lowest seen
    temperature: float  # [deg C] highest seen
    warnings: tuple[str, ...]  # in words: servos by leg and joint
    # What each foot found when it last came down; it stays here until it comes down again.
    touch_ns: Annotated[NDArray[np.int64], Dims(6)] = dataclasses.field(default_factory=lambda: _NEVER)  # -1 nothing yet
    touch: PerJoint = dataclasses.field(
        default_factory=lambda: _NOWHERE
    )  # (6, 3) [m] {odom} underside of the foot: where it met ground, or the deepest that it looked for some
    touch_carries: LegFlags = dataclasses.field(default_factory=lambda: _NONE)  # False: there is no ground
    slip: float = 0.0  # [m] by which the standing feet have moved against each other, the worst of them


@dataclass(frozen=True, slots=True)
class BodyPose(Message):
    """Where the body is; perception -> mapper, planner, operator."""

    T_world_body: Pose
    T_world_odom: Pose  # correction: T_world_odom @ T_odom_body is where the body is at any time near, its tilt averaged
    covariance: Annotated[
        NDArray[np.float64], Dims(6, 6)
    ]  # [m^2, m rad, rad^2] of the body's position, then rotation, {world}, against the ground as it was mapped lately
    overlap: float  # [1] share of the scan that met the reference
    ok: bool  # False: registration failed and odometry alone stands behind the pose
    reason: str  # what is wrong, in words; empty when nothing is
    degenerate: Annotated[NDArray[np.float64], Dims("k", 6)]  # unit twists, as above, that the scene leaves to odometry


@dataclass(frozen=True, slots=True)
class Scan(Message):
    """The ground as one frame saw it, a point per map cell; perception -> mapper."""

    origin: Vector3  # [m] {world}
    points_mm: Annotated[NDArray[np.int16], Dims("n", 3, packed=True)]  # [mm] from the origin, neighbours behind each other
    count: Annotated[NDArray[np.uint8], Dims("n", packed=True)]  # pixels behind a point, 255 for more
    spread_mm: Annotated[NDArray[np.uint8], Dims("n", packed=True)]  # [mm] from the lowest to the highest of them, 255 for more
    p_world_camera: Vector3  # [m] where the camera was
    pose_covariance: Annotated[
        NDArray[np.float64], Dims(6, 6)
    ]  # [m^2, m rad, rad^2] of the camera's position, then rotation, {world}, by which the points were placed
    color: Annotated[NDArray[np.uint8], Dims("n", 3, packed=True, optional=True, most=63)] = dataclasses.field(
        default_factory=lambda: _POINTS_WITHOUT_COLOR
    )  # codes of `sextant.shared.color`, a row per point, or none at all
    sights_mm: Annotated[NDArray[np.int16], Dims("m", 3, packed=True)] = dataclasses.field(
        default_factory=lambda: _NO_SIGHTS
    )  # [mm] from the origin: points up to which the camera saw nothing, beside those of the scan

    @property
    def points(self) -> NDArray[np.float64]:
        """(n, 3) [m] {world}"""
        return from_millimetres(self.points_mm, self.origin)

    @property
    def sights(self) -> NDArray[np.float64]:
        """(m, 3) [m] {world}"""
        return from_millimetres(self.sights_mm, self.origin)


@dataclass(frozen=True, slots=True)
class ScanReceipt(Message):
    """That a scan has come, by its stamp; mapper -> perception, which sends no more than the link carries."""


@dataclass(frozen=True, slots=True)
class TerrainMap(Message):
    """Terrain around the robot; mapper -> planner, console. Cell (i, j) is centred at origin + resolution * (i, j)."""

    resolution: float  # [m] cell edge
    origin: Annotated[NDArray[np.float64], Dims(2)]  # [m] {world} centre of cell (0, 0)
    elevation: Annotated[NDArray[np.float32], Dims("nx", "ny", finite=False)]  # [m] {world}, NaN where never seen
    variance: Annotated[NDArray[np.float32], Dims("nx", "ny", finite=False)]  # [m^2] of elevation, NaN where never seen
    score: Annotated[NDArray[np.float32], Dims("nx", "ny", finite=False)]  # 0 best, above 1 no foothold, NaN unknown
    assumed: Annotated[NDArray[np.bool_], Dims("nx", "ny")]  # filled in at the start, not measured
    # Masri's evaluation function [cells]: -1 and less where a foot may stand, the least being best; 1 and more elsewhere, the
    # distance from there; 127 where nothing is known.
    evaluation: Annotated[NDArray[np.int8], Dims("nx", "ny")]
    # Without a colour camera these are empty.
    color: Annotated[NDArray[np.uint8], Dims("nx", "ny", 3, optional=True)] = dataclasses.field(
        default_factory=lambda: _CELLS_WITHOUT_COLOR
    )  # R, G, B
    hazard: Annotated[NDArray[np.uint8], Dims("nx", "ny", optional=True, most=len(HAZARDS) - 1)] = dataclasses.field(
        default_factory=lambda: _NO_CELLS
    )  # 1 water, 2 loose ground, 3 none at all under a foot here, which is then no foothold; 0 nothing of these
    confidence: Annotated[NDArray[np.uint8], Dims("nx", "ny", optional=True, most=100)] = dataclasses.field(
        default_factory=lambda: _NO_CELLS
    )  # [%] of the type of ground that is the most probable, 0 where nothing is known


@dataclass(frozen=True, slots=True)
class PassageRequest(Message):
    """A strip of ground to be surveyed, as long as this is repeated; planner, operator -> mapper."""

    origin: Annotated[NDArray[np.float64], Dims(2)]  # [m] {world} middle of its near side
    heading: float  # [rad] {world} of its length
    length: float  # [m] a whole number of the map's cells, as the width
    width: float  # [m]


@dataclass(frozen=True, slots=True)
class PassageMap(Message):
    """A strip as it was surveyed, in 1 cm cells along and across it; mapper -> planner, console.

    Cell (i, j) is centred at origin + resolution * R(heading) (i, j). Unseen is a cell whose elevation is NaN.
    """

    resolution: float  # [m] cell edge
    origin: Annotated[NDArray[np.float64], Dims(2)]  # [m] {world} centre of cell (0, 0)
    heading: float  # [rad] {world} of the first axis
    elevation: Annotated[NDArray[np.float32], Dims("nx", "ny", finite=False)]  # [m] {world}, NaN where unknown
    normals: Annotated[
        NDArray[np.int16], Dims("nx", "ny", 3, packed=True)
    ]  # {world} upward, of length 32767; zero where there is none
    roughness: Annotated[NDArray[np.float32], Dims("nx", "ny", finite=False)]  # [m] rms of points around off their plane
    assumed: Annotated[NDArray[np.bool_], Dims("nx", "ny")]  # taken for the plane under the feet, not measured
    # Masri's evaluation function [cells], as the terrain map's; what lies beside the strip counts as vacant.
    evaluation: Annotated[NDArray[np.int8], Dims("nx", "ny")]
    unseen: float  # [1] share of the cells
    reason: str  # what is unseen and why, or why there is no map, in words; empty when all is seen
    T_world_look: Pose  # body pose, reachable from here without a step, from which most of what is unseen would show
    look_shows: Annotated[NDArray[np.bool_], Dims("nx", "ny")]  # unseen cells that would; none: no look is worth it


@dataclass(frozen=True, slots=True)
class PassagePlan(Message):
    """What planning at one stop of a passage came to; planner -> console, scorer.

    Its steps are the section that is walked; where there is no way, those to the furthest configuration, which nobody walks.
    """

    section: int  # counts up from 1 within a passage
    state: Literal["complete", "partial", "no way"]  # up to the goal; as far as the map or the cycles asked for go; nowhere
    reason: str  # why it ends where it does, in words; where there is no way, which test stops it
    origin: Annotated[NDArray[np.float64], Dims(2)]  # [m] {world} middle of the near side of the strip that was planned on
    heading: float  # [rad] {world} of its length
    goal: float  # [m] from the origin along the strip, where the body is to get
    furthest: float  # [m] likewise, where it gets in the furthest configuration found
    generated: int  # nodes of the tree, Masri's n_g
    expanded: int  # expansions of the budget that were spent, his n_e
    planning_ms: float  # [ms] that it took by the machine's clock: timing, so not the same twice
    leg: Annotated[NDArray[np.uint8], Dims("step", most=6, lengths=(0, MAX_SECTION))]  # that swings, 6: the body moves alone
    # [m] {world} centre of that leg's foot at the end of the step, or then the body
    footholds: Annotated[NDArray[np.float64], Dims("step", 3, lengths=(0, MAX_SECTION))]
    body: Annotated[NDArray[np.float64], Dims("step", 3, lengths=(0, MAX_SECTION))]  # [m] {world} body at its end
    edges: Annotated[
        NDArray[np.float32], Dims("edge", 2, 3, lengths=(0, MAX_TREE))
    ]  # [m] {world} body positions of nodes and of those expanded from them
    # [m] {world} foot whose leg fails the test that stops the furthest configuration, or the body; none where there is a way
    stopped: Annotated[NDArray[np.float64], Dims("stop", 3, lengths=(0, 1))]


@dataclass(frozen=True, slots=True)
class StepPlan(Message):
    """One step: which legs swing where, and where the body goes meanwhile; planner -> actuator.

    It ends in a statically stable stance, so the actuator can always finish it alone. A higher revision of the running step
    moves its touchdowns; the next step number queues behind it.
    """

    epoch: int  # of the actuator state it was planned on
    step: int  # counts up by one
    revision: int  # counts up within a step
    T_world_odom: Pose  # the correction the planner planned under; ties {world} to what the legs know
    swing: LegFlags
    touchdown: Annotated[
        NDArray[np.float64], Dims(6, 3)
    ]  # [m] {world} foot centres; for legs that do not swing, where they stand
    clearance: PerLeg  # [m] of a swinging foot over both its ends
    body_goal: Pose  # {world} body at the end of the step
    duration: float  # [s]
    stop: bool  # True: come to rest at its end


@dataclass(frozen=True, slots=True)
class PlannerStatus(Message):
    """What the planner is doing and why it does not go on; planner -> operator, console."""

    state: Literal["waiting", "resting", "stepping", "blocked", "arrived"]
    reason: str  # in words
    step: int
    moved_footholds: int  # touchdowns of the newest plan that are not at their nominal place
    blocked_leg: int  # index of the leg without a foothold, -1 for none
    path: Annotated[NDArray[np.float64], Dims("path", 2, lengths=(0, MAX_PATH))] = dataclasses.field(
        default_factory=lambda: _NO_PATH
    )  # [m] {world} corners of the way to the goal that is being walked, from the robot on; empty without one


@dataclass(frozen=True, slots=True)
class VelocityCommand(Message):
    """What the operator asks of the walk, repeated while it holds; operator -> planner."""

    velocity: Annotated[NDArray[np.float64], Dims(2)]  # [m/s] {body} forward, left
    yaw_rate: float  # [rad/s]
    body_height: float  # [m] over the floor
    lift: float  # [m] clearance of swinging feet
    gait: GaitName = "tripod"  # from the next step on
    by_touch: bool = False  # True: no map is asked for; feet find the ground, slowly


@dataclass(frozen=True, slots=True)
class Goal(Message):
    """Where the operator wants the robot, repeated while it holds; operator -> planner. A fresh VelocityCommand comes first."""

    waypoints: Annotated[NDArray[np.float64], Dims("waypoint", 2, lengths=(1, MAX_WAYPOINTS))]  # [m] {world} in their order
    tolerance: float  # [m] from the last one, within which it has arrived
    speed: float  # [m/s] at most
    body_height: float  # [m] over the floor
    lift: float  # [m] clearance of swinging feet
    gait: GaitName = "tripod"
    passage: bool = False  # True: from here straight to the last waypoint, deliberately, one leg at a time


@dataclass(frozen=True, slots=True)
class ModeCommand(Message):
    """What the operator orders of the legs; operator -> actuator."""

    mode: Literal["off", "stop", "ready", "stand", "walk", "sit"]
    sequence: int  # [ns] by the robot's clock when it was given: an order counts once, however often it is repeated
    holder: str = "operator"  # who orders: one at a time may move the legs, everybody may stop them
    take: bool = False  # True: take over from whoever may move them now; with `stop` without moving anything


@dataclass(frozen=True, slots=True)
class StopOrder(Message):
    """That the legs are to stop or to let go; whoever is there -> actuator. For those who may not lead it is the only key."""

    mode: Literal["off", "stop"]
    sequence: int  # an order counts once, however often it is repeated: another number is another order
    holder: str = "operator"  # who orders


@dataclass(frozen=True, slots=True)
class RecordCommand(Message):
    """What the operator wants of the recorder; console -> recorder."""

    record: bool
    sequence: int  # [ns] when it was given; counts up: an order counts once, however often it is repeated


@dataclass(frozen=True, slots=True)
class RecorderState(Message):
    """Whether what is said is being recorded, and where; recorder -> console."""

    recording: bool
    sequence: int  # of the order that it follows, -1 before the first
    file: str  # that is being written, or was last; empty before the first
    seconds: float  # [s] recorded since it began
    size: int  # [B] of its files together
    free: int  # [B] that are free where they are, -1 where that is not known
    dropped: int  # messages that came faster than the disk took them
    reason: str  # why it ended before it was told to, in words; empty when all is well


@dataclass(frozen=True, slots=True)
class FaultCommand(Message):
    """What to break in the simulated servos or on their bus, as `sextant.shared.servo.bus_fault` has it; tests -> simulator."""

    target: FaultTarget
    kind: FaultKind
    at_s: float  # [s] simulated; at once where that is past
    for_s: float  # [s] from its beginning on
    servo: int  # bus id, -1 for none in particular
    share: float  # of the bytes or answers
    value: int  # of a byte
    part: BrokenPart  # of an answer
    delay_ms: float  # [ms]
    on_ms: float  # [ms] all is well
    off_ms: float  # [ms] and then not
    cable: bool  # the servo's power goes with it
    offset_ticks: int
    kelvin_per_s: float  # [K/s]
    celsius: int  # [deg C] that a servo reports
    renamed: bool  # the port comes back under another name
    volts: float  # [V] less


@dataclass(frozen=True, slots=True)
class GroundTruth(Message):
    """What the simulator knows; simulator -> scorer and nobody else."""

    T_world_body: Pose
    q: PerJoint  # [rad]
    torque: PerJoint  # [N m] of the motors
    feet: PerJoint  # (6, 3) [m] {world} foot centres
    contact: LegFlags  # feet that bear load
    bears: LegFlags  # legs that do, by the foot or by a shank that leans on an edge
    shutdown: Annotated[NDArray[np.bool_], Dims(6, 3)]  # servos that have latched an error
    voltage: float  # [V]
    temperature: float  # [deg C] hottest servo
    scenario: str  # name of what is simulated
    seed: int  # and of everything random in it
    robot: str  # name of the profile


@dataclass(frozen=True, slots=True)
class Health(Message):
    """How one service fares, once a second; every service -> launcher, console."""

    service: str
    doing: str  # in words
    steps: int
    refused: int  # messages that did not decode, or were sent to another key
    dropped: int  # messages that came faster than they were read
    last_refusal: str
    stages: tuple[str, ...]  # names of the timed stages and streams
    stage_p50_ms: Annotated[NDArray[np.float64], Dims("stage")]
    stage_p99_ms: Annotated[NDArray[np.float64], Dims("stage")]
    robot_ahead_s: float = 0.0  # [s] the robot's clock is ahead of its machine's; 0 on the robot
    # Inputs with an age limit, by topic key, "beat" or "stall"; see `shared.runtime.lateness`. Each since the last report:
    inputs: tuple[str, ...] = ()
    input_age_s: Annotated[NDArray[np.float64], Dims("input")] = dataclasses.field(default_factory=lambda: _NO_INPUTS)  # worst
    input_arrived_s: Annotated[NDArray[np.float64], Dims("input")] = dataclasses.field(
        default_factory=lambda: _NO_INPUTS
    )  # [s] the worst age when it arrived
    input_limit_s: Annotated[NDArray[np.float64], Dims("input")] = dataclasses.field(default_factory=lambda: _NO_INPUTS)
    input_late: Annotated[NDArray[np.float64], Dims("input")] = dataclasses.field(
        default_factory=lambda: _NO_INPUTS
    )  # [1] share of the uses beyond the limit

    missed_beats: int = 0  # beats that its own clock left out since it started

    def contradiction(self) -> str:
        """Whether there is a number for each name."""
        named = (len(self.stages), len(self.inputs))
        numbers = (len(self.stage_p50_ms), len(self.input_age_s))
        return "" if named == numbers else f"{named} numbers of stages and inputs expected, as there are names, found {numbers}"


@dataclass(frozen=True, slots=True)
class Presence(Message):
    """What one machine of a robot runs, once a second; whoever starts processes on it -> the same on the others."""

    machine: str  # unlike any other, also of an earlier start
    role: str
    version: str  # of Sextant
    up_s: float  # [s] since it started
    services: tuple[str, ...]  # that it has started
    keys: tuple[str, ...]  # of its topic table
    schemas: tuple[str, ...]  # of their messages, in the same order


FieldSchema: TypeAlias = tuple[str, Any, Any]


_SCHEMAS: dict[type[Message], tuple[FieldSchema, ...]] = {}


def schema(kind: type[Message]) -> tuple[FieldSchema, ...]:
    """Fields of a message class as (name, type, detail): an array's type is np.ndarray and its detail (dtype, Dims)."""
    known = _SCHEMAS.get(kind)
    if known is None:
        known = _SCHEMAS[kind] = _schema(kind)
    return known


def _schema(kind: type[Message]) -> tuple[FieldSchema, ...]:
    hints = get_type_hints(kind, include_extras=True)
    fields: list[FieldSchema] = []
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        origin, args = get_origin(hint), get_args(hint)
        if origin is Annotated:
            dtype = np.dtype(get_args(get_args(args[0])[1])[0])
            fields.append((field.name, np.ndarray, (dtype, args[1])))
        elif origin is Literal:
            fields.append((field.name, Literal, args))
        elif origin is tuple:
            fields.append((field.name, tuple, None))
        else:
            fields.append((field.name, hint, None))
    return tuple(fields)


Check: TypeAlias = Callable[[Any, dict[str, int]], str]  # what is wrong with a value, or nothing

_CHECKS: dict[type[Message], tuple[tuple[str, Check], ...]] = {}


def _checks(kind: type[Message]) -> tuple[tuple[str, Check], ...]:
    """The checks of a message's fields, made once: they run for every message sent and received."""
    known = _CHECKS.get(kind)
    if known is None:
        known = _CHECKS[kind] = tuple((name, _check(base, detail)) for name, base, detail in schema(kind))
    return known


def _check(kind: Any, detail: Any) -> Check:
    if kind is np.ndarray:
        return _array_check(*detail)
    if kind is Literal:
        return lambda value, _: "" if value in detail else f"one of {detail} expected, found {str(value)[:40]!r}"
    if kind is tuple:
        return _check_texts
    plain = {float: _check_float, int: _check_int, str: _check_text, bool: _check_bool}
    if kind in plain:
        return plain[kind]
    return lambda value, _: "" if isinstance(value, kind) else f"{kind.__name__} expected, found {value!r:.40}"


def _fitted(value: Any) -> str | tuple[str, ...] | None:
    """A text, or a tuple of texts, with what a message cannot carry left out; None for any other value."""
    if isinstance(value, str):
        text = value.encode("utf-8", "replace").decode("utf-8")
        return text if len(text) <= MAX_TEXT else f"{text[: MAX_TEXT - 3]}..."
    if isinstance(value, tuple) and all(isinstance(v, str) for v in value):
        return tuple(_fitted(v) for v in value[:MAX_ITEMS])  # type: ignore[misc]
    return None


def _check_texts(value: Any, _: dict[str, int]) -> str:
    if not isinstance(value, tuple) or len(value) > MAX_ITEMS:
        return f"a tuple of at most {MAX_ITEMS} texts expected"
    return "" if all(_is_text(v) for v in value) else f"texts of at most {MAX_TEXT} characters expected"


def _check_float(value: Any, _: dict[str, int]) -> str:
    return "" if isinstance(value, float) and math.isfinite(value) else f"a finite number expected, found {value!r:.40}"


def _check_int(value: Any, _: dict[str, int]) -> str:
    good = isinstance(value, int) and not isinstance(value, bool) and abs(value) < _MAX_INT
    return "" if good else f"a 64-bit whole number expected, found {value!r:.40}"


def _check_text(value: Any, _: dict[str, int]) -> str:
    return "" if _is_text(value) else f"a text of at most {MAX_TEXT} characters expected, found {value!r:.40}"


def _is_text(value: object) -> bool:
    if not isinstance(value, str) or len(value) > MAX_TEXT:
        return False
    return value.isascii() or not any("\ud800" <= c <= "\udfff" for c in value)  # half a surrogate pair has no UTF-8


def _check_bool(value: Any, _: dict[str, int]) -> str:
    return "" if isinstance(value, bool) else f"true or false expected, found {value!r:.40}"


def _array_check(dtype: np.dtype[Any], dims: Dims) -> Check:
    """The check of an array field; arrays of fixed shape take the short way."""
    expected, names = dims.shape, any(isinstance(n, str) for n in dims.shape)
    finite = dims.finite and dtype.kind == "f"
    empty = tuple(0 if isinstance(n, str) else n for n in expected) if dims.optional else None

    def check(value: Any, lengths: dict[str, int]) -> str:
        if not isinstance(value, np.ndarray):
            return f"an array of {dtype} expected, found {type(value).__name__}"
        if value.dtype != dtype:
            return f"an array of {dtype} expected, found {value.dtype}"
        if empty is not None and value.shape == empty:
            return ""
        if names:
            problem = _shape_misfit(value.shape, dims, lengths)
            if problem:
                return problem
        elif value.shape != expected:
            return f"shape {expected} expected, found {value.shape}"
        # A finite sum of squares proves it at a third of the cost; one that overflows proves nothing.
        if finite and not math.isfinite(np.vdot(value, value)) and not np.isfinite(value).all():
            return "finite numbers expected, found NaN or infinity"
        if dims.most is not None and value.size and value.max() > dims.most:
            return f"values of at most {dims.most} expected, found {value.max()}"
        return ""

    return check


def _shape_misfit(shape: tuple[int, ...], dims: Dims, lengths: dict[str, int]) -> str:
    """What is wrong with the shape of an array that has free lengths, or nothing; notes what they are."""
    if len(shape) != len(dims.shape):
        return f"shape {dims.shape} expected, found {shape}"
    low, high = dims.lengths or (0, MAX_LENGTH)
    for name, found in zip(dims.shape, shape, strict=True):
        known = lengths.setdefault(name, found) if isinstance(name, str) else name
        if found != known:
            return f"shape {dims.shape} expected with {name} = {known}, found {shape}"
        if isinstance(name, str) and not low <= found <= high:
            return f"{low} to {high} of {dims.shape} expected, found {found}"
    return ""
