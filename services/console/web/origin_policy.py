"""Who may come in: a browser on this machine may have pages of other sites open, too. Pure."""

import hmac
import math
from collections.abc import Mapping, Sequence
from urllib.parse import urlsplit

from sextant.services.console.config import Settings
from sextant.services.console.web import view

PROTOCOL = f"sextant.{view.PROTOCOL}"
MOST_PAGES = 32
_SAID_EVERY_S = 1.0
_LOCAL = ("127.0.0.1", "localhost", "[::1]")
_TOKEN = "token."  # before it, among the protocols that a page offers


class Door:
    """Refuses whoever does not name an address of the console's own, and pages that it has not served."""

    def __init__(self, settings: Settings):
        """Of a console that listens where the settings say."""
        self._host, self._token = settings.host, settings.token

    def is_own(self, host: str) -> bool:
        """Whether a request names this console: a name that somebody has turned to its address is none."""
        name = host.rpartition(":")[0] if host.rpartition(":")[2].isdigit() else host
        return bool(self._token) or name in (*_LOCAL, self._host)

    def refusal(self, headers: Mapping[str, str], offered: Sequence[str], pages: int) -> str:
        """Why a page may not connect, in words, or nothing.

        Args:
            headers: Of its request, by names in small letters.
            offered: Protocols that it speaks.
            pages: That are open already.
        """
        host, origin = headers.get("host", ""), headers.get("origin")
        if not self.is_own(host):
            return "this address is not the console's own"
        if origin is not None and _site(origin) != host:
            return "the page of another site may not connect"
        if PROTOCOL not in offered:
            return f"{PROTOCOL} is spoken here; load the page anew"
        if self._token:
            token = next((word.removeprefix(_TOKEN) for word in offered if word.startswith(_TOKEN)), "")
            if not hmac.compare_digest(token.encode(), self._token.encode()):
                return "the token is wrong, or missing; open the address with #TOKEN behind it"
        if pages >= MOST_PAGES:
            return f"{MOST_PAGES} pages are open already; close one"
        return ""


class Porter:
    """Says who was refused, for the log: at most once a second, for whoever is refused comes again."""

    def __init__(self) -> None:
        """Nobody has come yet."""
        self._next_s, self._left_out = -math.inf, 0

    def words(self, refusal: str, now_s: float) -> str:
        """What to say of a refusal at a time [s], by any clock that only goes on; nothing so soon after the last."""
        if now_s < self._next_s:
            self._left_out += 1
            return ""
        more = f" (and {self._left_out} more since the last that was said)" if self._left_out else ""
        self._next_s, self._left_out = now_s + _SAID_EVERY_S, 0
        return f"a page was refused: {refusal}{more}"


def _site(origin: str) -> str:
    """Host and port of a page's origin; nothing where it is none."""
    try:
        return urlsplit(origin).netloc
    except ValueError:  # of brackets that hold no address
        return ""
