"""Walk authorization: a stored walk order survives a restart until the walk ends."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.actuator.safety import walk_authorization as permit_files
from sextant.services.actuator.safety.command_ordering import WalkOrder
from sextant.services.actuator.safety.walk_authorization import WalkAuthorization

ORDER = WalkOrder("page 1 at a console", 123_456_789)


@pytest.mark.slow
@given(st.text(min_size=1, max_size=100), st.integers(0, 2**63))
def test_kept_walk_order_is_loaded_after_restart(tmp_path_factory: pytest.TempPathFactory, holder: str, sequence: int) -> None:
    path = tmp_path_factory.mktemp("run") / "walk"
    WalkAuthorization(path).keep(WalkOrder(holder, sequence))
    assert WalkAuthorization(path).order == WalkOrder(holder, sequence)
    assert [file.name for file in path.parent.iterdir()] == ["walk"]


def test_ended_walk_order_is_deleted(tmp_path: Path) -> None:
    authorization = WalkAuthorization(tmp_path / "walk")
    authorization.keep(ORDER)
    authorization.keep(None)
    assert WalkAuthorization(tmp_path / "walk").order is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "text", [b"", b"12", b"12 ", b"-3 a", b"1e3 a", "\u0663 a".encode(), b"\xff\xfe a", b"12" + 5000 * b"0" + b" a"]
)
def test_invalid_file_gives_no_walk_order(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "walk").write_bytes(text)
    assert WalkAuthorization(tmp_path / "walk").order is None


def test_failed_write_deletes_previous_walk_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    authorization = WalkAuthorization(tmp_path / "walk")
    authorization.keep(ORDER)
    monkeypatch.setattr(Path, "write_text", lambda *_, **__: (_ for _ in ()).throw(OSError("no space left")))
    authorization.keep(WalkOrder("b", 5))
    assert authorization.trouble == ""
    assert WalkAuthorization(tmp_path / "walk").order is None


def test_failed_deletion_is_reported_until_it_succeeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_authorization_is_per_port_in_first_writable_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(permit_files, "FOLDERS", (tmp_path / "not there", tmp_path))
    WalkAuthorization.of_port("/dev/ttyUSB0").keep(ORDER)
    assert WalkAuthorization.of_port("/dev/ttyUSB0").order == ORDER
    assert WalkAuthorization.of_port("/dev/ttyUSB1").order is None
    monkeypatch.setattr(permit_files, "FOLDERS", (tmp_path / "not there",))
    nowhere = WalkAuthorization.of_port("/dev/ttyUSB0")
    nowhere.keep(ORDER)
    assert (nowhere.order, nowhere.trouble) == (ORDER, "")
