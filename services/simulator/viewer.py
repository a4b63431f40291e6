"""MuJoCo's own viewer, in which the mouse pushes the robot."""

from collections.abc import Callable
from typing import Any

from sextant.services.simulator.physics.world import World

_PERIOD_NS = 33_000_000  # [ns] of simulated time between two pictures


def launch(model: Any, data: Any) -> Any:
    """Open the window, with a camera that follows the robot, and return its handle."""
    import mujoco.viewer  # loads OpenGL, which a machine without a display may lack

    handle = mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
    with handle.lock():
        handle.cam.type, handle.cam.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, model.body("body").id
        handle.cam.distance, handle.cam.azimuth, handle.cam.elevation = 1.4, 130.0, -25.0  # [m], [deg]
    return handle


class Viewer:
    """Window with the simulated world.

    A double click selects a body. Dragging it with the control key and the right mouse button pulls it. The force acts on the
    physics from the next picture on.
    """

    def __init__(self, world: World, open_window: Callable[[Any, Any], Any] = launch):
        """Open the window.

        Args:
            world: The world to show.
            open_window: Makes the handle, from model and data.
        """
        self._handle = open_window(world.model, world.data)
        self._due_ns = 0

    def show(self, time_ns: int) -> None:
        """Draw the state at a simulated time if a picture is due, and take over the forces of the mouse.

        Nothing happens after the window was closed.
        """
        if time_ns < self._due_ns or not self._handle.is_running():
            return
        self._due_ns = time_ns + _PERIOD_NS
        self._handle.sync()

    def close(self) -> None:
        """Close the window."""
        self._handle.close()
