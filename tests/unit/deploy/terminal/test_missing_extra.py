"""Commands without the libraries of the extras: one sentence names the extra to install."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import click
import pytest

from sextant.deploy.terminal import missing_extra, run_command

ROOT = Path(__file__).parents[4]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
OWN_ERRORS = {"realsense", "openni", "oak", "orbbec", "imu"}  # extras with drivers, whose absence the camera or the IMU reports
FOR_CHECKOUTS = {"bench", "docs", "dev"}
BARE = """
import sys
sys.path.insert(0, {root!r})
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {modules!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
from sextant.deploy import cli
for line in sys.stdin.read().splitlines():
    sys.stderr.write(f"== {{line}}\\n")
    sys.stderr.write(f"status {{cli.main(line.split())}}\\n")
"""
COMMANDS = {
    "demo": "all",
    "run steps --lockstep": "all",
    "trials flat --seeds 0:1 --out runs": "all",
    "trials flat --seeds 0:1 --out runs --cluster local:2": "cluster",
    "up all --scenario steps": "all",
    "video runs": "all",
    "figures run runs": "all",
    "recording info runs": "recording",
    "recording recover runs": "recording",
    "record": "recording",
    "servos scan": "actuator",
    "servos emulate": "simulator",
    "doctor": "actuator",
    "keys new keys": "access",
    "topics foxglove": "foxglove",
    "topics ros2": "ros2",
    "robot export phantomx_mk2 --mjcf": "simulator",
}
WORKING = ("topics list", "service compose", "robot export phantomx_mk2 --urdf")  # with the base dependencies alone


def libraries(extra: str) -> set[str]:
    """Return the names of the libraries of an extra, those of the extras that it includes among them."""
    found = set()
    for requirement in EXTRAS[extra]:
        name, extras = re.match(r"([\w.-]+)(?:\[([\w,]+)\])?", requirement).groups()
        found |= {library for one in extras.split(",") for library in libraries(one)} if extras else {name}
    return found


def test_each_library_of_an_extra_has_a_remedy_that_brings_it():
    base = {re.match(r"[\w.-]+", requirement)[0] for requirement in PROJECT["dependencies"]}
    wanted = set().union(*(libraries(extra) for extra in EXTRAS.keys() - OWN_ERRORS - FOR_CHECKOUTS))
    known = {library for library, _ in missing_extra.EXTRAS.values()}
    assert wanted - base == known
    for library, extra in missing_extra.EXTRAS.values():
        assert library in libraries(extra)


@pytest.mark.slow
def test_command_without_its_libraries_names_the_extra(tmp_path):
    lines = [*COMMANDS, *WORKING]
    modules = tuple(missing_extra.EXTRAS)
    code = BARE.format(root=str(ROOT), modules=modules)
    done = subprocess.run(
        [sys.executable, "-c", code], input="\n".join(lines), capture_output=True, text=True, cwd=tmp_path, check=True
    )
    assert "Traceback" not in done.stderr
    told = dict(part.split("\n", 1) for part in done.stderr.removeprefix("== ").split("\n== "))
    for line, extra in COMMANDS.items():
        *words, status = told[line].strip().splitlines()
        assert status in ("status 1", "status 2"), line
        assert len(words) == 1, told[line]
        assert re.search(rf"pip install (-e )?'(sextant|\.)\[{extra}\]'", words[0]), told[line]
    for line in WORKING:
        assert told[line].strip() == "status 0"


def test_other_missing_module_is_a_fault_of_the_program():
    assert missing_extra.remedy(ModuleNotFoundError("No module named 'sextant.gone'", name="sextant.gone")) == ""
    assert missing_extra.remedy(ModuleNotFoundError("nothing is known")) == ""


def test_command_that_uvx_runs_without_an_extra_is_started_again_with_it(monkeypatch, capsys):
    started = []

    def replace(path, words):
        started.append((path, words))
        raise SystemExit(0)  # as `os.execv`, it does not return

    def run(words):
        raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco")

    monkeypatch.setattr(run_command.os, "execv", replace)
    monkeypatch.setattr(run_command, "parse", lambda _program, name, _argv: SimpleNamespace(path=name, run=lambda: run(name)))
    monkeypatch.setenv("UV", "/usr/bin/uv")
    monkeypatch.delenv("SEXTANT_STARTED_AGAIN", raising=False)
    assert run_command.run_command(click.Command("sextant"), "sextant", ["demo"]) == 2, "an environment that is to stay"
    monkeypatch.setattr(missing_extra.sys, "prefix", "/root/.cache/uv/archive-v0/abc")
    with pytest.raises(SystemExit):
        run_command.run_command(click.Command("sextant"), "sextant", ["demo", "--seed", "3"])
    path, words = started[0]
    assert path == words[0] == "/usr/bin/uv"
    assert words[1:3] == ["tool", "run"]
    assert words[words.index("--from") + 1].startswith("sextant[all]")
    assert words[-4:] == ["sextant", "demo", "--seed", "3"]
    assert run_command.run_command(click.Command("sextant"), "sextant", ["demo"]) == 2, "only once"
    assert len(started) == 1
    assert "the extra all brings it" in capsys.readouterr().err
