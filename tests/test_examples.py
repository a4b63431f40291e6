"""Every script and notebook of examples/ runs."""

import json
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from sextant.shared.geometry import from_xyz_rpy, transform
from tests.support.depth_folders import room, write_folder

EXAMPLES = Path(__file__).parents[1] / "examples"
SCRIPTS = sorted(path.stem for path in EXAMPLES.glob("*.py"))
NOTEBOOKS = sorted((EXAMPLES / "notebooks").glob("*.ipynb"))
COURSE = 'name = "short"\ntime_limit_s = 60\n[goal]\ndistance = 0.2\n[[terrain]]\nkind = "plane"\n'
OPTICAL = transform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a camera that moves ahead over a cluttered floor."""
    poses = [from_xyz_rpy((0.01 * k, 0.0, 0.4), (0.0, np.radians(25.0), 0.0)) @ OPTICAL for k in range(10)]
    return write_folder(tmp_path_factory.mktemp("recorded") / "sequence", poses, room())


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Return a function that runs a script in an empty folder and returns what it prints."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(EXAMPLES))

    def call(name: str, *arguments: str) -> str:
        path = str(EXAMPLES / f"{name}.py")
        monkeypatch.setattr(sys, "argv", [path, *arguments])
        runpy.run_path(path, run_name="__main__")
        return capsys.readouterr().out

    return call


def number(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    assert found is not None, text
    return float(found[1])


def test_scripts_are_short_and_each_is_run_by_a_test() -> None:
    tests = Path(__file__).read_text(encoding="utf-8") + (EXAMPLES.parent / "tests/unit/test_client_commands.py").read_text(
        encoding="utf-8"
    )
    assert len(SCRIPTS) == 8
    for name in SCRIPTS:
        assert len((EXAMPLES / f"{name}.py").read_text(encoding="utf-8").splitlines()) <= 40, name
        assert re.search(rf'"{name}(\.py)?"', tests), f"no test runs {name}.py"


@pytest.mark.parametrize("profile", ["phantomx_mk2", "lotriet_rx64"])
def test_leg_kinematics_prints_reach_of_each_leg(profile: str, run) -> None:
    printed = run("leg_kinematics", profile)
    assert printed.startswith(f"{profile}: joint angles [ 10.  20. -90.] deg")
    assert "[nan nan nan]" in printed
    assert printed.count("reaches") == 6


@pytest.mark.slow
def test_depth_to_map_maps_the_floor(recorded: Path, run) -> None:
    printed = run("depth_to_map", str(recorded), "map.npy")
    assert number(r"(\d+) of 160000 cells", printed) > 2000
    heights = np.load("map.npy")
    assert abs(np.nanmedian(heights)) < 0.01


@pytest.mark.slow
def test_foothold_layers_draws_a_picture(run) -> None:
    printed = run("foothold_layers", "footholds.png")
    assert 1000 < number(r"(\d+) carry a foot", printed) < number(r"^(\d+) cells", printed)
    assert Path("footholds.png").stat().st_size > 10_000
    np.save("map.npy", np.zeros((60, 50)))
    assert run("foothold_layers", "flat.png", "map.npy").startswith("2784 cells are known; 2784 carry")


def test_register_recording_follows_the_camera(recorded: Path, run) -> None:
    printed = run("register_recording", str(recorded))
    assert "10 images, 0 refused" in printed
    assert number(r"rms ([\d.]+) mm", printed) < 10.0


def test_plan_step_avoids_the_ditch(run) -> None:
    printed = run("plan_step")
    assert number(r"; (\d) footholds are moved", printed) >= 1
    assert printed.count("m chosen") == 3


@pytest.mark.slow
def test_lockstep_walk_prints_the_report(run) -> None:
    Path("short.toml").write_text(COURSE)
    printed = run("lockstep_walk", "short.toml", "1", "out")
    assert printed.startswith("short, seed 1: success: ")
    assert json.loads(Path("out/report.json").read_text())["success"]


@pytest.mark.slow
def test_compare_rules_prints_both_rates(run) -> None:
    Path("short.toml").write_text(COURSE)
    printed = run("compare_rules", "short.toml", "1", "out")
    assert "Sextant's score: 1 of 1" in printed
    assert "anywhere: 1 of 1" in printed


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_committed_without_outputs(path: Path) -> None:
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            assert cell["execution_count"] is None


def execute(name: str, **changes: str) -> dict[str, object]:
    """Run the code cells of a notebook, with some of its text replaced; return its variables."""
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    mpl.use("Agg")
    names: dict[str, object] = {"__name__": "__main__"}
    for cell in json.loads((EXAMPLES / "notebooks" / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            code = "".join(cell["source"])
            for old, new in changes.items():
                code = code.replace(old, new)
            exec(compile(code, f"{name}.ipynb", "exec"), names)
    assert plt.get_fignums(), "it draws something"
    for figure in map(plt.figure, plt.get_fignums()):
        figure.canvas.draw()
    plt.close("all")
    return names


def test_there_are_five_notebooks() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["compare_rules", "depth_to_map", "footholds", "kinematics", "registration"]


def test_notebook_of_kinematics_runs() -> None:
    within = execute("kinematics")["within"]
    assert isinstance(within, np.ndarray)
    assert 0.1 < within.mean() < 0.9


def test_notebook_of_depth_to_map_is_exact_to_millimetres() -> None:
    error = execute("depth_to_map")["error"]
    assert isinstance(error, np.ndarray)
    assert np.sqrt(np.nanmedian(error**2)) < 0.003


def test_notebook_of_footholds_plans_a_step() -> None:
    from sextant import PlannedStep

    assert isinstance(execute("footholds")["step"], PlannedStep)


def test_notebook_of_registration_follows_the_camera(recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("runs").mkdir()
    Path("runs/steps_depth").symlink_to(recorded)
    error = execute("registration")["error"]
    assert isinstance(error, np.ndarray)
    assert error.max() < 0.01


@pytest.mark.slow
def test_notebook_of_compared_rules_walks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    found = execute("compare_rules", **{"range(3)": "range(1)", "distance = 0.8": "distance = 0.2"})["found"]
    assert isinstance(found, dict)
    assert [trials.success.n for trials in found.values()] == [1, 1]
