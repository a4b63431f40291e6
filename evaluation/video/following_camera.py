"""Smooth camera that follows the robot from behind and from the side."""

import numpy as np

from sextant.evaluation.video.renderer import View
from sextant.evaluation.video.timeline import Timeline, trail
from sextant.shared.geometry import Array, transform
from sextant.shared.robot.profile import RobotProfile

_STEP_NS = 50_000_000  # [ns] sampling interval of the robot's path
_PLACE_S, _HEADING_S = 0.9, 3.0  # [s] standard deviations of the averages of position and heading
_ASIDE, _SWAY, _SWAY_S = np.radians(-48.0), np.radians(9.0), 45.0  # [rad] from behind, sway amplitude, its period [s]
_UP = np.radians(33.0)  # [rad] above the horizon
_FOCAL = 1.75  # [1] of the picture's height
_DISTANCE = 1.60  # [m] from a robot of the usual size
_AHEAD = 0.06  # [m] of the picture's middle in front of the robot


class FollowingCamera:
    """Camera smoothed over past and future, so that it does not lag."""

    def __init__(self, story: Timeline, profile: RobotProfile):
        n = max((story.ended_ns - story.began_ns) // _STEP_NS, 1) + 1
        self._began_ns = story.began_ns
        poses = trail(story, [story.began_ns + k * _STEP_NS for k in range(n)])
        forward = poses[:, :2, 0] / np.linalg.norm(poses[:, :2, 0], axis=1, keepdims=True)
        self._p = _smoothed(poses[:, :3, 3], _PLACE_S)
        self._forward = _smoothed(forward, _HEADING_S)
        links = profile.links
        self._scale = float(np.clip((links.coxa + links.femur + links.tibia) / 0.251, 0.6, 4.0))

    def view(self, t_ns: int) -> View:
        """Return the camera at a time [ns]."""
        s = (t_ns - self._began_ns) / _STEP_NS
        p, forward = _at(self._p, s), _at(self._forward, s)
        heading = np.arctan2(forward[1], forward[0])
        aside = _ASIDE + _SWAY * np.sin(2 * np.pi * (t_ns - self._began_ns) * 1e-9 / _SWAY_S)
        toward = heading - aside
        look = np.array([np.cos(toward) * np.cos(_UP), np.sin(toward) * np.cos(_UP), -np.sin(_UP)])
        x = np.cross(look, np.array([0.0, 0.0, 1.0]))
        x /= np.linalg.norm(x)
        distance = _DISTANCE * self._scale
        target = p + self._scale * _AHEAD * np.array([np.cos(heading), np.sin(heading), 0.0])
        return View(transform(np.column_stack([x, np.cross(look, x), look]), target - distance * look), _FOCAL, distance)

    def heading(self, t_ns: int) -> float:
        """Return the smoothed heading [rad] {scene} of the robot."""
        x, y = _at(self._forward, (t_ns - self._began_ns) / _STEP_NS)
        return float(np.arctan2(y, x))


def _smoothed(values: Array, sigma_s: float) -> Array:
    """Average values (n, k) over neighbours with a Gaussian."""
    sigma = sigma_s * 1e9 / _STEP_NS
    reach = int(3 * sigma)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
    return np.column_stack([np.convolve(column, weights / weights.sum(), mode="valid") for column in padded.T])


def _at(values: Array, s: float) -> Array:
    """Interpolate values (k,) between two samples."""
    s = min(max(s, 0.0), len(values) - 1.0)
    i = min(int(s), max(len(values) - 2, 0))
    return np.asarray(values[i] + (s - i) * (values[min(i + 1, len(values) - 1)] - values[i]))
