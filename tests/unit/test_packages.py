"""Every folder of the program is a package that the checkout has: one that is ignored is neither checked nor shipped."""

import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PARTS = ("shared", "services", "evaluation", "deploy")
FOLDERS = sorted({path.parent.relative_to(ROOT) for part in PARTS for path in (ROOT / part).rglob("*.py")})


@pytest.mark.parametrize("folder", FOLDERS, ids=str)
def test_program_folder_is_package_with_docstring(folder: Path) -> None:
    words = (ROOT / folder / "__init__.py").read_text(encoding="utf-8")
    assert words.startswith('"""')


def test_no_program_file_is_ignored_by_git() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("no checkout of git")
    asked = "\0".join(f"{folder}/any.py" for folder in FOLDERS)
    command = ["git", "check-ignore", "--stdin", "-z"]
    done = subprocess.run(command, cwd=ROOT, input=asked, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, ""), "nothing is ignored"
