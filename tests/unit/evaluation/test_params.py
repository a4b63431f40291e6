"""Parameters: one tree, stated in a scenario, by `--set` or by code, and equal in lockstep and in processes."""

import json
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

from sextant.deploy import cli
from sextant.deploy.launch import process_table
from sextant.evaluation import params
from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.evaluation.observers.run_observers import RunObservers, about
from sextant.evaluation.params import SystemParams
from sextant.evaluation.replay.walk import _params
from sextant.evaluation.report import Report, check
from sextant.evaluation.trials import results_store
from sextant.evaluation.trials.campaign_table import of_runs
from sextant.evaluation.trials.environment import fingerprint
from sextant.evaluation.trials.trials import run_trials
from sextant.services.planner.config import Settings as PlannerSettings
from sextant.shared.files import config
from sextant.shared.files.config import ConfigError
from sextant.shared.params import Params
from sextant.shared.recording.reader import Recording
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.process import load_settings
from sextant.shared.runtime.service import Service
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import MapOptions, Scenario
from sextant.shared.wire.transport import Endpoints

FLAT = load_scenario("flat")
REPORT = Report(
    "", 0, "phantomx_mk2", "tripod", blind=False, success=True, reason="goal reached", distance_m=2.5, duration_s=25.0,
    speed_mps=0.1, falls=0, shutdowns=0, steps=24,
)  # fmt: skip
DOCS = Path(__file__).parents[3] / "docs"
STEP = "planner.costmap.max_step_m=0.07"


def numbers(group: Params, prefix: str = "") -> Iterator[tuple[str, Any, tuple[float, float]]]:
    """Yield dotted name, default and range of each number."""
    for field in fields(group):  # type: ignore[arg-type]
        value = getattr(group, field.name)
        if isinstance(value, Params):
            yield from numbers(value, f"{prefix}{field.name}.")
        elif limits := config.range_of(field):
            yield f"{prefix}{field.name}", value, limits


NUMBERS = tuple(numbers(SystemParams()))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "default", "limits"), NUMBERS, ids=[name for name, *_ in NUMBERS])
def test_number_within_range_is_taken_and_beyond_it_refused(name: str, default: float, limits: tuple[float, float]) -> None:
    low, high = limits
    assert low <= default <= high
    for value in (low - 1, high + 1):
        with pytest.raises(ConfigError, match=rf"{name}: .* expected, found"):
            params.assigned(FLAT, [f"{name}={value}"])


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("planner.costmap.max_stp_m=0.07", "planner.costmap.max_stp_m: unknown key; did you mean 'max_step_m'?"),
        ("planer.costmap.max_step_m=0.07", "planer: unknown key; did you mean 'planner'?"),
        ("planner.costmap.max_step_m=7", "planner.costmap.max_step_m: 0.005 to 0.3 expected, found 7"),
        ("planner.costmap.max_step_m=high", "planner.costmap.max_step_m: a number expected, found 'high'"),
        ("planner.costmap.bare_width_cells=1.5", "planner.costmap.bare_width_cells: a whole number expected, found 1.5"),
        ("perception.alignment.gate_near=0.1", "perception.alignment: gate_near: at most gate_far expected, found"),
        ("mapper.height_drift.end_m=0.01", "mapper.height_drift: end_m: at most begin_m expected, found"),
        (
            "actuator.unload_s=0.15",
            "planner.step.handover_s: at least actuator.unload_s + actuator.load_s, 0.25 s, expected, found 0.15 s",
        ),
        ("planner.costmap=3", "planner.costmap: a table expected, found 3"),
        ("planner.blind=true", "planner.blind: unknown key"),
        ("max_step_m", "key=value expected, found 'max_step_m'"),
    ],
)
def test_invalid_assignment_is_refused_in_one_line(assignment: str, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        params.assigned(FLAT, [assignment])
    assert str(error.value).startswith(f"--set: {words}")
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_run_reports_parameters_of_its_command(tmp_path: Path) -> None:
    path, out = tmp_path / "short.toml", tmp_path / "out"
    path.write_text('name = "short"\ntime_limit_s = 1.0\ngoal = {distance = 1.0}\nterrain = [{kind = "plane"}]\n')
    cli.main(["run", str(path), "--lockstep", "--set", STEP, "--set", "planner.costmap.rough_cost=2", "--out", str(out)])
    reported = json.loads((out / "report.json").read_text())["params"]
    assert reported["planner"]["costmap"]["max_step_m"] == 0.07
    assert params.changes(params.read(reported, "report")) == {"planner": {"costmap": {"max_step_m": 0.07, "rough_cost": 2.0}}}


def test_parameters_of_running_services_cannot_be_set(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "flat", "--connect", "tcp/127.0.0.1:1", "--set", STEP]) == 2
    assert "--set is for services that this command starts" in capsys.readouterr().err


@pytest.mark.parametrize("name", [name for name, *_ in NUMBERS])
def test_page_states_unit_or_meaning_of_each_number(name: str) -> None:
    group, _, field = name.rpartition(".")
    page = DOCS / f"parameters_{name.partition('.')[0]}.md"
    section = page.read_text(encoding="utf-8").split(f"# {group}\n")[1].split("\n#")[0]
    row = next(line for line in section.splitlines() if line.startswith(f"| `{field}` |"))
    assert row.split(" | ")[4].strip(" |"), f"{name} has no comment"


def test_assignment_overrides_scenario(tmp_path: Path) -> None:
    path = tmp_path / "course.toml"
    path.write_text(
        'name = "course"\ngoal = {distance = 1.0}\nterrain = [{kind = "plane"}]\n'
        "[params.planner.costmap]\nmax_step_m = 0.05\nrough_cost = 2.0\n"
    )
    scenario = load_scenario(str(path))
    assert params.of_scenario(scenario).planner.costmap.max_step_m == 0.05
    tuned = params.of_scenario(params.assigned(scenario, [STEP])).planner.costmap
    assert (tuned.max_step_m, tuned.rough_cost) == (0.07, 2.0)


def test_scenario_with_unknown_parameter_is_refused() -> None:
    scenario = replace(FLAT, params={"planner": {"costmap": {"max_stp_m": 1}}})
    with pytest.raises(ConfigError, match=r"\[params\] of flat: planner.costmap.max_stp_m: unknown key; did you mean"):
        params.assigned(scenario, [])


def test_partial_group_keeps_other_values_of_its_service() -> None:
    score = params.of_scenario(params.assigned(FLAT, ["mapper.footholds.score.limit=0.9"])).mapper.footholds.score
    assert score == replace(SystemParams().mapper.footholds.score, limit=0.9)


def test_only_changed_parameters_are_kept() -> None:
    assert params.assigned(FLAT, ["planner.costmap.max_step_m=0.065"]) == params.assigned(FLAT, []) == FLAT
    assert params.assigned(FLAT, [STEP]).params == {"planner": {"costmap": {"max_step_m": 0.07}}}


def test_trials_with_and_without_parameters_do_not_mix() -> None:
    tuned = params.assigned(FLAT, [STEP])
    assert fingerprint(tuned) != fingerprint(FLAT) == fingerprint(params.assigned(FLAT, ["planner.costmap.max_step_m=0.065"]))


def test_tables_of_trials_name_changed_parameters(tmp_path: Path) -> None:
    def run(scenario: Scenario, seed: int) -> Report:
        return replace(REPORT, scenario=scenario.name, seed=seed)

    tuned = params.assigned(FLAT, [STEP])
    for scenario in (FLAT, tuned):
        batch = run_trials(scenario, [0, 1], 1, tmp_path, run=run, keep_in=tmp_path / "campaign.jsonl")
        assert batch.params == ("" if scenario is FLAT else STEP)
    entries = of_runs(results_store.read(tmp_path / "campaign.jsonl")).entries
    assert [(entry.seeing.params, entry.seeing.success.n) for entry in entries] == [("", 2), (STEP, 2)]


def test_settings_that_do_not_fit_each_other_are_refused() -> None:
    scenario = replace(FLAT, map=MapOptions(64, resolution=0.005))
    scenario = params.assigned(scenario, ["mapper.footholds.score.flat_radius=0.2"])
    with pytest.raises(ConfigError, match="settings of the mapper: flat_radius of at most 25 cells expected"):
        LockstepRun(scenario, 0, load_profile(scenario.robot))


def test_process_receives_the_parameters_of_lockstep() -> None:
    scenario = params.assigned(FLAT, [STEP])
    chosen = process_table.choices(scenario, "flat", 0)
    rows = process_table.rows("all", simulated=True)
    command = next(c for c in process_table.commands(rows, chosen, Endpoints(("tcp/127.0.0.1:1",))) if c.name == "planner")
    assignments = [word for word, before in zip(command.arguments[1:], command.arguments, strict=False) if before == "--set"]
    live = load_settings(PlannerSettings, None, assignments)
    made: list[Any] = []

    def kept(service: Service) -> Service:
        made.append(service)
        return service

    LockstepRun(scenario, 0, load_profile(scenario.robot), around={"planner": kept})
    assert live == made[0]._settings
    assert live.costmap.max_step_m == 0.07


def test_setting_of_a_process_is_checked_before_it_starts() -> None:
    rows = process_table.rows("all", simulated=True)
    assert process_table.further_settings([STEP], rows) == {"planner": ("costmap.max_step_m=0.07",)}
    with pytest.raises(ConfigError, match=r"planner: costmap.max_stp_m: unknown key; did you mean 'max_step_m'\?"):
        process_table.further_settings(["planner.costmap.max_stp_m=0.07"], rows)


def test_report_has_all_parameters() -> None:
    scenario = params.assigned(FLAT, [STEP])
    observers = RunObservers(load_profile(scenario.robot), scenario, 0)
    reported = observers.params
    assert params.changes(params.read(reported, "report")) == scenario.params
    assert set(params.flat(reported)) >= {name for name, *_ in NUMBERS}
    assert not [problem for problem in check({"params": reported}) if problem.startswith("params")]


def test_parameters_of_running_services_are_unknown() -> None:
    assert RunObservers(load_profile(FLAT.robot), FLAT, 0, live=True, linked=True).params == {}


def test_replay_has_the_parameters_of_the_recording() -> None:
    scenario = params.assigned(FLAT, [STEP])
    recorded: Any = _Recorded(about(scenario, 0, "lockstep"))
    assert _params(recorded) == params.of_scenario(scenario)
    assert _params(_Recorded({})) == SystemParams()  # an old recording


class _Recorded(Recording):
    """Metadata of a recording."""

    path = Path("recording.mcap")

    def __init__(self, about: dict[str, str]):
        self.about = about  # type: ignore[misc]
