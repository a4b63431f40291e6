"""A TLS server that requires client certificates; it replaces a router in tests."""

import socket
import ssl
import threading
from contextlib import suppress
from pathlib import Path


class EchoServer:
    """A server that sends the client's common name (16 bytes), then echoes all data.

    The name is that of the client's certificate.
    """

    def __init__(self, authority: Path, certificate: Path, key: Path | None = None, port: int = 0):
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.verify_mode = ssl.CERT_REQUIRED
        context.load_verify_locations(authority)
        context.load_cert_chain(certificate, key)
        self._context, self._listener = context, socket.create_server(("127.0.0.1", port))
        self.port = self._listener.getsockname()[1]
        self._open: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                plain, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._echo, args=(plain,), daemon=True).start()

    def _echo(self, plain: socket.socket) -> None:
        try:
            with self._context.wrap_socket(plain, server_side=True) as link:
                self._open.append(link)
                certificate = link.getpeercert() or {}
                subject = certificate["subject"]
                link.sendall(f"{dict(pair[0] for pair in subject)['commonName']:<16}".encode())
                while data := link.recv(1 << 16):
                    link.sendall(data)
        except OSError:
            pass

    def close(self) -> None:
        with suppress(OSError):  # closed already
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def hang_up(self) -> None:
        """Close all connections."""
        for link in self._open:
            with suppress(OSError):
                socket.socket.shutdown(link, socket.SHUT_RDWR)


def read(link: socket.socket, size: int) -> bytes:
    """Read this number of bytes."""
    data = b""
    while len(data) < size:
        more = link.recv(1 << 16)
        assert more, f"closed after {len(data)} of {size} bytes"
        data += more
    return data
