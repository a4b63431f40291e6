"""Walk authorization: a stored walk order survives a restart until the walk ends."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.actuator.safety import walk_authorization as permit_files
from sextant.services.actuator.safety.command_ordering import WalkOrder
from sextant.services.actuator.safety.walk_authorization import WalkAuthorization

ORDER = WalkOrder("page 1 at a console", 123_456_789)


@given(st.text(min_size=1, max_size=100), st.integers(0, 2**63))
def test_what_is_kept_is_found_by_who_begins_anew(tmp_path_factory: pytest.TempPathFactory, holder: str, sequence: int) -> None:
    path = tmp_path_factory.mktemp("run") / "walk"
    WalkAuthorization(path).keep(WalkOrder(holder, sequence))
    assert WalkAuthorization(path).order == WalkOrder(holder, sequence)
    assert [file.name for file in path.parent.iterdir()] == ["walk"]


def test_what_has_ended_is_not(tmp_path: Path) -> None:
    authorization = WalkAuthorization(tmp_path / "walk")
    authorization.keep(ORDER)
    authorization.keep(None)
    assert WalkAuthorization(tmp_path / "walk").order is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "text", [b"", b"12", b"12 ", b"-3 a", b"1e3 a", "\u0663 a".encode(), b"\xff\xfe a", b"12" + 5000 * b"0" + b" a"]
)
def test_a_file_that_says_nothing_permits_nothing(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "walk").write_bytes(text)
    assert WalkAuthorization(tmp_path / "walk").order is None


def test_an_order_that_cannot_be_kept_leaves_none_of_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    authorization = WalkAuthorization(tmp_path / "walk")
    authorization.keep(ORDER)
    monkeypatch.setattr(Path, "write_text", lambda *_, **__: (_ for _ in ()).throw(OSError("no space left")))
    authorization.keep(WalkOrder("b", 5))
    assert authorization.trouble == ""
    assert WalkAuthorization(tmp_path / "walk").order is None


def test_one_that_cannot_be_taken_away_is_said_until_it_can(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    authorization = WalkAuthorization(tmp_path / "walk")
    authorization.keep(ORDER)
    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", lambda *_, **__: (_ for _ in ()).throw(OSError("read-only file system")))
        authorization.keep(None)
    assert (
        authorization.trouble
        == "a restarted actuator would resume an ended walk, its order cannot be deleted: read-only file system"
    )
    authorization.keep(None)
    assert authorization.trouble == ""
    assert WalkAuthorization(tmp_path / "walk").order is None


def test_it_belongs_to_one_port_and_to_the_first_folder_that_takes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(permit_files, "FOLDERS", (tmp_path / "not there", tmp_path))
    WalkAuthorization.of_port("/dev/ttyUSB0").keep(ORDER)
    assert WalkAuthorization.of_port("/dev/ttyUSB0").order == ORDER
    assert WalkAuthorization.of_port("/dev/ttyUSB1").order is None
    monkeypatch.setattr(permit_files, "FOLDERS", (tmp_path / "not there",))
    nowhere = WalkAuthorization.of_port("/dev/ttyUSB0")
    nowhere.keep(ORDER)
    assert (nowhere.order, nowhere.trouble) == (ORDER, "")
