"""Schema of a robot profile: body, legs, joint limits, servos, camera and stance.

The legs are numbered like f1 to f6 in Masri 2016: left front, right front, right middle, right rear, left rear, left middle.
They go once around the body, so every second leg belongs to the same tripod (Lotriet 2024, eq. 5.15, has the same order).

Joint angles q are (6, 3) [rad]. The coxa turns about body z, from the leg's neutral yaw. The femur angle is upward from the
horizontal. The tibia angle is relative to the straight continuation of the femur, positive upward. With all angles zero the
leg is stretched straight outward.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import date
from functools import cache, cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.shared.files import config
from sextant.shared.geometry import Array, from_xyz_rpy, inverse, rotation_from_rpy, rotation_z, transform
from sextant.shared.robot import joint_names, joint_servos
from sextant.shared.robot.body import MM, Body, Foot, LegLinks
from sextant.shared.robot.camera import DepthSensor, Intrinsics
from sextant.shared.robot.joint_servos import BusJoints, JointServos, ServoGroup
from sextant.shared.robot.servo import Battery, Servo
from sextant.shared.servo.servo_model import ServoModel

LEGS, JOINTS = joint_names.LEGS, joint_names.JOINTS
GRAVITY = 9.81  # [m/s^2]
# Limits of any step, which the actuator verifies:
SHORTEST_STEP_S, LONGEST_STEP_S = 0.3, 4.0  # [s]
MAX_TILT_DEG, MAX_TURN_DEG = 15.0, 25.0  # [deg] of the body in one step: roll and pitch, and yaw
MAX_TRAVEL_M = 0.20  # [m] of the body in one step
MAX_CLEARANCE_M = 0.12  # [m] of a swinging foot over both ends of its path
MIN_MARGIN_M = 0.005  # [m] of the centre of mass inside the polygon of standing feet
MAX_TRIM_DEG = 20.0  # a larger trim means that the horn is on the wrong notch, or that the pose was wrong
_MAX_SERVO_DEG = 180.0  # in both directions from the centre, of any model


class CoxaFrame(NamedTuple):
    """A coxa frame in plain numbers, because for six legs arrays take longer than the arithmetic itself."""

    cos: float  # of the neutral yaw
    sin: float
    x: float  # [m] {body} coxa axis
    y: float
    z: float


@dataclass(frozen=True, slots=True)
class Leg:
    """Mount, servos and servo limits of one leg."""

    name: str  # place at the body; the legs are in the order above
    mount_xyz: tuple[float, float, float]  # [m] {body} coxa axis
    neutral_yaw_deg: float  # [deg] direction of the leg at coxa angle zero, about body z from x
    servo_ids: tuple[int, int, int]  # coxa, femur, tibia
    # Signs and limits as in Masri 2016, Tables 3.1 and 3.2: servo angle = sign * (joint angle + horn offset), 0 = tick 512.
    # The limits are those of a leg without trims. The leg's brackets set the limits, so a trim shifts the servo limits.
    servo_signs: tuple[int, int, int]
    servo_limits_deg: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]  # [deg] lowest and highest

    checks = (
        *config.each("name", lambda name: name in LEGS, f"one of {', '.join(LEGS)}"),
        *config.each("mount_xyz", lambda place: abs(place) <= 10, f"at most 10 m either way {MM}"),
        *config.each("neutral_yaw_deg", lambda yaw: abs(yaw) <= 360, "-360 to 360 deg"),
        *config.each("servo_ids", lambda servo: 0 <= servo <= 253, "a servo id from 0 to 253"),
        *config.each("servo_signs", lambda sign: sign in (-1, 1), "a servo sign of 1 or -1"),
        *config.each(
            "servo_limits_deg",
            lambda limits: -_MAX_SERVO_DEG <= limits[0] < limits[1] <= _MAX_SERVO_DEG,
            "limits (coxa, femur, tibia) within -180 and 180 deg in rising order",
        ),
        config.Check(("servo_limits_deg",), joint_servos.limits_in_radians),
    )

    def __post_init__(self) -> None:
        config.verify(self)


@dataclass(frozen=True, slots=True)
class Stance:
    """Default stance and walking parameters."""

    # [m] horizontal distance of a resting foot from its coxa axis, for front, middle and rear legs. In a tripod a middle leg
    # stands alone on its side and carries the most load, so its foot should be near the body.
    foot_radius_from_coxa: tuple[float, float, float]
    body_height: float  # [m] body origin above the ground
    body_height_range: tuple[float, float]  # [m] lowest and highest
    max_speed: float  # [m/s] of the body; a planner that chooses the speed itself goes as fast as the servos bear
    step_s: float  # [s] duration of a tripod's step over level ground
    stride: float  # [m] maximum body motion during the stance of a foot
    # [m/s] speed of swinging feet, height counted twice; a faster swing takes more time instead, or the servos overheat
    foot_speed: float
    # These also scale with the size of the robot; the defaults are for a PhantomX.
    search_radius: float = 0.06  # [m] radius of the foothold search around the nominal foothold
    foot_distance: float = 0.06  # [m] minimum between feet
    support_margin: float = 0.02  # [m] minimum distance of the centre of mass from the edges of each support polygon
    max_climb: float = 0.03  # [m] maximum change of body height in one step
    rough_lift: float = 0.04  # [m] minimum clearance where the ground under a swing is uneven
    max_lift: float = 0.11  # [m] maximum height of a foot over both ends of its swing

    checks = (
        *config.each(
            "foot_radius_from_coxa body_height body_height_range search_radius max_climb rough_lift",
            lambda length: 0 < length <= 10,
            f"more than 0 and at most 10 m {MM}",
        ),
        *config.each("max_lift", lambda lift: 0 < lift <= MAX_CLEARANCE_M, f"more than 0 and at most {MAX_CLEARANCE_M} m"),
        *config.each("stride", lambda length: 0 < length <= MAX_TRAVEL_M, f"more than 0 and at most {MAX_TRAVEL_M} m"),
        *config.each("foot_distance", lambda length: 0 <= length <= 10, "0 to 10 m"),
        *config.each(
            "support_margin", lambda length: MIN_MARGIN_M < length <= 10, f"more than {MIN_MARGIN_M} and at most 10 m"
        ),
        *config.each("max_speed foot_speed", lambda speed: 0 < speed <= 100, "more than 0 and at most 100 m/s"),
        *config.each("step_s", lambda duration: 0.4 <= duration <= 2.0, "0.4 to 2 s"),
        config.together(
            "body_height body_height_range",
            lambda height, bounds: bounds[0] <= height <= bounds[1],
            "a body height within its range",
        ),
    )

    def __post_init__(self) -> None:
        config.verify(self)

    def height_or_own(self, body_height: float) -> float:
        """Return a body height [m], or that of the stance if this robot does not reach it."""
        low, high = self.body_height_range
        return body_height if low <= body_height <= high else self.body_height


CAMERA_DEVICES = ("openni2", "realsense", "oak", "orbbec", "external", "none")  # besides the paths of recorded folders


@dataclass(frozen=True, slots=True)
class Camera:
    """Depth camera and its mount.

    Without angles it looks along body x. It is turned left by yaw, then down by pitch, then about its line of sight by roll.
    """

    intrinsics: Intrinsics
    sensor: DepthSensor
    mount_xyz: tuple[float, float, float]  # [m] {body} optical centre
    pitch_down_deg: float  # [deg] below the horizontal
    roll_deg: float = 0.0  # [deg] about the line of sight; positive raises the camera's left side
    yaw_deg: float = 0.0  # [deg] left of body x
    time_offset_s: float = 0.0  # [s] from the exposure of an image to its stamp
    depth_error: float = 0.0  # [1] relative error of the measured depth; positive: it is too large
    distortion: float = 0.0  # [1] radial distortion k1 of Brown's model
    color: bool = False  # whether it also sends colour images
    # Driver on the robot: "openni2", "realsense", "oak", "orbbec", "external" (frames of another program on external/depth),
    # the path of a recorded folder, or "none".
    device: str = "none"

    checks = (
        *config.each("mount_xyz", lambda place: abs(place) <= 10, "at most 10 m either way"),
        *config.each("pitch_down_deg", lambda pitch: -45.0 <= pitch <= 90.0, "an angle from -45 (up) to 90 (straight down)"),
        *config.each("roll_deg yaw_deg", lambda angle: abs(angle) <= 180.0, "an angle from -180 to 180 deg"),
        *config.each("time_offset_s", lambda offset: abs(offset) <= 1.0, "at most 1 s either way"),
        *config.each("depth_error distortion", lambda share: abs(share) <= 0.5, "at most 0.5 either way"),
        *config.each(
            "device", lambda device: device.strip() != "", f"{', '.join(CAMERA_DEVICES)}, or the path of a recorded folder"
        ),
    )

    def __post_init__(self) -> None:
        config.verify(self)

    @property
    def rectified(self) -> "Camera":
        """Camera of the same images after their distortion is removed, with true depth."""
        true_scale = self.sensor.depth_scale * (1.0 + self.depth_error)
        sensor = replace(self.sensor, depth_scale=true_scale) if self.depth_error else self.sensor
        return replace(self, sensor=sensor, depth_error=0.0, distortion=0.0)

    @property
    def T_body_mount(self) -> Array:
        """Pose (4, 4) of the camera in the body frame, with x along the line of sight, y left, z up."""
        return _mount_pose(self.mount_xyz, (self.roll_deg, self.pitch_down_deg, self.yaw_deg)).copy()

    @property
    def T_body_camera(self) -> Array:
        """Pose (4, 4) of the optical frame (x right, y down, z forward) in the body frame."""
        return np.asarray(self.T_body_mount @ _T_MOUNT_CAMERA)


@dataclass(frozen=True, slots=True)
class Imu:
    """Inertial sensor, which gives the robot gravity and its heading between two steps.

    The keys besides `device` are those of a BNO055 or BNO085. Without angles its x axis points ahead and its z axis up.
    Otherwise it is turned left by yaw, then down by pitch, then about its x axis by roll.
    """

    device: Literal["camera", "bno055", "bno085", "none"] = "camera"  # "camera": that of the depth camera, if it has one
    port: str = "/dev/i2c-1"  # I2C bus, or serial port such as /dev/ttyUSB0
    address: int = 0  # on the I2C bus; 0: 0x28 of a BNO055, 0x4A of a BNO085
    roll_deg: float = 0.0  # [deg] about its x axis
    pitch_deg: float = 0.0  # [deg] positive: its x axis points down
    yaw_deg: float = 0.0  # [deg] left of body x

    checks = (
        *config.each("port", lambda port: port.startswith("/dev/"), "a device such as /dev/i2c-1 or /dev/ttyUSB0"),
        *config.each("address", lambda address: 0 <= address <= 0x7F, "an I2C address from 0 to 0x7f"),
        *config.each("roll_deg pitch_deg yaw_deg", lambda angle: abs(angle) <= 180.0, "an angle from -180 to 180 deg"),
    )

    def __post_init__(self) -> None:
        config.verify(self)

    @property
    def R_body_imu(self) -> Array:
        """Rotation (3, 3) of vectors from the axes of the sensor into {body}."""
        return rotation_from_rpy(np.radians([self.roll_deg, self.pitch_deg, self.yaw_deg]))

    @property
    def is_separate(self) -> bool:
        """Whether the robot has an inertial sensor apart from its camera."""
        return self.device not in ("camera", "none")


_T_MOUNT_CAMERA = transform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))


@cache
def _mount_pose(mount_xyz: tuple[float, float, float], rpy_deg: tuple[float, float, float]) -> Array:
    return from_xyz_rpy(mount_xyz, np.radians(rpy_deg))


@dataclass(frozen=True, slots=True)
class Calibration:
    """Deviation of one leg's horns from the profile.

    `sextant servos calibrate` measures it.
    """

    leg: str  # name of the leg
    date: date  # of the measurement
    trims_deg: tuple[float, float, float]  # [deg] coxa, femur, tibia; added to the horn offsets

    checks = (
        *config.each("leg", lambda name: name in LEGS, f"one of {', '.join(LEGS)}"),
        *config.each("date", lambda day: type(day) is date, "a date without time, as in 2026-07-30,"),
        *config.each(
            "trims_deg",
            lambda trim: abs(trim) <= MAX_TRIM_DEG,
            f"a trim of at most {MAX_TRIM_DEG:g} deg either way; mount the horn straight",
        ),
    )

    def __post_init__(self) -> None:
        config.verify(self)


def _out_of_order(legs: tuple[Leg, ...]) -> Iterator[config.Misfit]:
    """Yield legs whose name does not match their index."""
    for i, (leg, expected) in enumerate(zip(legs, LEGS, strict=False)):
        found = getattr(leg, "name", expected)
        if found != expected:
            yield config.Misfit(f"legs[{i}].name", f"{expected!r}, the order of the legs around the body,", repr(found))


def _ids_given_twice(legs: tuple[Leg, ...]) -> Iterator[config.Misfit]:
    """Yield servo ids that occur more than once."""
    owners: dict[int, str] = {}
    for i, leg in enumerate(legs):
        for k, servo in enumerate(getattr(leg, "servo_ids", ())):
            place = f"legs[{i}].servo_ids[{k}]"
            if servo in owners:
                yield config.Misfit(place, "18 different servo ids", f"{servo}, which {owners[servo]} has, too")
            owners.setdefault(servo, place)


def _calibrated_twice(calibration: tuple[Calibration, ...]) -> Iterator[config.Misfit]:
    """Yield legs with more than one calibration."""
    seen: set[str] = set()
    for i, entry in enumerate(calibration):
        name = getattr(entry, "leg", None)
        if name in seen:
            yield config.Misfit(f"calibration[{i}].leg", "each leg once", repr(name))
        seen |= {name} if name else set()


@dataclass(frozen=True)
class RobotProfile:
    """All parameters of one kind of robot.

    They are in SI units, except angles in fields named `_deg`.
    """

    name: str  # of the robot
    servo: Servo
    horn_offsets_deg: tuple[float, float, float]  # coxa, femur, tibia; Masri 2016, Fig. 3.4
    links: LegLinks
    body: Body
    foot: Foot
    stance: Stance
    legs: tuple[Leg, Leg, Leg, Leg, Leg, Leg]
    camera: Camera
    battery: Battery = field(default_factory=Battery)
    imu: Imu = Imu()
    servo_groups: tuple[ServoGroup, ...] = ()  # servos of joints that differ from `servo`
    buses: tuple[BusJoints, ...] = ()  # of servos on several ports
    calibration: tuple[Calibration, ...] = ()  # of the measured legs

    checks = (
        *config.each("name", lambda name: name.strip() != "", "a name"),
        *config.each("name", lambda name: len(name) <= 100, "a name of at most 100 characters"),
        *config.each("horn_offsets_deg", lambda offset: abs(offset) <= 360, "-360 to 360 deg"),
        config.Check(("legs",), _out_of_order),
        config.Check(("legs",), _ids_given_twice),
        config.Check(("servo_groups",), lambda groups: joint_servos.given_twice(groups, "servo_groups")),
        config.Check(("buses",), lambda buses: joint_servos.given_twice(buses, "buses")),
        config.Check(("servo", "servo_groups"), joint_servos.unlike),
        config.Check(("servo", "servo_groups", "buses"), joint_servos.wrong_buses),
        config.Check(("servo", "servo_groups", "legs"), joint_servos.beyond_servo),
        config.Check(("calibration",), _calibrated_twice),
    )

    def __post_init__(self) -> None:
        config.verify(self)

    @property
    def servo_model(self) -> ServoModel:
        """Registers and units of the servos in `servo`; those of groups have other ones."""
        return self.servo.servo_model

    @cached_property
    def servos(self) -> JointServos:
        """The servo of each joint, and its bus."""
        return JointServos(self.servo, self.servo_groups, self.buses)

    @cached_property
    def servo_models(self) -> dict[int, ServoModel]:
        """Map of bus id -> model, ordered by leg."""
        return dict(zip(self.servo_names, self.servos.models, strict=True))

    @cached_property
    def servo_ids(self) -> NDArray[np.int64]:
        """Bus ids (6, 3)."""
        return np.array([leg.servo_ids for leg in self.legs])

    @cached_property
    def servo_signs(self) -> Array:
        """Signs (6, 3) of the servo angles: +1 or -1 for an increasing joint angle."""
        return np.array([leg.servo_signs for leg in self.legs], dtype=np.float64)

    @cached_property
    def servo_names(self) -> dict[int, str]:
        """Map of bus id -> name such as "left front coxa", ordered by leg."""
        return {servo: f"{leg.name} {joint}" for leg in self.legs for servo, joint in zip(leg.servo_ids, JOINTS, strict=True)}

    @property
    def servos_elsewhere(self) -> dict[int, str]:
        """Map of bus id -> name of servos that are not on the bus in question; empty for a whole robot."""
        return {}

    @cached_property
    def trims(self) -> Array:
        """Deviations (6, 3) [rad] of the horns from `horn_offsets_deg`.

        They are zero for legs without calibration.
        """
        measured = {entry.leg: entry.trims_deg for entry in self.calibration}
        return np.asarray(np.radians([measured.get(name, (0.0, 0.0, 0.0)) for name in LEGS]))

    @cached_property
    def horn_offsets(self) -> Array:
        """Offsets (6, 3) [rad] of the horns, including trims.

        They are added to the joint angle before the sign is applied.
        """
        return np.asarray(np.radians(self.horn_offsets_deg) + self.trims)

    @cached_property
    def joint_limits(self) -> Array:
        """Lowest and highest joint angles q (6, 3, 2) [rad], from the servo limits.

        Source of the mapping: Masri 2016, Table 3.1.

        Collisions of a leg do not depend on its horns, so trims change these limits only at the end of the servo's own range.
        """
        servo = np.radians(np.array([leg.servo_limits_deg for leg in self.legs]))
        signs = self.servo_signs[..., None]
        most = self.servos.range_rad[..., None]
        servo = np.clip(servo + signs * self.trims[..., None], -most, most)
        return np.sort(signs * servo - self.horn_offsets[..., None], axis=-1)

    @cached_property
    def foot_radii(self) -> Array:
        """Horizontal distances (6,) [m] of the resting feet from their coxa axes."""
        front, middle, rear = self.stance.foot_radius_from_coxa
        return np.array([front, front, middle, rear, rear, middle])

    @cached_property
    def leg_reach(self) -> Array:
        """Shortest and longest distances (6, 2) [m] from femur axis to foot.

        They follow from the limits of the tibia.
        """
        femur, tibia = self.links.femur, self.links.tibia
        folded, stretched = self.joint_limits[:, 2, 0], np.minimum(self.joint_limits[:, 2, 1], 0.0)
        ways = [np.sqrt(femur**2 + tibia**2 + 2.0 * femur * tibia * np.cos(q)) for q in (folded, stretched)]
        return np.column_stack(ways)

    @cached_property
    def T_body_coxa(self) -> Array:
        """Coxa frames (6, 4, 4) in the body frame, at joint angle zero.

        The origin is on the coxa axis, x points outward along the neutral leg, z up.
        """
        yaw = np.radians([leg.neutral_yaw_deg for leg in self.legs])
        return transform(rotation_z(yaw), np.array([leg.mount_xyz for leg in self.legs]))

    @cached_property
    def coxa_frames(self) -> tuple[CoxaFrame, ...]:
        """The six frames of `T_body_coxa` in plain numbers."""
        return tuple(CoxaFrame(*T[:2, 0].tolist(), *T[:3, 3].tolist()) for T in self.T_body_coxa)

    @cached_property
    def T_coxa_body(self) -> Array:
        """Inverses (6, 4, 4) of `T_body_coxa`."""
        return inverse(self.T_body_coxa)

    def rest_feet(self, body_height: float | None = None) -> Array:
        """Return the foot centres (6, 3) [m] {body} of the resting stance on flat ground.

        The body origin is at `body_height` [m] above the ground, by default the height of the stance.
        """
        height = self.stance.body_height if body_height is None else body_height
        feet = np.zeros((6, 3))
        feet[:, :2] = self.T_body_coxa[:, :2, 3] + self.foot_radii[:, None] * self.T_body_coxa[:, :2, 0]
        feet[:, 2] = self.foot.radius - height
        return feet

    def servo_angles(self, q: Array) -> Array:
        """Return the servo angles (..., 6, 3) [rad] of joint angles, zero at tick 512.

        Source: Masri 2016, eq. (3.11)-(3.13), minus 150 deg.
        """
        return np.asarray(self.servo_signs * (q + self.horn_offsets))

    def joint_angles(self, servo: Array) -> Array:
        """Return the joint angles q (..., 6, 3) [rad] of servo angles.

        It is the inverse of `servo_angles`.
        """
        return np.asarray(self.servo_signs * servo - self.horn_offsets)
