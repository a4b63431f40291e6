"""The simulator as a service: rates, subscribers, and time."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sextant.services.simulator.config import Settings
from sextant.services.simulator.physics.model import TIME_STEP_NS
from sextant.services.simulator.service import Simulator
from sextant.shared.files.config import ConfigError
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.lockstep import Lockstep
from sextant.shared.runtime.service import AnyTopic, Inbox
from sextant.shared.scenario.scenario import CameraOptions, Fault, Goal, Scenario, Start, Variation
from sextant.shared.scenario.terrain import Plane
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.bus_fault import BusFault
from sextant.shared.servo.servo_model import Register
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import CameraState, ColorImage, DepthImage, GroundTruth, Imu, Message, Tick

PROFILE = load_profile("phantomx_mk2")
FLAT = Scenario("flat", (Plane(),), Goal(1.0))
MS = 1_000_000


def simulator(imu: bool = False, seed: int = 0) -> Simulator:
    scenario = Scenario("flat", (Plane(),), Goal(1.0), camera=CameraOptions(), variation=Variation(imu=imu))
    return Simulator(PROFILE, Settings(seed=seed), scenario)


def run(
    sim: Simulator, until_ns: int, wanted: tuple[AnyTopic, ...] = (), period_ns: int = 0, from_ns: int = 0
) -> list[Message]:
    inbox = Inbox(sim.subscribes, sim.stages, lambda topic: topic in wanted)
    period = period_ns or sim.trigger.period_ns
    return [m for ns in range(from_ns, until_ns + 1, period) for m in sim.step(Tick(ns), inbox)]


BEAT_NS = TIME_STEP_NS  # messages are published after a step


def test_message_counts_match_rates_exactly() -> None:
    made = run(simulator(imu=True), 2_000 * MS)
    counts = Counter(type(m) for m in made)
    # The first of each comes at once, so the two seconds after it contain two seconds of messages.
    first = {kind: next(m.stamp_ns for m in made if type(m) is kind) for kind in counts}
    within = Counter(type(m) for m in made if m.stamp_ns < first[type(m)] + 2_000 * MS - 4 * TIME_STEP_NS)
    assert set(first.values()) == {BEAT_NS}
    assert within == {DepthImage: 60, CameraState: 8, GroundTruth: 100, Imu: 200}
    for kind, rate in ((DepthImage, 30.0), (GroundTruth, 50.0)):
        stamps = np.array([m.stamp_ns for m in made if type(m) is kind])
        ideal = np.arange(len(stamps)) * 1e9 / rate
        late = stamps - ideal
        assert (late >= 0).all()
        assert late[1:].max() < BEAT_NS + 100  # no drift: it is at most one beat of the simulator late


def test_colour_is_rendered_only_with_colour_camera_and_subscriber() -> None:
    in_colour = Simulator(load_profile("phantomx_mk2_rgbd"), Settings(), FLAT)
    assert not [m for m in run(in_colour, 300 * MS) if isinstance(m, ColorImage)]
    assert not [m for m in run(simulator(), 300 * MS, (topics.COLOR,)) if isinstance(m, ColorImage)]
    sim = Simulator(load_profile("phantomx_mk2_rgbd"), Settings(), FLAT)
    made = run(sim, 500 * MS, (topics.COLOR,))
    pictures = [m for m in made if isinstance(m, ColorImage)]
    assert len(pictures) == 3  # at once, and five per second
    assert pictures[0].rgb.shape == (480, 640, 3)
    assert {m.stamp_ns for m in pictures} <= {m.stamp_ns for m in made if isinstance(m, DepthImage)}


def test_depth_is_unaffected_by_colour() -> None:
    both = [Simulator(load_profile(name), Settings(), FLAT) for name in ("phantomx_mk2", "phantomx_mk2_rgbd")]
    one, two = ([m.depth for m in run(sim, 120 * MS, (topics.COLOR,)) if isinstance(m, DepthImage)] for sim in both)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("kind", ["absent", "frozen", "blind", "noise"])
def test_camera_fault_of_scenario_starts_and_ends_in_time(kind: str) -> None:
    fault = Fault(0.2, "camera", kind, for_s=0.3)  # type: ignore[arg-type]
    made = run(Simulator(PROFILE, Settings(), Scenario("flat", (Plane(),), Goal(1.0), faults=(fault,))), 800 * MS)
    before, during, after = (
        [m for m in made if isinstance(m, DepthImage) and low <= m.stamp_ns - BEAT_NS < high]
        for low, high in ((0, 195 * MS), (200 * MS, 495 * MS), (505 * MS, 800 * MS))
    )
    assert len(during) in ([0] if kind == "absent" else [8, 9])
    assert len(before) > 4
    assert len(after) > 7
    assert np.ptp([m.stamp_ns for m in after]) > 200 * MS
    for image in during:
        if kind == "frozen":
            np.testing.assert_array_equal(image.depth, before[-1].depth)
        else:
            assert image.depth.any() == (kind == "noise")
    assert all(np.count_nonzero(image.depth) > 50_000 for image in (*before, *after))
    states = [m for m in made if isinstance(m, CameraState)]
    assert {m.ok for m in states} == ({True, False} if kind == "absent" else {True})
    assert states[-1].ok


def test_real_robot_of_another_name_is_simulated_under_the_name_that_the_services_know(tmp_path: Path) -> None:
    """Check that a scorer, which knows the scenario's robot only, takes the run for its own."""
    (tmp_path / "real.toml").write_text('extends = "phantomx_mk2"\nname = "another"\n[stance]\nbody_height = 0.12\n')
    sim = Simulator(PROFILE, Settings(seed=0), replace(FLAT, real_robot=str(tmp_path / "real.toml")))
    assert {m.robot for m in run(sim, 100 * MS) if isinstance(m, GroundTruth)} == {PROFILE.name}
    assert sim._profile.name == "another"


@pytest.mark.parametrize(
    ("robot", "published"), [("phantomx_mk2", False), ("phantomx_mk2_d435", False), ("phantomx_mk2_imu", True)]
)
def test_imu_is_published_only_if_scenario_or_profile_has_one(robot: str, published: bool) -> None:
    """Check that the IMU of a camera, which only its driver finds out about, is not assumed."""
    made = run(Simulator(load_profile(robot), Settings(), FLAT), 100 * MS)
    assert any(isinstance(m, Imu) for m in made) == published


def test_robot_starts_standing_with_torque_on() -> None:
    sim = simulator()
    truths = [m for m in run(sim, 500 * MS) if isinstance(m, GroundTruth)]
    last = truths[-1]
    assert last.contact.all()
    assert not last.shutdown.any()
    assert abs(last.T_world_body[2, 3] - FLAT.walk.body_height) < 0.02
    np.testing.assert_allclose(last.T_world_body[:2, 3], 0.0, atol=5e-3)


def test_start_pose_follows_seed_within_spread() -> None:
    start = Start((0.1, -0.2), 10.0, xy_spread=(0.02, 0.01), yaw_spread_deg=2.0)
    scenario = Scenario("flat", (Plane(),), Goal(1.0), start=start)
    poses = np.array([Simulator(PROFILE, Settings(seed=seed), scenario).world.T_world_body for seed in [*range(8), 0]])
    np.testing.assert_array_equal(poses[0], poses[-1])
    off = poses[:-1, :2, 3] - start.xy
    yaw = np.degrees(np.arctan2(poses[:-1, 1, 0], poses[:-1, 0, 0])) - start.yaw_deg
    for found, spread in ((off[:, 0], 0.02), (off[:, 1], 0.01), (yaw, 2.0)):
        assert spread / 3 < np.abs(found).max() <= spread


@pytest.mark.parametrize("name", ["phantomx_mk2", "lotriet_rx64"])
def test_servos_of_each_model_answer_on_actuator_bus(name: str) -> None:
    profile = load_profile(name)
    sim = Simulator(profile, Settings(seed=0), FLAT)
    for servo in profile.servo_ids.ravel().tolist():
        (answer,) = sim.bus.receive(dxl.read(servo, dxl.MODEL_NUMBER.address, 1), 1_000_000_000)
        assert answer.data == dxl.status(servo, 0, bytes([{"AX-12A": 12, "RX-64": 64}[profile.servo.model]]))


def test_stamps_follow_the_pacing_clock() -> None:
    """Take stamps from the pacing clock; live, it does not begin at zero."""
    origin = 123_456_789_000
    made = run(simulator(), origin + 100 * MS, from_ns=origin)
    assert min(m.stamp_ns for m in made) > origin
    assert max(m.stamp_ns for m in made) <= origin + 100 * MS


def test_slow_machine_drops_time_and_reports_it() -> None:
    sim = simulator()
    run(sim, 40 * MS)
    inbox = Inbox(sim.subscribes, sim.stages, lambda _: False)
    assert "too slow" not in sim.status()
    before = sim.world.time_ns
    made = list(sim.step(Tick(5_000 * MS), inbox))
    assert sim.world.time_ns - before <= 2 * TIME_STEP_NS
    assert "1 times too slow" in sim.status()
    assert len([m for m in made if isinstance(m, DepthImage)]) <= 2
    # From there on time passes as before, on the new origin.
    stamps = [m.stamp_ns for m in run(sim, 5_100 * MS, from_ns=5_004 * MS) if isinstance(m, GroundTruth)]
    assert min(stamps) > 4_990 * MS
    assert np.diff(stamps).max() <= 20 * MS + TIME_STEP_NS
    assert "1 times too slow" in sim.status()


def test_small_delay_is_caught_up() -> None:
    sim = simulator()
    run(sim, 40 * MS)
    list(sim.step(Tick(140 * MS), Inbox(sim.subscribes, sim.stages, lambda _: False)))
    assert sim.world.time_ns == 140 * MS
    assert "too slow" not in sim.status()


@pytest.mark.parametrize("seed", [0, 3])
def test_depth_images_are_determined_by_seed(seed: int) -> None:
    frames = []
    for _ in range(2):
        made = run(simulator(seed=seed), 60 * MS)
        frames.append([m for m in made if isinstance(m, DepthImage)])
    assert len(frames[0]) == len(frames[1]) > 0
    for a, b in zip(*frames, strict=True):
        np.testing.assert_array_equal(a.depth, b.depth)
    other = [m for m in run(simulator(seed=seed + 1), 60 * MS) if isinstance(m, DepthImage)]
    assert (other[0].depth != frames[0][0].depth).any()


def test_lockstep_publishes_depth_and_truth_but_no_colour() -> None:
    heard: Counter[str] = Counter()
    lockstep = Lockstep({"simulator": simulator}, lambda topic, _frame, _ns: heard.update([topic.key]))
    lockstep.run(200 * MS)
    assert heard[topics.DEPTH.key] in (6, 7)
    assert heard[topics.TRUTH.key] in (10, 11)
    assert heard[topics.COLOR.key] == 0


@pytest.mark.parametrize("nonsense", [{"bus_port": 70_000}, {"seed": -1}, {"frames_per_picture": 0}])
def test_invalid_settings_are_refused(nonsense: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="expected"):
        Settings(**nonsense)  # type: ignore[arg-type]


def is_bus_silent(sim: Simulator, at_ns: int) -> bool:
    return sim.bus.receive(dxl.ping(1), at_ns) == []


def test_bus_fault_of_scenario_starts_and_ends_in_time() -> None:
    fault = BusFault("bus", "silent", 0.1, for_s=0.1)
    sim = Simulator(PROFILE, Settings(), Scenario("flat", (Plane(),), Goal(1.0), bus_faults=(fault,)))
    run(sim, 120 * MS)
    assert [is_bus_silent(sim, at * MS) for at in (99, 100, 199, 200)] == [False, True, True, False]
    assert sim.status() == "simulating flat, 0.1 s, faults: bus silent"


def read_register(sim: Simulator, row: int, register: Register, at_ns: int | None = None) -> int:
    return int.from_bytes(sim.servos.read(row, register.address, register.size, at_ns), "little")


def test_jammed_servo_reports_full_motor_load() -> None:
    sim, row, goal = simulator(), 4, dxl.GOAL_POSITION
    run(sim, 20 * MS)
    sim.inject(BusFault("servo", "jammed", 0.0, for_s=1.0, servo=PROFILE.servo_ids.ravel().tolist()[row]))
    sim.servos.write(row, goal.address, goal.encode(read_register(sim, row, goal) - 80))
    run(sim, 100 * MS, from_ns=24 * MS)
    for at_ns in (None, sim.world.time_ns, sim.world.time_ns + 3 * MS):
        assert dxl.load_from_register(read_register(sim, row, dxl.PRESENT_LOAD, at_ns)) == pytest.approx(-1.0, abs=0.01)


def test_load_extrapolated_ahead_of_physics_matches_later_physics() -> None:
    sim, row, goal = simulator(), 4, dxl.GOAL_POSITION
    run(sim, 100 * MS)
    ticks, told, found = read_register(sim, row, goal), list[float](), list[float]()
    for _ in range(15):  # a femur moves with its leg, step by step
        ticks -= 4
        sim.servos.write(row, goal.address, goal.encode(ticks))
        begin_ns = sim.world.time_ns
        run(sim, begin_ns + 12 * MS, from_ns=begin_ns)
        asked_ns = sim.world.time_ns + 4 * MS
        told.append(dxl.load_from_register(read_register(sim, row, dxl.PRESENT_LOAD, asked_ns)))
        run(sim, asked_ns, from_ns=asked_ns)
        found.append(dxl.load_from_register(read_register(sim, row, dxl.PRESENT_LOAD, asked_ns)))
        run(sim, begin_ns + 20 * MS, from_ns=begin_ns + 20 * MS)
    assert np.ptp(found) > 0.5
    np.testing.assert_allclose(told, found, atol=0.003)


def test_fault_injection_uses_simulated_time() -> None:
    sim = simulator()
    begun_ns = 7_000 * MS
    run(sim, begun_ns + 20 * MS, from_ns=begun_ns)
    sim.inject(BusFault("bus", "silent", 0.1, for_s=0.1))
    assert [is_bus_silent(sim, begun_ns + at * MS) for at in (99, 100, 199, 200)] == [False, True, True, False]
    sim.inject(BusFault("packets", "silent", 0.0, for_s=0.01, share=1.0))  # at once
    assert [is_bus_silent(sim, begun_ns + at * MS) for at in (20, 29, 30)] == [True, True, False]


def test_fault_message_is_injected_and_invalid_one_is_refused() -> None:
    sim = simulator()
    inbox = Inbox(sim.subscribes, sim.stages)
    overload = BusFault("servo", "overload", 0.0, servo=8).command(0)
    for command, words in (
        (overload, "faults: servo overload, servo 8"),
        (replace(overload, servo=99), "fault refused: servo overload, servo 99: one of the servos 1, 2"),
        (replace(overload, kind="gone"), "fault refused: kind: one of silent, stuck"),
        (replace(overload, for_s=-1.0), "fault refused: for_s: more than 0 and at most"),
    ):
        inbox.receive(topics.FAULT, codec.encode(command), 0)
        truths = [m for m in sim.step(Tick(sim.world.time_ns + BEAT_NS), inbox) if isinstance(m, GroundTruth)]
        assert words in sim.status()
    run(sim, 100 * MS)
    truths = [m for m in run(sim, 200 * MS, from_ns=100 * MS) if isinstance(m, GroundTruth)]
    assert truths[-1].shutdown[PROFILE.servo_ids == 8].all()
    assert truths[-1].shutdown.sum() == 1


def test_scenario_with_fault_of_unknown_servo_is_refused() -> None:
    scenario = Scenario("flat", (Plane(),), Goal(1.0), bus_faults=(BusFault("servo", "silent", 0.1, servo=99),))
    with pytest.raises(ConfigError, match=r"scenario flat: servo silent, servo 99, .* expected, found 99"):
        Simulator(PROFILE, Settings(), scenario)
