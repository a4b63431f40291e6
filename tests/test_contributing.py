"""CONTRIBUTING.md names only files, targets and names that exist."""

import re
from pathlib import Path

import pytest
import yaml

from sextant.services.planner.locomotion.gait import GAITS
from sextant.shared.scenario import scenario
from sextant.shared.servo.dynamixel import MODELS, ServoModel

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
PATHS = sorted(set(re.findall(r"\b(?:services|shared|deploy|tests|docs|sextant)/[\w./]*", TEXT)))


@pytest.mark.parametrize("path", PATHS)
def test_a_path_exists(path: str) -> None:
    assert (ROOT / path.rstrip(".")).exists()


@pytest.mark.parametrize("target", sorted(set(re.findall(r"\bmake (\w+)", TEXT))))
def test_a_target_of_make_exists(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)


def test_the_names_that_it_tells_to_extend_exist() -> None:
    assert all(isinstance(model, ServoModel) for model in MODELS)
    assert set(GAITS) == {"tripod", "ripple", "wave"}
    assert scenario.load_scenario("flat").name == "flat"


def test_the_citation_is_valid_yaml_with_the_version_of_the_package() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert f'version = "{cited["version"]}"' in project
    assert cited["license"] == "Apache-2.0"
    assert {reference["authors"][0]["family-names"] for reference in cited["references"]} == {"Lotriet", "Masri"}
