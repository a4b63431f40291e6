"""Speed of registration compared with its peers.

Every frame is processed by all methods in turn.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.peers.registration_peers import METHODS, Registered, RegistrationMethod
from benchmarks.peers.scenes import REGISTERED
from benchmarks.peers.synthetic_trajectory import CarriedCamera, Errors, Ride, ride
from benchmarks.peers.timing import Race, Timing, installed, one_core
from sextant.services.perception.config import Settings
from sextant.services.perception.registration.plugin_registration import PluginRegistration
from sextant.shared.geometry import Array, inverse

_WARM = 5  # untimed frames at the start, if there are more
_STEP = 0.02  # [m] between frames
_BELIEF = Settings()  # covariance model of the odometry
HEADINGS = {"drift_m": ("drift mm", 1e3, 1)}


class _Tracked:
    """A method on one ride."""

    def __init__(self, method: RegistrationMethod, T_first: Array):
        self.T_world_camera = T_first
        self._method = method

    def __call__(self, depth: NDArray[np.uint16], index: int, motion: Array, covariance: Array) -> None:
        expected = self.T_world_camera @ motion
        self.T_world_camera = self._method.update(depth, index, expected, covariance)


def registration(
    seeds: Sequence[int], frames: int = 100, say: Callable[[str], object] = lambda _: None, plugin: str = ""
) -> tuple[list[Timing], list[str]]:
    """Time all methods of registration on all scenes.

    Return the timings, and which methods cannot be timed and why. The figure `drift_m` [m] is the position error at the end,
    the median over the seeds. A plug-in is one more method.

    Raises:
        PluginError: The plug-in failed.
        ValueError: Fewer than three frames.
    """
    out, missing = list[Timing](), list[str]()
    with one_core():
        for scene in REGISTERED:
            race = Race("registration", scene, warm=min(_WARM, frames - 1))
            drifts: dict[str, list[float]] = {}
            for seed in seeds:
                rngs = [np.random.default_rng([seed, k]) for k in range(3)]
                way = ride(REGISTERED[scene](rngs[0]), rngs[1], Errors(), frames, _STEP * frames)
                methods, missing = installed(METHODS, way.profile.camera.intrinsics, way.profile.camera.sensor)
                if plugin:
                    methods[plugin] = Registered(PluginRegistration(way.profile, plugin))
                tracked = {name: _Tracked(method, way.T_world_camera[0]) for name, method in methods.items()}
                race.start(tracked)
                camera = CarriedCamera(way, rngs[2])
                for k in range(frames):
                    race.run(camera.frame(k), k, *_odometry(way, k))
                for name, method in tracked.items():
                    error = float(np.linalg.norm((method.T_world_camera - way.T_world_camera[-1])[:3, 3]))
                    drifts.setdefault(name, []).append(error)
                say(f"registration: {scene}, seed {seed} done")
            out += race.timings({name: {"drift_m": float(np.median(errors))} for name, errors in drifts.items()})
    return out, missing


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
