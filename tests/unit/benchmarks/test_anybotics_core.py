"""ANYbotics' map update: what is taken from its sources, and what is said if it cannot be built."""

import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks import cli
from benchmarks.peers import anybotics_core
from benchmarks.peers.anybotics_core import BuildError, build

SOURCE = """
bool ElevationMap::add(int a) {
  if (a) {
    return true;
  }
}

bool ElevationMap::update() {
}

bool ElevationMap::clean() {
  return true;
}
"""
HEADER = "class ElevationMap {\n  struct Parameters {\n    double min_{0.1};\n  };\n  int last;\n};\n"


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    package = tmp_path / "elevation_mapping" / "elevation_mapping"
    for folder in (
        package / "src",
        package / "include/elevation_mapping",
        tmp_path / "grid_map/grid_map_core",
        tmp_path / "eigen3",
    ):
        folder.mkdir(parents=True)
    (package / "src/ElevationMap.cpp").write_text(SOURCE, encoding="utf-8")
    (package / "include/elevation_mapping/ElevationMap.hpp").write_text(HEADER, encoding="utf-8")
    return tmp_path


def test_functions_are_taken_unchanged_and_a_failed_compiler_is_quoted(sources: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: "/usr/bin/c++")
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=1, stderr="core.inc:3: error: no map"))
    with pytest.raises(BuildError, match=r"the compiler failed: core\.inc:3: error: no map"):
        build(sources, sources)
    core = (sources / "core.inc").read_text(encoding="utf-8")
    assert (
        core
        == SOURCE[1 : SOURCE.index("\nbool ElevationMap::update")] + "\n" + SOURCE[SOURCE.index("bool ElevationMap::clean") :]
    )
    assert (sources / "parameters.inc").read_text(encoding="utf-8") == "  struct Parameters {\n    double min_{0.1};\n  };\n"


def test_incomplete_sources_are_named(sources: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(BuildError, match=r"a C\+\+ compiler named c\+\+ expected"):
        build(sources, sources)
    monkeypatch.setattr(shutil, "which", lambda _: "/usr/bin/c++")
    (sources / anybotics_core._PACKAGE / "src/ElevationMap.cpp").write_text("", encoding="utf-8")
    with pytest.raises(BuildError, match="they may be of another version"):
        build(sources, sources)
    (sources / "eigen3").rmdir()
    with pytest.raises(BuildError, match=r"a folder eigen3 in .* expected"):
        build(sources, sources)


def test_stages_command_refuses_folder_without_sources(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["stages", "--anybotics", str(tmp_path), "--out", str(tmp_path)]) == 1
    assert "--anybotics: a folder elevation_mapping/elevation_mapping" in capsys.readouterr().err
