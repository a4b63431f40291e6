import contextlib
import socket

import pytest

from sextant.shared.wire import ports
from sextant.shared.wire.ports import NoFreePortError, free_port, port_taken


def test_free_port_is_not_taken() -> None:
    assert not port_taken(free_port())


def test_listening_process_takes_its_port() -> None:
    with contextlib.closing(socket.create_server(("127.0.0.1", 0))) as server:
        assert port_taken(server.getsockname()[1])


def test_free_port_is_not_returned_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Never return one port twice, although nothing listens on it yet."""
    monkeypatch.setattr(ports, "_PORTS", range(20_000, 20_040))
    monkeypatch.setattr(ports, "port_taken", lambda _: False)
    given = [free_port() for _ in range(20)]
    assert len(set(given)) == len(given)


def test_no_free_port_names_the_range_and_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "port_taken", lambda _: True)
    with pytest.raises(NoFreePortError, match=r"no free TCP port in 20000 to 32000 on 127\.0\.0\.1; close programs"):
        free_port()
