"""Camera on the robot: depth and colour frames of a world, with the camera faults of a scenario."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.simulator.physics.movers import Movers, together
from sextant.services.simulator.physics.solids import Boxes, Capsules
from sextant.services.simulator.physics.world import World
from sextant.services.simulator.sensors import camera_faults
from sextant.services.simulator.sensors.camera_errors import CameraErrors
from sextant.services.simulator.sensors.camera_faults import CameraFaults
from sextant.services.simulator.sensors.color_camera import ColorCamera
from sextant.services.simulator.sensors.depth_camera import DepthCamera
from sextant.services.simulator.sensors.gray_camera import GrayCamera
from sextant.services.simulator.sensors.renderer import Renderer
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import Stages
from sextant.shared.scenario.mover import Mover
from sextant.shared.scenario.scenario import Fault, Scenario

_GRAY_STREAM = 8  # random stream of the run's seed for texture and light
_NO_GRAY = np.zeros((0, 0), dtype=np.uint8)


class RobotCamera:
    """Renders the frames of the robot's camera, which sees terrain, robot and movers."""

    def __init__(
        self,
        profile: RobotProfile,
        scenario: Scenario,
        world: World,
        seed: int,
        random: tuple[np.random.Generator, np.random.Generator, np.random.Generator],
        stages: Stages,
        frames_per_picture: int = 1,
    ):
        """Begin without a frame.

        Args:
            profile: The real robot.
            scenario: Noise, errors, faults and movers.
            world: The physics.
            seed: Random seed of the run.
            random: Random generators of depth noise, colour noise and movers.
            stages: Takes the durations.
            frames_per_picture: Render only every n-th depth frame.
        """
        depth_random, color_random, movers_random = random
        self._world, self._profile, self._seed = world, profile, seed
        self._renderer = Renderer(world.terrain, profile.camera.intrinsics)
        self._depth_camera = DepthCamera(
            profile.camera.intrinsics,
            profile.camera.sensor,
            depth_random,
            noise=scenario.camera.noise,
            dropouts=scenario.camera.dropouts,
            loss=scenario.camera.loss,
        )
        self._errors = CameraErrors(profile.camera, scenario.deviation(seed).depth_bias)
        has_color = profile.camera.color
        self._color_camera = ColorCamera(self._renderer, world.terrain, color_random) if has_color else None
        gray_random = np.random.default_rng([seed, _GRAY_STREAM])
        self._gray_camera = GrayCamera(profile.camera.intrinsics, scenario.floor, gray_random) if has_color else None
        self._gray = _NO_GRAY
        self._faults = [fault for fault in scenario.faults_at(seed) if fault.of_camera]
        self._effects: CameraFaults | None = None  # of faults of the picture, from the first of them on
        self._movers = Movers(scenario.movers, world.terrain, movers_random)
        self._stages = stages
        self._frames_per_picture = frames_per_picture
        self._frames = 0
        self._last_depth: NDArray[np.uint16] | None = None

    @property
    def fault(self) -> str:
        """Kind of the present camera fault, "" without one."""
        present = self._present()
        return "" if present is None else present.kind

    def _present(self) -> Fault | None:
        now_s = self._world.time_ns * 1e-9
        return next((fault for fault in self._faults if fault.at_s <= now_s < fault.at_s + fault.for_s), None)

    def disturb(self, by: Fault | Mover) -> None:
        """Add a fault of the camera, or something that moves in its view, from its simulated time on.

        Raises:
            ValueError: It is a fault of a process.
        """
        if not isinstance(by, Fault):
            self._movers.add(by)
        elif by.of_camera:
            self._faults.append(by)
        else:
            raise ValueError(f"a fault of the camera expected, found one of {by.service}")

    def delivery(self, stamp_ns: int) -> tuple[int, int]:
        """Return stamp and arrival [ns] of the newest frame, for its stamp without a fault."""
        present = self._present()
        if present is None:
            return stamp_ns, stamp_ns
        begin_ns = stamp_ns - max(0, self._world.time_ns - round(present.at_s * 1e9))
        return camera_faults.delivery(present.kind, stamp_ns, begin_ns, self._frames)

    @property
    def has_color(self) -> bool:
        """Whether the camera has a colour sensor."""
        return self._color_camera is not None

    def begin_frame(self) -> bool:
        """Count a depth frame, and return whether it is to be rendered.

        The movers advance in any case.
        """
        self._frames += 1
        if len(self._movers):
            self._movers.advance(self._world.time_ns * 1e-9, self._world.T_world_body)
        rendered = self._frames % self._frames_per_picture == 0
        if not rendered:
            self._depth_camera.skip_frame()
            if self._gray_camera is not None:
                self._gray_camera.skip_frame()
        return rendered

    def depth(self) -> NDArray[np.uint16] | None:
        """Return the raw depth frame (h, w) with the effect of a camera fault.

        The result is None while the camera is absent.
        """
        fault = self.fault
        if fault == "absent":
            return None
        if fault in ("frozen", "stale") and self._last_depth is not None:
            return self._last_depth
        if fault and self._effects is None:
            self._effects = CameraFaults(self._profile.camera.intrinsics, self._profile.camera.sensor, self._seed)
        effects = self._effects if fault else None
        replaced = None if effects is None else effects.replaced(fault, self._world.time_ns)
        if replaced is not None:
            return replaced
        T_world_camera = self._T_world_camera
        with self._stages("render"):
            self._renderer.settle(self._world.loose_boxes)
            picture = self._rendered(T_world_camera)
            if effects is not None:
                picture = effects.scene(fault, picture, T_world_camera)
        with self._stages("depth noise"):
            depth = self._depth_camera.measure(self._errors.depth(picture))
            if effects is not None:
                depth = effects.measured(fault, depth, T_world_camera, self._world.time_ns)
        self._last_depth = depth
        return depth

    def _rendered(self, T_world_camera: Array) -> NDArray[np.float32]:
        """Return inverse depth (h, w) [1/m]; a camera with colour also takes its grey image."""
        if self._gray_camera is None:
            return self._renderer.inverse_depth(T_world_camera, self._solids())
        canvas = self._renderer.surfaces(T_world_camera, self._solids())
        with self._stages("gray"):
            self._gray = self._errors.gray(self._gray_camera.picture(canvas, T_world_camera, self._world.time_ns * 1e-9))
        return canvas.w

    @property
    def gray(self) -> NDArray[np.uint8]:
        """Grey image of the newest depth frame; empty without a colour sensor."""
        return self._gray

    def color(self) -> NDArray[np.uint8]:
        """Return the colour image (h, w, 3) now.

        Raises:
            ValueError: The camera has no colour sensor.
        """
        if self._color_camera is None:
            raise ValueError("a camera with a colour sensor expected")
        with self._stages("color"):
            return self._errors.color(self._color_camera.picture(self._T_world_camera, self._solids()))

    @property
    def _T_world_camera(self) -> Array:
        return np.asarray(self._world.T_world_body @ self._profile.camera.T_body_camera)

    def _solids(self) -> tuple[Boxes, Capsules]:
        """Return the solids that the camera sees besides the terrain: robot and movers."""
        robot = self._world.robot_solids()
        return together(robot, self._movers.solids()) if len(self._movers) else robot
