"""Shared test kit for camera drivers: a small camera, pictures and a manual clock."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.shared.robot.camera import Intrinsics
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile

SMALL = Intrinsics(64, 48, 58.5, 58.5, 31.5, 23.5)


@dataclass
class Clock:
    """A clock [ns] that advances only on request."""

    now_ns: int = 1_000_000_000

    def __call__(self) -> int:
        return self.now_ns

    def pass_s(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


@dataclass(frozen=True)
class Kit:
    """Shared test kit, provided by a fixture."""

    clock: Clock
    profile: RobotProfile

    def ground(self, seed: int = 0) -> NDArray[np.uint16]:
        """Return a picture (48, 64) of ground that slopes away, with sensor noise."""
        rng = np.random.default_rng(seed)
        rows = np.linspace(2000.0, 700.0, 48)[:, None]
        return np.asarray(np.rint(rows + rng.normal(0, 3, (48, 64))), dtype=np.uint16)


@pytest.fixture
def kit() -> Kit:
    phantom = load_profile("phantomx_mk2")
    return Kit(Clock(), replace(phantom, camera=replace(phantom.camera, intrinsics=SMALL)))
