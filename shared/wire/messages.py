"""All messages on the wire, as frozen dataclasses.

The annotation of a field is its schema. `Annotated[NDArray[np.float32], Dims("nx", "ny", finite=False)]` is a float32 array.
Dimensions with the same name have the same length within one message. The constructor checks every field, so every message
object is well formed, for the sender and for the receiver.

Poses are (4, 4) matrices [m]. {world} is fixed at the robot's start, {odom} is the frame of leg odometry, {body} moves with
the robot.
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
UNKNOWN = 127  # value of the evaluation function in cells that were never seen
MAX_FOOTHOLD_SCORE = 1.0  # highest score of a cell that carries a foot
HAZARDS = ("", "water", "loose ground", "no ground by touch")  # indexed by TerrainMap.hazard
MAX_LENGTH = 4_000_000  # elements along one dimension of an array
MAX_WAYPOINTS = 32  # of a goal
MAX_PATH = 64  # corners of a planned path
MAX_SECTION = 512  # steps in a planned section of a passage
MAX_PREVIEW = 1 << 17  # bytes of a preview image
MAX_GRAY = 640  # [px] edges of a grey image
MAX_TREE = 8000  # edges of the search tree that are sent


@dataclass(frozen=True, slots=True)
class Dims:
    """Shape of an array field: exact lengths, or names of free lengths.

    A name stands for the same length everywhere in one message. A packed array is sent as compressed differences along its
    first axis, without loss. An optional array may be empty: all its free lengths are then 0, even if other arrays use the
    same names.
    """

    shape: tuple[int | str, ...]
    finite: bool
    packed: bool
    optional: bool
    most: int | None = dataclasses.field(repr=False)  # largest allowed value; not part of the wire format
    lengths: tuple[int, int] | None = dataclasses.field(repr=False)  # range of the free lengths; not part of the wire format

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
GaitRequest: TypeAlias = Literal["tripod", "ripple", "wave", "auto"]  # auto: the planner chooses by what it sees
GapCrossingMode: TypeAlias = Literal["if needed", "always", "never"]
FaultTarget: TypeAlias = Literal["bytes", "packets", "servo", "bus", "supply"]
FaultKind: TypeAlias = Literal[
    "silent", "stuck", "garbage", "wrong", "slow", "intermittent", "jammed", "overload", "heat", "hot", "slipped", "jump",
    "drift", "bit", "sign", "weak", "gone", "sag", "drain"
]  # fmt: skip
BrokenPart: TypeAlias = Literal["value", "id", "length", "error", "two bits", "two bytes"]
_POINTS_WITHOUT_COLOR, _CELLS_WITHOUT_COLOR = np.zeros((0, 3), np.uint8), np.zeros((0, 0, 3), np.uint8)
_NO_SIGHTS = np.zeros((0, 3), dtype=np.int16)
_NO_CELLS = np.zeros((0, 0), np.uint8)
_LEVEL_LEGS = np.zeros(6)
_NEVER, _NOWHERE, _NONE = np.full(6, -1, dtype=np.int64), np.zeros((6, 3)), np.zeros(6, dtype=np.bool_)
_NO_PATH = np.zeros((0, 2))
_NO_INPUTS = np.zeros(0)


class Mode(StrEnum):
    """Mode of the actuator; only the actuator sets it."""

    OFF = "off"  # torque off; only an operator command leaves this mode
    READY = "ready"  # torque on, the legs hold their positions; `stand` is the next command
    STAND = "stand"  # moving to the resting stance
    WALK = "walk"  # executing an accepted plan
    HOLD = "hold"  # standing where the last step ended, torque on, ready for the next plan
    SIT = "sit"  # lowering the body to the ground
    FAULT = "fault"  # hardware fault; holds position as far as possible until the fault clears


@dataclass(frozen=True, slots=True)
class Message:
    """Base class of all messages; the constructor checks the annotations.

    The constructor truncates a text that is too long: a reason may quote other texts, and must not crash the service that
    sends it. A received frame with such a text is refused (`sextant.shared.wire.codec`).
    """

    stamp_ns: int  # [ns] time at which the content was true; every stage copies it from its input

    def contradiction(self) -> str:
        """Return how fields contradict each other, or an empty text.

        A frame with such a message is refused (`sextant.shared.wire.codec`).
        """
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
    """Clock tick of a service that is paced by its own clock; never sent."""


@dataclass(frozen=True, slots=True)
class DepthImage(Message):
    """One depth frame; camera -> perception.

    The robot profile has the intrinsics.
    """

    depth: Annotated[NDArray[np.uint16], Dims("h", "w")]  # raw units of the sensor's depth_scale, 0 = no return
    # Brightness of a camera with colour at the same instant, or empty; a pixel is the mean of a square of pixels
    gray: Annotated[NDArray[np.uint8], Dims("gray_h", "gray_w", optional=True, lengths=(1, MAX_GRAY))] = dataclasses.field(
        default_factory=lambda: _NO_CELLS
    )


@dataclass(frozen=True, slots=True)
class ExternalDepth(Message):
    """One depth frame of a camera that another program reads; any program on the robot -> camera.

    The camera process publishes it as its own if its `device` is "external". The stamp is the time of the exposure on the
    robot's clock, as that of ActuatorState.
    """

    depth: Annotated[NDArray[np.uint16], Dims("h", "w")]  # raw units, 0 = no return
    depth_scale: float  # raw units per metre
    fx: float  # [px] focal length along u
    fy: float  # [px] focal length along v
    cx: float  # [px] u of the optical axis
    cy: float  # [px] v of the optical axis


@dataclass(frozen=True, slots=True)
class ColorImage(Message):
    """One colour frame, registered to the depth frame; camera -> perception.

    Both frames have the same stamp.
    """

    rgb: Annotated[NDArray[np.uint8], Dims("h", "w", 3)]


@dataclass(frozen=True, slots=True)
class Preview(Message):
    """Small JPEG images of the camera's view for display; perception -> console."""

    # JPEG, near red, far blue, unknown black
    depth_jpeg: Annotated[NDArray[np.uint8], Dims("depth", lengths=(0, MAX_PREVIEW))]
    color_jpeg: Annotated[NDArray[np.uint8], Dims("color", lengths=(0, MAX_PREVIEW))]  # JPEG; empty without a colour camera


@dataclass(frozen=True, slots=True)
class FloorView(Message):
    """The floor in a depth frame while a calibration subscribes; perception -> calibration.

    A block has 40 x 40 pixels; the blocks are in rows, from the first pixel of the frame. Depth error and distortion of the
    camera are not corrected.
    """

    inverse_depth: Annotated[NDArray[np.float64], Dims("block", finite=False)]  # [1/m] mean of a block; NaN: not the floor


@dataclass(frozen=True, slots=True)
class CameraState(Message):
    """State of the depth camera, a few times a second; camera -> planner, console."""

    device: str  # description of the camera
    ok: bool  # False: no images arrive, or they are unusable and are not published
    reason: str  # of the fault; empty when ok


@dataclass(frozen=True, slots=True)
class Imu(Message):
    """Angular rate and specific force; imu -> actuator, perception."""

    gyro: Vector3  # [rad/s] {body}
    specific_force: Vector3  # [m/s^2] {body}, +g up at rest


@dataclass(frozen=True, slots=True)
class Odometry(Message):
    """Leg odometry from the stance legs' joints; actuator -> perception, planner.

    {odom} starts again, with its origin on the ground below the body, x ahead: when the actuator starts, when the robot has
    stood up, and when the legs go on after the servo bus or the actuator was interrupted. `epoch` of ActuatorState changes
    with it.
    """

    T_odom_body: Pose
    path_length: float  # [m] horizontal path length since {odom} began
    total_rotation: float  # [rad] summed absolute heading change since {odom} began
    stance: LegFlags  # legs that the odometry used as stance legs
    reliable: bool  # False while fewer than three legs carry load


@dataclass(frozen=True, slots=True)
class ActuatorState(Message):
    """State of the legs and progress of the plan; actuator -> planner, console."""

    mode: Mode
    reason: str  # of this mode
    lease: str  # holder that may move the legs; empty when the lease is free
    epoch: int  # [ns] when {odom} began, see Odometry; plans of another epoch are refused
    speed_scale: float  # [1] share of normal speed that the servos can sustain
    plan_refusal: str  # why the last plan was refused; empty if it was accepted, or 1 s after it
    refused_plan_ns: int  # [ns] stamp of the newest plan that the legs cannot execute; -1 for none
    plan_ns: int  # [ns] stamp of the current or last plan; -1 before the first
    step: int  # number of the current step, or of the last finished one
    phase: float  # [1] progress of the step, 0 to 1; 1 when it is finished
    swing: LegFlags  # legs that swing according to the plan
    contact: LegFlags  # legs that carry load according to the measured load; never between lift-off and touchdown
    q: PerJoint  # [rad] measured joint angles by the horns of the profile, without the corrections of `HornErrors`
    load_nm: PerJoint  # [N m] motor torque, from the servos' present load
    feet: PerJoint  # (6, 3) [m] {body} measured foot centres
    T_odom_body: Pose  # measured, the same as in Odometry
    body_ref: Pose  # {odom} current reference of the body pose
    T_world_odom: Pose  # correction that the newest accepted plan used; a restarted perception starts from it
    voltage: float  # [V] lowest of all servos
    temperature: float  # [deg C] highest of all servos
    warnings: tuple[str, ...]  # present ones, with servos named by leg and joint; the refusal of an order stays for 5 s
    # [ns] stamp of each foot's last touchdown, -1 before the first; the next two fields describe it until the next touchdown
    touchdown_ns: Annotated[NDArray[np.int64], Dims(6)] = dataclasses.field(default_factory=lambda: _NEVER)
    touchdown_point: PerJoint = dataclasses.field(
        default_factory=lambda: _NOWHERE
    )  # (6, 3) [m] {odom} underside of the foot where it touched the ground, or the lowest point that it probed
    touchdown_contact: LegFlags = dataclasses.field(default_factory=lambda: _NONE)  # False: the foot found no ground
    slip: float = 0.0  # [m] largest displacement of a stance foot relative to the others


@dataclass(frozen=True, slots=True)
class BodyPose(Message):
    """Estimated body pose; perception -> mapper, planner, operator."""

    T_world_body: Pose
    T_world_odom: Pose  # correction: T_world_odom @ T_odom_body is the body pose at nearby times, with averaged tilt
    covariance: Annotated[
        NDArray[np.float64], Dims(6, 6)
    ]  # [m^2, m rad, rad^2] of body position, then rotation, in {world}, relative to the recently mapped ground
    overlap: float  # [1] share of the scan that overlaps the reference
    ok: bool  # False: registration failed, the pose is odometry alone
    reason: str  # of the failure; empty when ok
    degenerate: Annotated[NDArray[np.float64], Dims("k", 6)]  # unit twists, as above, that only odometry constrains


@dataclass(frozen=True, slots=True)
class ExternalPose(Message):
    """Body pose from another localization, such as SLAM; any program -> perception.

    Perception uses it in place of its registration if its setting `method` is "external". The stamp is the time of the
    measurement on the robot's clock, as that of ActuatorState.
    """

    frame: str  # name of the pose's frame, which does not move on the ground
    T_frame_body: Pose
    position_sigma: float = 0.0  # [m] standard deviation in each direction; 0: unknown
    rotation_sigma: float = 0.0  # [rad] the same about each axis


@dataclass(frozen=True, slots=True)
class CameraErrors(Message):
    """Errors of the camera's profile, estimated while the robot walks; perception -> console, recorder.

    Each array holds roll, pitch and yaw [rad] of the mount in axes of the body, its height [m], the relative error of the
    depth [1], and the time [s] from an exposure to its stamp: those of the profile minus the true ones.
    """

    estimate: Annotated[NDArray[np.float64], Dims(6)]  # [rad, rad, rad, m, 1, s]
    sigma: Annotated[NDArray[np.float64], Dims(6)]  # standard deviations of the estimate
    corrected: Annotated[NDArray[np.float64], Dims(6)]  # errors that perception corrects now
    finding: str  # errors that the operator should know, as a sentence, or empty


@dataclass(frozen=True, slots=True)
class HornErrors(Message):
    """Errors of the horns, estimated while the robot walks; actuator -> console, recorder.

    Each array (6, 3) [rad] holds numbers to add to the horn offsets of the profile, as `trims_deg` of a calibration does.
    """

    estimate: PerJoint  # (6, 3) [rad] most likely errors
    sigma: PerJoint  # (6, 3) [rad] standard deviations of the estimate
    corrected: PerJoint  # (6, 3) [rad] what the actuator adds now


@dataclass(frozen=True, slots=True)
class Scan(Message):
    """Ground points of one depth frame, one point per map cell; perception -> mapper."""

    origin: Vector3  # [m] {world}
    points_mm: Annotated[NDArray[np.int16], Dims("n", 3, packed=True)]  # [mm] from the origin; neighbours are consecutive
    pixel_count: Annotated[NDArray[np.uint8], Dims("n", packed=True)]  # pixels per point, 255 for more
    height_range_mm: Annotated[NDArray[np.uint8], Dims("n", packed=True)]  # [mm] height range of these pixels, 255 for more
    p_world_camera: Vector3  # [m] camera position
    pose_covariance: Annotated[
        NDArray[np.float64], Dims(6, 6)
    ]  # [m^2, m rad, rad^2] of the camera position, then rotation, in {world}, that placed the points
    color: Annotated[NDArray[np.uint8], Dims("n", 3, packed=True, optional=True, most=63)] = dataclasses.field(
        default_factory=lambda: _POINTS_WITHOUT_COLOR
    )  # codes of `sextant.shared.color`, one row per point, or empty
    free_rays_mm: Annotated[NDArray[np.int16], Dims("m", 3, packed=True)] = dataclasses.field(
        default_factory=lambda: _NO_SIGHTS
    )  # [mm] from the origin: ends of additional rays that are free of obstacles
    ground_change: Annotated[NDArray[np.float64], Dims(3)] = dataclasses.field(
        default_factory=lambda: np.zeros(3)
    )  # (a, b, c): corrections of the camera have changed heights by a x + b y + c since the first scan

    @property
    def points(self) -> NDArray[np.float64]:
        """Ground points (n, 3) [m] {world}."""
        return from_millimetres(self.points_mm, self.origin)

    @property
    def free_ray_ends(self) -> NDArray[np.float64]:
        """Ends of the additional free rays (m, 3) [m] {world}."""
        return from_millimetres(self.free_rays_mm, self.origin)


@dataclass(frozen=True, slots=True)
class ScanReceipt(Message):
    """Receipt for the scan with this stamp; mapper -> perception, planner.

    Perception limits its rate by these receipts.
    """

    refused: str = ""  # why the scan before this one was not mapped, or empty
    leg_heights: Annotated[NDArray[np.float64], Dims(6, finite=False)] = dataclasses.field(
        default_factory=lambda: np.full(6, np.nan)
    )  # [m] height of the ground as each leg measures it, minus the map's; NaN before its first touchdown


@dataclass(frozen=True, slots=True)
class TerrainMap(Message):
    """Terrain around the robot; mapper -> planner, console.

    Cell (i, j) is centred at origin + resolution * (i, j).
    """

    resolution: float  # [m] cell edge
    origin: Annotated[NDArray[np.float64], Dims(2)]  # [m] {world} centre of cell (0, 0)
    elevation: Annotated[NDArray[np.float32], Dims("nx", "ny", finite=False, packed=True)]  # [m] {world}, NaN where never seen
    variance: Annotated[
        NDArray[np.float32], Dims("nx", "ny", finite=False, packed=True)
    ]  # [m^2] of elevation, NaN where never seen
    score: Annotated[
        NDArray[np.float32], Dims("nx", "ny", finite=False, packed=True)
    ]  # 0 is best, above 1 no foothold, NaN unknown
    assumed: Annotated[NDArray[np.bool_], Dims("nx", "ny", packed=True)]  # filled in at the start, not measured
    # Masri's evaluation function [cells]: -1 and less is a foothold, the lowest is best; 1 and more is the distance to the
    # nearest foothold; 127 is unknown.
    evaluation: Annotated[NDArray[np.int8], Dims("nx", "ny", packed=True)]
    # Empty without a colour camera, as are the next two fields
    color: Annotated[NDArray[np.uint8], Dims("nx", "ny", 3, packed=True, optional=True)] = dataclasses.field(
        default_factory=lambda: _CELLS_WITHOUT_COLOR
    )  # R, G, B
    hazard: Annotated[NDArray[np.uint8], Dims("nx", "ny", packed=True, optional=True, most=len(HAZARDS) - 1)] = (
        dataclasses.field(default_factory=lambda: _NO_CELLS)
    )  # 0 none, 1 water, 2 loose ground, 3 a foot found no ground; a cell with a hazard is no foothold
    confidence: Annotated[NDArray[np.uint8], Dims("nx", "ny", packed=True, optional=True, most=100)] = dataclasses.field(
        default_factory=lambda: _NO_CELLS
    )  # [%] probability of the most likely ground type, 0 where unknown
    # (6,) [m] height of the ground as each leg measures it, minus `elevation`
    leg_heights: Annotated[NDArray[np.float64], Dims(6)] = dataclasses.field(default_factory=lambda: _LEVEL_LEGS)


@dataclass(frozen=True, slots=True)
class PassageRequest(Message):
    """Request to survey a strip, repeated while it holds; planner, operator -> mapper."""

    origin: Annotated[NDArray[np.float64], Dims(2)]  # [m] {world} middle of the near side
    heading: float  # [rad] {world} of the long axis
    length: float  # [m] a whole number of map cells
    width: float  # [m] a whole number of map cells


@dataclass(frozen=True, slots=True)
class PassageMap(Message):
    """Map of a surveyed strip, in 1 cm cells; mapper -> planner, console.

    The cells are along and across the strip.

    Cell (i, j) is centred at origin + resolution * R(heading) (i, j). The elevation of an unseen cell is NaN.
    """

    resolution: float  # [m] cell edge
    origin: Annotated[NDArray[np.float64], Dims(2)]  # [m] {world} centre of cell (0, 0)
    heading: float  # [rad] {world} of the first axis
    elevation: Annotated[NDArray[np.float32], Dims("nx", "ny", finite=False)]  # [m] {world}, NaN where unknown
    normals: Annotated[
        NDArray[np.int16], Dims("nx", "ny", 3, packed=True)
    ]  # {world} upward normals of length 32767; zero where unknown
    roughness: Annotated[NDArray[np.float32], Dims("nx", "ny", finite=False)]  # [m] rms distance of nearby points to a plane
    assumed: Annotated[NDArray[np.bool_], Dims("nx", "ny")]  # set to the plane through the feet, not measured
    # Masri's evaluation function [cells], as in TerrainMap; cells outside the strip count as vacant
    evaluation: Annotated[NDArray[np.int8], Dims("nx", "ny")]
    unseen_share: float  # [1] share of unseen cells
    reason: str  # what is unseen and why, or why there is no map; empty when all is seen
    T_world_next_view: Pose  # body pose, reachable without a step, that shows the most unseen cells
    next_view_cells: Annotated[NDArray[np.bool_], Dims("nx", "ny")]  # unseen cells that it shows; none if no pose is worth it


@dataclass(frozen=True, slots=True)
class PassagePlan(Message):
    """Result of planning at one stop of a passage; planner -> console, scorer.

    The robot walks these steps as one section. With the state "no way" they lead to the furthest configuration found, and are
    not walked.
    """

    section: int  # counts up from 1 within a passage
    state: Literal["complete", "partial", "no way"]  # reaches the goal; ends with the map or the requested cycles; no path
    reason: str  # why the plan ends there; with "no way", the test that stops it
    origin: Annotated[NDArray[np.float64], Dims(2)]  # [m] {world} middle of the near side of the planned strip
    heading: float  # [rad] {world} of its long axis
    goal: float  # [m] goal of the body along the strip, from the origin
    furthest: float  # [m] furthest body position found, along the strip from the origin
    generated_nodes: int  # nodes of the tree, Masri's n_g
    expanded_nodes: int  # expanded nodes, Masri's n_e
    planning_ms: float  # [ms] wall time of planning; differs between runs
    leg: Annotated[NDArray[np.uint8], Dims("step", most=6, lengths=(0, MAX_SECTION))]  # swing leg; 6 if only the body moves
    # [m] {world} centre of that foot at the end of the step; with leg 6 the body position
    footholds: Annotated[NDArray[np.float64], Dims("step", 3, lengths=(0, MAX_SECTION))]
    body: Annotated[NDArray[np.float64], Dims("step", 3, lengths=(0, MAX_SECTION))]  # [m] {world} body position at its end
    tree_edges: Annotated[
        NDArray[np.float32], Dims("edge", 2, 3, lengths=(0, MAX_TREE))
    ]  # [m] {world} body positions of parent and child nodes
    # [m] {world} foot of the leg that fails the test at the furthest configuration, or the body; empty if there is a path
    failure_point: Annotated[NDArray[np.float64], Dims("stop", 3, lengths=(0, 1))]


@dataclass(frozen=True, slots=True)
class StepPlan(Message):
    """One step: swing legs, touchdowns and body motion; planner -> actuator.

    A step ends in a statically stable stance, so the actuator can finish it without another plan. A higher revision of the
    current step moves its touchdowns. The next step number is queued after it.
    """

    epoch: int  # of the actuator state that the plan uses
    step: int  # counts up by one
    revision: int  # counts up within a step
    T_world_odom: Pose  # correction that the planner used; relates {world} to leg odometry
    swing: LegFlags
    touchdown: Annotated[NDArray[np.float64], Dims(6, 3)]  # [m] {world} foot centres; for stance legs their present position
    clearance: PerLeg  # [m] height of a swing foot over both ends of its swing
    body_goal: Pose  # {world} body at the end of the step
    duration: float  # [s]
    stop: bool  # True: come to rest at the end of the step
    # [ns] stamp of the newest terrain map that the plan agrees with, thus of a depth image; -1 for a plan without that map
    map_ns: int = -1


@dataclass(frozen=True, slots=True)
class PlannerStatus(Message):
    """State of the planner and the reason for it; planner -> operator, console."""

    state: Literal[
        "waiting", "resting", "stepping", "blocked", "arrived"
    ]  # arrived: at the goal or in the commanded posture, with all legs at rest
    reason: str  # of this state
    step: int
    moved_footholds: int  # touchdowns of the newest plan that differ from their nominal position
    blocked_leg: int  # index of the leg without a foothold, -1 for none
    path: Annotated[NDArray[np.float64], Dims("path", 2, lengths=(0, MAX_PATH))] = dataclasses.field(
        default_factory=lambda: _NO_PATH
    )  # [m] {world} corners of the path from the robot to the goal; the goal alone once arrived, empty without a path
    invalid_command: bool = False  # blocked because this robot can never execute the command, wherever it stands
    # The planner's choice; the gait is empty and the speed is zero where the request does not leave them to the planner
    gait: Literal["", "tripod", "ripple", "wave"] = ""
    speed: float = 0.0  # [m/s] over level ground; steps over obstacles are slower
    gait_reason: str = ""  # class of the ground, a colon, and what decided

    def has_arrived_at(self, place: NDArray[np.float64]) -> bool:
        """Return whether the robot has arrived at the goal with this last waypoint (2,) [m] {world}, not at another one."""
        return self.state == "arrived" and np.array_equal(self.path, [place])


@dataclass(frozen=True, slots=True)
class VelocityCommand(Message):
    """Commanded velocity and gait, repeated while it holds; operator -> planner.

    With `auto_speed` the planner chooses the speed. A velocity of the profile's `max_speed` or more then means that speed, a
    smaller one the same share of it.
    """

    velocity: Annotated[NDArray[np.float64], Dims(2)]  # [m/s] {body} forward, left
    yaw_rate: float  # [rad/s]
    body_height: float  # [m] over the floor
    lift: float  # [m] clearance of swinging feet
    gait: GaitRequest = "tripod"  # from the next step on
    blind_walking: bool = False  # True: walk slowly without a map, the feet detect the ground
    auto_speed: bool = False  # True: the planner chooses speed and foot height by what it sees


@dataclass(frozen=True, slots=True)
class Goal(Message):
    """Goal of the walk, repeated while it holds; operator -> planner.

    A fresh VelocityCommand overrides it.
    """

    waypoints: Annotated[NDArray[np.float64], Dims("waypoint", 2, lengths=(1, MAX_WAYPOINTS))]  # [m] {world} in order
    tolerance: float  # [m] distance from the last waypoint that counts as arrived
    speed: float  # [m/s] maximum
    body_height: float  # [m] over the floor
    lift: float  # [m] clearance of swinging feet
    gait: GaitRequest = "tripod"
    gap_crossing: GapCrossingMode = "if needed"  # if needed: where there is no path; always: straight to the last waypoint
    auto_speed: bool = False  # True: the planner chooses the speed, see VelocityCommand


@dataclass(frozen=True, slots=True)
class PostureCommand(Message):
    """Commanded pose of the body over its standing feet, repeated while it holds; operator -> planner.

    It is relative to the rest pose, in which the feet are nearest to the resting stance. All zero is that pose. A fresh
    VelocityCommand overrides it, and it overrides a Goal.
    """

    place: Annotated[NDArray[np.float64], Dims(3)]  # [m] forward, left, up from the rest pose
    rpy: Annotated[NDArray[np.float64], Dims(3)]  # [rad] roll, pitch and yaw from the rest pose


@dataclass(frozen=True, slots=True)
class ModeCommand(Message):
    """Mode command for the legs; operator -> actuator."""

    mode: Literal["off", "stop", "ready", "stand", "walk", "sit"]
    sequence: int  # [ns] robot clock time of the command; the actuator executes each sequence once, repeats are ignored
    holder: str = "operator"  # sender; only the lease holder may move the legs, any client may stop them
    take_over: bool = False  # True: take the lease from its holder; with `stop` nothing moves


@dataclass(frozen=True, slots=True)
class StopOrder(Message):
    """Stop or torque-off command; any client -> actuator.

    Clients that may not drive can publish only this command.
    """

    mode: Literal["off", "stop"]
    sequence: int  # the actuator executes each sequence once, repeats are ignored
    holder: str = "operator"  # sender


@dataclass(frozen=True, slots=True)
class CalibrationState(Message):
    """Progress and result of a calibration; `sextant camera calibrate` -> console."""

    running: bool
    status: str  # what is being done, or how it ended
    posture: int  # number of the current posture, 0 before the first one
    postures: int  # number of all postures
    result: tuple[str, ...]  # each number with its 95 % interval, as text; empty before the end, and if nothing was computed
    refusal: str  # why the result is not used, or why there is none; empty otherwise


@dataclass(frozen=True, slots=True)
class RecordCommand(Message):
    """Command to start or stop recording; console -> recorder."""

    record: bool
    sequence: int  # [ns] time of the command, increasing; the recorder executes each once, repeats are ignored


@dataclass(frozen=True, slots=True)
class RecorderState(Message):
    """State of the recorder; recorder -> console."""

    recording: bool
    sequence: int  # of the last executed command, -1 before the first
    file: str  # current or last file; empty before the first
    duration: float  # [s] duration of the recording
    size: int  # [B] total size of its files
    disk_free: int  # [B] free disk space, -1 if unknown
    dropped: int  # messages lost because the disk was too slow
    reason: str  # why recording ended without a command; empty otherwise


@dataclass(frozen=True, slots=True)
class FaultCommand(Message):
    """Fault to inject into the simulated servos or bus; tests -> simulator.

    `sextant.shared.servo.bus_fault` defines the faults.
    """

    target: FaultTarget
    kind: FaultKind
    at_s: float  # [s] simulated start time; a past time means at once
    for_s: float  # [s] duration
    servo: int  # bus id, -1 for no particular servo
    share: float  # [1] of the affected bytes or responses
    value: int  # of a byte
    part: BrokenPart  # part of the response that is wrong
    delay_ms: float  # [ms] of a response
    on_ms: float  # [ms] healthy part of the cycle
    off_ms: float  # [ms] faulty part of the cycle
    cable: bool  # True: the servo loses its power too
    offset_ticks: int  # [ticks]
    kelvin_per_s: float  # [K/s] heating rate
    celsius: int  # [deg C] temperature that the servo reports
    degrees: float  # [deg] by which the horn slips or the encoder jumps
    deg_per_s: float  # [deg/s] drift of the encoder
    bit: int  # of the goal register
    renamed: bool  # True: the port returns under another name
    volts: float  # [V] voltage drop


@dataclass(frozen=True, slots=True)
class GroundTruth(Message):
    """True state of the simulation; simulator -> scorer only."""

    T_world_body: Pose
    q: PerJoint  # [rad]
    torque: PerJoint  # [N m] of the motors
    feet: PerJoint  # (6, 3) [m] {world} foot centres
    contact: LegFlags  # legs whose foot carries load
    carries_load: LegFlags  # legs that carry load, by the foot or by a tibia on an edge
    shutdown: Annotated[NDArray[np.bool_], Dims(6, 3)]  # servos that have latched an error
    voltage: float  # [V]
    temperature: float  # [deg C] hottest servo
    scenario: str  # name of the scenario
    seed: int  # random seed of the scenario
    robot: str  # name of the profile


@dataclass(frozen=True, slots=True)
class Health(Message):
    """State of one service, once a second; every service -> launcher, console."""

    service: str
    status: str  # current activity
    steps: int
    refused: int  # messages that did not decode, or arrived under another key
    dropped: int  # messages that arrived faster than they were read
    last_refusal: str
    stages: tuple[str, ...]  # names of the timed stages and streams
    stage_p50_ms: Annotated[NDArray[np.float64], Dims("stage")]  # [ms] median
    stage_p99_ms: Annotated[NDArray[np.float64], Dims("stage")]  # [ms] 99th percentile
    robot_clock_offset_s: float = 0.0  # [s] offset of the robot's clock from this machine's clock; 0 on the robot
    # Inputs with an age limit: topic keys, "beat" or "stall" (`shared.runtime.lateness`); the ages are since the last report
    inputs: tuple[str, ...] = ()
    # [s] worst age
    input_age_s: Annotated[NDArray[np.float64], Dims("input")] = dataclasses.field(default_factory=lambda: _NO_INPUTS)
    input_arrived_s: Annotated[NDArray[np.float64], Dims("input")] = dataclasses.field(
        default_factory=lambda: _NO_INPUTS
    )  # [s] worst age on arrival
    # [s] age limit
    input_limit_s: Annotated[NDArray[np.float64], Dims("input")] = dataclasses.field(default_factory=lambda: _NO_INPUTS)
    input_late_share: Annotated[NDArray[np.float64], Dims("input")] = dataclasses.field(
        default_factory=lambda: _NO_INPUTS
    )  # [1] share of the uses over the limit

    missed_ticks: int = 0  # clock ticks skipped since the start

    def contradiction(self) -> str:
        """Return a text if the numbers of names and values differ."""
        named = (len(self.stages), len(self.inputs))
        numbers = (len(self.stage_p50_ms), len(self.input_age_s))
        return "" if named == numbers else f"{named} values for the named stages and inputs expected, found {numbers}"


@dataclass(frozen=True, slots=True)
class Presence(Message):
    """Services of one machine, once a second; launcher -> launchers elsewhere."""

    machine: str  # unique id, new at each start
    role: str
    version: str  # of Sextant
    uptime_s: float  # [s] since the start
    services: tuple[str, ...]  # started on this machine
    keys: tuple[str, ...]  # of its topic table
    schemas: tuple[str, ...]  # of the messages of these keys, in the same order


FieldSchema: TypeAlias = tuple[str, Any, Any]


_SCHEMAS: dict[type[Message], tuple[FieldSchema, ...]] = {}


def schema(kind: type[Message]) -> tuple[FieldSchema, ...]:
    """Return the fields of a message class as (name, type, detail).

    The type of an array is np.ndarray and its detail is (dtype, Dims).
    """
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


Check: TypeAlias = Callable[[Any, dict[str, int]], str]  # returns the error in a value, or an empty text

_CHECKS: dict[type[Message], tuple[tuple[str, Check], ...]] = {}


def _checks(kind: type[Message]) -> tuple[tuple[str, Check], ...]:
    """Return the checks of a message's fields, cached.

    They run for every message.
    """
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
    """Truncate a text, or a tuple of texts, to the limits of a message.

    Returns None for other values.
    """
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
    return value.isascii() or not any("\ud800" <= c <= "\udfff" for c in value)  # a lone surrogate has no UTF-8 form


def _check_bool(value: Any, _: dict[str, int]) -> str:
    return "" if isinstance(value, bool) else f"true or false expected, found {value!r:.40}"


def _array_check(dtype: np.dtype[Any], dims: Dims) -> Check:
    """Return the check of an array field; a fixed shape needs one comparison."""
    expected, names = dims.shape, any(isinstance(n, str) for n in dims.shape)
    finite = dims.finite and dtype.kind == "f"
    empty = tuple(0 if isinstance(n, str) else n for n in expected) if dims.optional else None

    def check(value: Any, lengths: dict[str, int]) -> str:
        if not isinstance(value, np.ndarray):
            return f"an array of {dtype} expected, found {type(value).__name__}"
        if value.dtype is not dtype and value.dtype != dtype:
            return f"an array of {dtype} expected, found {value.dtype}"
        if empty is not None and value.shape == empty:
            return ""
        if names:
            problem = _shape_misfit(value.shape, dims, lengths)
            if problem:
                return problem
        elif value.shape != expected:
            return f"shape {expected} expected, found {value.shape}"
        # A finite sum of squares proves that all values are finite, at a third of the cost. The sum may overflow, so a sum
        # that is not finite needs the full test.
        if finite and not math.isfinite(np.vdot(value, value)) and not np.isfinite(value).all():
            return "finite numbers expected, found NaN or infinity"
        if dims.most is not None and value.size and value.max() > dims.most:
            return f"values of at most {dims.most} expected, found {value.max()}"
        return ""

    return check


def _shape_misfit(shape: tuple[int, ...], dims: Dims, lengths: dict[str, int]) -> str:
    """Return the error in the shape of an array with free lengths, or an empty text.

    `lengths` stores the free lengths found so far.
    """
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
