"""Robot profiles: the body, six legs in circular order, joint limits, servo map, camera mount, stance; read from TOML.

Legs are numbered as Masri 2016's f1 to f6: left front, right front, right middle, right rear, left rear, left middle. That is
once around the body, so every second leg makes a tripod (Lotriet 2024, eq. 5.15, counts the same way).

Joint angles q are (6, 3) [rad]: coxa about body z from the leg's neutral yaw, femur up from the horizontal, tibia from the
femur's straight continuation, up positive. All zero is the leg straight out.
"""

from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from shared import config
from shared.camera import DepthSensor, Intrinsics
from shared.geometry import Array, from_xyz_rpy, inverse, rotation_z, transform

LEGS = ("left front", "right front", "right middle", "right rear", "left rear", "left middle")
JOINTS = ("coxa", "femur", "tibia")


@dataclass(frozen=True, slots=True)
class LegLinks:
    """Lengths of a leg's three links [m]: coxa axis to femur axis, femur to tibia axis, tibia axis to the foot's centre."""

    coxa: float
    femur: float
    tibia: float

    def __post_init__(self) -> None:
        if min(self.coxa, self.femur, self.tibia) <= 0:
            raise ValueError(f"positive link lengths expected, found {self.coxa}, {self.femur}, {self.tibia} m")


@dataclass(frozen=True, slots=True)
class Leg:
    """Where one leg sits, which servos move it, and how far each may turn."""

    name: str
    mount_xyz: tuple[float, float, float]  # [m] {body} coxa axis
    neutral_yaw_deg: float  # [deg] direction of the leg at coxa angle zero, about body z from x
    servo_ids: tuple[int, int, int]  # coxa, femur, tibia
    # Signs and limits as in Masri 2016, Tables 3.1 and 3.2: servo angle = sign * (joint angle + horn offset), 0 = tick 512.
    servo_signs: tuple[int, int, int]
    servo_limits_deg: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]

    def __post_init__(self) -> None:
        if self.name not in LEGS:
            raise ValueError(f"leg name out of {', '.join(LEGS)} expected, found {self.name!r}")
        if any(sign not in (-1, 1) for sign in self.servo_signs):
            raise ValueError(f"servo signs of 1 or -1 expected, found {self.servo_signs}")
        if not all(0 <= servo <= 253 for servo in self.servo_ids):
            raise ValueError(f"servo ids from 0 to 253 expected, found {self.servo_ids}")
        for joint, (low, high) in zip(JOINTS, self.servo_limits_deg, strict=True):
            if not -150.0 <= low < high <= 150.0:
                raise ValueError(f"{joint} limits within -150 and 150 deg in rising order expected, found {low}, {high}")


@dataclass(frozen=True, slots=True)
class Servo:
    """Data sheet of the servos, all 18 alike."""

    model: Literal["AX-12A", "RX-64"]
    stall_torque: float  # [N m]
    no_load_speed: float  # [rad/s]
    stiffness: float  # [N m/rad] torque per position error at the profile's compliance slope
    compliance_slope: int  # registers 28 and 29
    armature: float  # [kg m^2] reflected rotor inertia; unknown for most servos, so it is varied in tests
    friction: float  # [N m] dry friction

    def __post_init__(self) -> None:
        if min(self.stall_torque, self.no_load_speed, self.stiffness) <= 0 or min(self.armature, self.friction) < 0:
            raise ValueError(f"positive torque, speed, stiffness and no negative armature or friction expected, found {self}")
        if not 1 <= self.compliance_slope <= 254:
            raise ValueError(f"a compliance slope from 1 to 254 expected, found {self.compliance_slope}")

    @property
    def damping(self) -> float:
        """Joint damping [N m s/rad] that makes stall torque and no-load speed the ends of one line."""
        return self.stall_torque / self.no_load_speed


@dataclass(frozen=True, slots=True)
class Body:
    """The trunk as a box, and the robot's weight."""

    size: tuple[float, float, float]  # [m] length, width, height
    mass: float  # [kg] everything but the legs
    leg_link_masses: tuple[float, float, float]  # [kg] coxa, femur, tibia link with the servos they carry

    def __post_init__(self) -> None:
        if min(*self.size, self.mass, *self.leg_link_masses) <= 0:
            raise ValueError(f"positive size and masses expected, found {self.size} m, {self.mass}, {self.leg_link_masses} kg")

    @property
    def total_mass(self) -> float:
        """Mass of the whole robot [kg]."""
        return self.mass + 6.0 * sum(self.leg_link_masses)


@dataclass(frozen=True, slots=True)
class Foot:
    """The foot is a sphere around the end of the tibia."""

    radius: float  # [m]

    def __post_init__(self) -> None:
        if self.radius <= 0:
            raise ValueError(f"a positive foot radius expected, found {self.radius} m")


@dataclass(frozen=True, slots=True)
class Stance:
    """How the robot stands and walks when nothing else is asked."""

    # [m] horizontal distance of a resting foot from its coxa axis, for front, middle and rear legs: in a tripod a middle leg
    # stands alone on its side and carries the most, so it had better stand near.
    foot_radius_from_coxa: tuple[float, float, float]
    body_height: float  # [m] body origin above the ground
    body_height_range: tuple[float, float]  # [m]
    max_speed: float  # [m/s]
    step_s: float  # [s] duration of a tripod's step over level ground
    stride: float  # [m] of the body while a foot stands, at most
    foot_speed: float  # [m/s] of swinging feet, height counted twice: what asks for more takes longer, or the servos grow hot

    def __post_init__(self) -> None:
        low, high = self.body_height_range
        if not low <= self.body_height <= high:
            raise ValueError(f"body height within {low} to {high} m expected, found {self.body_height}")
        if not 0.4 <= self.step_s <= 2.0:
            raise ValueError(f"a step_s of 0.4 to 2 s expected, found {self.step_s}")
        if min(self.stride, self.foot_speed) <= 0:
            raise ValueError(f"a positive stride and foot_speed expected, found {self.stride} m and {self.foot_speed} m/s")
        if min(low, *self.foot_radius_from_coxa, self.max_speed) <= 0:
            found = f"{low} m, {self.foot_radius_from_coxa} m, {self.max_speed} m/s"
            raise ValueError(f"positive heights, foot radii and speed expected, found {found}")


@dataclass(frozen=True, slots=True)
class Camera:
    """The depth camera and where it is mounted: looking along body x, pitched down."""

    intrinsics: Intrinsics
    sensor: DepthSensor
    mount_xyz: tuple[float, float, float]  # [m] {body} optical centre
    pitch_down_deg: float  # [deg]
    color: bool = False  # whether it sends colour pictures too
    # What the robot itself reads it by: "openni2", "realsense", the path of a recorded folder, or "none" for no driver.
    device: str = "none"

    def __post_init__(self) -> None:
        if not -45.0 <= self.pitch_down_deg <= 90.0:
            raise ValueError(f"a pitch_down_deg from -45 (up) to 90 (straight down) expected, found {self.pitch_down_deg:g}")
        if not self.device.strip():
            raise ValueError('a device of "openni2", "realsense", "none" or the path of a recorded folder expected, found none')

    @property
    def T_body_camera(self) -> Array:
        """Optical frame (x right, y down, z forward) in the body frame."""
        look = from_xyz_rpy(self.mount_xyz, (0.0, np.radians(self.pitch_down_deg), 0.0))
        optical = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
        return np.asarray(look @ transform(optical, np.zeros(3)))


@dataclass(frozen=True)
class RobotProfile:
    """Everything the services know about one kind of robot, in SI units."""

    name: str
    servo: Servo
    horn_offsets_deg: tuple[float, float, float]  # coxa, femur, tibia; Masri 2016, Fig. 3.4
    links: LegLinks
    body: Body
    foot: Foot
    stance: Stance
    legs: tuple[Leg, Leg, Leg, Leg, Leg, Leg]
    camera: Camera

    def __post_init__(self) -> None:
        names = tuple(leg.name for leg in self.legs)
        if names != LEGS:
            raise ValueError(f"legs in the order {', '.join(LEGS)} expected, found {', '.join(names)}")
        ids = [i for leg in self.legs for i in leg.servo_ids]
        if len(set(ids)) != len(ids):
            raise ValueError(f"18 different servo ids expected, found {sorted(i for i in set(ids) if ids.count(i) > 1)} twice")

    @cached_property
    def servo_ids(self) -> NDArray[np.int64]:
        """(6, 3) bus ids."""
        return np.array([leg.servo_ids for leg in self.legs])

    @cached_property
    def servo_signs(self) -> Array:
        """(6, 3) of +-1: which way a servo turns for a growing joint angle."""
        return np.array([leg.servo_signs for leg in self.legs], dtype=np.float64)

    @cached_property
    def horn_offsets(self) -> Array:
        """(3,) [rad] added to the joint angle before the sign."""
        return np.asarray(np.radians(self.horn_offsets_deg))

    @cached_property
    def joint_limits(self) -> Array:
        """(6, 3, 2) [rad] lowest and highest joint angle q, from the servo limits by the map of Table 3.1."""
        servo = np.radians(np.array([leg.servo_limits_deg for leg in self.legs]))
        q = self.servo_signs[..., None] * servo - self.horn_offsets[:, None]
        return np.sort(q, axis=-1)

    @cached_property
    def foot_radii(self) -> Array:
        """(6,) [m] horizontal distance of the resting feet from their coxa axes."""
        front, middle, rear = self.stance.foot_radius_from_coxa
        return np.array([front, front, middle, rear, rear, middle])

    @cached_property
    def T_body_coxa(self) -> Array:
        """(6, 4, 4) coxa frames at joint angle zero: origin on the coxa axis, x outward along the neutral leg, z up."""
        yaw = np.radians([leg.neutral_yaw_deg for leg in self.legs])
        return transform(rotation_z(yaw), np.array([leg.mount_xyz for leg in self.legs]))

    @cached_property
    def T_coxa_body(self) -> Array:
        """(6, 4, 4) inverse of `T_body_coxa`."""
        return inverse(self.T_body_coxa)

    def rest_feet(self, body_height: float | None = None) -> Array:
        """(6, 3) [m] {body} foot centres of the resting stance on flat ground, the body origin at its height [m]."""
        height = self.stance.body_height if body_height is None else body_height
        feet = np.zeros((6, 3))
        feet[:, :2] = self.T_body_coxa[:, :2, 3] + self.foot_radii[:, None] * self.T_body_coxa[:, :2, 0]
        feet[:, 2] = self.foot.radius - height
        return feet

    def servo_angles(self, q: Array) -> Array:
        """Servo angles (..., 6, 3) [rad], zero at tick 512, of joint angles; Masri 2016, eq. (3.11)-(3.13) less 150 deg."""
        return np.asarray(self.servo_signs * (q + self.horn_offsets))

    def joint_angles(self, servo: Array) -> Array:
        """Joint angles q (..., 6, 3) [rad] of servo angles; the inverse of `servo_angles`."""
        return np.asarray(self.servo_signs * servo - self.horn_offsets)


def load_profile(name_or_path: str) -> RobotProfile:
    """Read a profile that comes with Sextant by its name, or any other by the path of its TOML file.

    Raises:
        ConfigError: No such profile, or what is wrong in it, all at once.
    """
    if name_or_path.endswith(".toml"):
        return _checked_stance(config.load(Path(name_or_path), RobotProfile), name_or_path)
    known = profile_names()
    if name_or_path not in known:
        raise config.ConfigError(
            "robot", [f"no profile {name_or_path!r}; known: {', '.join(known)}; or give a path that ends in .toml"]
        )
    with resources.as_file(resources.files("shared.profiles") / f"{name_or_path}.toml") as path:
        return config.load(path, RobotProfile)


def profile_names() -> list[str]:
    """Names of the profiles that come with Sextant."""
    files = resources.files("shared.profiles").iterdir()
    return sorted(p.name.removesuffix(".toml") for p in files if p.name.endswith(".toml"))


def _checked_stance(profile: RobotProfile, source: str) -> RobotProfile:
    """A profile whose legs reach the ground in the resting stance.

    Raises:
        ConfigError: One does not.
    """
    from shared.kinematics import body_inverse, within_limits  # which knows robots

    q = body_inverse(profile, profile.rest_feet())
    bad_legs = np.flatnonzero(~within_limits(profile, q).all(axis=1)).tolist()
    if not bad_legs:
        return profile
    bad = [LEGS[leg] for leg in bad_legs]
    out = [leg for leg, angles in zip(LEGS, q, strict=True) if not np.isfinite(angles).all()]
    why = "is out of the legs' reach" if out else "is beyond the servos' limits"
    raise config.ConfigError(
        source,
        [
            f"stance: the resting stance ({profile.foot_radii[bad_legs[0]]:g} m from the coxa, the body "
            f"{profile.stance.body_height:g} m high) {why} for {', '.join(bad)}; check links, limits and stance"
        ],
    )
