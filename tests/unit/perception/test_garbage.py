"""Perception with invalid frames: it keeps running, reports them, and recovers.

No ground is made of an invalid frame.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from sextant.services.perception.config import Settings
from sextant.services.perception.service import Perception
from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.robot.camera import Intrinsics
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import BodyPose, DepthImage, Message, Odometry, Scan

PHANTOM = load_profile("phantomx_mk2")
PROFILE = replace(PHANTOM, camera=replace(PHANTOM.camera, intrinsics=Intrinsics(320, 240, 292.5, 292.5, 159.5, 119.5)))
FRAME_NS = 66_000_000
SHAPE = (240, 320)
RNG = np.random.default_rng(3)


def grey(value: int, shape: tuple[int, int] = SHAPE) -> Callable[[], NDArray[np.uint16]]:
    return lambda: np.full(shape, value, np.uint16)


def noise(low: int, high: int) -> Callable[[], NDArray[np.uint16]]:
    return lambda: RNG.integers(low, high, SHAPE, dtype=np.uint16)


GARBAGE: dict[str, tuple[Callable[[], NDArray[np.uint16]], tuple[str, ...]]] = {
    "no return anywhere": (grey(0), ("measured",)),
    "what NaN and infinity become": (grey(65535), ("measured", "frozen")),
    "all nearer than can be measured": (grey(200), ("measured", "frozen")),
    "noise": (noise(0, 65536), ("noise",)),
    "noise within the range": (noise(500, 3500), ("noise",)),
    "another size": (grey(900, (120, 160)), ("(240, 320) expected by the profile, found (120, 160)",)),
    "one row": (grey(900, (1, 320)), ("(240, 320) expected",)),
    "no pixels": (grey(0, (0, 0)), ("(240, 320) expected",)),
}


class Rig:
    """Perception with a robot that walks ahead with correct odometry."""

    def __init__(self, world) -> None:  # type: ignore[no-untyped-def]
        self.world, self.now_ns, self.x = world, 1_000_000_000, 0.0
        self.perception = Perception(PROFILE, Settings(scan_rate_hz=PROFILE.camera.sensor.rate_hz, settle_s=0.0))
        self.inbox = Inbox([self.perception.trigger, *self.perception.subscribes], self.perception.stages)

    @property
    def T_world_body(self) -> Array:
        return from_xyz_rpy((self.x, 0.0, 0.1), np.zeros(3))

    def good(self) -> NDArray[np.uint16]:
        camera, boxes = PROFILE.camera, self.world.scenes["pillars"]
        image: NDArray[np.uint16] = self.world.depth_image(
            self.T_world_body @ camera.T_body_camera, boxes, intrinsics=camera.intrinsics, sensor=camera.sensor
        )
        return image

    def see(self, depth: NDArray[np.uint16] | None = None, step: float = 0.004, late_ns: int = 0) -> list[Message]:
        self.now_ns += FRAME_NS
        self.x += step
        self.inbox.now_ns = self.now_ns
        legs = Odometry(self.now_ns, self.T_world_body, self.x, 0.0, np.ones(6, dtype=bool), True)
        self.inbox.receive(topics.ODOMETRY, codec.encode(legs), self.now_ns)
        image = DepthImage(self.now_ns - late_ns, self.good() if depth is None else depth)
        return list(self.perception.step(image, self.inbox))


def pose_of(messages: list[Message]) -> BodyPose:
    return next(m for m in messages if isinstance(m, BodyPose))


def scan_of(messages: list[Message]) -> Scan | None:
    return next((m for m in messages if isinstance(m, Scan)), None)


@pytest.mark.slow
@pytest.mark.parametrize("name", GARBAGE)
def test_invalid_frames_during_walk_are_reported_and_give_no_ground(world, name: str) -> None:  # type: ignore[no-untyped-def]
    rig, (garbage, words) = Rig(world), GARBAGE[name]
    for _ in range(3):
        assert pose_of(rig.see()).ok
    for _ in range(8):
        messages = rig.see(garbage())
        pose, scan = pose_of(messages), scan_of(messages)
        assert not pose.ok
        assert any(word in pose.reason for word in words)
        assert pose.reason in rig.perception.status()
        assert scan is None or len(scan.points_mm) == 0, "no ground is made of it"
        np.testing.assert_allclose(pose.T_world_body[:3, 3], rig.T_world_body[:3, 3], atol=2e-3)  # from leg odometry
    for _ in range(3):
        messages = rig.see()
    assert pose_of(messages).ok
    scan = scan_of(messages)
    assert scan is not None
    assert len(scan.points_mm) > 500


@pytest.mark.parametrize("name", GARBAGE)
def test_invalid_first_frames_start_no_map(world, name: str) -> None:  # type: ignore[no-untyped-def]
    rig, (garbage, words) = Rig(world), GARBAGE[name]
    for _ in range(4):
        messages = rig.see(garbage())
        assert scan_of(messages) is None, "no map begins with it"
        assert not pose_of(messages).ok
        assert any(word in rig.perception.status() for word in words)
    messages = rig.see()
    assert pose_of(messages).ok
    assert scan_of(messages) is not None


def test_frozen_frame_for_5_s_is_reported_and_tracking_recovers(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    rig.see()
    stuck = rig.good()
    rig.see(stuck, step=0.0)
    made = [rig.see(stuck) for _ in range(75)]
    late = made[5:]
    assert all(not pose_of(messages).ok and "frozen" in pose_of(messages).reason for messages in late)
    assert all(scan_of(messages) is None for messages in late)
    assert "same image for 5.0 s" in pose_of(made[-1]).reason
    np.testing.assert_allclose(pose_of(made[-1]).T_world_body[:3, 3], rig.T_world_body[:3, 3], atol=12e-3)
    for _ in range(3):
        messages = rig.see()
    assert pose_of(messages).ok
    np.testing.assert_allclose(pose_of(messages).T_world_body[:3, 3], rig.T_world_body[:3, 3], atol=4e-3)


def test_tracking_continues_after_frame_gap(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    rig.see()
    rig.now_ns += 200_000_000
    pose = pose_of(rig.see(step=0.02))
    assert pose.ok
    np.testing.assert_allclose(pose.T_world_body[:3, 3], rig.T_world_body[:3, 3], atol=4e-3)


def test_out_of_order_frames_are_skipped_and_reported(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    rig.see()
    assert rig.see(late_ns=2 * FRAME_NS) == []
    assert rig.see(late_ns=2 * FRAME_NS) == [], "the same stamp again"
    assert "order" in rig.perception.status()
    assert pose_of(rig.see()).ok


def test_perception_recovers_from_future_stamp(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    rig.see()
    rig.see(late_ns=-60_000_000_000)
    assert [pose_of(rig.see()).ok for _ in range(4)][-1]


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture])
@given(arrays(np.uint16, (30, 40), elements=st.integers(0, 65535), fill=st.sampled_from([0, 700, 65535])))
def test_perception_keeps_running_for_any_pixels(world, small: NDArray[np.uint16]) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    picture = np.repeat(np.repeat(small, 8, axis=0), 8, axis=1)
    rig.see(picture)
    rig.see()
    pose = pose_of(rig.see(picture))
    assert np.abs(pose.T_world_body[:3, 3] - rig.T_world_body[:3, 3]).max() < 0.1
    assert rig.perception.status()
