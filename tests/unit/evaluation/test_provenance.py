import datetime
import shutil
import subprocess
from pathlib import Path

import pytest

from sextant.evaluation import provenance
from sextant.evaluation.provenance import Made


def test_commit_of_checkout_marks_uncommitted_changes(tmp_path, monkeypatch):
    if shutil.which("git") is None:
        pytest.skip("git is not installed, so there is no checkout to ask")
    module = tmp_path / "deploy" / "provenance.py"
    module.parent.mkdir()
    module.write_text("one")

    def git(*words: str) -> str:
        name = ("-c", "user.name=n", "-c", "user.email=e@example.org")
        return subprocess.run(["git", *name, *words], cwd=tmp_path, check=True, capture_output=True, text=True).stdout.strip()

    git("init")
    git("add", ".")
    git("commit", "-m", "one")
    monkeypatch.setattr(provenance, "_ROOT", tmp_path)
    head = git("rev-parse", "HEAD")
    assert provenance.commit() == head[:7]
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "runs.jsonl").write_text("1\n")
    git("add", "docs")
    assert provenance.commit() == head[:7]  # kept data do not change the program
    seeds = provenance.seeds_of_commit(100)
    assert len(set(seeds)) == 100
    assert seeds == provenance.seeds_of_commit(100)
    assert 1_000_000 <= min(seeds) < max(seeds) < 2**31
    module.write_text("two")
    assert provenance.commit() == head[:7] + "+"
    with pytest.raises(ValueError, match="a checkout without changes expected"):
        provenance.seeds_of_commit(100)
    git("commit", "-am", "two")
    assert not set(seeds) & set(provenance.seeds_of_commit(100))


def test_commit_without_checkout_is_package_version(tmp_path, monkeypatch):
    monkeypatch.setattr(provenance, "_ROOT", tmp_path)
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert provenance.commit() in ("", f"version {provenance.version()}")


def test_now_is_utc_with_one_second_resolution():
    moment = datetime.datetime.fromisoformat(provenance.now())
    assert moment.utcoffset() == datetime.timedelta(0)
    assert moment.microsecond == 0


def test_provenance_of_mixed_results_lists_all_commits():
    marks = [("b", "2024-01-03T00:00:00+00:00"), ("a", "2024-01-01T00:00:00+00:00"), ("", "")]
    made = Made.of(marks)
    assert made == Made(("a", "b"), "2024-01-01T00:00:00+00:00", "2024-01-03T00:00:00+00:00")
    assert made.words == "at commit a, b on 2024-01-01 to 2024-01-03"
    assert Made.of([("", "")]).words == "by an unknown commit"
    assert Path(provenance.__file__).is_file()


def test_machine_name_is_processor_model(monkeypatch):
    assert provenance.machine().strip()
    monkeypatch.setattr(
        Path, "read_text", lambda *_args, **_more: "processor\t: 0\nmodel name\t: A Fast One\nmodel name\t: B\n"
    )
    assert provenance.machine() == "A Fast One"


def test_results_of_one_commit_are_stated_once_with_all_their_days():
    of = [Made(("b",), f"2026-01-0{day}T10:00", f"2026-01-0{day}T12:00") for day in (3, 1, 2)]
    joined = Made.joined([*of, Made(("a",)), Made()])
    assert [made.words for made in joined] == [
        "by an unknown commit",
        "at commit a",
        "at commit b on 2026-01-01 to 2026-01-03",
    ]
