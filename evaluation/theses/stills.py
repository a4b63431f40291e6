"""Pictures of the simulated robot at moments of a recorded walk, and what its camera shows there."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.video.film import Animation
from sextant.evaluation.video.following_camera import FollowingCamera
from sextant.evaluation.video.ground import of_terrain
from sextant.evaluation.video.renderer import Renderer
from sextant.evaluation.video.timeline import Timeline, trail
from sextant.services.simulator.physics.terrain import Terrain, build_terrain
from sextant.services.simulator.sensors.renderer import Renderer as CameraRenderer
from sextant.shared.geometry import Array
from sextant.shared.recording.reader import Recording
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario

_STEP_NS = 200_000_000  # [ns] between the places that the ground's colours are for
_LIGHT = np.array([0.3, -0.5, -0.8])  # {camera} direction to the lamp: x right, y down, z forward
_AMBIENT = 0.35
_SKY = 235  # grey


def true_terrain(scenario: str, seed: int) -> Terrain:
    """Return the ground of a walk, as the simulator builds it."""
    return build_terrain(load_scenario(scenario), np.random.default_rng([seed, 0]))


def stills(path: Path, scenario: str, seed: int, times_s: Sequence[float], size: tuple[int, int]) -> list[NDArray[np.uint8]]:
    """Return pictures (h, w, 3) of the simulated robot at simulated times [s] of a recorded lockstep run."""
    story = Timeline.read(Recording(path))
    profile = load_profile(load_scenario(scenario).robot)
    span = range(story.began_ns, story.ended_ns + 1, _STEP_NS)
    way = trail(story, list(span))[:, :2, 3]
    painter, camera = Renderer(profile, size), FollowingCamera(story, profile)
    painter.stand_on(of_terrain(true_terrain(scenario, seed), way))
    moments = [min(max(round(t * 1e9), story.began_ns), story.ended_ns) for t in times_s]
    return [Animation.paint(painter, story.moment(t), camera.view(t)) for t in moments]


def camera_picture(terrain: Terrain, profile: RobotProfile, T_world_body: Array) -> NDArray[np.uint8]:
    """Return what the robot's camera shows (h, w, 3), lit by a lamp; pale where nothing is."""
    renderer = CameraRenderer(terrain, profile.camera.intrinsics)
    canvas = renderer.surfaces(T_world_body @ profile.camera.T_body_camera)
    normals = np.asarray(canvas.normal, dtype=np.float64)
    light = _AMBIENT + (1.0 - _AMBIENT) * np.abs(normals @ (-_LIGHT / np.linalg.norm(_LIGHT)))
    picture = renderer.colours[canvas.material] * light[..., None]
    return np.asarray(np.where((canvas.w > 0)[..., None], np.clip(picture, 0, 255), _SKY), dtype=np.uint8)


def draw_stills(axes: Sequence[Any], pictures: Sequence[NDArray[np.uint8]], titles: Sequence[str]) -> None:
    """Draw pictures side by side."""
    for axis, picture, title in zip(axes, pictures, titles, strict=True):
        axis.imshow(picture)
        axis.set_axis_off()
        axis.set_title(title)
