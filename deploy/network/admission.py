"""Which connections a listener drops before their certificate is verified. Pure: times and addresses come in.

A stranger costs nothing but a socket until it has sent a byte, and a handshake is computed for it a limited number of times a
second for each address. Addresses from which a certificate was verified are not limited. The number of pending connections is
bounded: for a new one, the address with the most of them loses one, the oldest that has sent nothing first.
"""

import ipaddress
from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Generic, TypeVar

C = TypeVar("C", bound=Hashable)


@dataclass(frozen=True, slots=True)
class Limits:
    """Bounds for connections, without a verified certificate but for the last one."""

    handshakes_hz: float = 20.0  # of one address, on average
    handshakes_burst: int = 50  # of one address, at once
    pending: int = 1024  # connections
    timeout_s: float = 3.0  # [s] from accepting a connection to its verified certificate
    addresses: int = 4096  # remembered, of each kind
    verified: int = 64  # connections of one role, whose certificates are verified


def source_of(host: str) -> str:
    """Return the address by which a host is counted: its IPv4 address, or the /64 network of an IPv6 address."""
    address = ipaddress.ip_address(host.partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return str(address.ipv4_mapped)
        return str(ipaddress.IPv6Network((address, 64), strict=False).network_address)
    return str(address)


class HandshakeLimit:
    """A token bucket for each address; a verified address is not limited."""

    def __init__(self, limits: Limits):
        self._limits = limits
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()  # address -> tokens, when [s]
        self._verified: OrderedDict[str, None] = OrderedDict()

    def allows(self, source: str, now_s: float) -> bool:
        """Take a token of an address, if it has one."""
        if source in self._verified:
            return True
        most = float(self._limits.handshakes_burst)
        tokens, before_s = self._buckets.pop(source, (most, now_s))
        tokens = min(most, tokens + (now_s - before_s) * self._limits.handshakes_hz)
        allowed = tokens >= 1.0
        self._buckets[source] = (tokens - allowed, now_s)
        _bound(self._buckets, self._limits.addresses)
        return allowed

    def is_verified(self, source: str) -> bool:
        """Whether a certificate was verified from an address."""
        return source in self._verified

    def verify(self, source: str) -> None:
        """Limit an address no longer."""
        self._verified.pop(source, None)
        self._verified[source] = None
        self._buckets.pop(source, None)
        _bound(self._verified, self._limits.addresses)


class Pending(Generic[C]):
    """Connections that have no verified certificate yet, in order of arrival."""

    def __init__(self, limits: Limits):
        self._limits = limits
        self._since: OrderedDict[C, tuple[float, str]] = OrderedDict()  # connection -> arrival [s], address
        self._silent: dict[str, OrderedDict[C, None]] = {}  # address -> connections that have sent nothing
        self._of: dict[str, OrderedDict[C, None]] = {}  # address -> all its connections

    def __len__(self) -> int:
        return len(self._since)

    def add(self, connection: C, source: str, now_s: float) -> C | None:
        """Add a new connection; return the one to drop for it, or None."""
        self._since[connection] = (now_s, source)
        self._of.setdefault(source, OrderedDict())[connection] = None
        self._silent.setdefault(source, OrderedDict())[connection] = None
        if len(self._since) <= self._limits.pending:
            return None
        crowded = max(self._of, key=lambda one: len(self._of[one]))
        dropped = next(iter(self._silent.get(crowded) or self._of[crowded]))
        self.remove(dropped)
        return dropped

    def speaks(self, connection: C) -> None:
        """Note that a connection has sent something."""
        _, source = self._since[connection]
        self._forget(self._silent, source, connection)

    def remove(self, connection: C) -> None:
        """Forget a connection, if it is known."""
        _, source = self._since.pop(connection, (0.0, ""))
        self._forget(self._of, source, connection)
        self._forget(self._silent, source, connection)

    def overdue(self, now_s: float) -> list[C]:
        """Remove and return the connections that have exceeded the handshake timeout."""
        found: list[C] = []
        for connection, (since_s, _) in self._since.items():
            if now_s - since_s < self._limits.timeout_s:
                break
            found.append(connection)
        for connection in found:
            self.remove(connection)
        return found

    @staticmethod
    def _forget(table: dict[str, OrderedDict[C, None]], source: str, connection: C) -> None:
        if source in table:
            table[source].pop(connection, None)
            if not table[source]:
                del table[source]


def _bound(table: OrderedDict[str, object] | OrderedDict[str, tuple[float, float]] | OrderedDict[str, None], most: int) -> None:
    while len(table) > most:
        table.popitem(last=False)
