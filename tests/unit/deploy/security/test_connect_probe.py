"""A refused machine logs each reason once while the refusal lasts."""

import threading
from pathlib import Path

import pytest

from sextant.deploy.security.connect_probe import ConnectProbe
from sextant.deploy.security.hosting import hosted
from sextant.deploy.security.router_security import Gate
from sextant.shared.wire.ports import free_port
from tests.support import gated


def test_each_refusal_reason_is_logged_once_until_admitted() -> None:
    told, reasons, connected = list[str](), ["no", "no", "", "no", "other"], [False]
    knocking = ConnectProbe(lambda: reasons.pop(0), lambda: connected[0], told.append)
    for _ in range(5):
        knocking.look()
    assert told == ["no", "no", "other"], "again after it was let in between"
    connected[0] = True
    knocking.look()
    assert reasons == []


def test_probe_starts_immediately_and_ends() -> None:
    asked = threading.Event()

    def ask() -> str:
        asked.set()
        return ""

    with ConnectProbe(ask, lambda: False, lambda _: None, pause_s=0.01) as knocking:
        assert asked.wait(gated.PATIENCE_S)
    knocking._thread.join(gated.PATIENCE_S)
    assert not knocking._thread.is_alive()


@pytest.mark.parametrize(
    ("who", "words"), [("base", ""), ("foreign", "is not the expected machine"), ("console", "cannot be reached")]
)
def test_probe_reports_refusal_reason(who: str, words: str, tmp_path: Path) -> None:
    keys = gated.make_keys(tmp_path)
    plain, secure, nowhere = (f"{kind}/127.0.0.1:{free_port()}" for kind in ("tcp", "tls", "tls"))
    here = Gate((plain, secure), gated.NAMESPACE, keys / "robot")
    with hosted(here) as router:
        at = nowhere if who == "console" else secure
        assert words in Gate((plain,), gated.NAMESPACE, keys / who, upstream=(at,)).knock()
        assert bool(Gate((plain,), gated.NAMESPACE, keys / who, upstream=(at,)).knock()) is bool(words)
        assert not router.chained
