"""A secured router on loopback, valid and foreign keys, and a counting reader."""

import json
import threading
import time
from collections import Counter
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import zenoh

from sextant.deploy.security.authority import Authority
from sextant.shared.wire.access import ROLES, Keys
from sextant.shared.wire.topics import Topic
from sextant.shared.wire.transport import Endpoints, ZenohLink

NAMESPACE = "here"
PATIENCE_S = 10.0  # longest wait for an event
_REFUSAL_S = 1.5  # [s] for which an unauthorized client tries to connect


def make_keys(folder: Path) -> Path:
    """Create keys of each role, expired keys, and keys by another authority."""
    authority, other = Authority(days=30), Authority(days=30)
    for role in ROLES:
        authority.issue(folder / role.name, role.name)
    authority.issue(folder / "expired", "console", ends=datetime.now(UTC) - timedelta(days=1))
    other.issue(folder / "foreign", "console")
    return folder


def stranger(endpoint: str, tls: dict[str, Any] | None, mode: str = "client") -> zenoh.Session:
    """Try briefly to open a session with a client that has to be refused.

    Raises:
        zenoh.ZError: The router refuses it.
    """
    return session(endpoint, tls, mode, patience_s=_REFUSAL_S)


def session(
    endpoint: str, tls: dict[str, Any] | None, mode: str = "client", listen: str = "", patience_s: float = PATIENCE_S
) -> zenoh.Session:
    """Open a session without this project's rules; only the listener restricts it.

    Raises:
        zenoh.ZError: The router refuses it.
    """
    config: dict[str, Any] = {
        "mode": mode,
        "connect": {"endpoints": [endpoint], "timeout_ms": round(1e3 * patience_s), "exit_on_failure": True},
        "listen": {"endpoints": [listen] if listen else []},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}, "link": {"tls": tls or {}}},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def tls_of(folder: Path, trusted: Path | None = None) -> dict[str, Any]:
    """Return the TLS settings of a client, possibly with expired or foreign keys.

    `trusted` is the folder with the authority that the client accepts; the default is its own folder.
    """
    return {
        "root_ca_certificate": str((trusted or folder) / "ca.pem"),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "connect_private_key": str(folder / "key.pem"),
        "connect_certificate": str(folder / "certificate.pem"),
    }


class Inside:
    """A process on the robot's own machine that reads topics and counts their frames."""

    def __init__(self, plain: str, *topics: Topic[Any]):
        self.count: Counter[str] = Counter()
        self.newest: dict[str, bytes] = {}
        self._news = threading.Condition()
        self.link = ZenohLink(Endpoints((plain,), namespace=NAMESPACE))
        self.link.__enter__()
        for topic in topics:
            self.link.subscribe(topic, self._take)

    def _take(self, topic: Topic[Any], frame: bytes) -> None:
        with self._news:
            self.count[topic.key] += 1
            self.newest[topic.key] = frame
            self._news.notify_all()

    def until(self, done: Callable[[], bool], what: str) -> None:
        """Wait until a condition on the received frames holds."""
        with self._news:
            assert self._news.wait_for(done, PATIENCE_S), f"{what}; so far {dict(self.count)}"

    def close(self) -> None:
        self.link.__exit__(None, None, None)


def put_until(inside: Inside, link: ZenohLink, topic: Topic[Any], frame: bytes) -> None:
    """Send a frame repeatedly until it is received.

    The router has then processed all that this client sent before.
    """
    again(inside, topic, frame, lambda: link.send(topic, frame))


def again(inside: Inside, topic: Topic[Any], frame: bytes, put: Callable[[], object]) -> None:
    """Call `put` repeatedly until this frame is received on the topic."""
    until, pause = time.monotonic() + PATIENCE_S, threading.Event()
    while inside.newest.get(topic.key) != frame:
        assert time.monotonic() < until, f"{topic.key} does not come through; so far {dict(inside.count)}"
        put()
        pause.wait(0.02)


def keys_of(folder: Path, role: str) -> Keys:
    return Keys.load(folder / role)
