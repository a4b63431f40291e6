"""Inset of the robot's height map from above, with its heading up.

It marks unsafe ground, the path and the next footholds.
"""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.figures.relief import shaded
from sextant.evaluation.video.ground import RELIEF
from sextant.evaluation.video.robot_figure import CARRIES, COLORS, SWINGS
from sextant.evaluation.video.timeline import Moment
from sextant.shared.geometry import Array, apply
from sextant.shared.robot.kinematics import body_forward
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import TerrainMap

FOOTHOLD, PATH = (219, 22, 102), (36, 70, 200)
_UNKNOWN = (214, 217, 221)
_NO_FOOTHOLD = (104, 34, 40)
_HEIGHTS = np.array(RELIEF, dtype=np.float64)
_TRAIL, _BODY = (90, 96, 104), (40, 45, 53)
_REACH = 0.80  # [m] shown to each side, for a robot of the usual size
_FINER = 2  # supersampling factor
_SHIFT = 4  # bits of a pixel's fraction in OpenCV's drawing functions


class Inset:
    """Draws maps into squares of one size [px]."""

    def __init__(self, profile: RobotProfile, size: int, limits: tuple[float, float]):
        self._profile, self.size = profile, size
        self._low, self._high = limits
        links = profile.links
        self._reach = _REACH * float(np.clip((links.coxa + links.femur + links.tibia) / 0.251, 0.6, 4.0))

    def draw(self, terrain: TerrainMap | None, moment: Moment, heading: float, trail: Array) -> NDArray[np.uint8]:
        """Return a picture (size, size, 3).

        Args:
            terrain: The map; None before the first.
            moment: Pose and path of the robot.
            heading: [rad] {world} direction that is up.
            trail: (n, 2) [m] {world} past positions of the body.
        """
        n = self.size * _FINER
        pixel = 2 * self._reach / n
        ahead = np.array([np.cos(heading), np.sin(heading)])
        left = np.array([-ahead[1], ahead[0]])
        T = moment.T_world_body
        middle = T[:2, 3] + 0.22 * self._reach * ahead
        off = (np.arange(n) - (n - 1) / 2) * pixel
        xy = middle - off[:, None, None] * ahead - off[None, :, None] * left
        canvas = np.empty((n, n, 3), dtype=np.uint8)
        canvas[:] = _UNKNOWN
        if terrain is not None:
            self._ground(canvas, terrain, xy)

        def at(points: Array) -> NDArray[np.int32]:
            d = np.asarray(points)[..., :2] - middle
            u, v = (n - 1) / 2 - d @ left / pixel, (n - 1) / 2 - d @ ahead / pixel
            places = np.stack([u, v], axis=-1) * (1 << _SHIFT)
            return np.asarray(np.round(np.clip(places, -(1 << 20), 1 << 20)), dtype=np.int32)

        unit = n / 300
        self._lines(canvas, at(trail), _TRAIL, max(round(2 * unit), 1))
        if len(moment.path):
            self._lines(canvas, at(np.vstack([T[:2, 3], moment.path])), PATH, max(round(4 * unit), 1))
        self._robot(canvas, at, moment, unit)
        for p in at(moment.footholds_world):
            self._dot(canvas, p, 8.0 * unit, FOOTHOLD)
            self._dot(canvas, p, 4.0 * unit, (255, 255, 255))
        return np.asarray(cv2.resize(canvas, (self.size, self.size), interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def _ground(self, canvas: NDArray[np.uint8], terrain: TerrainMap, xy: Array) -> None:
        height = terrain.elevation
        share = np.clip((height - self._low) / (self._high - self._low), 0.0, 1.0) * (len(_HEIGHTS) - 1)
        share = np.where(np.isfinite(share), share, 0.0)
        i = np.minimum(share.astype(int), len(_HEIGHTS) - 2)
        colors = _HEIGHTS[i] + (share - i)[..., None] * (_HEIGHTS[i + 1] - _HEIGHTS[i])
        bad = np.where(np.isfinite(terrain.score), np.clip((terrain.score - 0.8) / 0.6, 0.0, 1.0), 0.0)[..., None]
        colors = colors + 0.62 * bad * (np.array(_NO_FOOTHOLD) - colors)
        colors[~np.isfinite(height)] = _UNKNOWN
        colors = shaded(np.clip(colors, 0, 255).astype(np.uint8), height, terrain.resolution)
        cells = np.round((xy - terrain.origin) / terrain.resolution).astype(int)
        nx, ny = height.shape
        inside = (cells[..., 0] >= 0) & (cells[..., 0] < nx) & (cells[..., 1] >= 0) & (cells[..., 1] < ny)
        canvas[inside] = colors[cells[inside][:, 0], cells[inside][:, 1]]

    def _robot(self, canvas: NDArray[np.uint8], at: Callable[[Array], NDArray[np.int32]], moment: Moment, unit: float) -> None:
        T = moment.T_world_body
        length, width, _ = self._profile.body.size
        corners = np.array([[1, 0.6, 0], [1, -0.6, 0], [0.6, -1, 0], [-1, -1, 0], [-1, 1, 0], [0.6, 1, 0]], dtype=np.float64)
        body = at(apply(T, corners * (length / 2, width / 2, 0)))
        feet = at(apply(T, body_forward(self._profile, moment.q)))
        hips = at(apply(T, self._profile.T_body_coxa[:, :3, 3]))
        for hip, foot in zip(hips, feet, strict=True):
            self._lines(canvas, np.stack([hip, foot]), _BODY, max(round(3 * unit), 1))
        cv2.fillPoly(canvas, [body], _BODY, lineType=cv2.LINE_AA, shift=_SHIFT)
        for foot, carries in zip(feet, moment.carries, strict=True):
            self._dot(canvas, foot, 5.0 * unit, COLORS[CARRIES if carries else SWINGS][0])

    @staticmethod
    def _lines(canvas: NDArray[np.uint8], points: NDArray[np.int32], color: tuple[int, int, int], width: int) -> None:
        if len(points) > 1:
            cv2.polylines(canvas, [points], False, color, width, cv2.LINE_AA, _SHIFT)

    @staticmethod
    def _dot(canvas: NDArray[np.uint8], p: NDArray[np.int32], radius: float, color: tuple[int, int, int]) -> None:
        cv2.circle(canvas, (int(p[0]), int(p[1])), round(radius * (1 << _SHIFT)), color, -1, cv2.LINE_AA, _SHIFT)
