"""MuJoCo's viewer: pictures at a rate, forces of the mouse, a closed window."""

import numpy as np
import pytest

from sextant.services.simulator import viewer as module
from sextant.services.simulator.config import Settings
from sextant.services.simulator.service import Simulator
from sextant.services.simulator.viewer import Viewer
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire.messages import Tick

PROFILE = load_profile("phantomx_mk2")
MS = 1_000_000


class Window:
    """Handle of a window without a display; `pull` is the force of the mouse on the trunk."""

    def __init__(self, model, data):
        self.data, self.open, self.pictures = data, True, 0
        self.pull = np.zeros(3)

    def is_running(self):
        return self.open

    def sync(self):
        self.pictures += 1
        self.data.xfrc_applied[1, :3] = self.pull  # body 0 is the world

    def close(self):
        self.open = False


@pytest.fixture
def windows(monkeypatch):
    made: list[Window] = []

    def launch(model, data):
        made.append(Window(model, data))
        return made[-1]

    monkeypatch.setattr(module.Viewer.__init__, "__defaults__", (launch,))
    return made


def test_pictures_have_a_rate_of_simulated_time():
    window = Window(None, None)
    window.sync = lambda: setattr(window, "pictures", window.pictures + 1)
    viewer = Viewer(SimulatorWorld(), lambda *_: window)
    for t in range(0, 1000, 10):
        viewer.show(t * MS)
    assert window.pictures == 25, "every 40 ms, the first multiple of 10 ms above 33 ms"
    window.open = False
    viewer.show(2000 * MS)
    assert window.pictures == 25


class SimulatorWorld:
    model = data = None


def test_mouse_pushes_the_robot_and_the_window_closes_with_the_simulator(windows):
    simulator = Simulator(PROFILE, Settings(scenario="flat", viewer=True))
    inbox = Inbox(simulator.subscribes, simulator.stages)
    with simulator:
        (window,) = windows
        for t in range(0, 400, 4):
            list(simulator.step(Tick(t * MS), inbox))
        before = simulator.world.T_world_body[1, 3]
        window.pull[:] = (0.0, 8.0, 0.0)
        for t in range(400, 800, 4):
            list(simulator.step(Tick(t * MS), inbox))
        assert window.pictures > 10
        assert simulator.world.T_world_body[1, 3] > before + 1e-3
    assert not window.open


def test_no_window_opens_without_the_setting(windows):
    with Simulator(PROFILE, Settings(scenario="flat")):
        assert windows == []
