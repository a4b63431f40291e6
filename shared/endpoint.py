"""Endpoints such as tls/hexapod.local:7448, and why one cannot be reached or listened on: cause, and what to do."""

import errno
import socket
from collections.abc import Iterable

_CONNECT_S = 3.0
_UNKNOWN = "check its name, or give its IP address"


def place(endpoint: str) -> tuple[str, int]:
    """Return host and port of an endpoint, e.g. of tls/robot.local:7448.

    Raises:
        ValueError: It has none.
    """
    protocol, slash, rest = endpoint.partition("/")
    address = rest.partition("?")[0].partition("#")[0]
    host, colon, port = address.rpartition(":")
    if not (protocol and slash and host and colon and port.isdecimal() and int(port) < 1 << 16):
        given = address or endpoint
        missing = "" if colon else f"; the port is missing: {protocol if slash else 'tcp'}/{given}:7447?"
        raise ValueError(f"PROTOCOL/HOST:PORT expected, e.g. tls/robot.local:7448, found {endpoint!r}{missing}")
    return host.strip("[]"), int(port)


def fault(endpoints: Iterable[str]) -> str:
    """Return what is wrong with the first endpoint that is not written as one, or an empty text."""
    for endpoint in endpoints:
        try:
            place(endpoint)
        except ValueError as error:
            return str(error)
    return ""


def cannot_connect(endpoint: str, error: OSError) -> str:
    """Return why a connection to an endpoint failed."""
    host, port = place(endpoint)
    if isinstance(error, socket.gaierror):
        return f"{endpoint} cannot be reached: the host {host!r} is not known; {_UNKNOWN}"
    if isinstance(error, ConnectionRefusedError):
        return (
            f"{endpoint} cannot be reached: nothing listens on port {port} of {host}; is the robot up (`sextant up`), and is "
            "this its port?"
        )
    if isinstance(error, TimeoutError) or error.errno in (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ENETDOWN):
        return (
            f"{endpoint} cannot be reached: {host} does not answer; is the robot on, on this network, and is this its address?"
        )
    return f"{endpoint} cannot be reached: {error.strerror or error}; is the robot up, and is this its address?"


def obstacle(endpoint: str) -> str:
    """Return why no connection to an endpoint can be made, or an empty text; takes a few seconds at most."""
    host, port = place(endpoint)
    try:
        socket.create_connection((host, port), _CONNECT_S).close()
    except OSError as error:
        return cannot_connect(endpoint, error)
    return ""


def unknown_host(endpoint: str) -> str:
    """Return that the host of an endpoint is not known, or an empty text."""
    host, port = place(endpoint)
    try:
        socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except socket.gaierror as error:
        return cannot_connect(endpoint, error)
    return ""


def cannot_listen(endpoint: str, error: OSError) -> str:
    """Return why an endpoint cannot be listened on."""
    host, port = place(endpoint)
    if isinstance(error, socket.gaierror):
        return f"cannot listen on {endpoint}: the host {host!r} is not known; {_UNKNOWN}"
    if error.errno == errno.EADDRINUSE:
        return (
            f"cannot listen on {endpoint}: another program has port {port}, perhaps another `sextant up`; end it, or give "
            "another port with --listen"
        )
    if error.errno == errno.EADDRNOTAVAIL:
        return f"cannot listen on {endpoint}: this computer has no address {host}; give one that it has, or 0.0.0.0 for all"
    if error.errno == errno.EACCES:
        return f"cannot listen on {endpoint}: ports below 1024 are for the administrator; give another with --listen"
    return f"cannot listen on {endpoint}: {error.strerror or error}; give another endpoint with --listen"


def occupied(endpoint: str) -> str:
    """Return why an endpoint cannot be listened on, or an empty text."""
    host, port = place(endpoint)
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # closed connections that linger do not count
            probe.bind(address)
    except OSError as error:
        return cannot_listen(endpoint, error)
    return ""
