"""Deviations of a real robot from its profile, which only the simulator and the scorer know.

A scenario states bounds, and a run's seed draws the deviations. The levels `mild`, `usual` and `harsh` are the troubles of that
name in `sextant/shared/scenario/troubles`; they state where their numbers come from.
"""

from dataclasses import asdict, dataclass

import numpy as np

from sextant.shared.files import config
from sextant.shared.geometry import Array

PATCH_EDGE_M = 0.25  # [m] edge of a patch of ground with its own friction
_PATCHES = 64  # patches along x and along y, after which they repeat


@dataclass(frozen=True, slots=True)
class Deviation:
    """Deviations of one robot and its ground from the profile."""

    camera_rpy_deg: Array  # (3,) [deg] added to roll, pitch and yaw of the camera's mount
    camera_xyz: Array  # (3,) [m] {body} added to its place
    focal_length: float  # [1] relative error of the focal lengths
    principal_point: Array  # (2,) [px] added to cx and cy
    distortion: float  # [1] radial distortion k1 of Brown's model, of which the profile knows nothing
    depth_scale: float  # [1] relative error of the depth
    depth_bias: float  # [1/m] error of the inverse depth: the depth z grows by depth_bias z^2
    stamp_offset_s: float  # [s] from the exposure of an image to its stamp
    stamp_jitter_s: float  # [s] standard deviation of that time
    link_lengths: Array  # (6, 3) [m] added to coxa, femur and tibia
    horns_deg: Array  # (6, 3) [deg] added to the horn offsets
    backlash_deg: Array  # (6, 3) [deg] free play of the joints
    stiffness: Array  # (6, 3) [1] factors of the servos' stiffness
    torque: Array  # (6, 3) [1] factors of their torque
    foot_friction: Array  # (6,) [1] factors of the feet's friction
    patches: Array  # (n, n) [1] factors of the ground's friction by patch, which repeat
    payload: float  # [kg] on the trunk
    centre_of_mass: Array  # (3,) [m] {body} added to that of the trunk, with the payload
    battery_resistance: float  # [1] factor of the battery's resistance
    imu_rpy_deg: Array  # (3,) [deg] orientation of the IMU in the body
    imu_bias: float  # [1] factor of the IMU's biases

    def as_table(self) -> dict[str, float | list[float]]:
        """Return the deviations for a report; of the patches, only the slippery share."""
        table = {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in asdict(self).items()}
        table["patches"] = float(np.mean(self.patches < 1.0))
        return table


@dataclass(frozen=True, slots=True)
class Mismatch:
    """Largest deviations of the real robot from its profile.

    The run's seed draws each number uniformly within +- its bound, unless a line says otherwise. The simulator applies them,
    and the report states them. The robot does not know them.
    """

    camera_angle_deg: float = 0.0  # [deg] of roll, pitch and yaw of the camera's mount
    camera_place: float = 0.0  # [m] of its place along x, y and z
    focal_length: float = 0.0  # [1] relative, of both focal lengths together
    principal_point: float = 0.0  # [px] of cx and cy
    distortion: float = 0.0  # [1] radial distortion k1 of Brown's model
    depth_scale: float = 0.0  # [1] relative error of the depth
    depth_bias: float = 0.0  # [1/m] error of the inverse depth: at 1 m, as many metres of depth; it grows with the square
    stamp_offset_s: float = 0.0  # [s] from the exposure of an image to its stamp
    stamp_jitter_s: float = 0.0  # [s] standard deviation of that time, from 0 to this number
    link_length: float = 0.0  # [m] of each link
    horn_deg: float = 0.0  # [deg] of each horn
    backlash_deg: float = 0.0  # [deg] free play of each joint, from 0 to this number
    stiffness: float = 0.0  # [1] relative, of each servo
    torque: float = 0.0  # [1] relative, of each servo
    foot_friction: float = 0.0  # [1] relative, of each foot
    slippery_share: float = 0.0  # [1] share of the ground's patches, 0.25 m wide, that are slippery
    slippery_friction: float = 1.0  # [1] factor of their friction, not drawn
    payload: float = 0.0  # [kg] on the trunk, from 0 to this number
    centre_of_mass: float = 0.0  # [m] of the trunk's centre of mass along x and y
    battery_resistance: float = 0.0  # [1] relative increase of the battery's resistance, from 0 to this number
    imu_angle_deg: float = 0.0  # [deg] of roll, pitch and yaw of the IMU's mount
    imu_bias: float = 1.0  # [1] factor of the IMU's biases, not drawn
    at_bounds: bool = False  # True: each number that is drawn is at one end of its range

    checks = (
        *config.each("camera_angle_deg imu_angle_deg horn_deg backlash_deg", lambda angle: 0 <= angle <= 45, "0 to 45 deg"),
        *config.each("camera_place link_length centre_of_mass", lambda length: 0 <= length <= 0.1, "0 to 0.1 m"),
        *config.each(
            "focal_length depth_scale stiffness torque foot_friction slippery_share", lambda part: 0 <= part <= 0.9, "0 to 0.9"
        ),
        *config.each("principal_point", lambda pixels: 0 <= pixels <= 100, "0 to 100 pixels"),
        *config.each("distortion depth_bias", lambda value: 0 <= value <= 0.2, "0 to 0.2"),
        *config.each("stamp_offset_s stamp_jitter_s", lambda duration: 0 <= duration <= 0.5, "0 to 0.5 s"),
        *config.each("slippery_friction", lambda factor: 0.05 <= factor <= 2, "0.05 to 2"),
        *config.each("payload", lambda mass: 0 <= mass <= 100, "0 to 100 kg"),
        *config.each("battery_resistance imu_bias", lambda factor: 0 <= factor <= 100, "0 to 100"),
    )

    def __post_init__(self) -> None:
        config.verify(self)

    def draw(self, rng: np.random.Generator) -> Deviation:
        """Draw the deviations of one run."""

        def either(bound: float, *shape: int) -> Array:
            share = rng.uniform(-1.0, 1.0, shape)
            return bound * (np.sign(share) if self.at_bounds else share)

        def upto(bound: float, *shape: int) -> Array:
            return np.abs(either(bound, *shape))

        return Deviation(
            camera_rpy_deg=either(self.camera_angle_deg, 3),
            camera_xyz=either(self.camera_place, 3),
            focal_length=float(either(self.focal_length)),
            principal_point=either(self.principal_point, 2),
            distortion=float(either(self.distortion)),
            depth_scale=float(either(self.depth_scale)),
            depth_bias=float(either(self.depth_bias)),
            stamp_offset_s=float(either(self.stamp_offset_s)),
            stamp_jitter_s=float(upto(self.stamp_jitter_s)),
            link_lengths=either(self.link_length, 6, 3),
            horns_deg=either(self.horn_deg, 6, 3),
            backlash_deg=upto(self.backlash_deg, 6, 3),
            stiffness=1.0 + either(self.stiffness, 6, 3),
            torque=1.0 + either(self.torque, 6, 3),
            foot_friction=1.0 + either(self.foot_friction, 6),
            patches=np.where(rng.random((_PATCHES, _PATCHES)) < self.slippery_share, self.slippery_friction, 1.0),
            payload=float(upto(self.payload)),
            centre_of_mass=np.append(either(self.centre_of_mass, 2), 0.0),
            battery_resistance=1.0 + float(upto(self.battery_resistance)),
            imu_rpy_deg=either(self.imu_angle_deg, 3),
            imu_bias=self.imu_bias,
        )
