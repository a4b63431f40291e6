"""Check of host, origin and token of browsers.

It is needed on loopback, too, because the operator's browser may have pages of other sites open.
"""

import hmac
import math
from collections.abc import Mapping, Sequence
from urllib.parse import urlsplit

from sextant.services.console.config import Settings
from sextant.services.console.web import view

PROTOCOL = f"sextant.{view.PROTOCOL}"
MAX_PAGES = 32  # maximum number of open pages
_LOG_PERIOD_S = 1.0  # [s] minimum time between two log messages
_LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
_TOKEN = "token."  # prefix of the token in the subprotocols of a page


class OriginPolicy:
    """Access check: refuses foreign host names, pages of other sites and wrong tokens."""

    def __init__(self, settings: Settings):
        """Create the check of a console with the given address and token."""
        self._host, self._token = settings.host, settings.token

    def is_own(self, host: str) -> bool:
        """Return whether the Host header of a request is an address of this console.

        This refuses foreign names that resolve to this address (DNS rebinding). With a token any name is accepted.
        """
        name = host.rpartition(":")[0] if host.rpartition(":")[2].isdigit() else host
        return bool(self._token) or name in (*_LOOPBACK, self._host)

    def refusal(self, headers: Mapping[str, str], offered: Sequence[str], pages: int) -> str:
        """Return why a page may not connect, "" if it may.

        Args:
            headers: Headers of its request, by lower-case name.
            offered: WebSocket subprotocols that it offers.
            pages: Number of pages that are open already.
        """
        host, origin = headers.get("host", ""), headers.get("origin")
        if not self.is_own(host):
            return "this address is not an address of the console"
        if origin is not None and _site(origin) != host:
            return "a page of another site may not connect"
        if PROTOCOL not in offered:
            return f"the console uses protocol {PROTOCOL}; reload the page"
        if self._token:
            token = next((word.removeprefix(_TOKEN) for word in offered if word.startswith(_TOKEN)), "")
            if not hmac.compare_digest(token.encode(), self._token.encode()):
                return "the token is wrong or missing; open the address with #TOKEN at its end"
        if pages >= MAX_PAGES:
            return f"{MAX_PAGES} pages are already open; close one"
        return ""


class RejectionLog:
    """Rate limit of log messages on refused pages.

    It passes at most one message per second, because refused pages try again.
    """

    def __init__(self) -> None:
        """Start with no refusal."""
        self._next_s, self._left_out = -math.inf, 0

    def words(self, refusal: str, now_s: float) -> str:
        """Return the log message of a refusal, "" within a second of the last one.

        Args:
            refusal: Reason of the refusal.
            now_s: Time [s] of any monotonic clock.
        """
        if now_s < self._next_s:
            self._left_out += 1
            return ""
        more = f" (and {self._left_out} more since the last message)" if self._left_out else ""
        self._next_s, self._left_out = now_s + _LOG_PERIOD_S, 0
        return f"a page was refused: {refusal}{more}"


def _site(origin: str) -> str:
    """Return host and port of an origin, "" if it is invalid."""
    try:
        return urlsplit(origin).netloc
    except ValueError:  # raised for brackets that do not hold an IPv6 address
        return ""
