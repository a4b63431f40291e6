"""Load of strangers on a local listener, at an exact rate.

python -m benchmarks.access.stranger_load --port PORT --rate HZ

Strangers connect and close, stay silent, send bytes that are not TLS, or make a handshake with a certificate of a foreign
authority, in turn. Every second one comes from 127.0.0.1, as authorized clients do, the others from 200 separate addresses. The
process ends when its standard input is closed or after --seconds. It prints the number of each kind as JSON.
"""

import argparse
import contextlib
import json
import os
import random
import selectors
import socket
import ssl
import struct
import sys
import time
from collections import Counter, OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sextant.shared.runtime.process_priority import allow_many_files
from sextant.shared.wire.access import CERTIFICATE, KEY

KINDS = ("closed", "silent", "garbage", "foreign")
HERE = "127.0.0.1"
_TURN_S = 0.005
_LATE_S = 0.5  # [s] maximum delay; connections beyond it are skipped
_SILENT_S = 5.0  # [s] after which a silent one closes
_OTHERS = 200
_GARBAGE = 64  # [bytes]
_AT_ONCE = 4000  # maximum number of open connections


@dataclass(slots=True, eq=False)
class _Stranger:
    kind: str
    socket: socket.socket
    until_s: float


class Strangers:
    """Opens connections at a rate, and continues with open ones."""

    def __init__(self, port: int, rate_hz: float, kinds: Sequence[str], folder: Path, seed: int = 0):
        """Prepare the connections.

        Args:
            port: Port of 127.0.0.1.
            rate_hz: Connections per second.
            kinds: Kinds out of `KINDS`, in turn.
            folder: Folder with a certificate and key of a foreign authority.
            seed: Random seed of their bytes.
        """
        self.count: Counter[str] = Counter()
        self.left_out = 0  # skipped because this process was too slow
        self._port, self._rate_hz, self._kinds = port, rate_hz, kinds
        self._random = random.Random(seed)
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        self._context.check_hostname, self._context.verify_mode = False, ssl.CERT_NONE
        self._context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
        self._selector = selectors.DefaultSelector()
        self._open: OrderedDict[_Stranger, None] = OrderedDict()
        self._began_s = self._now_s = 0.0
        self._due = 0

    def run(self, seconds: float) -> float:
        """Run for some seconds, or until standard input is closed.

        Return the duration [s].
        """
        self._selector.register(sys.stdin, selectors.EVENT_READ)
        self._began_s = self._now_s = time.monotonic()
        while self._now_s - self._began_s < seconds:
            for key, _ in self._selector.select(_TURN_S):
                if key.data is None:
                    if not os.read(sys.stdin.fileno(), 4096):
                        return self._now_s - self._began_s
                elif key.data in self._open:
                    self._advance(key.data)
            self._now_s = time.monotonic()
            self._begin_due()
            while self._open and (oldest := next(iter(self._open))).until_s < self._now_s:
                self._close(oldest)
        return seconds

    def _begin_due(self) -> None:
        due = int((self._now_s - self._began_s) * self._rate_hz)
        late = due - self._due - int(_LATE_S * self._rate_hz)
        if late > 0:
            self.left_out += late
            self._due += late
        while self._due < due:
            self._due += 1
            if len(self._open) < _AT_ONCE:
                self._begin(self._kinds[self._due % len(self._kinds)])

    def _begin(self, kind: str) -> None:
        plain = socket.socket()
        plain.setblocking(False)
        if self._random.random() < 0.5:
            plain.setsockopt(socket.IPPROTO_IP, _BIND_NO_PORT, 1)
            plain.bind((f"127.0.1.{1 + self._random.randrange(_OTHERS)}", 0))
        plain.connect_ex((HERE, self._port))
        self.count[kind] += 1
        stranger = _Stranger(kind, plain, self._now_s + _SILENT_S)
        self._open[stranger] = None
        self._selector.register(plain.fileno(), selectors.EVENT_WRITE, stranger)

    def _advance(self, stranger: _Stranger) -> None:
        """Continue with a stranger that is connected or has received data."""
        connection = stranger.socket
        try:
            if isinstance(connection, ssl.SSLSocket):
                self._shake_hands(stranger, connection)
            elif self._selector.get_key(connection.fileno()).events & selectors.EVENT_READ:
                if not connection.recv(4096):
                    self._close(stranger)
            elif connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) or stranger.kind == "closed":
                self._close(stranger)
            elif stranger.kind == "foreign":
                secured = self._context.wrap_socket(connection, do_handshake_on_connect=False)
                stranger.socket = secured
                self._shake_hands(stranger, secured)
            else:
                if stranger.kind == "garbage":
                    connection.send(self._random.randbytes(_GARBAGE))
                self._selector.modify(connection.fileno(), selectors.EVENT_READ, stranger)
        except BlockingIOError:
            pass
        except OSError:  # TLS errors, too: the stranger is refused
            self._close(stranger)

    def _shake_hands(self, stranger: _Stranger, secured: ssl.SSLSocket) -> None:
        try:
            secured.do_handshake()
            secured.recv(1)
        except ssl.SSLWantReadError:
            self._selector.modify(secured.fileno(), selectors.EVENT_READ, stranger)
        except ssl.SSLWantWriteError:
            self._selector.modify(secured.fileno(), selectors.EVENT_WRITE, stranger)
        else:
            self._close(stranger)

    def _close(self, stranger: _Stranger) -> None:
        del self._open[stranger]
        self._selector.unregister(stranger.socket.fileno())
        with contextlib.suppress(OSError):  # leave no port in TIME_WAIT
            stranger.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        stranger.socket.close()


_BIND_NO_PORT = 24  # IP_BIND_ADDRESS_NO_PORT of Linux: the port is chosen by connect


def main(argv: Sequence[str] | None = None) -> int:
    """Run strangers until standard input is closed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.access.stranger_load", description=__doc__)
    parser.add_argument("--port", type=int, required=True, help="TCP port of 127.0.0.1")
    parser.add_argument("--rate", type=float, default=1000.0, help="connections per second (default %(default)s)")
    parser.add_argument(
        "--kinds", nargs="+", choices=KINDS, default=list(KINDS), help="kinds of connections, in turn (default: all)"
    )
    parser.add_argument(
        "--keys", type=Path, required=True, metavar="DIR", help="folder with a certificate of a foreign authority"
    )
    parser.add_argument("--seconds", type=float, default=1800.0, help="longest duration [s] (default %(default)s)")
    arguments = parser.parse_args(argv)
    allow_many_files()
    strangers = Strangers(arguments.port, arguments.rate, arguments.kinds, arguments.keys)
    lasted_s = strangers.run(arguments.seconds)
    sys.stdout.write(json.dumps({"seconds": lasted_s, "left_out": strangers.left_out, "count": strangers.count}) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
