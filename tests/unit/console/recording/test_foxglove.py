"""Messages survive the conversion to Foxglove and back."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from sextant.shared.geometry import exp_se3, rotation_from_quaternion, transform
from sextant.shared.recording.foxglove import ground, numbers, robot
from sextant.shared.recording.foxglove.translation import Foxglove
from sextant.shared.recording.writer import Recorder
from sextant.shared.robot.kinematics import body_forward
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import (
    BodyPose,
    CameraState,
    Health,
    Message,
    Mode,
    PlannerStatus,
    Preview,
    StepPlan,
)
from tests.support.recorded import scan, terrain
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
MM = 0.0005  # [m] largest change by rounding
S = 1_000_000_000


def legs(seed: int = 1, **changes: Any) -> Any:
    rng = np.random.default_rng(seed)
    swing = np.array([True, False, True, False, True, False])
    usual = {"q": rng.uniform(-0.4, 0.4, (6, 3)), "T_odom_body": exp_se3(rng.normal(0.0, 0.2, 6)), "swing": swing}
    return actuator_state(PROFILE, **(usual | changes))


def matrix(pose: Any) -> np.ndarray:
    q, p = pose.orientation, pose.position
    return np.asarray(transform(rotation_from_quaternion([q.w, q.x, q.y, q.z]), np.array([p.x, p.y, p.z])))


def unpacked(message: Any) -> np.ndarray:
    """Return the points or cells of a message, read by the fields that it declares."""
    kinds = {1: "u1", 7: "<f4"}
    stride = message.point_stride if hasattr(message, "point_stride") else message.cell_stride
    dtype = np.dtype(
        {
            "names": [f.name for f in message.fields],
            "formats": [kinds[f.type] for f in message.fields],
            "offsets": [f.offset for f in message.fields],
            "itemsize": stride,
        }
    )
    return np.frombuffer(message.data, dtype=dtype)


def test_grid_has_layers_of_every_map_cell() -> None:
    told, map_ = ground.grid(terrain(5, (7, 4))), terrain(5, (7, 4))
    cells = unpacked(told).reshape(-1, told.column_count)
    assert cells.shape == (4, 7), "rows along y, columns along x"
    assert told.row_stride == 7 * told.cell_stride
    assert np.allclose(cells["elevation"].T, map_.elevation, atol=MM, equal_nan=True)
    assert np.allclose(cells["score"].T, map_.score, atol=0.005, equal_nan=True)
    assert np.array_equal(cells["variance"].T, map_.variance)
    known = np.isfinite(map_.elevation)
    assert np.array_equal(cells["evaluation"].T[known], map_.evaluation[known])
    assert np.isnan(cells["evaluation"].T[~known]).all()
    centre = matrix(told.pose)[:2, 3] + told.cell_size.x / 2
    assert np.allclose(centre, map_.origin), "the grid begins at the corner of its first cell"


@pytest.mark.parametrize("colored", [False, True])
def test_known_map_cells_become_points_at_their_positions(colored: bool) -> None:
    map_ = terrain(6, (9, 5), colored)
    points = unpacked(ground.cells(map_))
    where = np.argwhere(np.isfinite(map_.elevation))
    assert len(points) == len(where) == 40
    assert np.allclose(np.column_stack([points["x"], points["y"]]), map_.origin + 0.01 * where, atol=MM)
    assert np.allclose(points["z"], map_.elevation[tuple(where.T)], atol=MM)
    if colored:
        rgb = np.column_stack([points["red"], points["green"], points["blue"]])
        assert np.array_equal(rgb, map_.color[tuple(where.T)])
        assert (points["alpha"] == 255).all()


def test_point_cloud_has_every_point_of_scan() -> None:
    seen = scan(7)
    points = unpacked(ground.points(seen))
    assert np.allclose(np.column_stack([points["x"], points["y"], points["z"]]), seen.points, atol=MM)
    assert np.array_equal(points["pixels"], seen.pixel_count)


@given(seed=st.integers(0, 1000))
def test_frame_chain_leads_from_world_to_camera(seed: int) -> None:
    state, T_world_odom = legs(seed), exp_se3(np.random.default_rng(seed).normal(0.0, 0.3, 6))
    camera = PROFILE.camera.T_body_camera
    tree = robot.frames(state, T_world_odom, camera).transforms
    assert [(f.parent_frame_id, f.child_frame_id) for f in tree] == [("world", "odom"), ("odom", "body"), ("body", "camera")]
    T = np.eye(4)
    for frame in tree:
        w, v = frame.rotation, frame.translation
        T = T @ transform(rotation_from_quaternion([w.w, w.x, w.y, w.z]), np.array([v.x, v.y, v.z]))
    assert np.allclose(T, T_world_odom @ state.T_odom_body @ camera, atol=1e-9)


def test_joint_states_are_named() -> None:
    state = legs(load_nm=np.arange(18.0).reshape(6, 3) / 10)
    told = {joint.name: joint for joint in robot.joints(state).joints}
    assert len(told) == 18
    assert told["left_front_coxa"].position == state.q[0, 0]
    assert told["left_middle_tibia"].position == state.q[5, 2]
    assert told["left_middle_tibia"].effort == pytest.approx(1.7)


def test_robot_is_drawn_with_feet_at_forward_kinematics() -> None:
    state = legs(contact=np.array([False, True, False, True, False, True]))
    (entity,) = robot.drawn(state, PROFILE).entities
    feet = np.array([matrix(ball.pose)[:3, 3] for ball in entity.spheres])
    assert np.allclose(feet, body_forward(PROFILE, state.q), atol=1e-9)
    assert entity.frame_id == "body"
    greens = [ball.color.g > ball.color.r for ball in entity.spheres]
    assert greens == state.contact.tolist(), "those that carry are green"
    links, polygon = entity.lines
    assert len(links.points) == 6 * 3 * 2
    assert len(polygon.points) == 3, "of the legs that stand"


def test_walk_numbers_equal_actuator_state() -> None:
    state = legs(stamp_ns=3 * S + 5, voltage=11.5, step=9, mode=Mode.WALK, load_nm=np.full((6, 3), -0.7))
    told: Any = numbers.walk(state, exp_se3(np.array([0.0, 0.0, 0.12, 0.1, 0.0, 0.0])))
    assert (told.timestamp.seconds, told.timestamp.nanos) == (3, 5)
    assert (told.voltage, told.step, told.mode) == (11.5, 9, "walk")
    assert told.roll == pytest.approx(0.1)
    assert told.torque == pytest.approx(0.7)


def pose(stamp_ns: int, T: np.ndarray, reason: str = "") -> BodyPose:
    return BodyPose(stamp_ns, T, T, np.zeros((6, 6)), 1.0, not reason, reason, np.zeros((0, 6)))


def health(stamp_ns: int, service: str) -> Health:
    return Health(stamp_ns, service, "well", 1, 0, 0, "", (), np.zeros(0), np.zeros(0))


def plan(stamp_ns: int) -> StepPlan:
    swing = np.array([True, False, True, False, True, False])
    return StepPlan(stamp_ns, 0, 1, 1, np.eye(4), swing, np.ones((6, 3)), np.full(6, 0.04), np.eye(4), 1.0, False)


def a_second(at_ns: int = 0) -> list[tuple[Message, int]]:
    """Return the messages of one second, some of each type."""
    status = PlannerStatus(at_ns, "blocked", "no foothold", 1, 0, 2, np.array([[0.0, 0.0], [1.0, 0.5]]))
    jpeg = np.frombuffer(b"\xff\xd8 a picture", dtype=np.uint8)
    said: list[Message] = [pose(at_ns, np.eye(4)), terrain(at_ns), scan(at_ns), plan(at_ns), status, health(at_ns, "mapper")]
    said += [Preview(at_ns, jpeg, jpeg), CameraState(at_ns, "simulated", True, "")]
    said += [legs(k, stamp_ns=at_ns + k * S // 25) for k in range(25)]
    return [(message, message.stamp_ns) for message in said]


def told(messages: list[tuple[Message, int]], foxglove: Foxglove | None = None) -> list[tuple[str, Any]]:
    follows = foxglove or Foxglove(PROFILE)
    return [
        said
        for message, at_ns in messages
        for said in follows.translate(topics.OF_TYPE[type(message)], codec.encode(message), at_ns)
    ]


def test_large_messages_are_translated_at_lower_rate() -> None:
    found: dict[str, int] = {}
    for name, _ in told([one for k in range(10) for one in a_second(k * S // 10)]):
        found[name] = found.get(name, 0) + 1
    assert found["/map"] == found["/map/points"] == 1
    assert found["/scan"] == 3
    assert found["/tf"] == found["/joints"] == 250
    assert found["/robot"] < 60


def test_log_repeats_no_line_and_marks_problems_as_warnings() -> None:
    follows = Foxglove(PROFILE)
    log = [m for name, m in told(a_second() + a_second(S), follows) if name == "/log"]
    said = [(m.name, m.message) for m in log]
    assert ("planner", "blocked: no foothold") in said
    assert len(said) == len(set(said))
    assert {m.level for m in log if m.message.startswith("blocked")} == {3}
    (lost,) = [m for name, m in told([(pose(3 * S, np.eye(4), "too little overlap"), 3 * S)], follows) if name == "/log"]
    assert (lost.name, lost.message) == ("perception", "too little overlap")


def test_undecodable_frame_is_logged() -> None:
    follows = Foxglove(PROFILE)
    ((name, line),) = follows.translate(topics.BODY_POSE, b"nonsense", S)
    assert name == "/log"
    assert "perception/pose" in line.message
    assert line.level == 3
    assert follows.translate(topics.IMU, b"nonsense", S) == (), "no viewer subscribes to it"


def test_recording_contains_schemas_that_decode_its_messages(tmp_path: Path) -> None:
    with Recorder(tmp_path / "r.mcap", {}, Foxglove(PROFILE)) as recorder:
        for message, at_ns in a_second():
            recorder.write(topics.OF_TYPE[type(message)], codec.encode(message), at_ns)
    seen: dict[str, int] = {}
    with (tmp_path / "r.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if channel.message_encoding != "protobuf":
                continue
            assert schema is not None
            pool = DescriptorPool()
            for one in FileDescriptorSet.FromString(schema.data).file:
                pool.Add(one)
            decoded = GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(message.data)
            assert decoded.IsInitialized()
            assert decoded.ListFields()
            seen[schema.name] = seen.get(schema.name, 0) + 1
    named = ("CompressedImage", "FrameTransforms", "Grid", "JointStates", "Log", "Odometry", "PointCloud", "SceneUpdate")
    assert sorted(seen) == [*(f"foxglove.{name}" for name in named), "sextant.Walk"]


def test_footholds_are_drawn_at_planned_positions() -> None:
    (entity,) = robot.footholds(plan(0)).entities
    assert np.allclose([matrix(ball.pose)[:3, 3] for ball in entity.spheres], np.ones((3, 3)))
