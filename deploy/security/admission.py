"""Decide which connections a listener drops before it verifies their certificate.

This module is pure: its inputs are times and addresses.

A connection occupies only a socket until it sends a byte. For each address, the number of handshakes per second is limited.
Addresses from which a certificate was verified are not limited. The number of pending connections is bounded. When it is
exceeded, the address with the most of them loses one: the oldest silent connection first.
"""

import ipaddress
from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Generic, TypeVar

C = TypeVar("C", bound=Hashable)


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits for connections.

    All but `verified` are for connections without a verified certificate.
    """

    handshakes_hz: float = 20.0  # average rate for one address
    handshakes_burst: int = 50  # maximum burst for one address
    pending: int = 1024  # maximum number of connections
    timeout_s: float = 3.0  # [s] from accepting a connection to its verified certificate
    addresses: int = 4096  # maximum number of remembered addresses of each kind
    verified: int = 64  # maximum number of verified connections for one role


def source_of(host: str) -> str:
    """Return the address under which a host is counted.

    That is its IPv4 address, or the /64 network of an IPv6 address.
    """
    address = ipaddress.ip_address(host.partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return str(address.ipv4_mapped)
        return str(ipaddress.IPv6Network((address, 64), strict=False).network_address)
    return str(address)


class HandshakeLimit:
    """Token bucket for each address; a verified address is not limited."""

    def __init__(self, limits: Limits):
        self._limits = limits
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()  # address -> tokens, when [s]
        self._verified: OrderedDict[str, None] = OrderedDict()

    def allows(self, source: str, now_s: float) -> bool:
        """Take a token of an address; return False if it has none."""
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
        """Return whether a certificate was verified from an address."""
        return source in self._verified

    def verify(self, source: str) -> None:
        """Exempt an address from the limit."""
        self._verified.pop(source, None)
        self._verified[source] = None
        self._buckets.pop(source, None)
        _bound(self._verified, self._limits.addresses)


class Pending(Generic[C]):
    """Connections without a verified certificate, in order of arrival."""

    def __init__(self, limits: Limits):
        self._limits = limits
        self._since: OrderedDict[C, tuple[float, str]] = OrderedDict()  # connection -> arrival [s], address
        self._silent: dict[str, OrderedDict[C, None]] = {}  # address -> connections that have sent nothing
        self._of: dict[str, OrderedDict[C, None]] = {}  # address -> all its connections

    def __len__(self) -> int:
        return len(self._since)

    def add(self, connection: C, source: str, now_s: float) -> C | None:
        """Add a connection; return the connection to drop in exchange, or None."""
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
        """Mark a connection as one that has sent something."""
        _, source = self._since[connection]
        self._forget(self._silent, source, connection)

    def remove(self, connection: C) -> None:
        """Remove a connection, if it is known."""
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
