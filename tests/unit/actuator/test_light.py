"""The actuator is small: its installed size and the imports of its processes."""

import importlib.metadata
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

import pytest

from tests.support.distributions import closure

ROOT = Path(__file__).parents[3]
MOST_MB = 150.0
HEAVY = {"cv2", "numba", "mujoco", "kiss_icp", "scipy", "matplotlib", "llvmlite", "mcap"}


def megabytes(paths: Iterable[Path]) -> float:
    return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6


def own_files() -> Iterable[Path]:
    """Return the files of Sextant itself, which may be installed in place.

    Bytecode caches do not count.
    """
    found = (path for part in ("shared", "services", "evaluation", "deploy") for path in (ROOT / part).rglob("*"))
    return (path for path in found if "__pycache__" not in path.parts)


def test_actuator_extra_installs_in_at_most_150_mb() -> None:
    """Check the installed size without Python, pip and setuptools.

    Bytecode of other packages counts as far as it exists on this machine.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    names = closure([*project["dependencies"], *project["optional-dependencies"]["actuator"]])
    assert {"numpy", "eclipse-zenoh", "pyserial"} <= names
    assert not names & {"opencv-python-headless", "numba", "mujoco"}
    files = {name: importlib.metadata.files(name) or [] for name in names}
    assert all(files.values())
    sizes = {name: megabytes(Path(str(file.locate())) for file in found) for name, found in files.items()}
    sizes["sextant"] = megabytes(own_files())
    assert sum(sizes.values()) <= MOST_MB, sizes


@pytest.mark.slow
@pytest.mark.parametrize("process", ["sextant.services.actuator", "sextant.services.actuator.estop"])
def test_actuator_processes_import_no_heavy_packages(process: str) -> None:
    """List all modules that are imported when `process.main` is called."""
    look = (
        "import sys; from sextant.shared.runtime import process; process.main = lambda *_: None; "
        f"import {process}.__main__; print(*{{name.partition('.')[0] for name in sys.modules}})"
    )
    ran = subprocess.run([sys.executable, "-c", look], cwd=ROOT, capture_output=True, text=True, check=True)
    modules = set(ran.stdout.split())
    assert {"numpy", "sextant", "zenoh"} <= modules
    assert not modules & HEAVY
