"""Mark of a warm-up: it holds until source, compiled code, versions or processor change, in any folder."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from sextant.shared.runtime import warm_up_mark

SEARCH = "roadmap_search.grow-1.py311.nbi"


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a package with a source file and compiled code."""
    folder = tmp_path / "package"
    folder.mkdir()
    for name in ("loops.py", "loops.add-1.py311.nbi", SEARCH):
        (folder / name).write_text("1")
    use(folder, monkeypatch)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    return folder


def use(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the mark be that of a package in a folder."""
    monkeypatch.setattr(warm_up_mark, "_PACKAGE", folder)
    monkeypatch.setattr(warm_up_mark, "MARK", folder / "cache" / "warm_up.txt")


def test_warm_up_is_complete_until_source_cache_or_processor_change(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def changes(change: Callable[[], object]) -> bool:
        warm_up_mark.write()
        assert warm_up_mark.is_complete(whole=True)
        change()
        return not warm_up_mark.is_complete(whole=True)

    assert not warm_up_mark.is_complete(whole=False)
    assert changes(lambda: (package / "more.py").write_text("1")), "added"
    assert changes(lambda: (package / "more.py").write_text("2")), "changed"
    assert not changes((package / "notes.txt").touch)
    assert not changes((package / "more.add-1.py311.nbi").touch), "the planner compiles later"
    assert changes((package / "more.add-1.py311.nbi").unlink)
    assert changes(lambda: monkeypatch.setenv("NUMBA_CPU_NAME", "another"))
    assert changes(lambda: monkeypatch.setenv("NUMBA_CACHE_DIR", str(package)))


def test_warm_up_without_gap_crossings_does_not_count_for_a_course_with_a_gap(package: Path) -> None:
    (package / SEARCH).unlink()
    warm_up_mark.write()
    assert warm_up_mark.is_complete(whole=False)
    assert not warm_up_mark.is_complete(whole=True)


def test_mark_holds_in_another_folder(package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    warm_up_mark.write()
    use(shutil.copytree(package, tmp_path / "installed"), monkeypatch)
    assert warm_up_mark.is_complete(whole=True)
