"""Replay of a recorded depth sequence through the real perception and mapper."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.figures import layers_picture
from sextant.evaluation.figures.relief import shaded
from sextant.evaluation.metrics.stage_times import rounded, stages_ms
from sextant.evaluation.observers.progress import Progress
from sextant.evaluation.replay import evidence as replay_evidence
from sextant.evaluation.replay.error import ReplayError
from sextant.evaluation.replay.evidence import (
    DepthRange,
    Evidence,
    PictureEvidence,
    TrueComparison,
    camera_motions,
    depth_range,
    picture_evidence,
)
from sextant.evaluation.replay.listener import Listener
from sextant.services.mapper.config import Settings as MapperSettings
from sextant.services.mapper.service import Mapper
from sextant.services.perception import tum
from sextant.services.perception.config import Settings as PerceptionSettings
from sextant.services.perception.registration.motion_prior import VelocityPrior
from sextant.services.perception.service import Perception
from sextant.services.perception.trajectory_error import relative_size, trajectory_error
from sextant.shared.files import whole_files
from sextant.shared.geometry import Array, inverse, log_so3, transform
from sextant.shared.robot.camera import DepthSensor
from sextant.shared.robot.profile import Camera, RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.lockstep import Lockstep, ServiceFailedError
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Service, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import BodyPose, ColorImage, DepthImage, Message, Odometry, TerrainMap, Tick

_FLAT = 0.05  # [m] least height range of a picture's colours, so that noise does not look like relief
_SETTLE_NS = 500_000_000  # [ns] simulated time after the last frame, for messages in transit
_SHOW_NS = 1_000_000_000
_HAND_CELLS = 512  # along each edge of the map: a hand-held camera sees further than the robot steps
_FARTHEST_M = 30.0  # [m] largest registration range
_HAND_SIGMA = 0.01  # [m] and [rad] change of a hand's motion from one picture to the next
_HAND_SIGMA_UNKNOWN = 0.05  # [m] and [rad] of motion if the previous one is unknown: 1.5 m/s and 86 deg/s at 30 Hz
HAND_DECAY_S = 0.15  # [s] in which the unobserved velocity of a hand decays to 1/e


@dataclass(frozen=True, slots=True)
class HandHeld(Camera):
    """A hand-held camera; the body frame is level, by gravity at the first picture."""

    down: tuple[float, float, float] = (0.0, 1.0, 0.0)  # {camera}

    @property
    def T_body_camera(self) -> Array:
        """Optical frame in a body frame with z up and x in the viewing direction."""
        up = -np.array(self.down) / np.linalg.norm(self.down)
        ahead = np.array([0.0, 0.0, 1.0]) - up[2] * up
        if np.linalg.norm(ahead) < 1e-6:  # it looks straight down: its upper edge is ahead
            ahead = np.array([0.0, -1.0, 0.0])
        ahead /= np.linalg.norm(ahead)
        return transform(np.stack([ahead, np.cross(up, ahead), up]), np.array(self.mount_xyz))


class Player:
    """Service that plays a sequence: it publishes each picture at its time.

    It also publishes where {odom} begins, as the start of the guess of `ConstantVelocity`.
    """

    name = "player"
    trigger = Every(5_000_000)
    subscribes: tuple[AnyTopic, ...] = ()
    publishes: tuple[AnyTopic, ...] = (topics.DEPTH, topics.COLOR, topics.ODOMETRY)

    def __init__(self, sequence: tum.Recording, sensor: DepthSensor):
        """Start with the first picture.

        Args:
            sequence: The sequence.
            sensor: Sensor with the range against which the depths are compared.
        """
        self.stages = Stages()
        self.played = 0
        self.depth_ranges: dict[int, DepthRange] = {}  # stamp [ns] of each played picture -> its depths
        self._sequence = sequence
        self._sensor = sensor
        self._color_due_ns = 0
        self._stamps_ns = [int(stamp) for stamp in sequence.stamps_ns - sequence.stamps_ns[0]]

    @property
    def finished(self) -> bool:
        """Whether all pictures have been played."""
        return self.played == len(self._stamps_ns)

    def step(self, tick: Tick, _: Inbox) -> Iterator[Message]:
        """Yield the pictures that are due."""
        if self.played == 0:
            yield odometry(0, np.eye(4), 0.0, 0.0)
        while not self.finished and self._stamps_ns[self.played] <= tick.stamp_ns:
            stamp_ns = self._stamps_ns[self.played]
            depth = self._depth(self.played)
            self.depth_ranges[stamp_ns] = depth_range(depth, self._sensor)
            yield DepthImage(stamp_ns, depth)
            color = self._color(self.played) if stamp_ns >= self._color_due_ns else None
            if color is not None:
                self._color_due_ns = stamp_ns + round(1e9 / topics.COLOR.rate_hz)
                yield ColorImage(stamp_ns, color)
            self.played += 1

    def _color(self, index: int) -> NDArray[np.uint8] | None:
        try:
            return self._sequence.color(index)
        except ValueError as error:
            raise ReplayError(str(error)) from None

    def _depth(self, index: int) -> NDArray[np.uint16]:
        try:
            return self._sequence.depth(index)
        except (FileNotFoundError, ValueError) as error:
            raise ReplayError(str(error)) from None

    def status(self) -> str:
        """Return the progress as text."""
        return f"playing picture {self.played} of {len(self._stamps_ns)}"


class ConstantVelocity:
    """Replaces leg odometry: after each pose it predicts the next one.

    The prediction assumes constant velocity.
    """

    name = "constant velocity"
    trigger = topics.BODY_POSE
    subscribes: tuple[AnyTopic, ...] = ()
    publishes: tuple[AnyTopic, ...] = (topics.ODOMETRY,)

    def __init__(self, period_ns: int):
        self.stages = Stages()
        self._period_ns = period_ns
        self._prior = VelocityPrior(HAND_DECAY_S)
        self._travelled = 0.0
        self._turned = 0.0

    def step(self, pose: BodyPose, _: Inbox) -> Iterator[Message]:
        """Yield the pose expected one picture later, in {odom}.

        Corrections by registration are in `T_world_odom`.
        """
        self._prior.update(pose.stamp_ns, pose.T_world_body, pose.ok, pose.degenerate)
        T_next = self._prior.predict(self._period_ns * 1e-9)
        motion = inverse(pose.T_world_body) @ T_next
        self._travelled += float(np.linalg.norm(motion[:3, 3]))
        self._turned += float(np.linalg.norm(log_so3(motion[:3, :3])))
        T_odom_next = inverse(pose.T_world_odom) @ T_next
        stamp_ns = pose.stamp_ns + self._period_ns
        yield odometry(stamp_ns, T_odom_next, self._travelled, self._turned, reliable=self._prior.measured)

    def status(self) -> str:
        """Return the progress as text."""
        return f"predicting without registration, {self._travelled:.2f} m so far"


def odometry(stamp_ns: int, T_odom_body: Array, travelled: float, turned: float, reliable: bool = True) -> Odometry:
    """Return odometry (lengths [m], angles [rad]) of a body without legs."""
    return Odometry(stamp_ns, T_odom_body, travelled, turned, stance=np.zeros(6, dtype=np.bool_), reliable=reliable)


def replay_folder(
    folder: Path, out: Path, progress: Progress, registration: Literal["projective", "kiss-icp"] = "projective"
) -> dict[str, Any]:
    """Run perception and mapper on a depth sequence.

    There is no odometry, so perception expects constant velocity. The estimated camera trajectory (trajectory.txt, in the
    layout of groundtruth.txt) and the last map with its foothold layers (map.png, layers.png) are written to `out`.

    Returns:
        Plain table: frames, pose_error_m after alignment, map_error_m (nothing to compare with), stages_ms, evidence (see
        `Evidence.as_table`) and pictures (see `PictureEvidence.as_table`).
    """
    # 1. Load the sequence, and make a profile with its camera.
    try:
        sequence = tum.read_recording(folder)
    except (FileNotFoundError, ValueError) as unreadable:
        raise ReplayError(str(unreadable)) from None
    profile = profile_for(sequence)
    # 2. Play it to perception and mapper on simulated time.
    poses, pictures, terrain, stages = _play(sequence, profile, registration, progress)
    # 3. Compare the camera's path with the truth, and evaluate the evidence.
    stamps_ns = np.array([pose.stamp_ns for pose in poses], dtype=np.int64) + sequence.stamps_ns[0]
    T_estimate = np.array([pose.T_world_body for pose in poses]).reshape(-1, 4, 4) @ profile.camera.T_body_camera
    pairs = _true_pairs(sequence.truth, stamps_ns, T_estimate)
    error = None if pairs is None else trajectory_error(*pairs)
    truth = None
    if pairs is not None and error is not None:
        p_estimate, p_true = pairs[0][:, :3, 3], pairs[1][:, :3, 3]
        extent = float(np.linalg.norm(p_true - p_true[0], axis=1).max())
        truth = TrueComparison(error.rms, extent, relative_size(p_estimate, p_true))
    registered = np.array([pose.ok for pose in poses], dtype=bool)
    motions = camera_motions(stamps_ns[registered] - sequence.stamps_ns[0], T_estimate[registered])
    found = Evidence(tuple(pictures), _registered_range(profile, registration), truth, motions)
    # 4. Write trajectory and map.
    with whole_files.reported(progress.say):
        tum.write_trajectory(out / "trajectory.txt", tum.Trajectory(stamps_ns, T_estimate))
        if terrain is not None:
            _draw(out / "map.png", terrain, T_estimate)
            layers_picture.draw(out / "layers.png", terrain, T_estimate)
    return {
        "source": folder.name,
        "frames": len(sequence),
        "poses": len(poses),
        "poses_not_ok": sum(not pose.ok for pose in poses),
        "pose_error_m": {"rms": error and rounded(error.rms), "final": error and rounded(error.final)},
        "map_error_m": {"rmse": None, "bias": None, "p95": None, "coverage": None},
        "stages_ms": stages,
        "evidence": found.as_table(),
        "pictures": [picture.as_table() for picture in pictures],
    }


def hand_held_settings(registration: Literal["projective", "kiss-icp"], sensor: DepthSensor) -> PerceptionSettings:
    """Return perception settings for a hand-held camera.

    The constant-velocity guess has the uncertainty of a hand's motion, and the map has the range of a Kinect. A sensor that
    states a longer range than usual, or whose range begins where registration usually ends, is used up to its full range.
    """
    usual = PerceptionSettings().registration_range
    whole = sensor.max_range > DepthSensor().max_range or sensor.min_range >= usual
    return PerceptionSettings(
        registration_range=min(sensor.max_range, _FARTHEST_M) if whole else usual,
        legs=False,
        settle_s=0.0,
        scan_rate_hz=1e3,  # every picture counts: the guess reaches from one to the next
        method=registration,
        blocks_across=320,  # rooms contain many small objects
        scan_range=3.0,
        odometry_drift=0.1,
        odometry_turn=0.1,
        odometry_floor=_HAND_SIGMA,
        odometry_level=_HAND_SIGMA,
        unreliable_way=_HAND_SIGMA_UNKNOWN,
        unreliable_turn=_HAND_SIGMA_UNKNOWN,
        unreliable_level=_HAND_SIGMA_UNKNOWN,
        tilt_s=1e-6,  # the guess adopts each correction at once: no two tripods to average over
    )


def profile_for(sequence: tum.Recording) -> RobotProfile:
    """Return the default robot with the sequence's camera, held in a hand."""
    camera = sequence.camera
    T_first = sequence.truth.at(int(sequence.stamps_ns[0])) if sequence.truth is not None else None
    down = np.array([0.0, 1.0, 0.0])  # assume an upright camera if its pose is unknown
    if T_first is not None:
        gravity = np.array([0.0, 0.0, -1.0]) if camera.gravity_world is None else camera.gravity_world
        down = T_first[:3, :3].T @ gravity
    hand_held = HandHeld(
        intrinsics=camera.intrinsics,
        sensor=camera.sensor,
        mount_xyz=(0.0, 0.0, 0.0),
        pitch_down_deg=0.0,
        color=sequence.colors is not None,
        down=(float(down[0]), float(down[1]), float(down[2])),
    )
    return replace(load_profile("phantomx_mk2"), camera=hand_held)


def in_words(table: dict[str, Any]) -> str:
    """Format a replay's result as text."""
    lines = [f"{table['source']}:"]
    lines.append(f"  {table['poses']} poses of {table['frames']} pictures, {table['poses_not_ok']} from the motion prior alone")
    lines += [f"  {line}" for line in replay_evidence.in_words(table["evidence"])]
    if table["pose_error_m"]["rms"] is not None:
        error = table["pose_error_m"]
        lines.append(
            f"  trajectory error after alignment: {error['rms'] * 1e3:.1f} mm rms, {error['final'] * 1e3:.1f} mm at the end"
        )
    else:
        lines.append("  no trajectory error: no groundtruth.txt covers the sequence")
    lines += [f"  {name}: {t['p50']:.2f} ms, 99 % below {t['p99']:.2f} ms" for name, t in table["stages_ms"].items()]
    return "\n".join(lines)


def _play(
    sequence: tum.Recording, profile: RobotProfile, registration: Literal["projective", "kiss-icp"], progress: Progress
) -> tuple[list[BodyPose], list[PictureEvidence], TerrainMap | None, dict[str, Any]]:
    heard = Listener()
    player = Player(sequence, _registered_range(profile, registration))
    makers: dict[str, Callable[[], Service]] = {
        "player": lambda: player,
        "perception": lambda: Perception(profile, hand_held_settings(registration, profile.camera.sensor)),
        "mapper": lambda: Mapper(profile, MapperSettings(cells=_HAND_CELLS)),
        "constant velocity": lambda: ConstantVelocity(round(1e9 / profile.camera.sensor.rate_hz)),
    }
    # The guess must arrive before the next picture, as if a hand-held camera's perception made it itself.
    lockstep = Lockstep(makers, heard.tap, latency_s={topics.BODY_POSE.key: 0.001, topics.ODOMETRY.key: 0.001})
    try:
        while not player.finished:
            lockstep.run(lockstep.now_ns + _SHOW_NS)
            progress.say(f"{player.status()}, {len(heard.poses)} poses")
        lockstep.run(lockstep.now_ns + _SETTLE_NS)
    except ServiceFailedError as error:
        if isinstance(error.__cause__, ReplayError):  # a picture that cannot be read
            raise error.__cause__ from None
        raise
    stages = stages_ms(lockstep.service("perception"), lockstep.service("mapper"))
    poses = {pose.stamp_ns: pose for pose in heard.poses}
    pictures = [picture_evidence(stamp_ns, poses.get(stamp_ns), depth) for stamp_ns, depth in player.depth_ranges.items()]
    return heard.poses, pictures, heard.terrain, stages


def _registered_range(profile: RobotProfile, registration: Literal["projective", "kiss-icp"]) -> DepthSensor:
    """Return the camera's sensor with the depth range that registration uses."""
    sensor = profile.camera.sensor
    settings = hand_held_settings(registration, sensor)
    return replace(sensor, max_range=min(sensor.max_range, settings.registration_range))


def _true_pairs(truth: tum.Trajectory | None, stamps_ns: NDArray[np.int64], T_estimate: Array) -> tuple[Array, Array] | None:
    """Return estimated and true poses (n, 4, 4) where the truth covers the path.

    None if there are fewer than three.
    """
    if truth is None:
        return None
    pairs = [
        (T, T_true) for stamp, T in zip(stamps_ns, T_estimate, strict=True) if (T_true := truth.at(int(stamp))) is not None
    ]
    if len(pairs) < 3:
        return None
    return np.array([T for T, _ in pairs]), np.array([T for _, T in pairs])


def _draw(path: Path, terrain: TerrainMap, T: Array) -> None:
    """Draw the map with x up and y left, unknown cells grey, the camera path white.

    The map has its own colours with hill shading if it has any, else heights from blue to red.
    """
    scale = max(1, math.ceil(640 / max(terrain.elevation.shape)))
    known = np.isfinite(terrain.elevation)
    low, high = np.percentile(terrain.elevation[known], (1, 99)) if known.any() else (0.0, 1.0)
    middle, half = (low + high) / 2, max((high - low) / 2, _FLAT / 2)
    low, high = middle - half, middle + half
    level = np.clip((np.where(known, terrain.elevation, low) - low) / (high - low), 0, 1)
    picture = cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_TURBO)
    colored = known & terrain.color.any(axis=-1) if terrain.color.size else np.zeros_like(known)
    if colored.any():
        picture[colored] = shaded(terrain.color, terrain.elevation, terrain.resolution)[colored][:, ::-1]
    picture[~known] = (96, 96, 96)
    picture = np.ascontiguousarray(picture[::-1, ::-1])
    picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    cells = (T[:, :2, 3] - terrain.origin) / terrain.resolution
    nx, ny = terrain.elevation.shape
    way = np.stack([(ny - 0.5 - cells[:, 1]) * scale, (nx - 0.5 - cells[:, 0]) * scale], axis=-1)
    cv2.polylines(picture, [np.clip(way, -1e6, 1e6).round().astype(np.int32)], False, (255, 255, 255), 2, cv2.LINE_AA)
    words = f"{low:.2f} m (blue) to {high:.2f} m (red), cell {terrain.resolution * 100:.0f} cm"
    if colored.any():
        words = f"heights {low:.2f} to {high:.2f} m in the ground's colours, cell {terrain.resolution * 100:.0f} cm"
    cv2.putText(picture, words, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    whole_files.write_bytes(path, cv2.imencode(path.suffix, picture)[1].tobytes())
