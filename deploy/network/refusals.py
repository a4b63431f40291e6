"""Counts of what a router refuses, by kind. Pure: lines of Zenoh's log and refused connections come in.

A refused connection is named by its certificate's fault (`sextant.deploy.network.tls_proxy`), a refused message by the role
of its sender's certificate and its key: that is read from Zenoh's log, the only place where Zenoh reports it. A line of the log
about anything else is passed on as it is.
"""

import re
import threading
from collections import Counter
from collections.abc import Iterator

LEVELS = (  # of Zenoh's log, as RUST_LOG has them
    "warn,zenoh::net::routing::interceptor=trace,zenoh::net::routing::interceptor::authorization=error,"
    "zenoh::net::runtime::orchestrator=error,zenoh::net::routing::hat=off"
)
_KINDS = 64  # that are told apart: who puts to a thousand keys is told of in one line
_CLIENTS = 256  # whose certificates are remembered
_BURST = 100  # messages a second that may come too soon behind another: a stream that stalled comes all at once
_OTHERS = "more than can be named"
_COLOR = re.compile(r"\x1b\[[0-9;]*m")
_SECOND = re.compile(r"^(\S+)\.\d+Z? ")
_MESSAGE = re.compile(r" (?:TRACE|DEBUG|INFO)\s+(?:(?P<thread>.*?) )?zenoh::\S+: (?P<words>.*)$")
_WHO = re.compile(r"^(?P<zid>[0-9a-f]+) on .*?(?:CertCommonName\((?P<who>[^)]*)\)|Transport\((?P<link>\w+)\))")
_DENIED = re.compile(r"(?P<zid>[0-9a-f]+)(?: on \S+)? is unauthorized to (?P<what>.+?) \((?P<flow>\w+)\) on (?P<key>\S+)")
_THINNED = re.compile(r"Message dropped by the downsampling interceptor: Push\((?P<key>[^)]*)\) from:\S*?/(?P<zid>[0-9a-f]+)")
_TOO_OFTEN = re.compile(r" comes too often from ")
_INTERCEPTED = "Msg intercepted!"
_FULL = re.compile(r"[Dd]efragmentation")
_WORDS = {  # what a client did, as the log has it
    "Put": "put",
    "Delete": "delete",
    "Declare Subscriber": "read",
    "Query": "ask for",
}
_QUIET = ("machine/presence/", "health/")  # that a machine's own processes publish: a router that keeps them back is no news


class RefusedConnections:
    """Counts refused connections from any thread until they are fetched."""

    def __init__(self) -> None:
        self._count: Counter[str] = Counter()
        self._lock = threading.Lock()

    def add(self, kind: str) -> None:
        """Count one."""
        with self._lock:
            self._count[kind] += 1

    def take(self) -> Counter[str]:
        """Return the counts since the last call."""
        with self._lock:
            count, self._count = self._count, Counter()
        return count


class Refusals:
    """What was refused so far."""

    def __init__(self, namespace: str):
        """Nothing yet; `namespace` is left out where keys are named."""
        self._prefix = f"{namespace}/"
        self.count: Counter[str] = Counter()  # kind, in words -> how often
        self.newest = ""  # kind
        self._soon: dict[str, tuple[str, int]] = {}  # of a key and who put it: the second of the log, messages too soon in it
        self._before: dict[str, str] = {}  # thread -> its last line
        self._who: dict[str, str] = {}  # id of a session -> by whose certificate

    def read(self, text: str) -> Iterator[str]:
        """Take in some lines of the log; those that are about something else are passed on."""
        for line in text.splitlines():
            if not line.isascii() or "\x1b" in line:
                line = _COLOR.sub("", line)
            kind = self._kind(line)
            if kind is None:
                yield line
            elif kind and (number := self._weight(kind, line)):
                self.add(kind, number)

    def words(self) -> str:
        """What was refused how often, the most frequent first."""
        return ", ".join(f"{kind}: {number} times" for kind, number in self.count.most_common())

    def _weight(self, kind: str, line: str) -> int:
        """How many refusals a line stands for: none while what comes too often may be a burst, all of it once it is more."""
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
        """What a line tells, in words; empty for what is no refusal, None for what is something else altogether."""
        message = _MESSAGE.search(line)
        if message is not None:
            return self._of_message(message["thread"] or "", message["words"])
        return "a message that is larger than any may be" if _FULL.search(line) else None

    def _of_message(self, thread: str, words: str) -> str:
        """Whether a message was kept back; why, the line before of the same thread says, which may be a look at the rules."""
        if words == _INTERCEPTED:
            return self._why(self._before.pop(thread, ""))
        self._before[thread] = words
        if (known := _WHO.match(words)) is not None:
            self._who[known["zid"]] = known["who"] or f"somebody without a certificate ({known['link'].lower()})"
            if len(self._who) > _CLIENTS:
                del self._who[next(iter(self._who))]
        return ""

    def _why(self, words: str) -> str:
        if (denied := _DENIED.search(words)) is not None and denied["flow"] == "ingress":
            key = denied["key"].removeprefix(self._prefix)
            who = self._who.get(denied["zid"], "somebody")
            own = key in {f"{quiet}{who}" for quiet in _QUIET}
            return "" if own else f"{who} may not {_WORDS.get(denied['what'], denied['what'].lower())} {key}"
        if (thinned := _THINNED.search(words)) is not None:
            who = next((name for zid, name in self._who.items() if zid.startswith(thinned["zid"])), "somebody")
            return f"{thinned['key'].removeprefix(self._prefix)} comes too often from {who}"
        return ""
