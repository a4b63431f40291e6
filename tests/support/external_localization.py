"""A localization by another program: a service that publishes body poses in its own frame."""

from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from sextant.services.perception.config import Settings
from sextant.services.perception.service import Perception
from sextant.shared.geometry import Array, exp_se3, from_xyz_rpy
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import AnyTopic, Inbox, Service, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ExternalPose, GroundTruth, Message

S = 1_000_000_000
RATE_HZ = 30.0
T_FRAME_WORLD = from_xyz_rpy((5.0, -3.0, 1.2), (0.01, -0.02, 2.0))  # its frame is where its program was started


class Localization:
    """Poses with noise, drift and delay, derived from the simulator's truth, which no service of the robot reads."""

    name = "slam"
    trigger: AnyTopic = topics.TRUTH
    subscribes: tuple[AnyTopic, ...] = ()
    publishes: tuple[AnyTopic, ...] = (topics.EXTERNAL_POSE,)

    def __init__(
        self,
        seed: int = 0,
        drift: float = 0.01,
        delay_s: float = 0.08,
        change: Callable[[ExternalPose], ExternalPose | None] = lambda pose: pose,
    ):
        """Create it.

        Args:
            seed: Random seed of the noise: 2 mm and 2 mrad.
            drift: [1] by which positions in its frame are too large, and [rad/m] by which the heading turns away.
            delay_s: [s] from a measurement to its publication.
            change: Changes or withholds a pose.
        """
        self.stages = Stages()
        self._rng, self._drift, self._delay_ns, self._change = np.random.default_rng(seed), drift, round(delay_s * S), change
        self._waiting: deque[ExternalPose] = deque()
        self._due_ns = 0

    def status(self) -> str:
        """Return nothing."""
        return ""

    def step(self, truth: GroundTruth, inbox: Inbox) -> Iterator[Message]:
        """Publish the poses whose delay is over."""
        if truth.stamp_ns >= self._due_ns:
            self._due_ns = truth.stamp_ns + round(S / RATE_HZ)
            self._waiting.append(ExternalPose(truth.stamp_ns, "slam_map", self._estimate(truth.T_world_body)))
        while self._waiting and truth.stamp_ns - self._waiting[0].stamp_ns >= self._delay_ns:
            pose = self._change(self._waiting.popleft())
            if pose is not None:
                yield pose

    def _estimate(self, T_world_body: Array) -> Array:
        scaled = T_world_body.copy()
        scaled[:2, 3] *= 1.0 + self._drift
        turned = from_xyz_rpy(np.zeros(3), (0.0, 0.0, self._drift * float(np.hypot(*T_world_body[:2, 3]))))
        noise = exp_se3(self._rng.normal(0.0, 0.002, 6))
        return np.asarray(T_FRAME_WORLD @ turned @ scaled @ noise)


def by_external_poses(profile: RobotProfile) -> dict[str, Callable[[Service], Service]]:
    """Return the replacement of perception by one that uses external poses."""
    return {"perception": lambda _: Perception(profile, Settings(method="external"))}
