"""Depth frames of another program: what the camera process publishes of them, and why it refuses them."""

from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sextant.services.perception.cameras.camera import CameraError
from sextant.services.perception.cameras.config import Settings
from sextant.services.perception.cameras.external import ExternalCamera
from sextant.services.perception.cameras.service import CameraService
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import CameraState, DepthImage, ExternalDepth, Message, Tick

MS = 1_000_000


def frame(kit, **changes: Any) -> ExternalDepth:  # type: ignore[no-untyped-def]
    i = kit.profile.camera.intrinsics
    return replace(ExternalDepth(kit.clock(), kit.ground(), 1000.0, i.fx, i.fy, i.cx, i.cy), **changes)


def test_newest_frame_is_returned_once_with_its_stamp(kit) -> None:  # type: ignore[no-untyped-def]
    frames: deque[ExternalDepth] = deque([frame(kit)], maxlen=1)
    with ExternalCamera(kit.profile.camera, frames, kit.clock) as camera:
        assert camera.read(False) is None, "frames that have waited are not new"
        frames.append(frame(kit))
        frames.append(frame(kit, stamp_ns=kit.clock() - 30 * MS, depth=kit.ground(2)))
        found = camera.read(True)
        assert found is not None
        assert found.stamp_ns == kit.clock() - 30 * MS
        assert found.rgb is None
        np.testing.assert_array_equal(found.depth, kit.ground(2))
        assert camera.read(False) is None


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"stamp_ns": 1_200_000_000}, r"stamped 0.20 s in the future; stamp frames with the time of their exposure"),
        ({"stamp_ns": -500_000_000}, r"one that is 1.50 s old"),
        ({"depth": np.zeros((24, 32), np.uint16)}, r"64x48.*expected.*found 32x24"),
        ({"fx": 70.0}, r"fx 58\.5.*expected.*fx 70\.0"),
        ({"fy": 0.0}, "reports invalid intrinsics"),
        ({"depth_scale": 10000.0}, r"1000 units per metre expected.*found 10000"),
        ({"depth_scale": 0.0}, r"1000 units per metre expected.*found 0"),
    ],
)
def test_frame_that_does_not_fit_is_refused_with_the_reason(kit, changes: dict[str, Any], reason: str) -> None:  # type: ignore[no-untyped-def]
    frames: deque[ExternalDepth] = deque(maxlen=1)
    camera = ExternalCamera(kit.profile.camera, frames, kit.clock)
    frames.append(frame(kit, **changes))
    with pytest.raises(CameraError, match=reason):
        camera.read(False)


class Bench:
    """A camera service whose device is another program."""

    def __init__(self, kit: Any):
        self.kit = kit
        self.service = CameraService(kit.profile, Settings(device="external"), None, kit.clock)
        self.inbox = Inbox(self.service.subscribes, self.service.stages)

    def run(self, seconds: float, **changes: Any) -> list[Message]:
        """Send frames 30 times a second, or none if `depth` is None; return what the service publishes."""
        made = []
        for k in range(round(120 * seconds)):
            self.kit.clock.pass_s(1 / 120)
            self.inbox.now_ns = self.kit.clock()
            if k % 4 == 0 and changes.get("depth", True) is not None:
                sent = frame(self.kit, **{"depth": self.kit.ground(k), **changes})
                self.inbox.receive(topics.EXTERNAL_DEPTH, codec.encode(sent), self.kit.clock())
            made += list(self.service.step(Tick(self.kit.clock()), self.inbox))
        return made


def test_service_publishes_the_frames_as_its_own_and_reports_their_absence(kit) -> None:  # type: ignore[no-untyped-def]
    bench = Bench(kit)
    made = bench.run(2.0)
    images = [m for m in made if isinstance(m, DepthImage)]
    assert len(images) > 50
    assert images[-1].depth.shape == (48, 64)
    assert [m for m in made if isinstance(m, CameraState)][-1].ok
    made = bench.run(8.0, depth=None)
    state = [m for m in made if isinstance(m, CameraState)][-1]
    assert not state.ok
    assert "camera of another program on external/depth has sent no new image" in state.reason
    assert any(isinstance(m, DepthImage) for m in bench.run(20.0)), "it is opened again"


def test_service_reports_wrong_frames_and_recovers(kit) -> None:  # type: ignore[no-untyped-def]
    bench = Bench(kit)
    made = bench.run(2.0, fx=70.0)
    assert not any(isinstance(m, DepthImage) for m in made)
    assert "fx 70.0" in [m for m in made if isinstance(m, CameraState)][-1].reason
    assert any(isinstance(m, DepthImage) for m in bench.run(20.0))


def test_service_with_a_device_does_not_subscribe_to_frames_of_others(kit) -> None:  # type: ignore[no-untyped-def]
    assert CameraService(kit.profile, Settings(device="realsense"), None, kit.clock).subscribes == ()
