"""Videos of recorded runs: properties of the pictures, and exits of the command."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from sextant.deploy import cli
from sextant.evaluation.video import ground, video_writer
from sextant.evaluation.video.captions import Caption
from sextant.evaluation.video.film import Animation, Cut
from sextant.evaluation.video.renderer import Figure, Mark, Renderer, View
from sextant.evaluation.video.robot_figure import CARRIES, COLORS, SWINGS, Solids
from sextant.evaluation.video.sinking import Sinking
from sextant.evaluation.video.timeline import Maps, Moment, Timeline, Track
from sextant.services.simulator.physics.solids import Boxes
from sextant.services.simulator.physics.terrain import Terrain, Weak
from sextant.shared.files.whole_files import WriteError
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, rotation_z, transform
from sextant.shared.recording.reader import Recording
from sextant.shared.recording.writer import Recorder
from sextant.shared.robot.kinematics import body_forward, body_inverse
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec
from sextant.shared.wire.messages import (
    ActuatorState,
    BodyPose,
    GroundTruth,
    Message,
    Mode,
    Odometry,
    PlannerStatus,
    StepPlan,
    TerrainMap,
)
from sextant.shared.wire.topics import OF_TYPE
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
RADIUS = PROFILE.foot.radius
S = 1_000_000_000
DURATION_S = 4.0
STEP_NS = S // 25
BLOCKED = "leg left front finds no foothold"
REFUSED_FROM_S = 3.0
SMALL = Cut(size=(160, 96), fps=5.0)


def at(t_s: float) -> Array:
    """Return the robot's pose at a time [s], in a bend to the left."""
    return transform(rotation_z(0.3 * t_s), np.array([0.12 * t_s, 0.02 * t_s**2, PROFILE.stance.body_height]))


def on_ground(T: Array) -> Array:
    """Return the joint angles (6, 3) of a robot on level ground.

    The feet stand in their resting places below it.
    """
    return body_inverse(PROFILE, PROFILE.rest_feet(float(T[2, 3])))


def walk_messages(seed: int = 0) -> list[Message]:
    """Return the messages of a robot that glides over level ground.

    Its odd legs are in the air, and the planner refuses at the end.
    """
    said: list[Message] = []
    for k in range(int(DURATION_S * S / STEP_NS) + 1):
        t_ns = k * STEP_NS
        T = at(t_ns / S)
        q, swing = on_ground(T), np.arange(6) % 2 == k // 12 % 2
        feet = apply(T, body_forward(PROFILE, q))
        said.append(
            GroundTruth(
                t_ns,
                T,
                q,
                np.zeros((6, 3)),
                feet,
                ~swing,
                ~swing,
                np.zeros((6, 3), dtype=bool),
                11.0,
                30.0,
                "flat",
                seed,
                PROFILE.name,
            )
        )
        said.append(Odometry(t_ns, T, 0.0, 0.0, ~swing, True))
        said.append(actuator_state(PROFILE, stamp_ns=t_ns, mode=Mode.WALK, q=q, swing=swing, step=1, phase=0.5, T_odom_body=T))
        said.append(BodyPose(t_ns, T, np.eye(4), np.eye(6), 1.0, True, "", np.zeros((0, 6))))
        down = feet + T[:3, 0] * 0.06
        said.append(StepPlan(t_ns, 0, 1, k, np.eye(4), swing, down, np.full(6, 0.04), T, 1.0, False))
        refused = t_ns >= REFUSED_FROM_S * S
        state, reason = ("blocked", BLOCKED) if refused else ("stepping", "")
        said.append(PlannerStatus(t_ns, state, reason, 1, 0, -1, np.array([[1.0, 0.0], [2.0, 0.5]])))  # type: ignore[arg-type]
        if k % 25 == 0:
            said.append(level_map(t_ns))
    return said


def level_map(stamp_ns: int, n: int = 120) -> TerrainMap:
    zeros = np.zeros((n, n), dtype=np.float32)
    elevation = zeros.copy()
    elevation[:20] = np.nan
    score = zeros.copy()
    score[80:90] = 2.0
    flags, evaluation = np.zeros((n, n), dtype=np.bool_), np.full((n, n), -1, dtype=np.int8)
    return TerrainMap(stamp_ns, 0.01, np.array([-0.6, -0.6]), elevation, zeros + np.float32(1e-5), score, flags, evaluation)


def record(path: Path, said: list[Message], about: dict[str, str] | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with Recorder(path, {"scenario": "flat", "seed": "0", "robot": PROFILE.name} if about is None else about) as recorder:
        for message in said:
            topic: AnyTopic = OF_TYPE[type(message)]
            recorder.write(topic, codec.encode(message), message.stamp_ns + 2_000_000)
    return path


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run."""
    folder = tmp_path_factory.mktemp("run")
    record(folder / "recording.mcap", walk_messages())
    return folder


@pytest.fixture(scope="module")
def recorded_timeline(run: Path) -> Timeline:
    return Timeline.read(Recording(run))


def level_ground(way: Array | None = None) -> ground.Ground:
    """Return level ground with a block next to the robot."""
    block = Boxes(np.array([[0.5, 0.0, 0.02]]), np.array([[0.05, 0.2, 0.02]]), np.eye(3)[None])
    return ground.of_terrain(Terrain(block, plane=0.0), np.array([[-0.5, 0.0], [0.5, 0.0]]) if way is None else way)


@pytest.fixture(scope="module")
def film(run: Path, recorded_timeline: Timeline) -> Animation:
    return Animation(run, recorded_timeline, PROFILE, level_ground(), "flat, seed 0", SMALL)


@pytest.fixture(scope="module")
def level_renderer() -> Renderer:
    level_renderer = Renderer(PROFILE, (320, 192))
    level_renderer.stand_on(level_ground())
    return level_renderer


def pixel(view: View, size: tuple[int, int], p: Array) -> Array:
    """Return the column and row (2,) of a point {world}."""
    x, y, z = apply(inverse(view.T_world_camera), p)
    return np.array([(size[0] - 1) / 2, (size[1] - 1) / 2]) + view.focal * size[1] * np.array([x, y]) / z


def test_frame_count_follows_duration_frame_rate_and_speed(recorded_timeline: Timeline) -> None:
    for fps, times, from_s, to_s in ((25.0, 1.0, 0.0, 4.0), (12.5, 2.0, 0.5, 3.3), (10.0, 0.25, 3.0, 99.0)):
        cut = Cut(fps=fps, times=times, from_s=from_s, to_s=to_s)
        shown = cut.times_ns(recorded_timeline)
        assert len(shown) == round((min(to_s, DURATION_S) - from_s) * fps / times)
        np.testing.assert_allclose(np.diff(shown) * 1e-9, times / fps, atol=1e-8)
        assert recorded_timeline.began_ns <= shown[0]
        assert shown[-1] <= recorded_timeline.ended_ns
    for from_s, to_s in ((5.0, 6.0), (2.0, 2.0), (3.0, 1.0)):
        with pytest.raises(ValueError, match=r"a part of the recorded 4\.0 s"):
            Cut(from_s=from_s, to_s=to_s).times_ns(recorded_timeline)


@pytest.mark.slow
def test_frames_do_not_depend_on_number_of_processes(film: Animation) -> None:
    alone, together = list(film.frames(1)), list(film.frames(3))
    assert len(alone) == len(together) == len(film.times_ns) == 20
    for one, other in zip(alone, together, strict=True):
        assert one.shape == (96, 160, 3)
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_robot_moves_and_stays_near_image_center(film: Animation, recorded_timeline: Timeline) -> None:
    size = np.array(SMALL.size)
    for t_ns in film.times_ns:
        body = pixel(film.camera.view(t_ns), SMALL.size, recorded_timeline.pose(t_ns)[:3, 3])
        assert (np.abs(body - (size - 1) / 2) < size / 4).all()
    first, *_, last = film.frames(2)
    middle = slice(24, 72), slice(40, 120)
    assert np.abs(first[middle].astype(int) - last[middle]).max(axis=-1).mean() > 5


def standing_figure(contact: NDArray[np.bool_]) -> tuple[Figure, Array]:
    T = at(0.0)
    q = on_ground(T)
    return Figure(T, q, contact), apply(T, body_forward(PROFILE, q))


def side_view(p: Array, yaw: float, away: float = 1.2) -> View:
    """Return a view of a foot from a heading, nearly level."""
    look = np.array([-np.cos(yaw), -np.sin(yaw), -0.5])
    look /= np.linalg.norm(look)
    x = np.cross(look, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return View(transform(np.column_stack([x, np.cross(look, x), look]), p - away * look), 1.6, away)


@pytest.mark.parametrize("leg", range(6))
def test_foot_is_drawn_at_its_position_in_contact_state_color(level_renderer: Renderer, leg: int) -> None:
    hue = {}
    for state in (CARRIES, SWINGS):
        figure, feet = standing_figure(np.full(6, state == CARRIES))
        out = np.arctan2(*feet[leg, 1::-1])
        view = side_view(np.array([0.0, 0.0, 0.05]), out)
        u, v = np.round(pixel(view, level_renderer.size, feet[leg])).astype(int)
        # The foot is in the middle between two columns, so one pixel alone would depend on rounding.
        color = level_renderer.paint(figure, view)[v - 1 : v + 2, u - 1 : u + 2].mean(axis=(0, 1))
        expected = np.array(COLORS[state][0], dtype=float)
        assert color @ expected / np.linalg.norm(color) / np.linalg.norm(expected) > 0.97, (color, expected)
        hue[state] = color / color.sum()
    assert np.abs(hue[CARRIES] - hue[SWINGS]).max() > 0.1


def test_mark_and_robot_shadow_are_drawn_on_ground(level_renderer: Renderer) -> None:
    figure, _ = standing_figure(np.ones(6, dtype=bool))
    view, p = side_view(np.zeros(3), 0.7, 1.6), np.array([0.30, 0.25, 0.0])
    bare = level_renderer.paint(figure, view).astype(int)
    marked = level_renderer.paint(figure, view, [Mark(p, 0.0, 0.03, (219, 22, 102))]).astype(int)
    u, v = np.round(pixel(view, level_renderer.size, p)).astype(int)
    assert marked[v, u, 0] - marked[v, u, 1] > bare[v, u, 0] - bare[v, u, 1] + 30
    changed = np.argwhere(np.abs(marked - bare).max(axis=-1) > 8)
    assert len(changed) > 4
    assert np.abs(changed - [v, u]).max() < 20
    # Next to its shadow the ground is lighter than below the robot.
    away = replace(figure, T_world_body=figure.T_world_body @ from_xyz_rpy((0.0, 3.0, 0.0), (0.0, 0.0, 0.0)))
    lit, below = (
        level_renderer.paint(away, view).astype(int),
        np.round(pixel(view, level_renderer.size, np.array([0.0, -0.12, 0.0]))).astype(int),
    )
    assert lit[below[1], below[0]].sum() > 1.3 * bare[below[1], below[0]].sum()


def test_rounded_box_stays_within_its_size() -> None:
    solids = Solids()
    solids.rounded_box(np.eye(4), (0.2, 0.1, 0.04), 0.01, 1)
    faces, _, starts, ends, radii, _ = solids.arrays()
    high = np.maximum(faces.max(axis=(0, 1)), np.maximum(starts, ends).max(axis=0) + radii.max())
    np.testing.assert_allclose(high, [0.1, 0.05, 0.02])
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    assert (np.einsum("ij,ij->i", normals, faces.mean(axis=1)) > 0).all()  # outward


def test_trouble_is_written_in_warning_color(film: Animation, recorded_timeline: Timeline) -> None:
    said = [recorded_timeline.moment(round(t_s * S)) for t_s in (2.0, 3.5)]
    assert [m.trouble for m in said] == ["", f"planner blocked: {BLOCKED}"]
    assert said[0].mode == "walk"
    assert [m.planner for m in said] == ["stepping", "blocked"]
    caption = Caption((640, 360), "flat", 1.0)
    amber = []
    for moment in said:
        picture = np.full((360, 640, 3), 128, dtype=np.uint8)
        caption.write(picture, moment)
        r, g, b = picture.astype(int).transpose(2, 0, 1)
        amber.append(int(((r > 200) & (b < 120) & (g > 130)).sum()))
        assert (picture[:200] == 128).all()
    assert amber[0] == 0
    assert amber[1] > 100
    long = replace(said[1], trouble="because " * 200)
    picture = np.full((96, 160, 3), 128, dtype=np.uint8)
    Caption((160, 96), "flat", 1.0).write(picture, long)
    assert (picture[:20] == 128).all()


def test_moment_takes_pose_from_truth_and_footholds_from_plan(recorded_timeline: Timeline) -> None:
    moment = recorded_timeline.moment(recorded_timeline.began_ns + 2 * S)
    np.testing.assert_allclose(moment.T_scene_body, at(2.0), atol=1e-6)
    np.testing.assert_allclose(moment.T_world_body, at(2.0), atol=1e-6)
    assert len(moment.footholds) == 3
    np.testing.assert_allclose(moment.footholds[:, 2], RADIUS, atol=1e-6)
    assert moment.speed == pytest.approx(np.linalg.norm(at(3.0)[:2, 3] - at(1.0)[:2, 3]) / 2, rel=0.01)


@pytest.mark.slow
def test_video_without_truth_uses_estimated_pose_and_own_map(tmp_path: Path) -> None:
    said = [m for m in walk_messages() if not isinstance(m, GroundTruth)]
    path = record(tmp_path / "recording.mcap", said, {"robot": PROFILE.name})
    recorded_timeline = Timeline.read(Recording(path))
    assert not recorded_timeline.true
    np.testing.assert_allclose(recorded_timeline.moment(recorded_timeline.began_ns + S).T_scene_body, at(1.0), atol=2e-3)
    out = tmp_path / "walk.gif"
    assert cli.main(["video", str(path), "--out", str(out), "--size", "160x96", "--fps", "2"]) == 0
    with Image.open(out) as image:
        assert (image.size, image.n_frames) == ((160, 96), 8)  # type: ignore[attr-defined]


def test_weak_pillar_sinks_at_recorded_foot_contact(recorded_timeline: Timeline, level_renderer: Renderer) -> None:
    """Sink the pillar under the left middle foot by the recorded contact.

    The pillar is assumed to reach 1 cm higher than the foot, so it has sunk.
    """
    foot = recorded_timeline.truth.said[0].feet[5]
    assert recorded_timeline.truth.said[0].contact[5]
    half = np.array([[0.04, 0.04, 0.2]])
    for over, gave in ((0.012, True), (0.004, False)):
        pillar = Boxes(np.array([[foot[0], foot[1], foot[2] - RADIUS + over - 0.2]]), half, np.eye(3)[None])
        weak = Weak(np.array([0]), np.array([3.0]), np.array([0.06]))
        terrain = Terrain(pillar, weak=weak)
        sinking = Sinking(terrain, recorded_timeline, RADIUS)
        later = [float(sinking.at(recorded_timeline.began_ns + round(t_s * S))[0]) for t_s in (-1.0, 0.0, 0.1, 0.2, 3.0)]
        assert later == sorted(later)
        assert (later[0], later[-1]) == (0.0, 0.06 if gave else 0.0)
    ground_ = ground.of_terrain(terrain, np.array([[-0.5, 0.0], [0.5, 0.0]]))
    assert (len(ground_.faces), ground_.sinking.shape) == (0, (1, 6, 4, 3))
    one = Renderer(PROFILE, (160, 96))
    one.stand_on(ground_)
    figure, _ = standing_figure(np.ones(6, dtype=bool))
    view = side_view(foot, 1.6, 0.8)
    stands, sunk = (one.paint(replace(figure, sunk=np.array([depth])), view) for depth in (0.0, 0.06))
    assert (stands != sunk).any(axis=-1).sum() > 50


def test_color_limits_show_main_ground_level_as_low() -> None:
    flat = np.zeros((50, 50), dtype=np.float32)
    for part, rise in ((0, 0.0), (10, -0.2), (10, 0.2), (3, -0.6)):
        heights = flat.copy()
        heights[:part] += rise
        low, high = ground.limits_of(heights)
        assert high - low >= 0.06 - 1e-9
        assert (0.0 - low) / (high - low) <= 0.5 + 1e-6
        assert low <= 0.0 <= high


def test_track_finds_messages_by_time() -> None:
    track: Track[ActuatorState] = Track()
    states = [actuator_state(PROFILE, stamp_ns=k * S) for k in range(4)]
    for k, state in enumerate(states):
        track.add(state, k * S + 5)
    assert track.newest(4) is None
    assert track.newest(S + 5) is states[1]
    assert track.newest(9 * S, S) is None
    assert track.between(S, 2 * S + 5) == states[1:3]
    before, after, s = track.around(S + S // 2 + 5)
    assert (before, after) == (states[1], states[2])
    assert s == pytest.approx(0.5)
    assert track.around(-1) == (states[0], states[0], 0.0)


def test_maps_until_returns_latest_map(run: Path) -> None:
    maps = Maps(Recording(run))
    assert maps.until(0) is None
    for t_s in (0.5, 1.5, 3.9):
        known = maps.until(round(t_s * S))
        assert known is not None
        assert known.stamp_ns == int(t_s) * S


@pytest.mark.parametrize("suffix", [".mp4", ".webm", ".avi"])
def test_video_file_preserves_frame_size_and_content(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"walk{suffix}"
    shades = [np.full((96, 160, 3), (40 * k, 80, 200 - 40 * k), dtype=np.uint8) for k in range(5)]
    assert video_writer.write(path, shades, 10.0, (160, 96)) == 5
    video, read = cv2.VideoCapture(str(path)), []
    while (got := video.read())[0]:
        read.append(got[1][..., ::-1])
    assert len(read) == 5
    for frame, shade in zip(read, shades, strict=True):
        assert frame.shape == (96, 160, 3)
        assert np.abs(frame.mean(axis=(0, 1)) - shade[0, 0]).max() < 12


@pytest.mark.parametrize("suffix", [".webp", ".gif", ".png"])
def test_animated_image_preserves_all_frames(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"walk{suffix}"
    shades = [np.full((96, 160, 3), (40 * k, 80, 200 - 40 * k), dtype=np.uint8) for k in range(5)]
    assert video_writer.write(path, shades, 10.0, (160, 96)) == 5
    with Image.open(path) as image:
        assert (image.size, image.n_frames) == ((160, 96), 5)  # type: ignore[attr-defined]
        for k, shade in enumerate(shades):
            image.seek(k)
            assert np.abs(np.asarray(image.convert("RGB")).mean(axis=(0, 1)) - shade[0, 0]).max() < 12


def test_gif_preserves_color_of_small_vivid_spots(tmp_path: Path) -> None:
    path = tmp_path / "walk.gif"
    y, x = np.mgrid[:192, :320]
    picture = np.stack([60 + x // 3, 80 + y // 2, 90 + (x + y) // 6], axis=-1).astype(np.uint8)
    picture[40:44, 50:54] = (219, 22, 102)
    picture[90:94, 200:204] = (18, 158, 110)
    assert video_writer.write(path, [picture, picture[::-1]], 10.0, (320, 192)) == 2
    with Image.open(path) as image:
        found = np.asarray(image.convert("RGB")).astype(int)
    assert np.abs(found - picture).max(axis=-1).mean() < 6
    for spot in (np.s_[40:44, 50:54], np.s_[90:94, 200:204]):
        assert np.abs(found[spot] - picture[spot]).max() < 12


def test_interrupted_video_leaves_no_file(tmp_path: Path) -> None:
    def breaks_off() -> "object":
        yield np.zeros((96, 160, 3), dtype=np.uint8)
        raise KeyboardInterrupt

    for suffix in (".mp4", ".webp"):
        with pytest.raises(KeyboardInterrupt):
            video_writer.write(tmp_path / f"walk{suffix}", breaks_off(), 10.0, (160, 96))  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".mp4", ".webm"])
def test_truncated_video_file_raises_and_is_removed(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [np.full((96, 160, 3), 10 * k, dtype=np.uint8) for k in range(12)]
    assert video_writer.write(tmp_path / f"whole{suffix}", frames, 10.0, (160, 96)) == 12
    assert video_writer._frames_in(tmp_path / f"whole{suffix}") == 12
    monkeypatch.setattr(video_writer, "_frames_in", lambda _: 11)  # as OpenCV leaves it on a full disk, without an error
    with pytest.raises(WriteError, match="cannot be written: the disk is full"):
        video_writer.write(tmp_path / f"cut{suffix}", frames, 10.0, (160, 96))
    assert [path.name for path in tmp_path.iterdir()] == [f"whole{suffix}"]


def test_video_command_renders_run_and_prints_summary(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = run / "short.webp"
    words = ["video", str(run), "--out", str(out), "--size", "160x96", "--fps", "5", "--from", "1", "--to", "3", "--speed", "2"]
    assert cli.main(words) == 0
    assert f"{out}: 5 frames, 1.0 s at 5 frames per second" in capsys.readouterr().out
    with Image.open(out) as image:
        assert (image.size, image.n_frames) == ((160, 96), 5)  # type: ignore[attr-defined]


def test_truncated_recording_is_rendered_up_to_its_end(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = (run / "recording.mcap").read_bytes()
    path = tmp_path / "recording.mcap"
    path.write_bytes(whole[: int(0.6 * len(whole))])
    out = tmp_path / "walk.webp"
    assert cli.main(["video", str(path), "--out", str(out), "--size", "64x64", "--fps", "1"]) == 0
    assert "is truncated; its first" in capsys.readouterr().err
    assert out.is_file()


def video_of_unknown_scenario(folder: Path) -> list[str]:
    path = record(folder / "recording.mcap", walk_messages(), {"scenario": "gone_by_now", "seed": "0", "robot": PROFILE.name})
    return ["video", str(path), "--out", str(folder / "walk.webp"), "--size", "64x64", "--fps", "1"]


def test_unknown_scenario_warns_and_can_be_given_as_option(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = video_of_unknown_scenario(tmp_path)
    assert cli.main(words) == 0
    assert "the video shows the robot's map instead" in capsys.readouterr().err
    assert cli.main([*words, "--scenario", "flat"]) == 0
    assert capsys.readouterr().err == ""
    assert cli.main([*words, "--scenario", "nowhere"]) == 2


Spoil = Callable[[Path], list[str]]
WRONG: dict[str, tuple[Spoil, str]] = {
    "no such run": (lambda folder: [str(folder / "nowhere")], "no such run"),
    "an empty folder": (lambda folder: [str(folder)], "no recordings in this folder"),
    "no recording": (lambda folder: [text_file(folder)], "not an MCAP file"),
    "no robot in it": (lambda folder: [str(record(folder / "a.mcap", [level_map(0)]))], "nothing to draw"),
    "an unknown suffix": (lambda folder: [recorded(folder), "--out", "walk.mov"], "one of .mp4, .webm"),
    "beyond the end": (
        lambda folder: [recorded(folder), "--from", "30", "--out", str(folder / "w.webp")],
        "a part of the recorded 4.0 s",
    ),
}


def text_file(folder: Path) -> str:
    (folder / "notes.mcap").write_text("notes\n", encoding="utf-8")
    return str(folder / "notes.mcap")


def recorded(folder: Path) -> str:
    return str(record(folder / "recording.mcap", walk_messages()))


@pytest.mark.parametrize("name", WRONG)
def test_invalid_input_is_refused_with_reason(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spoil, words = WRONG[name]
    assert cli.main(["video", *spoil(tmp_path)]) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.glob("*walk*"))


@pytest.mark.parametrize(
    "option", [["--size", "17x9"], ["--size", "641x480"], ["--fps", "0"], ["--speed", "-1"], ["--to", "x"]]
)
def test_invalid_options_are_refused(option: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["video", "run", *option]) == 2
    assert "expected" in capsys.readouterr().err


def test_animation_requests_only_the_shown_moments(film: Animation) -> None:
    shown: list[Moment] = [film._story.moment(t_ns) for t_ns in film.times_ns]
    assert shown[0].time_s == 0.0
    assert [round(m.time_s, 6) for m in shown] == [round(k / SMALL.fps, 6) for k in range(len(shown))]
