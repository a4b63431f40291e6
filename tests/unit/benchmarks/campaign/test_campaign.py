"""The campaign compares code between commits, runs parts, and keeps what they leave."""

import json
import math
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import cli
from benchmarks.campaign import code_state, part, run
from benchmarks.campaign import evidence as evidences
from benchmarks.campaign.code_state import Dependencies
from benchmarks.campaign.evidence import Evidence, Standing, ordered
from benchmarks.campaign.part import Part, load
from benchmarks.commands import campaign as command
from sextant.deploy import cli as sextant_cli
from sextant.deploy.terminal.arguments import parse
from sextant.evaluation.trials import results_store
from sextant.shared.files.config import ConfigError, build

ROOT = Path(__file__).parents[4]
PART = Part("Walks", "results", ("python -m benchmarks size",), "size.json", "size.json", ("benchmarks.robot.size",), 0.1)
EVIDENCE = Evidence(("HEAD",), "2026-01-01T00:00:00+00:00", "2026-01-02T00:00:00+00:00", "a machine")


def git(folder: Path, *words: str) -> None:
    subprocess.run(
        ["git", "-C", str(folder), "-c", "user.name=A", "-c", "user.email=a@b", *words], check=True, capture_output=True
    )


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A checkout of three commits: a module, then with other comments, then with other code."""
    git(tmp_path, "init", "-b", "main")
    texts = ('"""Double."""\nX = 1\n', '"""Double a number."""\n# of feet\nX = 1\n', '"""Double a number."""\nX = 2\n')
    (tmp_path / "robot.toml").write_text("legs = 6\n")
    for k, text in enumerate(texts):
        (tmp_path / "double.py").write_text(text)
        (tmp_path / "constraints.txt").write_text(f"numpy==2.0\nruff==0.{k}\n")
        git(tmp_path, "add", ".")
        git(tmp_path, "commit", "-m", "text")
        git(tmp_path, "branch", f"b{k}")
    monkeypatch.setattr(code_state, "ROOT", tmp_path)
    for cached in (code_state._tracked, code_state._pins, code_state._code):  # what they keep is of another checkout
        cached.cache_clear()
    yield tmp_path
    for cached in (code_state._tracked, code_state._pins, code_state._code):
        cached.cache_clear()


def test_comments_do_not_count_as_a_change_but_code_and_libraries_do(checkout: Path) -> None:
    code = Dependencies(("double.py", "robot.toml"), ("numpy",))
    assert code.changed("b0", "b1") == []
    assert code.changed("b1", "b2") == ["double.py"]
    assert code.digest("b0") != code.digest("b1") != code.digest("b2")
    assert Dependencies((), ("numpy", "ruff")).changed("b0") == ["ruff"]
    assert Dependencies(("missing.py",), ()).changed("b0") == []
    (checkout / "robot.toml").write_text("legs = 6  # of them\n")
    git(checkout, "commit", "-am", "comment")
    code_state._tracked.cache_clear()
    assert Dependencies(("robot.toml",), ()).changed("b0") == []


def test_dependencies_are_all_that_a_module_imports_and_the_named_profiles() -> None:
    walk = Dependencies.of(["sextant.evaluation.lockstep.lockstep_run"], ["shared/robot/profiles/phantomx_mk2.toml"])
    assert {"services/planner/service.py", "services/actuator/servo_bus/bus_driver.py", "shared/geometry.py"} <= set(walk.files)
    assert [path for path in walk.files if "/profiles/" in path] == [
        "shared/robot/profiles/__init__.py",
        "shared/robot/profiles/phantomx_mk2.toml",
    ]
    assert {"mujoco", "numpy", "opencv-python-headless"} <= set(walk.libraries)
    assert not any(path.startswith(("deploy/", "tests/", "docs/")) for path in walk.files)
    with pytest.raises(ValueError, match=r"a module of this checkout expected, found 'sextant\.nothing'"):
        Dependencies.of(["sextant.nothing"])
    with pytest.raises(ValueError, match=r"a file of this checkout expected, found 'robots/\*'"):
        Dependencies.of([], ["robots/*"])


@pytest.mark.parametrize("name", load())
def test_each_part_has_a_page_modules_and_a_command_that_takes_out(name: str) -> None:
    one = load()[name]
    assert (ROOT / "docs" / f"{one.page}.md").is_file()
    assert Dependencies.of(one.modules, one.reads).files
    for step in one.steps(Path("folder"), "--jobs 2"):
        program, *rest = shlex.split(re.sub(r"commit:(\d+)", r"0:\1", step.line))  # a commit's seeds need a clean checkout
        group, name = (sextant_cli.sextant, "sextant") if program == "sextant" else (cli.benchmarks, cli.PROGRAM)
        assert parse(group, name, rest if program == "sextant" else rest[2:]).path.startswith(name)
        assert step.words[0] == sys.executable


def test_evidence_of_trials_names_the_commits_of_its_runs() -> None:
    found = evidences.read()
    assert set(found) <= set(load())
    for name, one in load().items():
        if one.of_trials and name in found:
            path = part.DOCS / one.kept
            assert run.of_file(path, found[name]).made == found[name].made


def test_claim_holds_only_by_the_same_code(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = replace(PART, kept="fuzz.json")
    assert Standing.of(kept, EVIDENCE).words == "yes"
    assert Standing.of(kept, replace(EVIDENCE, commits=("fffffff",), digest=Dependencies.of(kept.modules).digest())).holds
    assert Standing.of(kept, None).words == "no: never kept"
    assert Standing.of(replace(kept, kept="nothing.json"), EVIDENCE).words == "no: never kept"
    assert Standing.of(kept, replace(EVIDENCE, passed=False)).words == "no: a limit was not kept"
    assert Standing.of(kept, replace(EVIDENCE, commits=())).words == "no: made by an unknown commit"
    assert "fffffff, which is not in this checkout" in Standing.of(kept, replace(EVIDENCE, commits=("fffffff",))).words
    monkeypatch.setattr(Dependencies, "changed", lambda *_: ["a.py", "b.py", "c.py", "d.py"])
    assert Standing.of(kept, EVIDENCE).words == "no: 4 files changed since: a.py, b.py, c.py, ..."


def test_oldest_evidence_comes_first_after_what_was_never_kept() -> None:
    parts = dict.fromkeys(("new", "old", "none"), PART)
    found = {"new": replace(EVIDENCE, first="2026-02-01T00:00:00+00:00"), "old": EVIDENCE}
    assert ordered(parts, found) == ["none", "old", "new"]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"commands": []}, "at least one command expected"),
        ({"commands": ["rm -rf folder"]}, "commands that begin with `sextant` or `python` expected"),
        ({"commands": ["sextant trials flat", "sextant trials steps"]}, "one command expected"),
        ({"modules": 3}, "modules"),
    ],
)
def test_wrong_part_is_refused(change: dict[str, object], expected: str) -> None:
    table = {"claim": "", "page": "", "commands": ["sextant fuzz"], "result": "a.json", "kept": "a.json", "modules": []}
    with pytest.raises(ConfigError, match=expected):
        build(table | {"core_hours": 1.0} | change, Part)


@pytest.fixture
def docs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder in place of docs/."""
    folder = tmp_path / "docs"
    folder.mkdir()
    monkeypatch.setattr(run, "DOCS", folder)
    monkeypatch.setattr(run.provenance, "commit", lambda: "HEAD")
    return folder


@pytest.mark.slow
def test_part_keeps_what_its_command_leaves(docs: Path, tmp_path: Path) -> None:
    said: list[str] = []
    found = run.run(PART, tmp_path / "out", "--jobs 1", math.inf, said.append)
    assert found is not None
    assert (found.commits, found.passed, found.digest) == (("HEAD",), True, Dependencies.of(PART.modules).digest())
    assert json.loads((docs / "size.json").read_text())
    assert said[0].startswith("$ python -m benchmarks size --out ")


def test_failed_limit_is_kept_and_failed_command_is_not(docs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "size.json").write_text("{}")
    monkeypatch.setattr(run, "_status", lambda *_: 1)
    found = run.run(PART, tmp_path, "", math.inf, lambda _: None)
    assert found is not None
    assert not found.passed
    (docs / "size.json").unlink()
    monkeypatch.setattr(run, "_status", lambda *_: 2)
    with pytest.raises(run.PartError, match="exit status 0 or 1 expected, found 2"):
        run.run(PART, tmp_path, "", math.inf, lambda _: None)
    (tmp_path / "size.json").unlink()
    monkeypatch.setattr(run, "_status", lambda *_: 1)
    with pytest.raises(run.PartError, match=r"size.json expected, found none"):
        run.run(PART, tmp_path, "", math.inf, lambda _: None)
    monkeypatch.setattr(run, "_status", lambda *_: None)
    assert run.run(PART, tmp_path, "", math.inf, lambda _: None) is None
    assert not (docs / "size.json").exists()


def test_code_that_changes_meanwhile_is_refused(docs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commits = iter(("aaaaaaa", "bbbbbbb", "bbbbbbb"))
    monkeypatch.setattr(run.provenance, "commit", lambda: next(commits))
    monkeypatch.setattr(run, "_status", lambda *_: 0)
    with pytest.raises(run.PartError, match="the code of commit aaaaaaa expected until the end, found bbbbbbb"):
        run.run(PART, tmp_path, "", math.inf, lambda _: None)


def test_command_is_interrupted_when_the_time_ends() -> None:
    words = ["sh", "-c", "trap 'exit 130' INT; while :; do :; done"]
    assert run._status(words, 0.0) is None
    assert run._status(["sh", "-c", "exit 1"], math.inf) == 1


def test_runs_of_several_commands_are_joined(docs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    several = replace(PART, commands=("sextant trials flat", "sextant trials steps"), result="trials.jsonl", kept="walks.jsonl")
    stored = results_store.read(part.DOCS / "by_touch.jsonl")[:2]
    folders = [step.folder for step in several.steps(tmp_path, "")]
    for folder, one, scenario in zip(folders, stored, ("flat", "steps"), strict=True):
        folder.mkdir()
        results_store.keep(folder / "trials.jsonl", [replace(one, scenario=scenario)])
    monkeypatch.setattr(run, "_status", lambda *_: 0)
    found = run.run(several, tmp_path, "", math.inf, lambda _: None)
    assert found is not None
    assert found.commits == (stored[0].commit,)
    assert [one.scenario for one in results_store.read(docs / "walks.jsonl")] == ["flat", "steps"]


def test_command_prints_standings_and_refuses_unknown_parts(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["campaign", "faults", "walks"]) == 0
    text = capsys.readouterr().out
    assert "| `faults` | Faults of processes" in text
    assert "of 2 hold by this code" in text
    assert cli.main(["campaign", "walks", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["walks"]["commands"][0].startswith("sextant trials all")
    assert cli.main(["campaign", "walk"]) == 2
    assert "no part 'walk'; did you mean 'walks'?" in capsys.readouterr().err


def test_failed_part_does_not_stop_the_others(
    docs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kept: list[set[str]] = []

    def ran(one: Part, *_: object) -> Evidence:
        if one.page == "fuzz":
            raise run.PartError("exit status 0 or 1 expected, found 2")
        return EVIDENCE

    monkeypatch.setattr(command, "run", ran)
    monkeypatch.setattr(evidences, "keep", lambda found: kept.append(set(found)))
    assert cli.main(["campaign", "fuzz", "size", "--run", "--json", "--out", str(tmp_path)]) == 1
    printed = capsys.readouterr()
    assert set(json.loads(printed.out)) == {"fuzz", "size"}
    assert "fuzz: exit status 0 or 1 expected, found 2\n" in printed.err
    assert printed.err.endswith("without a result: fuzz\n")
    assert len(kept) == 1
    assert "size" in kept[0]
