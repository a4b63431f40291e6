"""Count what a router refuses, by kind.

This module is pure: its inputs are lines of Zenoh's log and refused connections. A refused connection is named by the fault of
its certificate (`sextant.deploy.security.tls_proxy`). A refused message is named by the role of its sender's certificate and by
its key. Both are read from Zenoh's log, because Zenoh reports them only there. Other lines of the log are passed on unchanged.
"""

import re
import threading
from collections import Counter
from collections.abc import Iterator

LEVELS = (  # Zenoh's log levels, in the format of RUST_LOG
    "warn,zenoh::net::routing::interceptor=trace,zenoh::net::routing::interceptor::authorization=error,"
    "zenoh::net::runtime::orchestrator=error,zenoh::net::routing::hat=off"
)
_KINDS = 64  # maximum number of kinds: all further ones share one
_CLIENTS = 256  # maximum number of clients whose certificates are remembered
_BURST = 100  # messages per second above the limit that are tolerated: a stalled stream arrives in a burst
_OTHERS = "other kinds"
_COLOR = re.compile(r"\x1b\[[0-9;]*m")
_SECOND = re.compile(r"^(\S+)\.\d+Z? ")
_MESSAGE = re.compile(r" (?:TRACE|DEBUG|INFO)\s+(?:(?P<thread>.*?) )?zenoh::\S+: (?P<words>.*)$")
_WHO = re.compile(r"^(?P<zid>[0-9a-f]+) on .*?(?:CertCommonName\((?P<who>[^)]*)\)|Transport\((?P<link>\w+)\))")
_DENIED = re.compile(r"(?P<zid>[0-9a-f]+)(?: on \S+)? is unauthorized to (?P<what>.+?) \((?P<flow>\w+)\) on (?P<key>\S+)")
_THINNED = re.compile(r"Message dropped by the downsampling interceptor: Push\((?P<key>[^)]*)\) from:\S*?/(?P<zid>[0-9a-f]+)")
_TOO_OFTEN = re.compile(r" comes too often from ")
_INTERCEPTED = "Msg intercepted!"
_FULL = re.compile(r"[Dd]efragmentation")
_WORDS = {  # verb for each operation in the log
    "Put": "publish",
    "Delete": "delete",
    "Declare Subscriber": "subscribe to",
    "Query": "query",
}
_QUIET = ("machine/presence/", "health/")  # published by a machine's own processes: their refusal is not reported


class RefusedConnections:
    """Thread-safe counter of refused connections."""

    def __init__(self) -> None:
        self._count: Counter[str] = Counter()
        self._lock = threading.Lock()

    def add(self, kind: str) -> None:
        """Count one refusal."""
        with self._lock:
            self._count[kind] += 1

    def take(self) -> Counter[str]:
        """Return the counts since the last call."""
        with self._lock:
            count, self._count = self._count, Counter()
        return count


class Refusals:
    """Counts of all refusals."""

    def __init__(self, namespace: str):
        """Start with empty counts; `namespace` is removed from reported keys."""
        self._prefix = f"{namespace}/"
        self.count: Counter[str] = Counter()  # kind as text -> count
        self.newest = ""  # newest kind
        self._soon: dict[str, tuple[str, int]] = {}  # kind -> second of the log, and number of messages above the limit in it
        self._before: dict[str, str] = {}  # thread -> its last line
        self._who: dict[str, str] = {}  # id of a session -> common name of its certificate

    def read(self, text: str) -> Iterator[str]:
        """Process lines of the log; yield the lines that are not about refusals."""
        for line in text.splitlines():
            if not line.isascii() or "\x1b" in line:
                line = _COLOR.sub("", line)
            kind = self._kind(line)
            if kind is None:
                yield line
            elif kind and (number := self._weight(kind, line)):
                self.add(kind, number)

    def words(self) -> str:
        """Return all kinds with their counts, the most frequent first."""
        return ", ".join(f"{kind}: {number} times" for kind, number in self.count.most_common())

    def _weight(self, kind: str, line: str) -> int:
        """Return how many refusals a line counts for.

        Messages that are too frequent count 0 while they may be a burst. As soon as they are more, the whole burst counts.
        """
        if not _TOO_OFTEN.search(kind):
            return 1
        stamp = _SECOND.match(line)
        second = stamp[1] if stamp is not None else ""
        before, number = self._soon.get(kind, (second, 0))
        number = number + 1 if before == second else 1
        self._soon[kind] = second, number
        if len(self._soon) > _KINDS:
            del self._soon[next(iter(self._soon))]
        return 0 if number <= _BURST else _BURST + 1 if number == _BURST + 1 else 1

    def add(self, kind: str, number: int) -> None:
        """Count refusals of a kind."""
        if kind not in self.count and len(self.count) >= _KINDS:
            kind = _OTHERS
        self.count[kind] += number
        self.newest = kind

    def _kind(self, line: str) -> str | None:
        """Return the kind of refusal in a line as text.

        Return an empty string for a related line without a refusal, None for any other line.
        """
        message = _MESSAGE.search(line)
        if message is not None:
            return self._of_message(message["thread"] or "", message["words"])
        return "a message larger than any topic allows" if _FULL.search(line) else None

    def _of_message(self, thread: str, words: str) -> str:
        """Return the kind of refusal of a message, or "" if it was not refused.

        The reason is in the previous line of the same thread.
        """
        if words == _INTERCEPTED:
            return self._why(self._before.pop(thread, ""))
        self._before[thread] = words
        if (known := _WHO.match(words)) is not None:
            self._who[known["zid"]] = known["who"] or f"a client without a certificate ({known['link'].lower()})"
            if len(self._who) > _CLIENTS:
                del self._who[next(iter(self._who))]
        return ""

    def _why(self, words: str) -> str:
        if (denied := _DENIED.search(words)) is not None and denied["flow"] == "ingress":
            key = denied["key"].removeprefix(self._prefix)
            who = self._who.get(denied["zid"], "an unknown client")
            own = key in {f"{quiet}{who}" for quiet in _QUIET}
            return "" if own else f"{who} may not {_WORDS.get(denied['what'], denied['what'].lower())} {key}"
        if (thinned := _THINNED.search(words)) is not None:
            who = next((name for zid, name in self._who.items() if zid.startswith(thinned["zid"])), "an unknown client")
            return f"{thinned['key'].removeprefix(self._prefix)} comes too often from {who}"
        return ""
