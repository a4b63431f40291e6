"""Camera of the robot: which frames are rendered, and what a camera fault does to them."""

import numpy as np
import pytest

from sextant.services.simulator.physics.terrain import build_terrain
from sextant.services.simulator.physics.world import World
from sextant.services.simulator.sensors.robot_camera import RobotCamera
from sextant.shared.robot.kinematics import body_inverse
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Stages
from sextant.shared.scenario.scenario import Fault, Goal, Plane, Scenario


def camera(*faults: Fault, robot: str = "phantomx_mk2", frames_per_picture: int = 1) -> RobotCamera:
    profile, scenario = load_profile(robot), Scenario("flat", (Plane(),), Goal(1.0), faults=faults)
    world = World(profile, build_terrain(scenario, np.random.default_rng(0)))
    world.stand(body_inverse(profile, profile.rest_feet()))
    first, second, third = (np.random.default_rng([0, stream]) for stream in range(3))
    return RobotCamera(profile, scenario, world, 0, (first, second, third), Stages(), frames_per_picture)


def test_every_nth_frame_is_rendered() -> None:
    seen = camera(frames_per_picture=3)
    assert [seen.begin_frame() for _ in range(7)] == [False, False, True, False, False, True, False]


def test_a_skipped_frame_changes_no_later_frame() -> None:
    every, second = camera(), camera(frames_per_picture=2)
    frames = [every.depth() for _ in range(2) if every.begin_frame()]
    assert not second.begin_frame()
    assert second.begin_frame()
    np.testing.assert_array_equal(second.depth(), frames[1])


@pytest.mark.parametrize(("kind", "pixels"), [("absent", None), ("blind", 0), ("noise", 640 * 480 // 2)])
def test_a_fault_replaces_the_frame(kind: str, pixels: int | None) -> None:
    seen = camera(Fault(0.0, "camera", kind, for_s=1.0))  # type: ignore[arg-type]
    assert seen.fault == kind
    depth = seen.depth()
    if pixels is None:
        assert depth is None
    else:
        assert depth is not None
        assert depth.shape == (480, 640)
        assert np.count_nonzero(depth) > pixels if pixels else not depth.any()


def test_a_frozen_camera_repeats_its_last_frame() -> None:
    seen = camera(Fault(0.0, "camera", "frozen", for_s=1.0))
    first = seen.depth()
    assert first is not None
    assert seen.depth() is first


def test_only_a_colour_camera_has_colour() -> None:
    plain, color = camera(), camera(robot="phantomx_mk2_rgbd")
    assert not plain.has_color
    with pytest.raises(ValueError, match="a camera with a colour sensor expected"):
        plain.color()
    assert color.has_color
    assert color.color().shape == (480, 640, 3)
