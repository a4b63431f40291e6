"""Trajectories and tables of `python -m benchmarks`.

Trajectories have the requested errors, and tables contain the measured values.
"""

import json
import math
import os
import re
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import cli
from benchmarks.peers import (
    accuracy,
    foothold_model,
    full_frame,
    map_stages,
    passage,
    reduction_peers,
    registration_peers,
    registration_speed,
    score_peers,
    timing,
)
from benchmarks.peers.scenes import MAPPED, REGISTERED
from benchmarks.peers.synthetic_trajectory import CarriedCamera, Errors, ride
from sextant.evaluation.metrics.true_ground import TrueGround
from sextant.services.perception import tum
from sextant.services.perception.config import Settings
from sextant.services.perception.registration.projective_icp import Registration
from sextant.services.simulator.physics.terrain import Terrain
from sextant.shared.files.config import ConfigError
from sextant.shared.geometry import inverse
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import PassageMap, TerrainMap
from tests.support.recordings import recording

SCENES = {**MAPPED, **REGISTERED}


@pytest.mark.parametrize("name", SCENES)
def test_scenes_are_deterministic_for_seed(name: str) -> None:
    one, same, other = (SCENES[name](np.random.default_rng(seed)) for seed in (1000, 1000, 1001))

    def heights(terrain: Terrain) -> np.ndarray:
        return terrain.raster(-0.3, -0.6, 60, 25, 0.05)

    np.testing.assert_array_equal(heights(one), heights(same))
    random = name in ("boxes", "rough", "mixed", "sparse boxes")
    assert random != np.array_equal(heights(one), heights(other))


def test_leg_odometry_error_matches_requested_scale() -> None:
    terrain = REGISTERED["flat"](np.random.default_rng(0))
    way = ride(terrain, np.random.default_rng(1), Errors(scale=0.05))
    told = np.linalg.norm(np.diff(way.T_odom_body[:, :2, 3], axis=0), axis=1).sum()
    true = np.linalg.norm(np.diff(way.T_world_body[:, :2, 3], axis=0), axis=1).sum()
    assert told / true == pytest.approx(1.05, abs=0.005) or told / true == pytest.approx(0.95, abs=0.005)
    assert way.T_world_body[-1, 0, 3] == pytest.approx(2.0)
    assert np.abs(way.T_odom_body[:, 2, 3] - way.T_world_body[:, 2, 3]).max() < 0.01  # heights do not drift
    np.testing.assert_allclose(way.T_odom_body[0], way.T_world_body[0])


def test_slip_makes_odometry_longer_than_walked_distance() -> None:
    terrain = REGISTERED["flat"](np.random.default_rng(0))
    ways = [ride(terrain, np.random.default_rng(1), Errors(0.0, slip)) for slip in (0.0, 0.5)]
    lost = ways[1].T_odom_body[-1, 0, 3] - ways[0].T_odom_body[-1, 0, 3]
    speed_mps = 2.0 / 6.07
    assert lost == pytest.approx(0.5 * speed_mps, abs=0.06)


def test_displaced_robot_keeps_odometry_and_relative_motion() -> None:
    terrain = REGISTERED["flat"](np.random.default_rng(0))
    before, after = (
        ride(terrain, np.random.default_rng(1), Errors(carried_off=there))
        for there in ((0.0, 0.0, 0.0), (-0.25, 0.15, math.radians(15.0)))
    )
    np.testing.assert_array_equal(before.T_odom_body, after.T_odom_body)
    k = int(np.argmax(np.abs(after.T_world_body - before.T_world_body).max(axis=(1, 2)) > 1e-9))
    assert np.linalg.norm((after.T_world_body[k] - before.T_world_body[k])[:2, 3]) == pytest.approx(math.hypot(0.25, 0.15))
    np.testing.assert_allclose(
        inverse(after.T_world_body[k]) @ after.T_world_body[-1],
        inverse(before.T_world_body[k]) @ before.T_world_body[-1],
        atol=1e-12,
    )


@pytest.mark.rare
def test_accuracy_of_synthetic_trajectory() -> None:
    result = accuracy.measure(MAPPED["steps"], 1000, survey=True)
    assert result.legs_drift == pytest.approx(0.1, abs=0.01)
    assert result.drift < 0.01
    assert result.refused == 0
    assert result.interior_rmse < 0.006
    assert abs(result.bias) < 0.003
    assert result.edge < 0.010
    assert result.coverage > 0.95
    assert result.invented == 0
    assert result.model_rmse < 1.2 * result.beside_rmse < 0.006
    assert result.normal_deg < 1.0
    assert result.model_coverage > 0.95


def test_accuracy_table_shows_median_and_worst() -> None:
    rides = [accuracy.RideResult(0.001 * k, 0.1, 0, 0.01, 0.002, -0.001 * k, math.nan, 1.0 - 0.01 * k, 0) for k in range(5)]
    figures = accuracy.medians(rides)
    assert figures["drift"] == (0.002, 0.004)
    assert figures["bias"] == (0.002, 0.004)
    assert figures["coverage"] == pytest.approx((0.98, 0.96))
    assert "edge" not in figures  # no trajectory has one
    rows = [accuracy.Row("maps", "flat", "5 % wrong", 5, 4, figures)]
    assert "Maps; median (worst) of 5 rides" in accuracy.in_words(rows)
    assert "Maps of a strip survey" not in accuracy.in_words(rows)  # there was no survey
    surveyed = accuracy.Row("maps", "flat", "5 % wrong", 5, 5, {"normal_deg": (0.5, 0.7), "model_coverage": (0.98, 0.96)})
    assert "0.5 (0.7)" in accuracy.in_words([surveyed])
    assert json.loads(accuracy.to_json(rows))["rows"][0]["figures"]["drift"] == [0.002, 0.004]


FIGURES = st.dictionaries(
    st.sampled_from([field.name for field in fields(accuracy.RideResult)]), st.tuples(st.floats(0.0, 9.0), st.floats(0.0, 9.0))
)
ROWS = st.builds(
    accuracy.Row,
    st.sampled_from(["registration", "maps"]),
    st.sampled_from(list(SCENES)),
    st.sampled_from(list(accuracy.LEGS)),
    st.integers(1, 99),
    st.integers(0, 99),
    FIGURES,
    st.sampled_from([accuracy.SEXTANT, "a plug-in"]),
)


@given(st.lists(ROWS, min_size=1, max_size=6))
def test_kept_accuracy_gives_the_same_tables(rows: list[accuracy.Row]) -> None:
    assert accuracy.from_json(accuracy.to_json(rows)) == rows
    assert accuracy.in_words(accuracy.from_json(accuracy.to_json(rows))) == accuracy.in_words(rows)


def test_kept_accuracy_is_checked() -> None:
    row = accuracy.Row("maps", "flat", "5 % wrong", 5, 4, {"drift": (0.002, 0.004)})
    for right, wrong, said in (
        ('"rides": 5', '"rides": "5"', "rides: a whole number expected, found '5'"),
        ("0.004", "NaN", "finite numbers of at most 64 bits expected, found NaN"),
        ('"found"', '"lost"', "lost: unknown key"),
    ):
        with pytest.raises(ConfigError, match=re.escape(said)):
            accuracy.from_json(accuracy.to_json([row]).replace(right, wrong))


def test_accuracy_command_writes_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[tuple[object, int, Errors]] = []

    def measure(scene: object, seed: int, errors: Errors, survey: bool = False, variant: object = None) -> accuracy.RideResult:
        asked.append((scene, seed, errors))
        return accuracy.RideResult(0.002 * (seed - 999), 0.1, 0, 0.01, 0.002, 0.001, 0.005, 0.97, 0)

    monkeypatch.setattr(accuracy, "measure", measure)
    assert cli.main(["accuracy", "--seeds", "1000:1002", "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "accuracy.json").read_text(encoding="utf-8"))["rows"]
    assert len(rows) == (len(REGISTERED) + 1) * len(accuracy.LEGS) + len(MAPPED)
    assert all(row["found"] == 2 for row in rows)
    assert len(asked) == 2 * len(rows)
    assert rows[0]["figures"]["drift"] == [0.003, 0.004]
    assert "3.0 (4.0)" in capsys.readouterr().out
    plugin = ("--registration", "tests.support.plugins:Shifted", "--set", "mapper.publish_every=2")
    assert cli.main(["accuracy", "--seeds", "1000:1001", "--out", str(tmp_path), *plugin]) == 0
    beside = json.loads((tmp_path / "accuracy.json").read_text(encoding="utf-8"))["rows"]
    assert len(beside) == 2 * len(rows)
    assert [row["method"] for row in beside[:2]] == ["Sextant", "tests.support.plugins:Shifted, mapper.publish_every=2"]


@pytest.mark.slow
def test_accuracy_of_plugin_is_that_of_its_poses() -> None:
    found = accuracy.measure(REGISTERED["stairs"], 1000, variant=accuracy.Variant("tests.support.plugins:LegsAlone"))
    assert found.drift == pytest.approx(found.legs_drift, abs=0.01)
    assert found.legs_drift > 0.09
    assert found.refused == 0


@pytest.mark.slow
def test_failing_plugin_ends_accuracy_with_its_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plugin = "tests.support.plugins:BrokenAtFrame"
    assert cli.main(["accuracy", "--registration", plugin, "--out", str(tmp_path), "--seeds", "1000:1001"]) == 1
    *progress, said = capsys.readouterr().err.splitlines()
    where = f"perception failed: plug-in {plugin} failed: RuntimeError: no licence (plugins.py:"
    assert said.startswith(f"python -m benchmarks accuracy: {where}")
    assert not any("Traceback" in line for line in progress)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["speed", "--registration", "missing_module:X"], "there is no module missing_module"),
        (["accuracy", "--registration", "tests.support.plugins:Shifty"], "has no Shifty; did you mean 'Shifted'?"),
        (
            ["plans", "--planner", "tests.support.plugins:StandingStill"],
            "has no StandingStill; did you mean 'StandStill'?",
        ),
        (["plans", "--scenario", "flatt"], "did you mean 'flat'?"),
        (
            ["stages", "--foothold", "relief of mine"],
            "--foothold: package.module:Object or the name of an entry point expected",
        ),
        (
            ["accuracy", "--set", "planner.step.handover_s=0.6"],
            "a parameter of perception or mapper expected, found one of planner",
        ),
        (["accuracy", "--set", "mapper.colour=1"], "mapper.colour: unknown key"),
    ],
)
def test_wrong_plugin_or_parameter_is_refused_before_measuring(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words) == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_speed_command_writes_timings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    methods = ("projective (default)", "kiss-icp, block means")
    monkeypatch.setattr(registration_speed, "METHODS", {name: registration_peers.METHODS[name] for name in methods})
    monkeypatch.setattr(registration_speed, "REGISTERED", {"stairs": REGISTERED["stairs"]})
    plugin = "tests.support.plugins:Shifted"
    assert cli.main(["speed", "--seeds", "1000:1001", "--frames", "14", "--registration", plugin, "--out", str(tmp_path)]) == 0
    table = json.loads((tmp_path / "speed.json").read_text(encoding="utf-8"))
    assert [row["method"] for row in table["timings"]] == [*methods, plugin]
    assert table["timings"][0]["ratio"] == {"median": 1.0, "p10": 1.0, "p90": 1.0}
    for row in table["timings"]:
        assert row["figures"]["drift_m"] < 0.05
        assert row["inputs"] == 9
        assert row["ms"]["p10"] <= row["ms"]["median"] <= row["ms"]["p90"]
    assert table["machine"]["processor"]
    assert is_picture(tmp_path / "speed.png")


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    """Return a recording of eight frames over boxes, with their true poses."""
    scene = REGISTERED["sparse boxes"](np.random.default_rng(0))
    way = ride(scene, np.random.default_rng(1), Errors(), frames=8, length=0.1)
    camera, down = CarriedCamera(way, np.random.default_rng(2)), np.array([0.0, 0.0, -1.0])
    with tum.RecordingWriter(tmp_path / "boxes", tum.Camera(way.profile.camera.intrinsics, 1000.0, 15.0, down)) as writer:
        for k, stamp_ns in enumerate(way.stamps_ns):
            writer.add(int(stamp_ns), camera.frame(k), way.T_world_camera[k])
    return tmp_path / "boxes"


def test_speed_on_recording_has_error_and_time(
    tmp_path: Path, sequence: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ours = "projective (default)"
    monkeypatch.setattr(registration_speed, "METHODS", {ours: registration_peers.METHODS[ours], "other": pytest.fail})
    plugin = "tests.support.plugins:Shifted"
    words = ["speed", "--recording", str(sequence), "--registration", plugin, "--out", str(tmp_path)]
    assert cli.main([*words, "--only", "nothing"]) == 0
    said = capsys.readouterr().out
    assert said.index("rms, mm") < said.index("ratio")  # accuracy first
    ours_row, _ = json.loads((tmp_path / "speed.json").read_text(encoding="utf-8"))["timings"]
    assert (ours_row["method"], ours_row["case"]) == (ours, "boxes")
    assert ours_row["figures"]["rms_m"] < 0.005
    assert ours_row["figures"]["drift_m"] < 0.01
    assert ours_row["ms"]["median"] > 0.0


def test_speed_on_recording_needs_reference_poses(sequence: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (sequence / "groundtruth.txt").unlink()
    assert cli.main(["speed", "--recording", str(sequence)]) == 2
    assert "groundtruth.txt: poses of at least 3 frames expected, found 0" in capsys.readouterr().err


@pytest.mark.data
def test_speed_on_real_recording_follows_reference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kitchen = recording("kinect_kitchen")
    (tmp_path / "depth").symlink_to(kitchen / "depth")
    for name in ("camera.toml", "groundtruth.txt"):
        (tmp_path / name).write_bytes((kitchen / name).read_bytes())
    lines = [line for line in (kitchen / "depth.txt").read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    (tmp_path / "depth.txt").write_text("\n".join(lines[:10]) + "\n", encoding="utf-8")
    ours = "projective (default)"
    monkeypatch.setattr(registration_speed, "METHODS", {ours: registration_peers.METHODS[ours]})
    measured = registration_speed.on_recording(tmp_path)
    assert not measured.missing
    (found,) = measured.timings
    assert found.figures["rms_m"] < 0.005


def test_peers_get_every_measured_pixel_and_the_block_means_of_the_default() -> None:
    camera, settings = load_profile("phantomx_mk2").camera, Settings()
    raw = np.random.default_rng(0).integers(600, 2400, (camera.intrinsics.height, camera.intrinsics.width)).astype(np.uint16)
    raw[::3] = 0
    points = camera.intrinsics.points(raw / camera.sensor.depth_scale)[raw > 0]
    np.testing.assert_allclose(registration_peers.Pixels(camera, settings).of(raw), points, rtol=1e-6)
    raw[:] = 1000  # a wall
    blocks = registration_peers.BlockMeans(camera, settings).of(raw)
    assert len(blocks) == 160 * 120
    np.testing.assert_allclose(blocks[:, 2], 1.0, rtol=1e-6)


@pytest.mark.parametrize(("name", "library"), [("VGICP", "small_gicp"), ("GenZ-ICP", "genz_icp")])
@pytest.mark.parametrize("points", ["block means", "pixels"])
def test_peer_follows_a_short_ride(name: str, library: str, points: str, capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip(library, reason="not installed")
    way = ride(REGISTERED["sparse boxes"](np.random.default_rng(0)), np.random.default_rng(1), Errors(), 20, 0.2)
    camera = CarriedCamera(way, np.random.default_rng(2))
    peer = registration_peers.METHODS[f"{name}, {points}"](way.profile.camera, Settings())
    T = way.T_world_camera[8]
    for k in (8, 9, 10, 11, 12):
        T = peer.update(camera.frame(k), k, T, np.eye(6)).T_world_camera
    assert np.linalg.norm((T - way.T_world_camera[12])[:3, 3]) < 0.03
    assert capfd.readouterr().out == ""


def test_speed_requires_at_least_three_frames(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["speed", "--frames", "2"]) == 2
    assert "--frames: a whole number of 3 to 100000 expected, found '2'" in capsys.readouterr().err
    with pytest.raises(ValueError, match="at least 3 frames"):
        registration_speed.registration([1000], frames=2)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            ModuleNotFoundError("No module named 'somewhere'"),
            "elsewhere: No module named 'somewhere'; pip install -e '.[bench]'",
        ),
        (
            ImportError("libusb-1.0.so.0: cannot open shared object file"),
            "elsewhere: libusb-1.0.so.0: cannot open shared object file",
        ),
    ],
)
def test_unavailable_method_is_named_and_skipped(monkeypatch: pytest.MonkeyPatch, error: ImportError, said: str) -> None:
    def absent(*_: object) -> registration_peers.RegistrationMethod:
        raise error

    ours = registration_peers.METHODS["projective (default)"]
    monkeypatch.setattr(registration_speed, "METHODS", {"projective (default)": ours, "elsewhere": absent})
    monkeypatch.setattr(registration_speed, "REGISTERED", {"stairs": REGISTERED["stairs"]})
    found = registration_speed.registration([1000], frames=12)
    assert found.missing[0].startswith(said)
    assert ("pip install" in found.missing[0]) is isinstance(error, ModuleNotFoundError)
    assert [(t.method, t.case, t.ratio.median) for t in found.timings] == [("projective (default)", "stairs", 1.0)]
    assert said in timing.in_words(found, registration_speed.HEADINGS)
    assert timing.from_json(timing.to_json(found), timing.Measured).missing == found.missing


NUMBERS = st.integers(1, 99_999).map(lambda digits: digits / 100)  # five digits, as they are kept
SPREADS = st.builds(timing.Spread, NUMBERS, NUMBERS, NUMBERS)
TIMINGS = st.builds(
    timing.Timing,
    st.sampled_from(["registration", "map update"]),
    st.sampled_from(["flat", "256x256"]),
    st.sampled_from(["Sextant", "NumPy"]),
    SPREADS,
    SPREADS,
    st.integers(1, 300),
    st.dictionaries(st.sampled_from(["rms_m", "agreement", "per_s", "solved"]), NUMBERS),
)
COMMON = {
    "timings": st.lists(TIMINGS, max_size=4).map(tuple),
    "missing": st.sampled_from([(), ("a library: it is not there",)]),
    "machine": st.just({"processor": "a core", "python": "3.11", "numpy": "2.4"}),
    "load": st.just((0.1, 1.2, 2.3)),
}
SECTIONS = st.builds(
    passage.Section,
    *[st.sampled_from(passage.CASES), st.sampled_from([passage.OURS, passage.MASRI])],
    *[st.integers(0, 99)] * 3,
    *[NUMBERS] * 4,
    *[st.integers(0, 9)] * 2,
    *[st.none() | NUMBERS] * 3,
)
TABLES: dict[type[timing.Measured], tuple[dict[str, st.SearchStrategy[object]], Callable[..., str]]] = {
    timing.Measured: ({}, partial(timing.in_words, headings=registration_speed.HEADINGS)),
    map_stages.Measured: ({"parts_ms": st.just({"registration": 1.25, "reduction": 1.5})}, map_stages.in_words),
    passage.Measured: (
        {"sections": st.lists(SECTIONS, max_size=4).map(tuple), "wrong": st.just(("a leg",))},
        passage.in_words,
    ),
}


@pytest.mark.parametrize("kind", TABLES)
@given(st.data())
def test_kept_timings_give_the_same_table(kind: type[timing.Measured], data: st.DataObject) -> None:
    further, in_words = TABLES[kind]
    measured = data.draw(st.builds(kind, **COMMON, **further))
    kept = timing.from_json(timing.to_json(measured), kind)
    assert kept == measured
    assert in_words(kept) == in_words(measured)
    lines = [line for line in in_words(kept).split("\n") if line.startswith("|")]
    assert all(line.endswith(" |") or set(line) <= set("|-") for line in lines)


def test_kept_timings_are_checked() -> None:
    spread = timing.Spread(1.0, 0.5, 2.0)
    text = timing.to_json(timing.Measured(timings=(timing.Timing("a", "b", "c", spread, spread, 3),)))
    for right, wrong, said in (
        ('"inputs": 3', '"inputs": 3.5', "timings[0].inputs: a whole number expected, found 3.5"),
        ('"p90": 2.0', '"p90": Infinity', "timings[0].ms.p90: a finite number expected, found inf"),
        ('"timings"', '"timing"', "timing: unknown key"),
    ):
        with pytest.raises(ConfigError, match=re.escape(said)):
            timing.from_json(text.replace(right, wrong), timing.Measured)
    with pytest.raises(ConfigError, match="sections: missing"):
        timing.from_json(text, passage.Measured)


def is_picture(path: Path) -> bool:
    return path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_stages_command_writes_timings_and_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def absent(*_: object) -> score_peers.Scores:
        raise ImportError("some library is not there")

    monkeypatch.setattr(map_stages, "SCENES", ("steps",))
    monkeypatch.setattr(reduction_peers, "REDUCTION", {"NumPy": reduction_peers.NumpyReduction})
    monkeypatch.setattr(score_peers, "SCORE", {"OpenCV + NumPy": score_peers.OpencvChain, "elsewhere": absent})
    cores = os.sched_getaffinity(0)
    rule = "tests.support.plugins:all_good"
    words = ["stages", "--seeds", "1000:1001", "--frames", "4", "--foothold", rule, "--out", str(tmp_path), "--json"]
    assert cli.main(words) == 0
    assert os.sched_getaffinity(0) == cores
    table = json.loads(capsys.readouterr().out)
    assert table == json.loads((tmp_path / "stages.json").read_text(encoding="utf-8"))
    rows = {(row["stage"], row["case"], row["method"]): row for row in table["timings"]}
    assert {stage for stage, _, _ in rows} == {"reduction", "map update", "frame into map", "score chain", "frame to layers"}
    figures = {job: row["figures"] for job, row in rows.items()}
    assert figures["reduction", "640x480", "NumPy"]["agreement"] > 0.95
    for size in ("256x256", "512x512"):
        assert figures["map update", size, "NumPy"]["agreement"] > 0.99
        assert figures["score chain", size, "OpenCV + NumPy"]["agreement"] > 0.99
        assert figures["score chain", size, "Sextant, changes only"]["agreement"] > 0.99
        assert 0.3 < figures["score chain", size, rule]["agreement"] < 1.0  # the cells that are footholds by our score, too
    assert figures["map update", "512x512", "Sextant"]["growth"] > 0.0
    assert figures["frame to layers", "256x256", "Sextant"]["made"] == 1.0
    assert {"registration", "reduction", "fuse", "score"} <= table["parts_ms"].keys()
    assert table["missing"] == ["elsewhere: some library is not there"]
    assert is_picture(tmp_path / "stages.png")


def test_plans_command_asks_planners_for_the_same_steps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plugin = "tests.support.plugins:StandStill"
    words = ["plans", "--scenario", "flat", "--seeds", "1000:1001", "--requests", "4", "--planner", plugin]
    assert cli.main([*words, "--out", str(tmp_path), "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    assert table == json.loads((tmp_path / "plans.json").read_text(encoding="utf-8"))
    ours, other = table["timings"]
    assert (ours["method"], ours["case"], other["method"]) == ("Sextant", "flat", plugin)
    assert ours["figures"]["solved"] == ours["figures"]["accepted"] == 1.0
    assert ours["figures"]["travel_mm"] > 20.0
    assert other["figures"]["solved"] == 1.0
    assert other["figures"]["travel_mm"] == 0.0


def test_race_rotates_methods_and_drops_warm_up() -> None:
    order: list[str] = []
    race = timing.Race("stage", "case", warm=1)
    race.start({name: lambda _, name=name: order.append(name) for name in "abc"})
    for k in range(3):
        race.run(k)
    assert "".join(order) == "abcbcacab"
    assert [len(race.ms(name)) for name in "abc"] == [2, 2, 2]
    assert [t.method for t in race.timings({"b": {"figure": 1.0}})] == ["a", "b", "c"]


def test_thesis_icp_finds_observable_motion() -> None:
    way = ride(
        REGISTERED["stairs+pillars"](np.random.default_rng(0)), np.random.default_rng(1), Errors(), frames=20, length=0.2
    )
    camera = CarriedCamera(way, np.random.default_rng(2))
    profile = way.profile.camera
    thesis = registration_peers.METHODS["thesis ICP, pixels"](profile, Settings())
    T = way.T_world_camera[0]
    for k in (8, 9, 10, 11, 12):
        T = thesis.update(camera.frame(k), k - 8, T if k > 8 else way.T_world_camera[8], np.eye(6)).T_world_camera
    assert np.linalg.norm((T - way.T_world_camera[12])[:3, 3]) < 0.05


def test_survey_is_compared_in_overlap_of_both_maps() -> None:
    truth = TrueGround(np.zeros((59, 39)), 0.01)
    layers, flags = np.full((3, 30, 20), 0.002, np.float32), np.zeros((30, 20), np.bool_)
    terrain = TerrainMap(0, 0.01, np.zeros(2), *layers, flags, flags.astype(np.int8))
    normals = np.zeros((40, 10, 3), np.int16)
    normals[..., 2] = 32767
    elevation = np.full((40, 10), 0.001, np.float32)
    elevation[:15] = np.nan
    grid = np.zeros((40, 10), np.float32)
    flags = np.zeros((40, 10), np.bool_)
    passage = PassageMap(
        0, 0.01, np.array([0.10, 0.05]), 0.0, elevation, normals, grid, flags, flags.astype(np.int8), 0.5, "", np.eye(4), flags
    )  # fmt: skip
    seen = np.ones((30, 20), np.bool_)
    figures = foothold_model.judged(passage, terrain, truth, seen)
    assert figures.rmse == pytest.approx(0.001)
    assert figures.elevation_rmse == pytest.approx(0.002)
    assert figures.normal_deg == pytest.approx(0.0, abs=1e-6)
    assert figures.coverage == pytest.approx(5 / 20)  # of its first twenty rows, which the elevation map also has
    with pytest.raises(ValueError, match="off the grid"):
        foothold_model.judged(replace(passage, origin=np.array([0.105, 0.05])), terrain, truth, seen)


def test_steady_depth_drops_edge_and_invalid_pixels() -> None:
    camera = load_profile("phantomx_mk2").camera
    raw = np.full((camera.intrinsics.height, camera.intrinsics.width), 900, dtype=np.uint16)
    raw[:, 320:] = 1500  # a block's edge, with flying pixels
    raw[:, 320] = 1200
    raw[0, 0] = 0
    z = full_frame.steady_depth(raw, camera)
    assert np.isnan(z[:, 320]).all()
    assert np.isnan(z[0, 0])
    kept = np.isfinite(z)
    kept[:, 320] = kept[0, 0] = True
    assert kept.all()


def test_registration_on_sparse_boxes_resists_leg_slip() -> None:
    rngs = [np.random.default_rng([1006, k]) for k in range(3)]
    way = ride(REGISTERED["sparse boxes"](rngs[0]), rngs[1], Errors(slip=0.5))
    camera, T_body_camera = CarriedCamera(way, rngs[2]), way.profile.camera.T_body_camera
    registration = Registration(way.profile.camera.intrinsics, way.profile.camera.sensor)
    told, true = way.T_odom_body @ T_body_camera, way.T_world_body @ T_body_camera
    T = true[0]
    for k in range(60):
        motion = inverse(told[k - 1]) @ told[k] if k else np.eye(4)
        sigma = 0.1 * np.linalg.norm(motion[:3, 3]) + 0.001
        prior = np.diag(np.array([sigma, sigma, 0.01, 0.01, 0.01, 0.003]) ** 2)
        T = registration.update(camera.frame(k), k, T @ motion, prior).T_world_camera
    assert np.linalg.norm((inverse(told[0]) @ told[59])[:3, 3]) - np.linalg.norm((inverse(true[0]) @ true[59])[:3, 3]) > 0.1
    assert np.linalg.norm(T[:3, 3] - true[59][:3, 3]) < 0.03


@pytest.mark.rare
def test_passage_command_writes_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["passage", "--seeds", "1000:1001", "--out", str(tmp_path), "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    assert table == json.loads((tmp_path / "passage.json").read_text(encoding="utf-8"))
    assert table["wrong"] == []
    assert {section["case"] for section in table["sections"]} == {"scenario 1", "scenario 2", "scenario 3", "strewn pillars"}
    ours = [section for section in table["sections"] if section["planner"] == "Sextant"]
    masri = [section for section in table["sections"] if section["planner"] == "Masri 2016"]
    assert len(ours) == len(masri) == 4
    assert all(section["plans"] == 1 for section in ours + masri)
    assert all(section["margin_m"] >= 0.03 for section in ours)
    expansions = {row["method"]: row for row in table["timings"] if row["stage"] == "expansion"}
    assert expansions["NumPy"]["ratio"]["median"] > 10.0
    assert is_picture(tmp_path / "passage.png")


def test_page_report_shows_cost_and_kept_limits() -> None:
    from benchmarks.page import page

    cost = page.Cost(0.021, 0.01, 1.2e6, 14.0, 61.0, "a renderer")
    found = page.Measured(
        (page.Delay.of("pad released", (0.1, 0.2, 0.4), 0.35), page.Delay.of("feet down", (0.3, math.inf, 0.2))), cost
    )
    words = page.in_words(found)
    assert "| pad released | 200 | 400 | 400 | 350 | 2 of 3 |" in words
    assert "| feet down | 300 | inf | inf |  | 3 times |" in words
    assert "2.1% of a core" in words
    assert page.from_json(page.to_json(found)) == found


def test_recording_report_compares_with_unrecorded_walk() -> None:
    from benchmarks.robot import recording

    usual = recording.Way("nobody records", [np.array([0.02, 0.02, 0.021])])
    killed = recording.Way("the recorder is killed", [np.array([0.02, 0.02, 0.023])], [0.4, math.inf], [0.3, 0.25])
    found = [recording.Summary.of(way) for way in (usual, killed)]
    words = recording.in_words(found)
    assert "| the recorder is killed | 20.00 | 22.94 | +1.96 | 23.0 | 0.4 at most, never in 1 | 0.3 at most |" in words
    assert recording.from_json(recording.to_json(found)) == found
