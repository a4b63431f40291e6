"""A guarded router on loopback, keys of every role and of strangers, and a reader that counts what comes through."""

import json
import threading
import time
from collections import Counter
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import zenoh

from sextant.deploy.network.authority import Authority
from sextant.shared.wire.access import ROLES, Keys
from sextant.shared.wire.topics import Topic
from sextant.shared.wire.transport import Endpoints, ZenohLink

NAMESPACE = "here"
PATIENCE_S = 10.0  # an event that has not come by then never will
_REFUSAL_S = 1.5  # for which somebody tries who is not to be let in


def make_keys(folder: Path) -> Path:
    """A folder for each role, one that has expired, and one of another authority that has made the same roles."""
    authority, other = Authority(days=30), Authority(days=30)
    for role in ROLES:
        authority.issue(folder / role.name, role.name)
    authority.issue(folder / "expired", "console", ends=datetime.now(UTC) - timedelta(days=1))
    other.issue(folder / "foreign", "console")
    return folder


def stranger(endpoint: str, tls: dict[str, Any] | None, mode: str = "client") -> zenoh.Session:
    """A client that is not to be let in, and soon gives up.

    Raises:
        zenoh.ZError: It is not let in.
    """
    return session(endpoint, tls, mode, patience_s=_REFUSAL_S)


def session(
    endpoint: str, tls: dict[str, Any] | None, mode: str = "client", listen: str = "", patience_s: float = PATIENCE_S
) -> zenoh.Session:
    """A client that keeps to no rules of ours: only what the listener lets through comes through.

    Raises:
        zenoh.ZError: It is not let in.
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
    """What a client shows, of keys that may have expired or be foreign; `trusted` has the authority that it takes."""
    return {
        "root_ca_certificate": str((trusted or folder) / "ca.pem"),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "connect_private_key": str(folder / "key.pem"),
        "connect_certificate": str(folder / "certificate.pem"),
    }


class Inside:
    """A process of the robot's own machine that reads topics, and counts."""

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
        """Wait for something to have come."""
        with self._news:
            assert self._news.wait_for(done, PATIENCE_S), f"{what}; so far {dict(self.count)}"

    def close(self) -> None:
        self.link.__exit__(None, None, None)


def put_until(inside: Inside, link: ZenohLink, topic: Topic[Any], frame: bytes) -> None:
    """Put a frame again and again until it has come: what was put before it by the same client has then been judged."""
    again(inside, topic, frame, lambda: link.send(topic, frame))


def again(inside: Inside, topic: Topic[Any], frame: bytes, put: Callable[[], object]) -> None:
    """Likewise, by whatever puts it."""
    until, pause = time.monotonic() + PATIENCE_S, threading.Event()
    while inside.newest.get(topic.key) != frame:
        assert time.monotonic() < until, f"{topic.key} does not come through; so far {dict(inside.count)}"
        put()
        pause.wait(0.02)


def keys_of(folder: Path, role: str) -> Keys:
    return Keys.load(folder / role)
