"""What a release states about its dependencies: versions, hashes and licences."""

import importlib.metadata
import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.support.distributions import closure

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
HASHED = (ROOT / "requirements.txt").read_text(encoding="utf-8")
PERMISSIVE = {
    "0BSD",
    "Apache Software License",
    "Apache-2.0",
    "BSD License",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "3-Clause BSD License",
    "CC0-1.0",
    "ISC License (ISCL)",
    "LLVM-exception",
    "MIT",
    "MIT License",
    "MIT-0",
    "MIT-CMU",
    "PSF-2.0",
    "Python Software Foundation License",
    "Zlib",
}
NAMED = {  # licences that are not permissive, or not named: docs/platforms.md
    "apsw": "any-OSI",  # any licence that the Open Source Initiative has approved
    "tqdm": "MPL-2.0 AND MIT",
}


def dependencies(*extras: str) -> set[str]:
    """Return the names of the distributions that Sextant needs here with some extras."""
    wanted = [text for extra in extras for text in PROJECT["optional-dependencies"][extra]]
    own = [text for text in wanted if text.startswith("sextant[")]
    inner = [extra for text in own for extra in sorted(Requirement(text).extras)]
    found = closure([*PROJECT["dependencies"], *(text for text in wanted if text not in own)])
    return found | dependencies(*inner) if inner else found


def pinned(text: str) -> dict[str, str]:
    """Return name -> version of a file of pins."""
    return {canonicalize_name(name): version for name, version in re.findall(r"^([\w.-]+)==([\w.]+)", text, re.MULTILINE)}


def licence(name: str) -> str:
    """Return the licence that the metadata of a distribution state: an expression, else classifiers, else a text."""
    about = importlib.metadata.metadata(name)
    classified = [one.rpartition(" :: ")[2] for one in about.get_all("Classifier") or [] if one.startswith("License :: OSI")]
    return about.get("License-Expression") or " OR ".join(classified) or about.get("License") or ""


def is_permissive(expression: str) -> bool:
    """Return whether one of the licences to choose from is permissive in all its parts."""
    return any(all(part in PERMISSIVE for part in re.split(" AND | WITH ", one)) for one in expression.split(" OR "))


def test_hashed_requirements_are_those_of_the_constraints() -> None:
    assert pinned(HASHED).items() - pinned((ROOT / "constraints.txt").read_text(encoding="utf-8")).items() == {
        ("colorama", pinned(HASHED)["colorama"])  # for Windows alone, where nothing is tested
    }


@pytest.mark.parametrize("extra", ["actuator", "onboard", "offboard", "simulator", "all"])
def test_hashed_requirements_are_all_that_an_extra_needs(extra: str) -> None:
    assert dependencies(extra) <= set(pinned(HASHED))


def test_each_requirement_has_hashes_and_names_no_index() -> None:
    entries = re.split(r"^(?=\w)", re.sub(r"^#.*\n", "", HASHED, flags=re.MULTILINE), flags=re.MULTILINE)[1:]
    assert len(entries) == len(pinned(HASHED))
    for entry in entries:
        assert re.fullmatch(r"[\w.-]+==[\w.]+( ; [^\\\n]+)?( \\\n    --hash=sha256:[0-9a-f]{64})+\n", entry), entry[:200]


@pytest.mark.parametrize("name", sorted(dependencies("all")))
def test_dependency_has_a_permissive_or_named_licence(name: str) -> None:
    found = licence(name)
    assert found == NAMED[name] if name in NAMED else is_permissive(found)


def test_copyleft_is_no_permissive_licence() -> None:
    assert is_permissive("Apache-2.0 WITH LLVM-exception")
    assert is_permissive("GPL-3.0-only OR MIT")
    assert not any(map(is_permissive, ("", "MPL-2.0 AND MIT", "GPL-3.0-only", "GNU Lesser General Public License")))


def test_tools_of_a_release_are_pinned() -> None:
    (tools,) = re.findall(r"^RELEASE_TOOLS := (.*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert all(re.fullmatch(r"[\w-]+==[\d.]+", tool) for tool in tools.split())
