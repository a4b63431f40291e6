"""A wheel with the compiled inner loops: an installed package compiles nothing."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LEFT_OUT = (".*", "__pycache__", "*.egg-info", "build", "dist", "runs", "_build")
WARM_UP = """
from sextant.deploy.launch import warm_up
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime import compile_progress, warm_up_mark
from sextant.shared.scenario.loading import load_scenario

print(warm_up_mark.__file__, warm_up_mark.is_complete(whole=True))
warm_up.compile_functions(load_profile(load_scenario("puddle").robot), "puddle")
functions = compile_progress._compiled_functions()
print(any(one.stats.cache_hits for one in functions), any(one.stats.cache_misses for one in functions))
"""


@pytest.mark.rare
def test_package_installed_from_wheel_compiles_nothing(tmp_path: Path) -> None:
    source, installed = tmp_path / "source", tmp_path / "installed"
    shutil.copytree(ROOT, source, symlinks=True, ignore=shutil.ignore_patterns(*LEFT_OUT))
    outside = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "NUMBA_CACHE_DIR")}
    build = [sys.executable, "-m", "pip", "--quiet", "wheel", "--no-deps", "--wheel-dir", str(tmp_path), "."]
    subprocess.run(build, cwd=source, env=outside | {"SEXTANT_COMPILE": sys.executable}, check=True, timeout=1200)
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.stem.endswith(f"-py3-none-{re.sub('[-.]', '_', sysconfig.get_platform())}")
    zipfile.ZipFile(wheel).extractall(installed)
    for path in installed.rglob("*.nb[ci]"):
        assert not re.search(f"{tmp_path}|{sys.prefix}/|{sys.base_prefix}/lib".encode(), path.read_bytes()), path
    for place in ({}, {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}):  # the second stands for a folder without write permission
        around = outside | {"PYTHONPATH": str(installed), **place}
        done = subprocess.run(
            [sys.executable, "-c", WARM_UP], cwd=tmp_path, env=around, capture_output=True, text=True, check=True, timeout=300
        )
        where, complete, loaded, compiled = done.stdout.split()
        assert Path(where).is_relative_to(installed)
        assert complete == str(not place)
        assert (loaded, compiled) == ("True", "False")
