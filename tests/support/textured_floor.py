"""A camera with colour that moves over a level floor, and legs that drift."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.error_twist import apply_twist, error_twist
from sextant.services.perception.registration.params import TextureParams
from sextant.services.perception.registration.projective_icp import Registration
from sextant.services.perception.registration.registration_result import RegistrationResult
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.services.simulator.sensors.depth_camera import DepthCamera
from sextant.services.simulator.sensors.gray_camera import GrayCamera
from sextant.services.simulator.sensors.renderer import Renderer
from sextant.shared.geometry import Array, from_xyz_rpy, inverse
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Floor

CAMERA = load_profile("phantomx_mk2_rgbd").camera
PERIOD_NS = 66_000_000
STEP_M, TURN_RAD = 0.007, 0.002  # between two frames
DRIFT = np.array([0.0004, 0.0003, 0.0, 0.0, 0.0, 0.0005])  # [m] and [rad] error of the legs between two frames
_SPREAD = np.diag(np.array([0.003, 0.003, 0.01, 0.01, 0.01, 0.003]) ** 2)


class TexturedFloor:
    """The camera, its registration, and their poses."""

    def __init__(self, floor: Floor | None = None, texture: TextureParams | None = None):
        """Start at the origin; without `texture` the registration does not use it."""
        terrain = build_terrain(load_scenario("flat"), np.random.default_rng(0))
        self.renderer = Renderer(terrain, CAMERA.intrinsics)
        self.depth_camera = DepthCamera(CAMERA.intrinsics, CAMERA.sensor, np.random.default_rng(0))
        self.gray_camera = GrayCamera(CAMERA.intrinsics, floor or Floor(), np.random.default_rng(1))
        self.registration = Registration(CAMERA.intrinsics, CAMERA.sensor, texture=texture)
        self.frames = 0
        self.T = self.at(0.0)
        self.found: RegistrationResult | None = None

    @staticmethod
    def at(step: float) -> Array:
        """Return the true camera pose (4, 4) after a number of steps along an arc."""
        return np.asarray(
            from_xyz_rpy((STEP_M * step, 0.0005 * step, 0.11), (0.0, 0.0, TURN_RAD * step)) @ CAMERA.T_body_camera
        )

    def images(self, T: Array) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        """Return depth and grey image at a pose."""
        canvas = self.renderer.surfaces(T)
        return self.depth_camera.measure(canvas.w), self.gray_camera.picture(canvas, T, self.frames * PERIOD_NS * 1e-9)

    def expected(self, T: Array, drift: Array = DRIFT) -> Array:
        """Return where drifting legs expect the camera at its next true pose (4, 4)."""
        if self.found is None:
            return T
        return apply_twist(self.found.T_world_camera @ inverse(self.T) @ T, drift)

    def move(self, step: float, change=lambda gray, frame: gray, drift: Array = DRIFT) -> RegistrationResult:  # type: ignore[no-untyped-def]
        """Register the frame after a number of steps; `change` alters its grey image, or gives None."""
        T = self.at(step)
        depth, gray = self.images(T)
        prior = self.expected(T, drift)
        gray = change(gray, self.frames)
        self.found = self.registration.update(depth, self.frames * PERIOD_NS, prior, _SPREAD, gray)
        self.T, self.frames = T, self.frames + 1
        return self.found

    def walk(self, frames: int, **options) -> RegistrationResult:  # type: ignore[no-untyped-def]
        """Move one step per frame; `options` are those of `move`."""
        for _ in range(frames):
            found = self.move(self.frames, **options)
        return found

    def error(self) -> Array:
        """Return the error twist (6,) [m, rad] of the pose found."""
        assert self.found is not None
        return error_twist(self.found.T_world_camera, self.T)


def trusted(**changes: float) -> TextureParams:
    """Return parameters of texture that is trusted at once."""
    return replace(TextureParams(probation=0.0), **changes)  # type: ignore[arg-type]
