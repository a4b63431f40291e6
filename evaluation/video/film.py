"""Renderer of a recorded run as a film."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.video import ground as grounds
from sextant.evaluation.video.captions import Caption, lay_in
from sextant.evaluation.video.following_camera import FollowingCamera
from sextant.evaluation.video.ground import Ground
from sextant.evaluation.video.inset import FOOTHOLD, Inset
from sextant.evaluation.video.renderer import Figure, Mark, Renderer, View
from sextant.evaluation.video.sinking import Sinking
from sextant.evaluation.video.timeline import Maps, Moment, Timeline
from sextant.shared.geometry import Array, apply
from sextant.shared.recording.reader import Recording
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import TerrainMap

_TRAIL_NS = 200_000_000  # [ns] between the positions of the trail
_INSET = 0.40  # [1] of the picture's height
_SMALLEST = 96  # [px] least size of a legible map
_MARGIN = 0.025  # [1] of the picture's height
_INNER, _OUTER = 0.016, 0.024  # [m] radii of the ring around a planned foothold
_CORE = 0.007  # [m] radius of the dot within


@dataclass(frozen=True, slots=True)
class Cut:
    """Which part of a run is shown, and how."""

    size: tuple[int, int] = (1280, 720)  # [px]
    fps: float = 25.0
    times: float = 1.0  # [1] speed factor
    from_s: float = 0.0
    to_s: float = float("inf")

    def times_ns(self, story: Timeline) -> list[int]:
        """Return the time [ns] of each picture.

        Raises:
            ValueError: No part of the run lies in that interval.
        """
        to_s = min(self.to_s, story.duration_s)
        count = round((to_s - self.from_s) * self.fps / self.times)
        if not self.from_s < to_s or count < 1:
            asked = f"{self.from_s:g} s to {'the end' if self.to_s == float('inf') else f'{self.to_s:g} s'}"
            raise ValueError(f"a part of the recorded {story.duration_s:.1f} s expected, found {asked}")
        return [story.began_ns + round((self.from_s + k * self.times / self.fps) * 1e9) for k in range(count)]


class Animation:
    """Pictures of a run, rendered in order by several threads."""

    def __init__(
        self,
        path: Path,
        story: Timeline,
        profile: RobotProfile,
        ground: Ground | None,
        title: str,
        cut: Cut,
        sinking: Sinking | None = None,
    ):
        """Prepare the film.

        Args:
            path: The recording, whose maps are read again while rendering.
            story: Timeline of the other messages.
            profile: The robot.
            ground: The true ground; None to draw the robot on its own maps.
            title: Caption.
            cut: Part of the run to show.
            sinking: When the weak parts of the ground gave way.
        """
        self._sinking = sinking
        self._path, self._story, self._profile, self._cut = path, story, profile, cut
        self._ground = ground
        self.times_ns = cut.times_ns(story)
        self.camera = FollowingCamera(story, profile)
        self._caption = Caption(cut.size, title, cut.times)
        self._limits = (0.0, 0.0)
        n = (story.ended_ns - story.began_ns) // _TRAIL_NS + 1
        self._trail = np.array([story.believed(story.began_ns + k * _TRAIL_NS)[:2, 3] for k in range(n)])

    def frames(self, workers: int, tell: Callable[[int], None] = lambda _done: None) -> Iterator[NDArray[np.uint8]]:
        """Yield the pictures (h, w, 3) R, G, B in order, rendered by several threads.

        `tell` receives the number of finished pictures.
        """
        painters: SimpleQueue[Renderer] = SimpleQueue()
        for _ in range(workers):
            painters.put(Renderer(self._profile, self._cut.size))
        self._limits = self._limits_of_maps() if self._ground is None else self._limits_of(self._ground)
        maps = Maps(Recording(self._path))
        inset_size = max(round(_INSET * self._cut.size[1]), 1)
        inset = Inset(self._profile, inset_size, self._limits) if inset_size >= _SMALLEST else None
        coming: deque[Future[NDArray[np.uint8]]] = deque()
        terrain, ground = None, self._ground or self._mapped(None)
        with ThreadPoolExecutor(workers) as pool:
            try:
                for k, t_ns in enumerate(self.times_ns):
                    before, terrain = terrain, maps.until(t_ns)
                    if self._ground is None and terrain is not before:
                        ground = self._mapped(terrain)
                    coming.append(pool.submit(self._frame, painters, t_ns, ground, terrain, inset))
                    if len(coming) > 2 * workers:
                        yield coming.popleft().result()
                        tell(k + 1 - len(coming))
                while coming:
                    yield coming.popleft().result()
                    tell(len(self.times_ns) - len(coming))
            finally:
                for future in coming:
                    future.cancel()

    def _frame(
        self, painters: "SimpleQueue[Renderer]", t_ns: int, ground: Ground, terrain: TerrainMap | None, inset: Inset | None
    ) -> NDArray[np.uint8]:
        moment, view = self._story.moment(t_ns), self.camera.view(t_ns)
        painter = painters.get()
        try:
            painter.stand_on(ground)
            sunk = None if self._sinking is None else self._sinking.at(t_ns)
            picture = self.paint(painter, moment, view, sunk)
        finally:
            painters.put(painter)
        if inset is not None:
            ahead = moment.T_scene_world[:2, :2].T @ [np.cos(self.camera.heading(t_ns)), np.sin(self.camera.heading(t_ns))]
            been = self._trail[: (t_ns - self._story.began_ns) // _TRAIL_NS + 1]
            drawn = inset.draw(terrain, moment, float(np.arctan2(ahead[1], ahead[0])), been)
            lay_in(picture, drawn, round(_MARGIN * self._cut.size[1]))
        self._caption.write(picture, moment)
        return picture

    @staticmethod
    def paint(painter: Renderer, moment: Moment, view: View, sunk: Array | None = None) -> NDArray[np.uint8]:
        """Return the picture of a moment, without map and text."""
        marks = []
        for p in moment.footholds:
            marks += [Mark(p, _INNER, _OUTER, FOOTHOLD), Mark(p, 0.0, _CORE, FOOTHOLD)]
        return painter.paint(Figure(moment.T_scene_body, moment.q, moment.carries, sunk), view, marks, _way(moment))

    def _mapped(self, terrain: TerrainMap | None) -> Ground:
        if terrain is None:
            none = np.full((2, 2), np.nan, dtype=np.float32)
            return grounds.of_map(none, np.zeros(2), 0.01, self._limits)
        return grounds.of_map(terrain.elevation, terrain.origin, terrain.resolution, self._limits)

    def _limits_of(self, ground: Ground) -> tuple[float, float]:
        """Return the heights [m] {world} of the lowest and highest colour, by the ground."""
        rise = self._story.moment(self.times_ns[0]).T_scene_world[2, 3]
        return ground.low - rise, ground.high - rise

    def _limits_of_maps(self) -> tuple[float, float]:
        """Return the heights [m] of the lowest and highest colour, over all maps."""
        maps, found = Maps(Recording(self._path)), []
        for t_ns in range(self._story.began_ns, self._story.ended_ns + 1, 5_000_000_000):
            known = maps.until(t_ns)
            if known is not None:
                found.append(known.elevation[::4, ::4].ravel())
        return grounds.limits_of(np.concatenate(found) if found else np.zeros(0, dtype=np.float32))


def _way(moment: Moment) -> Array:
    """Return the path to the goal as segments (s, 2, 2) [m] {scene}."""
    if not len(moment.path):
        return np.zeros((0, 2, 2))
    corners = np.vstack([moment.T_world_body[:2, 3], moment.path])
    places = apply(moment.T_scene_world, np.column_stack([corners, np.zeros(len(corners))]))[:, :2]
    return np.stack([places[:-1], places[1:]], axis=1)
