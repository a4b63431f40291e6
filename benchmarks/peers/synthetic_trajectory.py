"""Synthetic trajectory of a camera on a walking robot, with leg odometry.

Both contain errors. Frame: {world} is that of the terrain. The first pose is known, so estimates can be compared directly.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sextant.services.simulator.physics.terrain import Terrain
from sextant.services.simulator.sensors.depth_camera import DepthCamera
from sextant.services.simulator.sensors.renderer import Renderer
from sextant.shared.geometry import Array, inverse, rotation_from_rpy, transform
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import DepthImage, Message, Odometry, Tick

_CARRIED = (0.0, 0.0, 0.35)  # [m] {body} position of the camera: 0.5 m above the ground with the body at 0.15
_PITCH_DEG = 40.0
_BODY_HEIGHT = 0.15  # [m]
_STANDING = 8  # frames before the first step
_STRIDE_HZ = 1.5  # [Hz] gait steps
_BOB = 0.010  # [m] amplitude
_ROCK = np.radians([1.5, 1.5, 1.0])  # [rad] amplitude of roll, pitch and yaw
_SWAY = 0.02  # [m] amplitude to the side
_SMOOTHED = 0.35  # [m] half the length over which the body height averages the ground
_LEG_LEVEL = np.array([0.002, 0.003, 0.003])  # [m] [rad] [rad] standard deviation of the odometry's height, roll and pitch
_LEG_MEMORY = 0.9  # [1] correlation from one frame to the next


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of the leg odometry."""

    scale: float = 0.05  # share of every motion in x, y and yaw; the seed determines its sign
    slip: float = 0.0  # share of the motion that is reported, but does not happen because the legs slip
    slip_at_s: float = 3.0
    slip_for_s: float = 0.5
    carried_off: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [m] [m] [rad] in x, y, yaw, unnoticed by the odometry
    carried_off_at_s: float = 4.0


@dataclass(frozen=True, slots=True)
class Ride:
    """One ride: true body poses and odometry for each frame."""

    profile: RobotProfile
    stamps_ns: NDArray[np.int64]  # (n,) [ns]
    T_world_body: Array  # (n, 4, 4)
    T_odom_body: Array  # (n, 4, 4) the first is the true one
    terrain: Terrain

    @property
    def T_world_camera(self) -> Array:
        """True poses (n, 4, 4) of the camera."""
        return np.asarray(self.T_world_body @ self.profile.camera.T_body_camera)


def carried_profile(rate_hz: float = 15.0) -> RobotProfile:
    """Return the default robot with its camera 0.5 m above the ground, 40 deg down."""
    profile = load_profile("phantomx_mk2")
    sensor = replace(profile.camera.sensor, rate_hz=rate_hz)
    return replace(profile, camera=replace(profile.camera, mount_xyz=_CARRIED, pitch_down_deg=_PITCH_DEG, sensor=sensor))


def ride(terrain: Terrain, rng: np.random.Generator, errors: Errors, frames: int = 100, length: float = 2.0) -> Ride:
    """Create a straight walk over a terrain, from the origin along x.

    Args:
        terrain: The ground; the body keeps its height above the averaged ground.
        rng: Random generator for the gait's phases, the sign of the scale error, and the odometry's noise.
        errors: Errors of the odometry.
        frames: Number of depth frames, at least three.
        length: [m] of the walk.

    Raises:
        ValueError: Fewer frames.
    """
    if frames < 3:
        raise ValueError(f"at least 3 frames expected, found {frames}")
    profile = carried_profile()
    t = np.arange(frames) / profile.camera.sensor.rate_hz
    begin = t[min(_STANDING, frames - 2)]
    x = length * np.clip((t - begin) / (t[-1] - begin), 0.0, 1.0)
    phase = 2 * np.pi * _STRIDE_HZ * t
    offsets = rng.uniform(0, 2 * np.pi, 5)
    walking = np.clip((t - begin) / 0.5, 0.0, 1.0)
    bob, sway = (walking * a * np.sin(phase * k + o) for a, k, o in ((_BOB, 1.0, offsets[0]), (_SWAY, 0.5, offsets[1])))
    rock = np.stack([walking * _ROCK[k] * np.sin(phase * (0.5 if k == 2 else 1.0) + offsets[2 + k]) for k in range(3)], axis=1)
    z = _BODY_HEIGHT + bob + _smoothed_ground(terrain, x)
    T = transform(rotation_from_rpy(rock), np.stack([x, sway, z], axis=1))
    stamps_ns = np.round(t * 1e9).astype(np.int64)
    T_odom_body = _by_legs(T, t, rng, errors)
    return Ride(profile, stamps_ns, _carried_off(T, t, errors), T_odom_body, terrain)


def _carried_off(T: Array, t: Array, errors: Errors) -> Array:
    """Displace poses (n, 4, 4) rigidly after a certain time."""
    k = int(np.searchsorted(t, errors.carried_off_at_s))
    if k >= len(T) or not any(errors.carried_off):
        return T
    x, y, yaw = errors.carried_off
    here = transform(np.eye(3), T[k, :3, 3])
    moved = here @ transform(rotation_from_rpy([0.0, 0.0, yaw]), np.array([x, y, 0.0])) @ inverse(here)
    return np.concatenate([T[:k], moved @ T[k:]])


def _smoothed_ground(terrain: Terrain, x: Array) -> Array:
    around = np.linspace(-_SMOOTHED, _SMOOTHED, 29)
    along = (x[:, None] + around).ravel()
    heights = terrain.height_at(np.column_stack([along, np.zeros(len(along))])).reshape(len(x), -1)
    # A gap counts as level with the ground before and behind it, because feet find no ground in it.
    return np.asarray(np.maximum(heights, heights.max(axis=1, keepdims=True) - 0.2).mean(axis=1))


def _by_legs(T: Array, t: Array, rng: np.random.Generator, errors: Errors) -> Array:
    """Return the odometry (n, 4, 4).

    Planar motions have a scale error. Heights and tilts have noise that does not grow.
    """
    sign = 1.0 if rng.random() < 0.5 else -1.0
    noise = np.zeros(3)
    out = [T[0]]
    planar = _planar(T)
    believed = planar[0]
    for k in range(1, len(T)):
        motion = inverse(planar[k - 1]) @ planar[k]
        told = 1.0 + sign * errors.scale
        if errors.slip_at_s <= t[k] < errors.slip_at_s + errors.slip_for_s and errors.slip:
            told = told / (1.0 - errors.slip)
        yaw = told * np.arctan2(motion[1, 0], motion[0, 0])
        believed = believed @ transform(rotation_from_rpy([0.0, 0.0, yaw]), told * motion[:3, 3])
        noise = _LEG_MEMORY * noise + np.sqrt(1 - _LEG_MEMORY**2) * _LEG_LEVEL * rng.standard_normal(3)
        tilt = inverse(planar[k]) @ T[k]
        wrong = transform(rotation_from_rpy([noise[1], noise[2], 0.0]), np.array([0.0, 0.0, noise[0]]))
        out.append(believed @ wrong @ tilt)
    return np.array(out)


def _planar(T: Array) -> Array:
    """Return the planar part (n, 4, 4) of poses: x, y and yaw."""
    yaw = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    rpy = np.stack([np.zeros_like(yaw), np.zeros_like(yaw), yaw], axis=1)
    return np.asarray(transform(rotation_from_rpy(rpy), T[:, :3, 3] * [1.0, 1.0, 0.0]))


class CarriedCamera:
    """Service that publishes a ride: odometry and depth frames at their times."""

    name = "carried camera"
    subscribes: tuple[AnyTopic, ...] = ()
    publishes: tuple[AnyTopic, ...] = (topics.DEPTH, topics.ODOMETRY)

    def __init__(self, way: Ride, rng: np.random.Generator):
        """Play a ride; `rng` generates the noise of the depth frames."""
        camera = way.profile.camera
        self.trigger = Every(round(1e9 / camera.sensor.rate_hz))
        self.stages = Stages()
        self.played = 0
        self._ride = way
        self._renderer = Renderer(way.terrain, camera.intrinsics)
        self._camera = DepthCamera(camera.intrinsics, camera.sensor, rng)
        self._T_world_camera = way.T_world_camera
        self._travelled, self._turned = 0.0, 0.0

    @property
    def finished(self) -> bool:
        """Whether the ride is over."""
        return self.played == len(self._ride.stamps_ns)

    def frame(self, index: int) -> NDArray[np.uint16]:
        """Return the raw depth frame (h, w) of one pose; each call draws new noise."""
        return self._camera.measure(self._renderer.inverse_depth(self._T_world_camera[index]))

    def step(self, tick: Tick, _: Inbox) -> Iterator[Message]:
        """Yield the odometry and the depth frame of this time."""
        if self.finished:
            return
        k, way = self.played, self._ride
        if k > 0:
            motion = inverse(way.T_odom_body[k - 1]) @ way.T_odom_body[k]
            self._travelled += float(np.linalg.norm(motion[:3, 3]))
            self._turned += abs(float(np.arctan2(motion[1, 0], motion[0, 0])))
        stance = np.zeros(6, dtype=np.bool_)
        yield Odometry(tick.stamp_ns, way.T_odom_body[k], self._travelled, self._turned, stance, reliable=True)
        with self.stages("camera"):
            depth = self.frame(k)
        yield DepthImage(tick.stamp_ns, depth)
        self.played += 1

    def status(self) -> str:
        """Return the progress."""
        return f"at picture {self.played} of {len(self._ride.stamps_ns)}"
