"""Deviations of the simulated robot from its profile: what is drawn, and what each of them changes."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from sextant.services.simulator.config import Settings
from sextant.services.simulator.service import Simulator
from sextant.services.simulator.servo_bus.servo_bank import ServoBank, ServoVariation
from sextant.shared.geometry import Array, apply, rotation_from_rpy, rpy_from_rotation
from sextant.shared.robot.kinematics import body_inverse, leg_forward
from sextant.shared.robot.profile import GRAVITY
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.mismatch import PATCH_EDGE_M, Deviation, Mismatch
from sextant.shared.scenario.scenario import CameraOptions, Goal, Scenario, Variation
from sextant.shared.scenario.terrain import Plane
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.wire.messages import DepthImage, Imu, Message, Tick

PROFILE = load_profile("phantomx_mk2")
MS = 1_000_000
TICK_RAD = dxl.TICK_RAD


def simulated(imu: bool = False, **bounds: float) -> tuple[Simulator, Deviation]:
    """Return a simulator on level ground whose deviations are at their bounds, and these."""
    mismatch = Mismatch(**bounds, at_bounds=True)  # type: ignore[arg-type]
    clean = CameraOptions(noise=False, dropouts=False)
    variation = Variation(1.0, 1.0, imu=imu)
    scenario = Scenario("flat", (Plane(),), Goal(1.0), mismatch=mismatch, camera=clean, variation=variation)
    return Simulator(PROFILE, Settings(), scenario), scenario.deviation(0)


def run(sim: Simulator, until_ns: int, from_ns: int = 0) -> list[Message]:
    inbox = Inbox(sim.subscribes, sim.stages, lambda topic: False)
    return [m for ns in range(from_ns, until_ns + 1, sim.trigger.period_ns) for m in sim.step(Tick(ns), inbox)]


def first_image(sim: Simulator) -> Array:
    """Return the depth (h, w) [m] of the first image, NaN without a measurement."""
    raw = next(m.depth for m in run(sim, 100 * MS) if isinstance(m, DepthImage))
    return np.where(raw > 0, raw / PROFILE.camera.sensor.depth_scale, np.nan)


@pytest.mark.parametrize("level", ["mild", "usual", "harsh"])
def test_levels_are_drawn_by_the_seed_within_their_bounds(level: str) -> None:
    scenario = load_scenario(f"flat+{level}")
    bounds, drawn = scenario.mismatch, [scenario.deviation(seed) for seed in range(50)]
    assert drawn[3].as_table() == scenario.deviation(3).as_table() != drawn[4].as_table()
    for name, bound, centre in (
        ("camera_rpy_deg", bounds.camera_angle_deg, 0.0),
        ("horns_deg", bounds.horn_deg, 0.0),
        ("link_lengths", bounds.link_length, 0.0),
        ("depth_scale", bounds.depth_scale, 0.0),
        ("stamp_offset_s", bounds.stamp_offset_s, 0.0),
        ("torque", bounds.torque, 1.0),
        ("payload", bounds.payload, 0.0),
    ):
        values = np.array([getattr(deviation, name) for deviation in drawn]) - centre
        assert bound > 0
        assert np.abs(values).max() <= bound
        assert np.abs(values).max() > 0.8 * bound


def test_harsh_bounds_exceed_usual_and_usual_exceed_mild() -> None:
    mild, usual, harsh = (load_scenario(f"flat+{level}").mismatch for level in ("mild", "usual", "harsh"))
    for field in fields(Mismatch):
        if field.name not in ("slippery_friction", "at_bounds"):
            values = [getattr(level, field.name) for level in (mild, usual, harsh)]
            assert values == sorted(values), field.name


def test_bad_bound_is_refused_with_its_name() -> None:
    with pytest.raises(ValueError, match=r"horn_deg.*0 to 45 deg"):
        Mismatch(horn_deg=-1.0)


def test_robot_without_mismatch_equals_its_profile() -> None:
    sim, deviation = simulated()
    table = deviation.as_table()
    assert {float(np.abs(value).max()) for value in table.values()} == {0.0, 1.0}
    np.testing.assert_array_equal(sim.world.q, body_inverse(PROFILE, PROFILE.rest_feet()))


def test_camera_mount_scale_and_bias_change_the_image() -> None:
    true = first_image(simulated()[0])
    longer, deviation = simulated(depth_scale=0.03)
    ratio = np.nanmedian(first_image(longer) / true)
    assert ratio == pytest.approx(1.0 + deviation.depth_scale, abs=1e-3)
    biased, deviation = simulated(depth_bias=0.01)
    difference = np.nanmedian((first_image(biased) - true) / true**2)
    assert difference == pytest.approx(deviation.depth_bias, rel=0.1)
    turned, deviation = simulated(camera_angle_deg=3.0)
    # The bundled profile looks down by 30 deg: on level ground the plane of the image's points shows the true angles.
    depth = first_image(turned)
    normal = _plane(PROFILE.camera.intrinsics.points(depth.astype(np.float32)))
    down = PROFILE.camera.T_body_camera[:3, :3] @ normal  # {body} of the profile
    assert math.degrees(math.acos(abs(down[2]))) == pytest.approx(
        3.0 * math.sqrt(2.0), abs=0.5
    )  # pitch and roll; yaw does not tilt


def _plane(points: Array) -> Array:
    """Return the unit normal (3,) of a plane through points."""
    points = points[np.isfinite(points).all(axis=-1)]
    return np.asarray(np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2])


def test_distortion_bends_straight_edges() -> None:
    straight, bent = (first_image(simulated(distortion=bound)[0]) for bound in (0.0, 0.1))
    rows = [np.nanmedian(image[130, [40, 600]]) - np.nanmedian(image[130, 318:322]) for image in (straight, bent)]
    assert abs(rows[0]) < 2e-3  # a row of level ground has one depth
    assert abs(rows[1]) > 5e-3


def test_stamps_are_late_and_images_wait_for_them() -> None:
    sim, deviation = simulated(stamp_offset_s=0.05, stamp_jitter_s=0.004)
    inbox = Inbox(sim.subscribes, sim.stages, lambda topic: False)
    seen = []
    for ns in range(0, 1000 * MS, sim.trigger.period_ns):
        seen += [(ns, m.stamp_ns) for m in sim.step(Tick(ns), inbox) if isinstance(m, DepthImage)]
    came, stamps = np.array(seen).T
    exposed = np.arange(len(stamps)) * 1e9 / PROFILE.camera.sensor.rate_hz
    assert np.mean(stamps - exposed) * 1e-9 == pytest.approx(deviation.stamp_offset_s, abs=0.005)
    assert (np.diff(stamps) > 0).all()
    assert (came >= stamps).all()


def test_horns_turn_the_legs_but_not_what_the_servos_report() -> None:
    sim, deviation = simulated(horn_deg=2.0)
    nominal = body_inverse(PROFILE, PROFILE.rest_feet())
    np.testing.assert_allclose(np.degrees(nominal - sim.world.q), deviation.horns_deg, atol=1e-9)
    reported = [
        int.from_bytes(sim.servos.read(row, dxl.PRESENT_POSITION.address, 2), "little") for row in range(len(sim.servos))
    ]
    expected = 512 + PROFILE.servo_angles(nominal).ravel() / TICK_RAD
    assert np.abs(np.array(reported) - expected).max() < 0.6


def test_links_have_their_own_lengths() -> None:
    sim, deviation = simulated(link_length=0.004)
    feet = apply(np.linalg.inv(sim.world.T_world_body), sim.world.p_world_foot)
    for leg in range(6):
        coxa, femur, tibia = (PROFILE.links.coxa, PROFILE.links.femur, PROFILE.links.tibia) + deviation.link_lengths[leg]
        own = type(PROFILE.links)(coxa, femur, tibia)
        expected = apply(PROFILE.T_body_coxa[leg], leg_forward(sim.world.q[leg], own))
        np.testing.assert_allclose(feet[leg], expected, atol=1e-9)


def test_payload_and_centre_of_mass_are_in_the_physics() -> None:
    sim, deviation = simulated(payload=0.3, centre_of_mass=0.006)
    body = sim.world.model.body("body")
    assert float(body.mass[0]) == pytest.approx(PROFILE.body.mass + 0.3)
    share = PROFILE.body.mass / (PROFILE.body.mass + 0.3)  # the payload is above the trunk's middle
    expected = share * np.array(PROFILE.body.centre_of_mass) + deviation.centre_of_mass
    np.testing.assert_allclose(body.ipos[:2], expected[:2])
    assert body.ipos[2] > PROFILE.body.centre_of_mass[2]


def test_feet_slide_on_slippery_patches_only() -> None:
    sim, deviation = simulated(slippery_share=0.5, slippery_friction=0.3, foot_friction=0.2)
    run(sim, 20 * MS)
    geoms = [sim.world.model.geom(f"foot {leg.name}").id for leg in PROFILE.legs]
    friction = sim.world.model.geom_friction[geoms, 0]
    patch = np.floor(sim.world.p_world_foot[:, :2] / PATCH_EDGE_M).astype(int) % len(deviation.patches)
    factors = deviation.patches[patch[:, 0], patch[:, 1]]
    assert set(factors) == {0.3, 1.0}  # this seed puts feet on both
    np.testing.assert_allclose(friction, 0.8 * deviation.foot_friction * factors)


def test_servo_with_backlash_has_no_torque_within_it() -> None:
    play = np.radians(1.0)
    bank = ServoBank([1, 2], variation=ServoVariation(np.ones(2), np.array([1.0, 0.8]), np.array([play, 0.0])), q=np.zeros(2))
    for row in range(2):
        bank.write(row, dxl.TORQUE_ENABLE.address, b"\x01")
        bank.write(row, dxl.CW_COMPLIANCE_MARGIN.address, b"\x00\x00")
        bank.write(row, dxl.GOAL_POSITION.address, dxl.GOAL_POSITION.encode(dxl.ticks_from_angle(np.radians(3.0))))
    command = bank.step(np.zeros(2), np.zeros(2), np.zeros(2), 1.0)
    goal = dxl.angle_from_ticks(dxl.ticks_from_angle(np.radians(3.0)))
    np.testing.assert_allclose(command.setpoint, [goal - play / 2, goal])
    np.testing.assert_allclose(command.torque_limit[1] / command.torque_limit[0], 0.8)
    np.testing.assert_allclose(command.stiffness[1] / command.stiffness[0], 0.8)
    bank.step(np.zeros(2), np.zeros(2), np.array([0.4, 0.4]), 0.01)
    loads = [int.from_bytes(bank.read(row, dxl.PRESENT_LOAD.address, 2), "little") & 1023 for row in range(2)]
    assert loads[1] / loads[0] == pytest.approx(1.0 / 0.8, rel=0.01)  # a weak servo reports more load for the same torque


def test_imu_is_turned_in_the_body() -> None:
    sim, deviation = simulated(imu=True, imu_angle_deg=5.0)
    forces = [m.specific_force for m in run(sim, 1500 * MS) if isinstance(m, Imu)][-50:]
    up = np.mean(forces, axis=0) / np.linalg.norm(np.mean(forces, axis=0))
    assert math.degrees(math.acos(up[2])) == pytest.approx(math.hypot(*deviation.imu_rpy_deg[:2]), abs=0.7)


def test_imu_is_right_once_the_profile_states_its_true_mount() -> None:
    deviation = {"imu_angle_deg": 3.0, "imu_bias": 0.0}
    mismatch = Mismatch(**deviation, at_bounds=True)  # type: ignore[arg-type]
    scenario = Scenario("flat", (Plane(),), Goal(1.0), mismatch=mismatch, real_robot="phantomx_mk2_imu")
    R_body_imu = rotation_from_rpy(np.radians(scenario.deviation(0).imu_rpy_deg))
    roll, pitch, yaw = np.degrees(rpy_from_rotation(R_body_imu)).tolist()
    base = load_profile("phantomx_mk2_imu")
    calibrated = replace(base, imu=replace(base.imu, roll_deg=roll, pitch_deg=pitch, yaw_deg=yaw))
    level = [0.0, 0.0, GRAVITY]
    assert Simulator(calibrated, Settings(), scenario).imu_of_level_body() == pytest.approx(level, abs=1e-6)
    assert Simulator(base, Settings(), scenario).imu_of_level_body() != pytest.approx(level, abs=0.2)
