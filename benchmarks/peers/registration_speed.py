"""Accuracy and speed of registration compared with its peers.

Every frame is processed by all methods in turn: those of synthetic rides with leg odometry, or those of a recording, with a
constant velocity as the prior.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.peers.registration_peers import METHODS
from benchmarks.peers.scenes import REGISTERED
from benchmarks.peers.synthetic_trajectory import CarriedCamera, Errors, Ride, ride
from benchmarks.peers.timing import Measured, Race, Timing, installed, one_core
from sextant.evaluation.replay.sequence import HAND_DECAY_S, hand_held_settings, profile_for
from sextant.services.perception import tum
from sextant.services.perception.config import Settings
from sextant.services.perception.registration.frame_registration import RegistrationMethod
from sextant.services.perception.registration.motion_prior import VelocityPrior
from sextant.services.perception.registration.plugin_registration import PluginRegistration
from sextant.services.perception.trajectory_error import trajectory_error
from sextant.shared.files.input_file import FileError
from sextant.shared.geometry import Array, inverse
from sextant.shared.robot.profile import RobotProfile

_WARM = 5  # untimed frames at the start, if there are more
_STEP = 0.02  # [m] between frames
_BELIEF = Settings()  # covariance model of the odometry
HEADINGS = {"drift_m": ("at the end, mm", 1e3, 1), "rms_m": ("rms, mm", 1e3, 1), "mean_ms": ("mean ms", 1.0, 1)}


class _OnRide:
    """A method on one ride."""

    def __init__(self, method: RegistrationMethod, T_first: Array):
        self.poses: list[Array] = []
        self._method, self._T_first = method, T_first

    def __call__(self, depth: NDArray[np.uint16], stamp_ns: int, motion: Array, covariance: Array) -> None:
        expected = (self.poses[-1] if self.poses else self._T_first) @ motion
        self.poses.append(self._method.update(depth, stamp_ns, expected, covariance).T_world_camera)


class _InHand:
    """A method on a recording without odometry."""

    def __init__(self, method: RegistrationMethod, settings: Settings, T_first: Array):
        self.poses: list[Array] = []
        self._method, self._settings, self._T_first = method, settings, T_first
        self._prior = VelocityPrior(HAND_DECAY_S)
        self._last_ns = 0

    def __call__(self, depth: NDArray[np.uint16], stamp_ns: int) -> None:
        expected = self._prior.predict(1e-9 * (stamp_ns - self._last_ns)) if self.poses else self._T_first
        sigma = math.hypot(self._settings.odometry_floor, 0.0 if self._prior.measured else self._settings.unreliable_way)
        found = self._method.update(depth, stamp_ns, expected, sigma**2 * np.eye(6))
        self._prior.update(stamp_ns, found.T_world_camera, found.ok, found.degenerate)
        self._last_ns = stamp_ns
        self.poses.append(found.T_world_camera)


def registration(
    seeds: Sequence[int],
    frames: int = 100,
    say: Callable[[str], object] = lambda _: None,
    plugin: str = "",
    only: str = "",
) -> Measured:
    """Time all methods of registration on all scenes.

    The figures are the median over the seeds of the position error, `rms_m` [m] of all frames and `drift_m` [m] at the end, and
    `mean_ms`, the mean time of a frame. A plug-in is one more method. `only` selects peers by a part of their name.

    Raises:
        PluginError: The plug-in failed.
        ValueError: Fewer than three frames.
    """
    out, missing = list[Timing](), list[str]()
    with one_core():
        for scene in REGISTERED:
            race = Race("registration", scene, warm=min(_WARM, frames - 1))
            errors: dict[str, list[tuple[float, float]]] = {}
            for seed in seeds:
                rngs = [np.random.default_rng([seed, k]) for k in range(3)]
                way = ride(REGISTERED[scene](rngs[0]), rngs[1], Errors(), frames, _STEP * frames)
                methods, missing = _methods(way.profile, Settings(), plugin, only)
                on_ride = {name: _OnRide(method, way.T_world_camera[0]) for name, method in methods.items()}
                race.start(on_ride)
                camera = CarriedCamera(way, rngs[2])
                for k in range(frames):
                    race.run(camera.frame(k), int(way.stamps_ns[k]), *_odometry(way, k))
                for name, method in on_ride.items():
                    error = trajectory_error(np.array(method.poses), way.T_world_camera, align=False)
                    errors.setdefault(name, []).append((error.rms, error.final))
                say(f"registration: {scene}, seed {seed} done")
            out += race.timings(_figures(errors, race))
    return Measured(timings=tuple(out), missing=tuple(missing))


def on_recording(folder: Path, say: Callable[[str], object] = lambda _: None, plugin: str = "", only: str = "") -> Measured:
    """Time all methods of registration on a recording in the TUM layout.

    The settings are those of `sextant recording replay`. Errors are those of the positions after a rigid alignment of the whole
    trajectory, as in the evaluation of the TUM benchmark.

    Raises:
        FileError: The recording cannot be read, or fewer than three frames have a true pose.
        PluginError: The plug-in failed.
    """
    sequence = tum.read_recording(folder)
    truth = [sequence.truth.at(int(stamp)) for stamp in sequence.stamps_ns] if sequence.truth else []
    known = [k for k, T in enumerate(truth) if T is not None]
    if len(known) < 3:
        raise FileError(folder / "groundtruth.txt", f"poses of at least 3 frames expected, found {len(known)}")
    profile = profile_for(sequence)
    settings = hand_held_settings("projective", profile.camera.sensor)
    with one_core():
        methods, missing = _methods(profile, settings, plugin, only)
        race = Race("registration", folder.name, warm=min(_WARM, len(sequence) - 1))
        in_hand = {name: _InHand(method, settings, profile.camera.T_body_camera) for name, method in methods.items()}
        race.start(in_hand)
        for k, (stamp_ns, depth) in enumerate(sequence.frames()):
            race.run(depth, stamp_ns)
            if k % 50 == 49:
                say(f"registration: frame {k + 1} of {len(sequence)}")
    errors: dict[str, list[tuple[float, float]]] = {}
    for name, method in in_hand.items():
        error = trajectory_error(np.array(method.poses)[known], np.array([truth[k] for k in known]))
        errors[name] = [(error.rms, error.final)]
    return Measured(timings=tuple(race.timings(_figures(errors, race))), missing=tuple(missing))


def _methods(
    profile: RobotProfile, settings: Settings, plugin: str, only: str
) -> tuple[dict[str, RegistrationMethod], list[str]]:
    """Return the default and the methods with `only` in their names, and which are missing."""
    chosen = {name: make for k, (name, make) in enumerate(METHODS.items()) if k == 0 or only in name}
    methods, missing = installed(chosen, profile.camera, settings)
    if plugin:
        methods[plugin] = PluginRegistration(profile, plugin)
    return methods, missing


def _figures(errors: Mapping[str, Sequence[tuple[float, float]]], race: Race) -> dict[str, dict[str, float]]:
    """Return the medians of errors (rms, final) [m], and the mean time of a frame [ms]."""
    medians = {name: np.median(np.array(each), axis=0).tolist() for name, each in errors.items()}
    return {
        name: {"rms_m": rms, "drift_m": final, "mean_ms": float(race.ms(name).mean())} for name, (rms, final) in medians.items()
    }


def _odometry(way: Ride, k: int) -> tuple[Array, Array]:
    """Return the camera motion (4, 4) since the last frame by leg odometry.

    Its covariance (6, 6) is that of perception.
    """
    motion = inverse(way.T_odom_body[k - 1]) @ way.T_odom_body[k] if k else np.eye(4)
    along = _BELIEF.odometry_drift * float(np.linalg.norm(motion[:3, 3])) + _BELIEF.odometry_floor
    turn = _BELIEF.odometry_turn * abs(math.atan2(motion[1, 0], motion[0, 0])) + _BELIEF.odometry_floor
    level = _BELIEF.odometry_level
    T_body_camera = way.profile.camera.T_body_camera
    covariance = np.diag(np.square([along, along, level, level, level, turn]))
    return inverse(T_body_camera) @ motion @ T_body_camera, covariance
