"""Trials on a Dask cluster: killed, refused and failing workers change no result."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from sextant.deploy import cli
from sextant.evaluation.trials import campaign, environment, results_store, trials
from sextant.evaluation.trials import cluster as clusters
from sextant.shared.plugins.loading import Plugins
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import HeightMap, Plane
from tests.support import cluster_tasks as tasks

SCENARIO = Scenario("made up", (Plane(),), Goal(2.5))
SHORT = Scenario("short", (Plane(),), Goal(0.1))
STAND_STILL = "tests.support.plugins:StandStill"
NEEDED = "distributed, of the extra cluster: pip install -e '.[cluster]'"


@pytest.fixture(scope="module")
def opened():
    """Three workers, and what is said of them."""
    pytest.importorskip("distributed", reason=NEEDED)
    said = []
    with clusters.open_cluster("local:3", said.append) as cluster:
        yield cluster, said


@pytest.fixture
def cluster(opened):
    cluster, said = opened
    said.clear()
    return cluster


@pytest.fixture
def said(opened):
    return opened[1]


def _runs(folder):
    """Return the stored runs by seed, without the time of day."""
    return {run.seed: repr(dataclasses.replace(run, time="")) for run in results_store.read(folder / "trials.jsonl")}


@pytest.mark.slow
def test_killed_workers_lose_nothing(tmp_path, cluster, said):
    (tmp_path / "marks").mkdir()
    runner = tasks.Fatal(str(tmp_path / "marks"), seeds=(3, 6))
    result = trials.run_trials(SCENARIO, range(12), 1, tmp_path / "cluster", run=runner, cluster=cluster)
    alone = trials.run_trials(SCENARIO, range(12), 1, tmp_path / "alone", run=tasks.Fatal("", seeds=()))
    assert _runs(tmp_path / "cluster") == _runs(tmp_path / "alone")
    assert repr(dataclasses.replace(result, made=alone.made)) == repr(alone)
    assert result.seeds == tuple(range(12))
    assert sorted(line.partition("; ")[2] for line in said) == ["its seed 3 runs again", "its seed 6 runs again"]
    assert all(line.startswith("worker tls://127.0.0.1:") for line in said)


@pytest.mark.slow
def test_task_that_kills_every_worker_is_given_up_and_the_others_are_stored(tmp_path, cluster, said):
    (tmp_path / "marks").mkdir()
    runner = tasks.Fatal(str(tmp_path / "marks"), seeds=(2,), deaths=5)
    with pytest.raises(clusters.ClusterError, match="lost 3 times each: seed 2 with tls://"):
        trials.run_trials(SCENARIO, range(5), 1, tmp_path, run=runner, cluster=cluster)
    assert sorted(_runs(tmp_path)) == [0, 1, 3, 4]
    # A worker that starts again may be lost once more afterwards, during the check of its environment.
    assert sum(line.endswith("its seed 2 has lost 3 workers and is given up") for line in said) == 1
    healthy = tasks.Fatal("", seeds=())
    assert trials.run_trials(SCENARIO, range(5), 1, tmp_path, run=healthy, cluster=cluster).success.n == 5


@pytest.mark.slow
def test_worker_whose_check_fails_gets_no_work(tmp_path, cluster, said):
    names = [f"task {k}" for k in range(20)]
    work = [(k,) for k in range(20)]
    cluster.client.wait_for_workers(2)  # an earlier test has killed one, and the first to join is refused
    found = list(cluster.share_out(tasks.process, work, tasks.refuses_first, (str(tmp_path / "mark"),), names))
    assert len(found) == 20
    # On a busy machine the scheduler may learn only now of a worker that an earlier test has killed.
    [line] = [line for line in said if "is lost during the check" not in line]
    assert ": numpy 1.0 in process " in line
    assert int(line.rpartition(" ")[2]) not in found


@pytest.mark.slow
def test_workers_of_another_environment_are_refused_with_what_differs(tmp_path, cluster, monkeypatch):
    here = environment.environment(SCENARIO)
    monkeypatch.setattr(trials, "environment", lambda _: here | {"numpy": "1.0"})
    with pytest.raises(clusters.ClusterError, match=rf"numpy: 1\.0 expected, found {np.__version__}"):
        trials.run_trials(SCENARIO, range(5), 1, tmp_path, run=tasks.Fatal("", seeds=()), cluster=cluster)
    assert not (tmp_path / "trials.jsonl").exists()


@pytest.mark.slow
def test_error_of_a_task_ends_the_work(cluster):
    with pytest.raises(ZeroDivisionError):
        list(cluster.share_out(tasks.fails, [(2,), (0,), (1,)], tasks.passes, (), ["a", "b", "c"]))
    assert list(cluster.share_out(tasks.fails, [(1,)], tasks.passes, (), ["a"])) == [1]


@pytest.mark.slow
def test_worker_without_the_program_is_refused(cluster, said):
    def check() -> str:
        return ""

    check.__module__, check.__qualname__ = "nowhere", "check"
    with pytest.raises(clusters.ClusterError, match="ModuleNotFoundError: No module named 'nowhere'"):
        list(cluster.share_out(tasks.process, [(1,)], check, (), ["a"]))
    assert [": ModuleNotFoundError: No module named 'nowhere'" in line for line in said] == [True] * 3
    assert cluster.size == 3


@pytest.mark.slow
def test_lost_scheduler_ends_the_work_with_what_to_do():
    pytest.importorskip("distributed", reason=NEEDED)
    with clusters.open_cluster("local:1", lambda _: None) as cluster:
        results = cluster.share_out(tasks.first_alone, [(0,), (1,)], tasks.passes, (), ["a", "b"])
        assert next(results) == 0
        cluster.client.cluster.close()
        with pytest.raises(clusters.ClusterError, match="the same command goes on"):
            next(results)


@pytest.mark.slow
def test_walks_on_a_cluster_are_those_without_one_to_the_bit(tmp_path, cluster):
    (tmp_path / "marks").mkdir()
    runner = tasks.Fatal(str(tmp_path / "marks"), seeds=(1001,), walks=True)
    trials.run_trials(SHORT, range(1000, 1003), 1, tmp_path / "cluster", run=runner, cluster=cluster)
    trials.run_trials(SHORT, range(1000, 1003), 1, tmp_path / "alone", run=tasks.Fatal("", (), walks=True))
    assert _reports(tmp_path / "cluster") == _reports(tmp_path / "alone")


def _reports(folder):
    """Return the reports by seed, without the times of computing, which depend on the machine's load."""
    lines = map(json.loads, (folder / "trials.jsonl").read_text(encoding="utf-8").splitlines())
    return {line["report"]["seed"]: line["report"] | {"real_time_factor": 0, "stages_ms": {}} for line in lines}


def test_check_reads_the_scenario_of_the_same_program_only():
    here = environment.environment(SCENARIO)
    for scenario in (SCENARIO, load_scenario("mixed+harsh"), dataclasses.replace(SHORT, plugins=Plugins(planner=STAND_STILL))):
        expected = environment.environment(scenario)
        assert environment.check_environment(expected, environment.as_json(scenario)) == ""
    found = environment.check_environment(here | {"program": "0123456789ab"}, "of another program")
    assert found == f"program: 0123456789ab expected, found {here['program']}"


def test_differences_of_environments_are_listed():
    here = {"program": "abc", "numpy": "2.4.6", "file course.npy": "12"}
    assert environment.differences(here, dict(here)) == ""
    there = {"program": "abc", "numpy": "2.3.0", "planner mine:Walk": "there is no module mine"}
    assert environment.differences(here, there) == (
        "numpy: 2.4.6 expected, found 2.3.0; file course.npy: 12 expected, found none; "
        "planner mine:Walk: none expected, found there is no module mine"
    )


def test_environment_covers_files_and_plugins_of_a_scenario(tmp_path, monkeypatch):
    scenario = dataclasses.replace(SCENARIO, terrain=(HeightMap("ground.npy", 0.01, (0.0, 0.0)),), folder=str(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    ground, plugin = tmp_path / "ground.npy", tmp_path / "my_planner.py"
    scenario = dataclasses.replace(scenario, plugins=Plugins(planner="my_planner:Walk"))
    name, of_plugin = f"file {ground}", "planner my_planner:Walk"
    found = environment.environment(scenario)
    assert found[name] == "missing"
    assert "there is no module my_planner" in found[of_plugin]
    ground.write_bytes(b"1")
    plugin.write_text("class Walk: ...\n")
    first = environment.environment(scenario)
    plugin.write_text("class Walk: pass\n")
    second = environment.environment(scenario)
    assert first[name] == second[name] != "missing"
    assert first[of_plugin] != second[of_plugin]
    assert first["program"] == second["program"]


@pytest.mark.parametrize("address", ["local:0", "local", "10.0.0.1:8786", "local:3000", "tcp://", "http://a:1", ""])
def test_invalid_address_is_refused(address):
    with pytest.raises(ValueError, match="local:N or a scheduler's address such as tcp://"):
        clusters.checked_address(address)


@pytest.mark.slow
def test_absent_scheduler_is_reported(monkeypatch):
    pytest.importorskip("distributed", reason=NEEDED)
    monkeypatch.setattr(clusters, "_CONNECT_S", 0.1)
    with (
        pytest.raises(clusters.ClusterError, match=r"a Dask scheduler expected at tcp:.*, found none"),
        clusters.open_cluster("tcp://127.0.0.1:9", lambda _: None),
    ):
        pass


@pytest.mark.slow
def test_campaign_on_a_cluster_survives_a_killed_worker(tmp_path, cluster, said):
    (tmp_path / "marks").mkdir()
    runner = tasks.Fatal(str(tmp_path / "marks"), seeds=(1,))
    campaign.run_campaign(("flat", "stairs"), range(3), 1, tmp_path / "cluster", run=runner, cluster=cluster)
    campaign.run_campaign(("flat", "stairs"), range(3), 1, tmp_path / "alone", run=tasks.Fatal("", seeds=()))
    tables = [(tmp_path / name / "table.md").read_text(encoding="utf-8") for name in ("cluster", "alone")]
    assert tables[0] == tables[1]
    assert [line.partition("; ")[2] for line in said] == ["its seed 1 runs again"]


@pytest.mark.slow
def test_trials_command_runs_on_a_cluster(tmp_path, capsys, monkeypatch):
    pytest.importorskip("distributed", reason=NEEDED)
    monkeypatch.chdir(tmp_path)
    course = Path("short.toml")
    course.write_text('name = "short"\n[goal]\ndistance = 0.1\n[[terrain]]\nkind = "plane"\n', encoding="utf-8")
    words = ["trials", str(course), "--seeds", "1000:1002", "--cluster", "local:2", "--out", "out", "--json"]
    assert cli.main(words) == 0
    table = json.loads(capsys.readouterr().out)
    assert (table["success"]["successes"], table["seeds"]) == (2, [1000, 1001])
    assert len((tmp_path / "out" / "trials.jsonl").read_text(encoding="utf-8").splitlines()) == 2
