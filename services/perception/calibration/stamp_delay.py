"""Error of the images' stamps, estimated from the changes of a walking robot's speed.

An image that is stamped too late shows the robot where it was before. While the robot speeds up, the registered poses then lag
behind the legs, and while it slows down they catch up. A constant speed shows nothing, because the lag is constant, too.
"""

from dataclasses import dataclass

import numpy as np

from sextant.services.perception.calibration.motion_calibration import Registered, image_gain
from sextant.shared.geometry import Array

_STRETCH_NS = 1_800_000_000  # [ns] of the motion that one measurement covers: more than one step
_FEWEST_FRAMES = 10  # of a stretch
_LEAST_WAY_M = 0.04  # [m] of a stretch
_LEAST_GAIN = 0.8  # [1] by which the poses must follow the images along the way
_PRIOR_SIGMA_S = 0.05  # [s] before the first measurement
_OF_POSE_M = 0.0005  # [m] error of a registered pose along the way
_FITTED = 3  # numbers that are fitted to a stretch
_OF_LEGS_S = 0.01  # [s] by which the legs' own stamps differ: servos are read one after the other


@dataclass(frozen=True, slots=True)
class _Frame:
    at_s: float  # [s]
    legs: Array  # (3,) [m] {world} motion of the body since the last frame, by odometry
    seen: Array  # (3,) [m] {world} the registered pose minus the prior
    gain: Array  # (3, 3) of the positions


class StampDelay:
    """Estimates how much later [s] than its profile says an image is stamped after its exposure."""

    def __init__(self) -> None:
        """Start with the prior."""
        self._frames: list[_Frame] = []
        self._information, self._sum = _PRIOR_SIGMA_S**-2, 0.0  # [1/s^2], [1/s]

    @property
    def value(self) -> float:
        """The most likely delay [s]."""
        return self._sum / self._information

    @property
    def sigma(self) -> float:
        """Its standard deviation [s]."""
        return float(np.hypot(self._information**-0.5, _OF_LEGS_S))

    def interrupt(self) -> None:
        """Drop the stretch: a frame was not registered, or the pose jumped."""
        self._frames.clear()

    def add(self, frame: Registered) -> None:
        """Add a registered frame."""
        frames = self._frames
        at_s = frames[-1].at_s + frame.since_ns * 1e-9 if frames else 0.0
        legs = frame.T_prior[:3, :3] @ frame.T_moved[:3, :3].T @ frame.T_moved[:3, 3]
        frames.append(_Frame(at_s, legs, frame.twist[:3], image_gain(frame)[:3, :3]))
        if at_s * 1e9 >= _STRETCH_NS:
            self._update()
            frames.clear()

    def _update(self) -> None:
        """Update the delay with a stretch: the slope of the lag over the speed, both without their mean and their trend."""
        frames = self._frames
        legs = np.cumsum([frame.legs for frame in frames], axis=0)
        way = legs[-1] - legs[0]
        length = float(np.linalg.norm(way))
        if len(frames) < _FEWEST_FRAMES or length < _LEAST_WAY_M:
            return
        along = way / length
        if along @ np.mean([frame.gain for frame in frames], axis=0) @ along < _LEAST_GAIN:
            return
        t = np.array([frame.at_s for frame in frames])
        speed = np.gradient(legs @ along, t)
        lag = -np.cumsum([frame.seen @ along for frame in frames])
        constant, _ = np.linalg.qr(np.stack([np.ones_like(t), t - t.mean()], axis=1))
        speed, lag = speed - constant @ (constant.T @ speed), lag - constant @ (constant.T @ lag)
        excitation = float(speed @ speed)
        if not excitation:
            return
        slope = float(speed @ lag) / excitation
        rest = lag - slope * speed  # of a slipping foot, and of a body that leans
        variance = max(_OF_POSE_M**2, float(rest @ rest) / (len(rest) - _FITTED))
        self._information += excitation / variance
        self._sum += slope * excitation / variance
