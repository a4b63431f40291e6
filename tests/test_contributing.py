"""CONTRIBUTING.md names only files, targets and names that exist."""

import re
from pathlib import Path

import pytest
import yaml

from sextant.services.planner.locomotion.gait import GAITS
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.servo.models import MODELS
from sextant.shared.servo.servo_model import ServoModel

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
NAMED = re.findall(r"\b(?:benchmarks|services|shared|evaluation|deploy|tests|docs|sextant)/[\w./]*", TEXT)
PATHS = sorted({path for path in NAMED if not path.startswith("docs/_build/")})  # except what `make docs` makes


@pytest.mark.parametrize("path", PATHS)
def test_named_path_exists(path: str) -> None:
    assert (ROOT / path.rstrip(".")).exists()


@pytest.mark.parametrize("target", sorted(set(re.findall(r"\bmake (\w+)", TEXT))))
def test_named_make_target_exists(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)


def test_named_extension_points_exist() -> None:
    assert all(isinstance(model, ServoModel) for model in MODELS)
    assert set(GAITS) == {"tripod", "ripple", "wave"}
    assert load_scenario("flat").name == "flat"


def test_citation_is_valid_yaml_with_package_version() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert f'version = "{cited["version"]}"' in project
    assert cited["license"] == "Apache-2.0"
    assert {reference["authors"][0]["family-names"] for reference in cited["references"]} == {"Lotriet", "Masri"}


def test_changelog_begins_with_package_version() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    newest, *older = re.split(r"^## ", text, flags=re.MULTILINE)[1:]
    assert f'version = "{newest.splitlines()[0]}"' in project
    assert older
    assert re.findall(r"^### (.*)$", newest, re.MULTILINE) == ["Added", "Changed", "Removed", "Fixed"]


def test_pre_commit_hooks_match_make_check() -> None:
    hooks = {hook["id"]: hook for hook in yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]}
    (recipe,) = re.findall(r"^check:[^\n]*\n((?:\t[^\n]*\n)+)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    tools = [line.removeprefix("\t$(BIN)/").split(" --check")[0].removesuffix(" .") for line in recipe.splitlines()]
    assert tools == ["ruff check", "ruff format", "mypy", "lint-imports"]
    for tool in tools:
        assert any(hook["entry"].startswith(f".venv/bin/{tool}") for hook in hooks.values()), tool


@pytest.mark.parametrize(
    ("subject", "length", "form"),
    [
        ("client: end goto with a reason", True, True),
        ("mapper, perception: write docstrings in plain English", True, True),
        ("Merge branch 'english'", True, True),
        ("x: " + 70 * "a", False, True),
        ("Did something", True, False),
    ],
)
def test_hooks_check_commit_subject(subject: str, length: bool, form: bool) -> None:
    hooks = {hook["id"]: hook for hook in yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]}
    text = f"{subject}\n\n{100 * 'b'}\n"
    assert (re.search(hooks["subject-length"]["entry"], text, re.MULTILINE) is None) == length
    assert (re.search(hooks["subject-form"]["entry"], text, re.MULTILINE) is not None) == form
