"""Count unauthorized messages that pass a secured router.

The benchmark also sends too many and too large messages. Everything is on loopback, with temporary keys. A process of the
robot's own machine counts the messages that pass. After each kind, an authorized client sends a final marker message, so that
all messages before it have been processed.
"""

import dataclasses
import ssl
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from benchmarks.access import replay_attacks
from benchmarks.peers import kept
from sextant.deploy.security.authority import Authority
from sextant.deploy.security.hosting import hosted
from sextant.deploy.security.router_security import Gate
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.access import CERTIFICATE, KEY, ROLES, AccessError, Keys
from sextant.shared.wire.handshake import verdict
from sextant.shared.wire.messages import ModeCommand, VelocityCommand
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Endpoints, TransportError, ZenohLink

_NAMESPACE = "bench"
_PATIENCE_S = 20.0
_REPEAT_S = 0.02
_WORD = b"a last word: "
_TRIES = 20  # Zenoh sessions tried by a refused client; all other attempts are handshakes, which take less time


@dataclass(frozen=True, slots=True)
class Row:
    """Results for one kind of unauthorized message."""

    what: str
    tried: int
    through: int
    note: str = ""


class _Inside:
    """Counts messages that pass."""

    def __init__(self, link: ZenohLink):
        self.count = 0
        self._last = b""
        self._news = threading.Condition()
        for topic in (topics.STEP_PLAN, topics.MODE, topics.VELOCITY):
            link.subscribe(topic, self._take)

    def _take(self, _topic: AnyTopic, frame: bytes) -> None:
        with self._news:
            self.count += not frame.startswith(_WORD)
            self._last = frame
            self._news.notify_all()

    def settle(self, link: ZenohLink, what: str) -> int:
        """Return the number of messages received before a marker.

        The marker is sent by `link`, and does not count.
        """
        words, until = _WORD + what.encode(), time.monotonic() + _PATIENCE_S
        with self._news:
            while self._last != words:
                if time.monotonic() > until:
                    raise TransportError("the last message did not arrive; is this machine very busy?")
                link.send(topics.MODE, words)
                self._news.wait(_REPEAT_S)
        with self._news:
            count, self.count = self.count, 0
            return count


@contextmanager
def _robot(folder: Path) -> Iterator[tuple[str, str]]:
    """Host a secured router with keys of every role.

    There are also an expired and a foreign certificate. Yield the endpoints without and with TLS.
    """
    authority, other = Authority(days=1), Authority(days=1)
    for role in ROLES:
        authority.issue(folder / role.name, role.name)
    authority.issue(folder / "expired", "console", ends=datetime.now(UTC) - timedelta(hours=1))
    other.issue(folder / "foreign", "console")
    plain, secure = f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}"
    gate = Gate((plain, secure), _NAMESPACE, folder / "robot")
    with hosted(gate):
        yield plain, secure


def measure(messages: int, say: Callable[[str], None] = lambda _: None) -> tuple[Row, ...]:
    """Try all kinds, with `messages` attempts each."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name, _robot(Path(name)) as (plain, secure):
        folder = Path(name)

        def link(role: str) -> ZenohLink:
            return ZenohLink(Endpoints((secure,), namespace=_NAMESPACE, keys=Keys.load(folder / role)))

        with ZenohLink(Endpoints((plain,), namespace=_NAMESPACE)) as own, link("base") as base:
            inside = _Inside(own)
            for row in (
                *_refused(folder, secure, messages),
                *_kept_back(inside, base, link, messages),
            ):
                say(f"{row.what}: {row.through} of {row.tried}")
                rows.append(row)
    for done in replay_attacks.measure(messages, say):
        note = "; ".join(done.said)
        rows.append(Row(done.what, done.tried, done.obeyed, f"not obeyed: {note}" if note else ""))
        say(f"{rows[-1].what}: {rows[-1].through} of {rows[-1].tried}")
    return tuple(rows)


def _refused(folder: Path, secure: str, messages: int) -> Iterator[Row]:
    """Yield results for clients that are not accepted."""
    known = Keys.load(folder / "console")
    kinds = (
        ("certificate that has expired", dataclasses.replace(known, folder=folder / "expired")),
        ("certificate of a foreign authority", dataclasses.replace(known, folder=folder / "foreign")),
        ("no certificate", None),
    )
    with ThreadPoolExecutor(len(kinds)) as at_once:
        tried = [at_once.submit(_knock, what, keys, secure, messages) for what, keys in kinds]
        yield from (one.result() for one in tried)


def _knock(what: str, keys: Keys | None, endpoint: str, messages: int) -> Row:
    """Try to connect as a client of Sextant, then as a stranger.

    The client reports the reason for its refusal. The stranger only makes handshakes.
    """
    opened, took_s, why = 0, [], ""
    for _ in range(_TRIES):
        began = time.perf_counter()
        try:
            with ZenohLink(Endpoints((endpoint,), namespace=_NAMESPACE, keys=keys)):
                opened += 1
        except (TransportError, AccessError, ValueError) as error:
            why = str(error)
        took_s.append(time.perf_counter() - began)
    stranger = _stranger(None if keys is None else keys.folder)
    opened += sum(not verdict(endpoint, stranger, _PATIENCE_S) for _ in range(_TRIES, messages))
    told = f"refused within {1e3 * max(took_s):.0f} ms: {why.partition('; ')[0]}"
    return Row(what, max(_TRIES, messages), opened, told)


def _stranger(folder: Path | None) -> ssl.SSLContext:
    """Return the TLS context of a stranger.

    It has the certificate of a folder, or none, and does not verify the robot's certificate.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    if folder is not None:
        context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
    return context


def _put(link: ZenohLink, topic: AnyTopic, frame: bytes, messages: int) -> None:
    """Send a frame `messages` times.

    The rate is below that of the client's queue, so that only the router drops messages.
    """
    for number in range(messages):
        link.send(topic, frame)
        if number % 50 == 49:
            time.sleep(0.005)
    time.sleep(0.3)


def _kept_back(inside: _Inside, base: ZenohLink, link: Callable[[str], ZenohLink], messages: int) -> Iterator[Row]:
    """Yield results for accepted clients that send messages without permission."""
    frame = codec.encode(ModeCommand(1, "walk", 1, "bench"))
    for role, topic in (("console", topics.STEP_PLAN), ("viewer", topics.MODE), ("viewer", topics.VELOCITY)):
        with link(role) as client:
            inside.settle(base, "before")
            _put(client, topic, frame, messages)
            yield Row(f"{role} publishes {topic.key}", messages, inside.settle(base, f"after {role} {topic.key}"))
    with link("console") as client:
        inside.settle(client, "before the flood")
        began = time.perf_counter()
        for number in range(messages):
            client.send(topics.MODE, frame)
            wait = began + number * 1e-4 - time.perf_counter()
            if wait > 0.0:
                time.sleep(wait)
        took = time.perf_counter() - began
        time.sleep(0.3)
        through = inside.settle(base, "after the flood")
        note = f"{messages / took:.0f} Hz for {took:.1f} s, passed at {through / took:.0f} Hz"
        yield Row("flood on operator/mode, by an authorised client", messages, through, note)
        large = codec.encode(VelocityCommand(1, np.zeros(2), 0.0, 0.1, 0.04)) + bytes(10_000_000)
        for _ in range(10):
            client.send(topics.VELOCITY, large)
        time.sleep(0.5)
        yield Row("10 MB on operator/velocity, by an authorised client", 10, inside.settle(base, "after the large"))


def in_words(rows: tuple[Row, ...]) -> str:
    """Return the rows as a Markdown table."""
    lines = ["| what | tried | came through | |", "|---|---|---|---|"]
    return "\n".join([*lines, *(f"| {row.what} | {row.tried} | {row.through} | {_cell(row.note)} |" for row in rows)])


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def to_json(rows: tuple[Row, ...]) -> str:
    """Return the rows as JSON."""
    return kept.rows_to_json(rows)


def from_json(text: str) -> tuple[Row, ...]:
    """Read rows written by `to_json`."""
    return tuple(kept.rows_from_json(text, Row))
