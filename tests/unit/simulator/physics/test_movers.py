"""Moving boxes and legs: positions by path, speed and start, and camera images."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.simulator.config import Settings
from sextant.services.simulator.physics.movers import Movers
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.services.simulator.service import Simulator
from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.scenario.mover import BoxMover, LegsMover, Mover
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Box, Plane
from sextant.shared.wire.messages import DepthImage, Tick

STEP = Scenario("step", (Plane(), Box((1.0, 0.0), (0.4, 0.4), 0.1)), Goal(1.0))
LEGS = LegsMover(((1.0, -2.0), (1.0, 2.0)), speed=1.2, stride=0.6)
CART = BoxMover(((-1.0, 0.0), (1.0, 0.0), (1.0, 1.0)), speed=0.5, size=(0.4, 0.2, 0.3), start_s=2.0)
HERE = from_xyz_rpy((0.0, 0.0, 0.1), np.zeros(3))


def make_movers(*movers: Mover, seed: int = 0) -> Movers:
    return Movers(movers, build_terrain(STEP, np.random.default_rng(0)), np.random.default_rng(seed))


def leg_ends(movers: Movers, now_s: float, body: Array = HERE) -> tuple[Array, Array]:
    """Return the lower and upper ends (2, 3) of a pair of legs."""
    movers.advance(now_s, body)
    capsules = movers.solids()[1]
    return capsules.start, capsules.end


def test_moving_box_exists_only_while_on_its_path() -> None:
    movers = make_movers(CART)
    for now_s, centre in ((2.0, (-1.0, 0.0, 0.15)), (4.0, (0.0, 0.0, 0.15)), (7.0, (1.0, 0.5, 0.15))):
        movers.advance(now_s, HERE)
        boxes, capsules = movers.solids()
        np.testing.assert_allclose(boxes.centre, [centre], atol=1e-9)
        np.testing.assert_allclose(boxes.half, [[0.2, 0.1, 0.15]])
        assert len(capsules) == 0
    np.testing.assert_allclose(boxes.R[0, :, 0], [0.0, 1.0, 0.0], atol=1e-9)
    for now_s in (0.0, 1.99, 8.01, 100.0):
        movers.advance(now_s, HERE)
        assert len(movers.solids()[0]) == 0


def test_moving_box_restarts_after_its_period() -> None:
    movers = make_movers(replace(CART, period_s=10.0))
    for lap in range(3):
        movers.advance(4.0 + 10.0 * lap, HERE)
        np.testing.assert_allclose(movers.solids()[0].centre, [[0.0, 0.0, 0.15]], atol=1e-9)
        movers.advance(9.0 + 10.0 * lap, HERE)
        assert len(movers.solids()[0]) == 0


def test_moving_legs_alternate_stance_and_swing_within_stride() -> None:
    movers = make_movers(LEGS)
    times = np.arange(0.1, 3.2, 0.01)
    feet = np.array([leg_ends(movers, t)[0] for t in times])
    hips = np.array([leg_ends(movers, t)[1] for t in times])
    np.testing.assert_allclose(np.diff(hips[:, 0, 1]), 0.012, atol=1e-9)
    still = np.linalg.norm(np.diff(feet, axis=0), axis=2) < 1e-6  # (times - 1, legs)
    assert still.any(axis=1).mean() > 0.95
    assert 0.4 < still.mean() < 0.6
    assert np.abs(feet - hips)[..., 1].max() <= 0.3 + 1e-9
    np.testing.assert_allclose(np.abs(hips[:, 0, 0] - hips[:, 1, 0]), 0.2)
    speed = np.linalg.norm(np.diff(feet, axis=0)[..., :2], axis=2).max() / 0.01
    assert speed < 4.0, "feet swing, they do not leap"


def test_moving_feet_stand_at_terrain_height() -> None:
    movers = make_movers(LEGS)
    lowest = {on_block: [] for on_block in (False, True)}  # type: ignore[var-annotated]
    for now_s in np.arange(0.1, 3.2, 0.01):
        for foot in leg_ends(movers, now_s)[0]:
            lowest[bool(abs(foot[1]) < 0.19)].append(foot[2] - LEGS.radius)
    assert min(lowest[False]) == pytest.approx(0.0, abs=1e-6)
    assert min(lowest[True]) == pytest.approx(0.1, abs=1e-6)


def test_robot_frame_path_is_fixed_at_robot_pose_at_start() -> None:
    movers = make_movers(replace(LEGS, frame="robot", period_s=5.0))
    turned = from_xyz_rpy((2.0, 3.0, 0.1), (0.0, 0.0, np.pi / 2))
    first = leg_ends(movers, 0.0, turned)[1].mean(axis=0)
    np.testing.assert_allclose(first[:2], [2.0 + 2.0, 3.0 + 1.0], atol=1e-9)
    later = leg_ends(movers, 1.0, HERE)[1].mean(axis=0)
    np.testing.assert_allclose(later[:2], [2.0 + 2.0 - 1.2, 3.0 + 1.0], atol=1e-9)
    again = leg_ends(movers, 5.0, HERE)[1].mean(axis=0)
    np.testing.assert_allclose(again[:2], [1.0, -2.0], atol=1e-9)


def test_start_time_depends_on_seed_within_spread() -> None:
    def first_seen(seed: int) -> float:
        movers = make_movers(replace(CART, start_spread_s=5.0), seed=seed)
        for now_s in np.arange(0.0, 8.0, 0.02):
            movers.advance(now_s, HERE)
            if len(movers.solids()[0]):
                return float(now_s)
        raise AssertionError("it never set off")

    seen = [first_seen(seed) for seed in range(20)]
    assert seen == [first_seen(seed) for seed in range(20)]
    assert 2.0 <= min(seen) < 3.0 < 6.0 < max(seen) <= 7.02


@pytest.mark.slow
def test_movers_are_visible_in_depth_but_have_no_contact() -> None:
    """Move a cart through the robot.

    At first it is a wall 1.3 m ahead.
    """
    cart = BoxMover(((1.5, 0.0), (-1.5, 0.0)), speed=1.0, size=(0.4, 0.6, 0.5))
    course = Scenario("flat", (Plane(),), Goal(1.0), movers=(cart,))
    profile = load_profile("phantomx_mk2")

    def frames(scenario: Scenario, frames_per_picture: int) -> tuple[dict[int, Array], Array]:
        sim = Simulator(profile, Settings(frames_per_picture=frames_per_picture), scenario)
        inbox = Inbox(sim.subscribes, sim.stages, lambda topic: False)
        made = [m for ns in range(0, 3_000_000_000, 20_000_000) for m in sim.step(Tick(ns), inbox)]
        return {m.stamp_ns: m.depth for m in made if isinstance(m, DepthImage)}, sim.world.q

    every, q = frames(course, 1)
    some, _ = frames(course, 2)
    assert set(some) < set(every)
    for stamp_ns, depth in some.items():
        np.testing.assert_array_equal(depth, every[stamp_ns])
    empty, q_alone = frames(replace(course, movers=()), 1)
    np.testing.assert_array_equal(q, q_alone)
    differ = [stamp_ns for stamp_ns, depth in every.items() if not np.array_equal(depth, empty[stamp_ns])]
    assert len(differ) > 10
    first = every[min(differ)]
    changed = first[(first != empty[min(differ)]) & (first > 0)] / profile.camera.sensor.depth_scale
    assert np.median(changed) == pytest.approx(1.3 - profile.camera.T_body_camera[0, 3], abs=0.25)
