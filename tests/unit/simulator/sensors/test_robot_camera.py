"""Camera of the robot: which frames are rendered, and what a camera fault does to them."""

import numpy as np
import pytest

from sextant.services.simulator.physics.terrain import build_terrain
from sextant.services.simulator.physics.world import World
from sextant.services.simulator.sensors.camera_faults import delivery
from sextant.services.simulator.sensors.robot_camera import RobotCamera
from sextant.shared.robot.kinematics import body_inverse
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Stages
from sextant.shared.scenario.mover import BoxMover
from sextant.shared.scenario.scenario import Fault, Goal, Scenario
from sextant.shared.scenario.terrain import Plane


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


def test_fault_or_mover_at_run_time_begins_at_its_time() -> None:
    seen = camera()
    plain = seen.depth()
    seen.disturb(Fault(0.0, "camera", "blind", for_s=1.0))
    assert not np.any(seen.depth())
    walker = camera()
    walker.disturb(BoxMover(((0.8, 0.1), (0.8, -0.1)), speed=0.1, size=(0.3, 0.2, 0.3), frame="robot"))
    assert walker.begin_frame()
    assert np.count_nonzero(walker.depth() != plain) > 1000
    with pytest.raises(ValueError, match="a fault of the camera expected, found one of mapper"):
        seen.disturb(Fault(0.0, "mapper", "hang"))


@pytest.mark.parametrize("kind", ["sun", "dark", "dropouts", "blobs"])
def test_light_and_dropouts_lose_pixels_and_change_no_other(kind: str) -> None:
    whole, seen = camera().depth(), camera(Fault(0.0, "camera", kind, for_s=1.0)).depth()  # type: ignore[arg-type]
    assert whole is not None
    assert seen is not None
    kept = seen > 0
    np.testing.assert_array_equal(seen[kept], whole[kept])
    assert 0.02 < np.count_nonzero(kept) / np.count_nonzero(whole) < 0.95


def test_puddles_show_what_is_above_them_below_the_floor() -> None:
    seen = camera(Fault(0.0, "camera", "wet", for_s=1.0))
    depth = seen.depth()
    assert depth is not None
    profile = load_profile("phantomx_mk2").camera
    points = profile.intrinsics.points(depth / profile.sensor.depth_scale)[depth > 0]
    z = (points @ (seen._T_world_camera[:3, :3]).T + seen._T_world_camera[:3, 3])[:, 2]
    below = np.abs(z + 0.6) < 0.05
    assert 0.1 < below.mean() < 0.9
    assert np.abs(z[~below]).max() < 0.1


def test_dirt_stays_in_its_place_in_the_image() -> None:
    depth = camera(Fault(0.0, "camera", "dirt", for_s=1.0)).depth()
    assert depth is not None
    assert (np.abs(depth[100:180, 270:370].astype(int) - 575) <= 25).all()


def test_wrong_intrinsics_show_the_ground_elsewhere() -> None:
    plain, swapped, zoomed = (
        camera(*(Fault(0.0, "camera", kind, for_s=1.0) for kind in kinds)).depth()  # type: ignore[arg-type]
        for kinds in ((), ("swapped",), ("zoomed",))
    )
    assert plain is not None
    assert swapped is not None
    assert zoomed is not None
    v, u = 150, 200
    assert abs(int(swapped[v + 80, u - 80]) - int(plain[v, u])) < 20, "cx and cy are 80 px apart"
    assert abs(int(zoomed[239 - 120, 319]) - int(plain[239 - 60, 319])) < 20


@pytest.mark.parametrize(
    ("kind", "stamps_s", "arrive_s"),
    [
        ("late", [0.0, 1.0], [1.0, 2.0]),
        ("stale", [0.0, 0.0], [0.0, 1.0]),
        ("ahead", [1.0, 2.0], [0.0, 1.0]),
        ("backward", [0.0, -2.0], [0.0, 1.0]),
        ("frozen", [0.0, 1.0], [0.0, 1.0]),
    ],
)
def test_faults_of_stamps(kind: str, stamps_s: list[float], arrive_s: list[float]) -> None:
    begin, s = 10_000_000_000, 1_000_000_000
    found = [delivery(kind, begin + k * s, begin, k) for k in (0, 1)]
    assert [((stamp - begin) / s, (due - begin) / s) for stamp, due in found] == list(zip(stamps_s, arrive_s, strict=True))


def test_jumping_stamps_go_to_and_fro() -> None:
    off = [delivery("jumping", k * 33_000_000, 0, k)[0] - k * 33_000_000 for k in range(8)]
    assert {*off} == {400_000_000, -400_000_000}
