import contextlib
import importlib.util
import inspect
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import get_args

import click
import pytest

from benchmarks.cli import benchmarks
from sextant.deploy import cli
from sextant.deploy.commands.common import out_folder
from sextant.deploy.commands.options import Variant
from sextant.deploy.launch.process_table import Command
from sextant.deploy.terminal.arguments import parse
from sextant.deploy.terminal.run_command import run_command
from sextant.evaluation.lockstep import lockstep_run
from sextant.evaluation.report import Report, write
from sextant.evaluation.trials import environment, results_store, trials
from sextant.shared.scenario.loading import load_scenario, point_names, scenario_names
from sextant.shared.scenario.scenario import Scenario, Walk
from sextant.shared.wire.codec import schema_id
from sextant.shared.wire.messages import ActuatorState, GaitName, Mode, schema
from sextant.shared.wire.topics import TOPICS

ROOT = Path(cli.__file__).resolve().parents[1]


def test_help_imports_no_heavy_packages() -> None:
    code = "import sys\nfrom sextant.deploy import cli\ntry:\n    cli.main(['--help'])\nfinally:\n    print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    loaded = set(done.stdout.split())
    assert "sextant.deploy.cli" in loaded, done.stderr
    assert not loaded & {"numpy", "zenoh", "cv2", "numba", "mujoco", "mcap"}
    for command in ("demo", "run", "trials", "up", "record", "topics", "doctor", "recording", "service"):
        assert command in loaded, f"{command} is not offered"


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["run", "stepz"], "did you mean 'steps'?"),
        (["run", "nowhere.toml"], "no such file"),
        (["run", "stepz", "--lockstep"], "did you mean 'steps'?"),
        (["run", "steps", "--lockstep", "--connect", "tcp/127.0.0.1:7447"], "leave --connect out"),
        (["run", "steps", "--lockstep", "--out", "/proc/nowhere"], "--out"),
        (["up", "all", "--scenario", "stepz"], "did you mean 'steps'?"),
        (["up", "onboard", "--set", "actuater.port=x"], "did you mean 'actuator'?"),
        (["up", "onboard", "--set", "port=x"], "SERVICE.KEY=VALUE"),
        (["up", "onboard", "--camera", "nowhere"], "a folder with depth.txt expected, found 'nowhere'"),
        (["up", "all", "--scenario", "flat", "--camera", "realsense"], "leave --scenario out"),
        (["up", "onboard", "--set", "planner.blind=true"], "no service 'planner'"),
        (["up", "offboard", "--with", "actuator"], "actuator must run on the robot, with its servos and camera"),
        (["up", "offboard", "--with", "simulator"], "is a simulation process; --scenario starts it"),
        (["up", "offboard", "--with", "plannar"], "did you mean 'planner'?"),
        (["up", "onboard", "--without", "mapper"], "mapper is not started by the role onboard"),
        (
            ["up", "onboard", "--camera", "none", "--set", "actuator.port=/dev/nowhere"],
            "no servo port /dev/nowhere; is the adapter",
        ),
        (["up", "all", "--scenario", "flat", "--robot", "nobody"], "no profile 'nobody'"),
        (["recording", "replay", "nowhere.mcap"], "recording.mcap of a run"),
        (["recording", "replay", "nowhere.txt"], "depth.txt"),
        (["service", "compose", "--scenario", "stepz"], "did you mean 'steps'?"),
        (["trials", "stepz", "--seeds", "0:2"], "did you mean 'steps'?"),
        (["trials", "table", "nowhere"], "campaign.jsonl or trials.jsonl, expected"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_invalid_input_is_refused_with_cause_and_suggestion(
    words: list[str], hint: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(words) == 2
    printed = capsys.readouterr()
    assert hint in printed.err
    assert printed.out == ""


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["walk"],
        ["run"],
        ["run", "steps", "--seed", "-1"],
        ["trials", "steps"],
        ["trials", "steps", "--seeds", "5:5"],
        ["trials", "steps", "--seeds", "5"],
        ["trials", "steps", "--seeds", "0:2", "--jobs", "0"],
        ["trials", "table"],
        ["trials", "table", "nowhere", "--of", "all"],
        ["up", "nobody"],
    ],
)
def test_invalid_arguments_are_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("sextant")
    assert line.endswith("--help`")


class NoLink:
    """A link to which no other process is connected."""

    def send(self, *_: object) -> None:
        """Discard the frame."""

    def collect(self, _: object) -> Callable[[], list[bytes]]:
        """Receive nothing."""
        return list


@pytest.mark.parametrize(
    ("words", "robot"), [([], "phantomx_mk2"), (["--robot", "lotriet_rx64"], "lotriet_rx64")], ids=["its own", "another"]
)
def test_up_starts_services_with_requested_robot_profile(
    words: list[str], robot: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sextant.deploy.launch import host_launcher

    started: list[tuple[str, ...]] = []

    class Launcher:
        def __init__(self, commands: Sequence[Command], **_: object) -> None:
            started.extend(command.arguments for command in commands)
            raise KeyboardInterrupt

    monkeypatch.setattr(host_launcher, "Launcher", Launcher)
    monkeypatch.setattr(host_launcher, "Router", lambda *_: contextlib.nullcontext())
    monkeypatch.setattr(host_launcher, "ZenohLink", lambda _: contextlib.nullcontext(NoLink()))
    assert cli.main(["up", "all", "--scenario", "flat", *words]) == 130
    capsys.readouterr()
    assert len(started) == 8
    assert all(arguments[arguments.index("--robot") + 1] == robot for arguments in started)


def test_topics_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["topics", "list", "--help"]) == 0
    assert "needs no robot" in capsys.readouterr().out
    assert cli.main(["topics", "list"]) == 0
    printed = capsys.readouterr().out
    assert all(topic.key in printed for topic in TOPICS)
    assert cli.main(["topics", "list", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["key"] for row in rows] == [topic.key for topic in TOPICS]
    state = next(row for row in rows if row["key"] == "actuator/state")
    assert (state["schema"], state["rate"]) == (schema_id(ActuatorState), "25 Hz and at each change")
    assert [field["name"] for field in state["fields"]] == [name for name, _, _ in schema(ActuatorState)]
    fields = {field.pop("name"): field for field in state["fields"]}
    assert (fields["q"]["type"], fields["q"]["shape"], fields["q"]["unit"]) == ("float64", [6, 3], "rad")
    assert fields["T_odom_body"]["frame"] == "odom"
    assert fields["mode"]["choices"] == list(Mode)


def test_compose_prints_the_committed_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["service", "compose"]) == 0
    assert capsys.readouterr().out == (ROOT / "deploy" / "compose.yaml").read_text()
    assert cli.main(["service", "compose", "--offboard"]) == 0
    assert capsys.readouterr().out == (ROOT / "deploy" / "compose.offboard.yaml").read_text()


def test_doctor_exit_code_follows_failed_checks(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    from sextant.deploy.doctor import machine_checks

    for level, status in ((machine_checks.Level.WARN, 0), (machine_checks.Level.FAIL, 1)):
        monkeypatch.setattr(
            machine_checks, "examine", lambda *_, level=level, **_rest: [machine_checks.Check("a", level, "so so", "mend it")]
        )
        assert cli.main(["doctor"]) == status
        assert "mend it" in capsys.readouterr().out


def test_ctrl_c_exits_with_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from sextant.deploy.doctor import machine_checks

    def interrupted(*_: object, **_rest: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(machine_checks, "examine", interrupted)
    assert cli.main(["doctor"]) == 130
    assert "stopped by the operator" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupted_trials_say_what_is_kept_and_how_to_go_on(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    kept = tmp_path / "trials.jsonl"

    def interrupted(*_: object, **__: object) -> None:
        signal.raise_signal(number)

    monkeypatch.setattr(trials, "run_trials", interrupted)
    words = ["trials", "flat", "--seeds", "0:4", "--out", str(tmp_path)]
    handler = signal.getsignal(number)
    assert cli.main(words) == 130
    assert capsys.readouterr().err.splitlines()[-1] == (
        f"stopped by the operator: no walk had ended, so {tmp_path} has no result; run the command again"
    )
    kept.write_text("{}\n{}\n", encoding="utf-8")
    assert cli.main(words) == 130
    assert capsys.readouterr().err.splitlines()[-1] == (
        f"stopped by the operator: 2 walks are kept in {kept}; the same command with --out {tmp_path} goes on with the seeds "
        "that are left"
    )
    assert signal.getsignal(number) is handler


def test_interrupted_lockstep_run_says_what_is_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(lockstep_run, "run_lockstep", lambda *_: signal.raise_signal(signal.SIGTERM))
    assert cli.main(["run", "flat", "--lockstep", "--out", str(tmp_path)]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == (
        f"stopped by the operator: {tmp_path} has an unfinished recording and no report; a lockstep run cannot be resumed, "
        "start it again"
    )


def test_taken_port_of_the_page_is_named_before_anything_starts(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert cli.main(["up", "all", "--scenario", "flat", "--set", f"console.port={port}"]) == 2
    printed = capsys.readouterr().err
    assert f"console.port: another program listens on port {port}; --set console.port=PORT names another" in printed


def test_internal_error_is_not_reported_as_usage_error(monkeypatch: pytest.MonkeyPatch) -> None:
    from sextant.deploy.doctor import machine_checks

    def broken(*_: object, **_rest: object) -> None:
        raise ValueError("a bug")

    monkeypatch.setattr(machine_checks, "examine", broken)
    with pytest.raises(ValueError, match="a bug"):
        cli.main(["doctor"])


def test_run_output_folder_is_new_by_default_or_given_by_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    named = out_folder("here/there", "steps-3")
    assert named == Path("here/there")
    assert named.is_dir()
    assert out_folder(None, "steps-3").parent == Path("runs")


def test_unwritable_output_folder_is_refused_before_trials_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("os.access", lambda path, _: Path(path) != tmp_path)  # root may write everywhere
    assert cli.main(["trials", "flat", "--seeds", "1000:1001", "--out", str(tmp_path)]) == 2
    assert f"may not write to the folder {tmp_path}" in capsys.readouterr().err
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert cli.main(["trials", "flat", "--seeds", "1000:1001", "--out", str(tmp_path / "file")]) == 2
    assert "cannot create the folder" in capsys.readouterr().err


def report(success: bool, seed: int = 3) -> Report:
    reason = "goal reached" if success else "fell at 0.4 m"
    return Report("flat", seed, "phantomx_mk2", "tripod", False, success, reason, 2.5, 25.0, 0.1, 0, 0, 33)


@pytest.mark.parametrize(("success", "status"), [(True, 0), (False, 1)])
def test_run_exit_code_is_zero_only_on_success(
    success: bool, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sextant.evaluation.lockstep import lockstep_run

    def walk(_scenario: Scenario, seed: int, out: Path, *_: object) -> Report:
        write(report(success, seed), out)
        return report(success, seed)

    monkeypatch.setattr(lockstep_run, "run_lockstep", walk)
    assert cli.main(["run", "flat", "--lockstep", "--seed", "9", "--out", str(tmp_path)]) == status
    assert report(success).reason in capsys.readouterr().out
    assert cli.main(["run", "flat", "--lockstep", "--seed", "9", "--out", str(tmp_path), "--json"]) == status
    printed = json.loads(capsys.readouterr().out)
    assert (printed["success"], printed["seed"]) == (success, 9)


@pytest.mark.parametrize(
    ("success", "presses", "status"), [(True, 0, 0), (False, 0, 1), (False, 1, 130)], ids=["success", "failure", "ctrl-c"]
)
def test_live_run_and_demo_exit_codes_follow_walk_outcome(
    success: bool,
    presses: int,
    status: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from sextant.deploy.live import live_run

    asked: list[tuple[str, str, int, bool]] = []

    def walk(
        scenario: Scenario, source: str, seed: int, out: Path, *_: object, slow_down: bool, page: object, viewer: bool
    ) -> live_run.Outcome:
        assert page is None, "the output is no terminal"
        assert not viewer
        write(report(success), out)
        asked.append((scenario.name, source, seed, slow_down))
        return live_run.Outcome(report(success), presses > 0)

    monkeypatch.setattr(live_run, "warm_up", lambda *_: "")
    monkeypatch.setattr(live_run, "run_live_scenario", walk)
    assert cli.main(["demo", "--out", str(tmp_path)]) == status
    printed = capsys.readouterr().out
    assert ("stands at its goal" in printed) == success
    assert all((f"  {tmp_path / file} " in printed) == success for file in ("summary.png", "recording.mcap", "report.json"))
    assert cli.main(["demo", "gap", "--out", str(tmp_path)]) == status
    assert ("shows the crossing" in capsys.readouterr().out) == success
    assert cli.main(["run", "flat", "--seed", "5", "--out", str(tmp_path)]) == status
    assert cli.main(["run", "flat", "--slow-down", "--out", str(tmp_path)]) == status
    demos = [("steps", "steps", 3, True), ("passage1", "passage1", 3, True)]
    assert asked == [*demos, ("flat", "flat", 5, False), ("flat", "flat", 3, True)]


@pytest.mark.parametrize("words", [["--lockstep"], ["--connect", "tcp/127.0.0.1:7447"]])
def test_slow_down_is_refused_with_lockstep_or_connect(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "flat", "--slow-down", *words]) == 2
    assert "leave --lockstep and --connect out" in capsys.readouterr().err


def test_run_reports_slow_computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from sextant.deploy.live import live_run

    slow = "this computer is too slow: maps are 1.6 s old, 0.8 s allowed"
    write(report(True), tmp_path)
    monkeypatch.setattr(live_run, "warm_up", lambda *_: "")
    monkeypatch.setattr(
        live_run, "run_live_scenario", lambda *_, **__: live_run.Outcome(replace(report(True), too_slow=slow), False)
    )
    assert cli.main(["run", "flat", "--out", str(tmp_path)]) == 0
    assert f"{slow}; use --lockstep or close programs" in capsys.readouterr().out
    assert cli.main(["run", "flat", "--json", "--out", str(tmp_path)]) == 0
    assert json.loads(capsys.readouterr().out)["too_slow"] == slow


def test_unknown_demo_course_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demo", "gpa"]) == 2
    assert "did you mean 'gap'?" in capsys.readouterr().err


def test_failed_warm_up_prevents_walk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sextant.deploy.live import live_run

    monkeypatch.setattr(live_run, "warm_up", lambda *_: "warm-up ended (exit status 1); last output: no mujoco")
    assert cli.main(["run", "passage1", "--out", str(tmp_path)]) == 1
    assert "no mujoco" in (printed := capsys.readouterr().err)
    assert "sextant doctor" in printed


def test_faults_are_refused_for_services_started_elsewhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario = tmp_path / "broken.toml"
    scenario.write_text(
        """name = "broken"
[goal]
distance = 1.0
[[terrain]]
kind = "plane"
[[faults]]
at_s = 1.0
service = "mapper"
"""
    )
    assert cli.main(["run", str(scenario), "--connect", "tcp/127.0.0.1:1"]) == 2
    assert "leave --connect out" in capsys.readouterr().err


def test_trials_report_success_rate_and_blind_baseline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sextant.evaluation.lockstep import lockstep_run

    def run(scenario: Scenario, seed: int) -> Report:
        return replace(report(not scenario.walk.blind, seed), blind=scenario.walk.blind)

    monkeypatch.setattr(lockstep_run, "run_lockstep", run)
    assert cli.main(["trials", "flat", "--seeds", "0:3", "--blind", "--json", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr()
    table = json.loads(printed.out)
    assert table["success"]["successes"] == 3
    assert table["baseline"]["success"]["successes"] == 0
    assert json.loads((tmp_path / "trials.json").read_text()) == table
    assert "without a map" in printed.err


def test_commit_seeds_require_clean_checkout(monkeypatch: pytest.MonkeyPatch) -> None:
    from sextant.evaluation import provenance

    words = ["trials", "all", "--seeds", "commit:7"]
    monkeypatch.setattr(provenance, "seeds_of_commit", lambda count: list(range(count)))
    assert parse(cli.sextant, "sextant", words).values["seeds"] == list(range(7))
    monkeypatch.undo()
    monkeypatch.setattr(provenance, "commit", lambda: "abcdef0+")
    assert cli.main(words) == 2


@pytest.mark.slow
def test_trials_of_all_terrains_print_one_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sextant.evaluation.lockstep import lockstep_run
    from sextant.evaluation.trials import campaign_table

    left: list[Path] = []

    def run(scenario: Scenario, seed: int, out: Path | None = None) -> Report:
        if out is not None:
            left.append(out)
        return replace(report(not scenario.walk.blind, seed), scenario=scenario.name, blind=scenario.walk.blind)

    monkeypatch.setattr(lockstep_run, "run_lockstep", run)
    assert cli.main(["trials", "all", "--seeds", "5:7", "--blind", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    walked = campaign_table.WALKED
    assert all(f"| `{name}` | 2 of 2" in printed and f"| `{name}`, blind | 0 of 2" in printed for name in walked)
    assert (tmp_path / "table.md").read_text() in printed
    # The table is printed again from its file, given the folder or the file.
    for kept in (tmp_path, tmp_path / "campaign.jsonl"):
        assert cli.main(["trials", "table", "--of", "walks", str(kept)]) == 0
        assert capsys.readouterr().out.splitlines()[:-2] == (tmp_path / "table.md").read_text().splitlines()[:-2]
    assert cli.main(["trials", "table", str(tmp_path / "flat"), "--of", "reached"]) == 0
    assert "| `flat`: level ground | 2 of 2 (34 to 100 %) | 0 of 2 (0 to 66 %) |" in capsys.readouterr().out
    # The first seed of each leaves its run and pictures.
    assert left == [tmp_path / name / f"seed-5{way}" for name in walked for way in ("", "-blind")]


def test_trials_of_all_passages_print_passage_and_thesis_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sextant.evaluation.lockstep import lockstep_run
    from sextant.evaluation.report import Passage, Section
    from sextant.evaluation.trials import campaign_table

    passage = Passage(30, sections=(Section("complete", "", 640, 70, 9.0, 40),))
    monkeypatch.setattr(
        lockstep_run, "run_lockstep", lambda s, seed, *_: replace(report(True, seed), scenario=s.name, passage=passage)
    )
    assert cli.main(["trials", "passages", "--seeds", "5:7", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert all(f"| `{name}` | 2 of 2" in printed for name in campaign_table.PASSAGES)
    assert "| 640 (1111) | 70 (71) | 0.009 (0.117) |" in printed
    assert (tmp_path / "table.md").read_text() in printed
    for of, row in (("passages", "| `passage3` | 2 of 2"), ("sections", "| 640 (1111) |")):
        assert cli.main(["trials", "table", str(tmp_path), "--of", of]) == 0
        assert row in capsys.readouterr().out


def test_trials_troubles_table_covers_each_trouble_and_terrain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sextant.evaluation.lockstep import lockstep_run
    from sextant.evaluation.trials import campaign_table
    from sextant.shared.scenario.loading import load_trouble, trouble_names

    monkeypatch.setattr(lockstep_run, "run_lockstep", lambda s, seed, *_: replace(report(True, seed), scenario=s.name))
    assert cli.main(["trials", "troubles", "--seeds", "5:7", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    disturbances = {name for name in trouble_names() if load_trouble(name).mismatch is None}
    assert set(campaign_table.TROUBLES) == disturbances
    assert set(campaign_table.LEVELS) == set(trouble_names()) - disturbances
    assert all(f"| `{name}` | 2 of 2" in printed for name in campaign_table.TROUBLED)
    assert cli.main(["trials", "table", str(tmp_path), "--of", "reached"]) == 0
    assert "| `steps+sun`: no depth for 10 s, twice | 2 of 2" in capsys.readouterr().out


def test_trials_of_a_level_walk_every_terrain_with_its_deviations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sextant.evaluation.lockstep import lockstep_run
    from sextant.evaluation.trials import campaign_table
    from sextant.shared.scenario.mismatch import Mismatch

    def walked(scenario: Scenario, seed: int, *_: object) -> Report:
        assert scenario.mismatch != Mismatch()
        return replace(report(True, seed), scenario=scenario.name)

    monkeypatch.setattr(lockstep_run, "run_lockstep", walked)
    assert cli.main(["trials", "usual", "--seeds", "5:7", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert all(f"| `{name}+usual` | 2 of 2" in printed for name in campaign_table.WALKED)


@pytest.mark.parametrize("group", ["ways", "bridges"])
def test_trials_of_group_walk_each_of_its_scenarios(
    group: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sextant.deploy.commands.trials import _GROUPS
    from sextant.evaluation.lockstep import lockstep_run
    from sextant.evaluation.trials import campaign_table

    assert tuple(campaign_table.GROUPS) == _GROUPS
    monkeypatch.setattr(
        lockstep_run, "run_lockstep", lambda course, seed, *_: replace(report(True, seed), scenario=course.name)
    )
    assert cli.main(["trials", group, "--seeds", "5:7", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert all(f"| `{name}` | 2 of 2" in printed for name in campaign_table.GROUPS[group])


@pytest.mark.parametrize(
    "data",
    [b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", b'{"scenario": "flat", "seed": 3}', b"", b"[]\n[]", b"[" * 100_000, b"words\n"],
    ids=("picture", "one line", "empty", "lists", "deeply nested", "words"),
)
def test_table_of_foreign_file_is_refused_and_file_unchanged(
    data: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "any.file"
    path.write_bytes(data)
    assert cli.main(["trials", "table", str(path)]) == 2
    assert str(path) in capsys.readouterr().err
    assert path.read_bytes() == data


def test_trials_begun_by_another_program_version_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:

    monkeypatch.setattr(environment, "_begun_by", lambda: (b"another", "abc1234"))
    assert cli.main(["trials", "flat", "--seeds", "0:3", "--out", str(tmp_path)]) == 2
    assert "restore commit abc1234" in capsys.readouterr().err


def test_robot_and_walk_options_override_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sextant.evaluation.lockstep import lockstep_run

    walked: list[str] = []
    ways: list[tuple[str, float]] = []
    walks: list[Walk] = []

    def run(scenario: Scenario, seed: int) -> Report:
        walked.append(scenario.robot)
        walks.append(scenario.walk)
        ways.append((scenario.walk.gait, scenario.time_limit_s))
        return report(True, seed)

    monkeypatch.setattr(lockstep_run, "run_lockstep", run)
    words = ["trials", "puddle", "--seeds", "0:1"]
    assert cli.main([*words, "--out", str(tmp_path / "its-own")]) == 0
    assert cli.main([*words, "--robot", "phantomx_mk2", "--out", str(tmp_path / "another")]) == 0
    assert walked == ["phantomx_mk2_rgbd", "phantomx_mk2"]
    assert cli.main([*words, "--gait", "wave", "--out", str(tmp_path / "wave")]) == 0
    (gait, before), *_, (slow_gait, after) = ways
    assert (gait, slow_gait) == ("tripod", "wave")
    assert after > 3 * before  # five strides with a sixth of the legs at a time take longer
    ways.clear()
    walks.clear()
    for given in (["--speed", "0.055"], ["--gait", "auto", "--speed", "auto", "--height", "0.09"]):
        assert cli.main([*words, *given, "--out", str(tmp_path / given[-1])]) == 0
    (slow, auto), ((_, longer), (_, same)) = walks, ways
    assert (slow.speed, slow.auto_speed, longer) == (0.055, False, 2 * before)
    assert (auto.gait, auto.auto_speed, auto.body_height, same) == ("auto", True, 0.09, before)
    assert cli.main([*words, "--speed", "fast", "--out", str(tmp_path / "fast")]) == 2
    assert "auto, or a speed from 0.001 to 10 m/s expected, found 'fast'" in capsys.readouterr().err
    assert cli.main([*words, "--robot", "nobody", "--out", str(tmp_path / "nobody")]) == 2
    assert "no profile 'nobody'" in capsys.readouterr().err


def test_course_is_scaled_to_the_robot_and_named_by_its_scale(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sextant.evaluation.lockstep import lockstep_run

    walked: list[Scenario] = []

    def run(scenario: Scenario, seed: int) -> Report:
        walked.append(scenario)
        return replace(report(True, seed), scenario=scenario.name, robot=scenario.robot)

    monkeypatch.setattr(lockstep_run, "run_lockstep", run)
    for robot in ("phantomx_mk2", "lotriet_rx64"):
        words = ["trials", "flat", "--scaled", "--robot", robot, "--seeds", "0:1"]
        assert cli.main([*words, "--out", str(tmp_path / robot)]) == 0
    own, larger = walked
    assert own == load_scenario("flat")
    assert larger == replace(load_scenario("flat+x1.11"), robot="lotriet_rx64")
    assert larger.goal.distance == pytest.approx(1.11 * own.goal.distance)
    names = {run.scenario for run in results_store.read(tmp_path / "lotriet_rx64" / "trials.jsonl")}
    assert names == {"flat+x1.11"}


def test_simulator_of_a_live_run_loads_the_scaled_course(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('name = "mine"\n[goal]\ndistance = 1.0\n[[terrain]]\nkind = "plane"\n')
    variant = Variant(robot="lotriet_rx64", scaled=True)
    for scenario in ("steps", "steps+usual", "riser@0.05", str(tmp_path / "mine.toml")):
        course = variant.load(scenario)
        source = variant.source(scenario, course.robot)
        assert source == f"{scenario}+x1.11"
        assert replace(load_scenario(source), robot=course.robot) == course


def test_gait_option_accepts_exactly_the_known_gaits() -> None:
    for gait in get_args(GaitName):
        assert parse(cli.sextant, "sextant", ["run", "flat", "--gait", gait]).values["gait"] == gait
    assert cli.main(["run", "flat", "--gait", "gallop"]) == 2


def test_closed_stdout_pipe_causes_no_traceback() -> None:
    code = "import sys; sys.argv = ['sextant', 'topics', 'list']; from sextant.deploy.cli import main; sys.exit(main())"
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "wb") as pipe:
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=ROOT, stdout=pipe, stderr=subprocess.PIPE, text=True, timeout=60, check=False
        )
    assert done.returncode == 1
    assert done.stderr == ""


@pytest.mark.parametrize("words", [["info", "nowhere.mcap"], ["recover", "nowhere.mcap"], ["replay", "nowhere.mcap"]])
def test_moved_command_still_runs_and_prints_hint(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == 2
    hint, error = capsys.readouterr().err.splitlines()
    assert hint == f"`sextant {words[0]}` is now `sextant recording {words[0]}`"
    assert error.startswith(f"sextant recording {words[0]}: nowhere.mcap")


def test_plot_still_draws_and_prints_hint(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["plot", "--list"]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("summary")
    assert printed.err == "`sextant plot` is now `sextant figures run`\n"


def test_docs_command_names_its_successor(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["topics", "docs", "keys"]) == 2
    assert "is now `python -m docs.reference`; run it in a checkout" in capsys.readouterr().err


@pytest.mark.slow
def test_bench_command_redirects_to_benchmarks_module(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(Path(__file__).parents[3])
    assert cli.main(["bench", "roles", "--only", "king"]) == 2
    hint, error = capfd.readouterr().err.splitlines()
    assert hint == "`sextant bench` is now `python -m benchmarks`"
    assert error.startswith("python -m benchmarks roles: --only")
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    assert cli.main(["faults", "--list"]) == 2
    assert "in a checkout of Sextant" in capfd.readouterr().err


def commands(group: click.Group, *path: str) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """Yield the words of each command that the help lists, and the command."""
    for name, one in group.commands.items():
        if not one.hidden:
            yield (*path, name), one
            if isinstance(one, click.Group):
                yield from commands(one, *path, name)


@pytest.mark.parametrize("group", [cli.sextant, benchmarks], ids=["sextant", "benchmarks"])
def test_function_of_each_command_takes_exactly_its_options_and_arguments(group: click.Group) -> None:
    for words, one in commands(group):
        if isinstance(one, click.Group):
            continue
        assert one.callback is not None
        taken: list[str] = []
        for parameter in inspect.signature(one.callback).parameters.values():
            kind = parameter.annotation
            taken += [field.name for field in fields(kind)] if is_dataclass(kind) else [parameter.name]
        assert sorted(taken) == sorted(option.name for option in one.params), words


@pytest.mark.parametrize("group", [cli.sextant, benchmarks], ids=["sextant", "benchmarks"])
def test_help_of_each_command_fits_80_columns_and_60_lines(
    group: click.Group, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert group is not cli.sextant or sum(not one.hidden for one in group.commands.values()) <= 19
    hidden = (("trials", "table"),) if group is cli.sextant else ()
    for words in ((), *(words for words, _ in commands(group)), *hidden):
        assert run_command(group, "program", [*words, "--help"]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert len(lines) <= 60, words
        assert all(len(line) <= 80 for line in lines), words
        assert lines[0].startswith(" ".join(("Usage: program", *words))), words


def test_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("sextant ")


def test_shell_completes_commands_options_and_choices(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, expected in (
        ("sextant fig", "figures"),
        ("sextant run --lock", "--lockstep"),
        ("sextant run --gait wa", "wave"),
        ("sextant run cob", "cobbles"),
        ("sextant trials bri", "bridges"),
    ):
        monkeypatch.setenv("_SEXTANT_COMPLETE", "bash_complete")
        monkeypatch.setenv("COMP_WORDS", words)
        monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
        assert cli.main([]) == 0
        assert capsys.readouterr().out.splitlines() == [f"plain,{expected}"]


def test_shell_completes_the_points_of_a_family_after_its_first_letter(monkeypatch, capsys) -> None:
    monkeypatch.setenv("_SEXTANT_COMPLETE", "bash_complete")
    monkeypatch.setenv("COMP_CWORD", "2")
    completed = {}
    for word in ("", "uneven", "uneven_pillars@0.04"):
        monkeypatch.setenv("COMP_WORDS", f"sextant run {word}")
        assert cli.main([]) == 0
        completed[word] = [line.removeprefix("plain,") for line in capsys.readouterr().out.splitlines()]
    assert completed[""] == scenario_names()
    assert completed["uneven"] == point_names("uneven_pillars")
    monkeypatch.setenv("COMP_WORDS", "sextant trials uneven")
    assert cli.main([]) == 0
    assert capsys.readouterr().out.splitlines()[:2] == ["plain,uneven_pillars", f"plain,{point_names('uneven_pillars')[0]}"]
    assert completed["uneven_pillars@0.04"] == ["uneven_pillars@0.04"]
