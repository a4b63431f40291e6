"""Endpoints such as tls/hexapod.local:7448, and causes of their failures."""

import errno
import socket
from collections.abc import Iterable
from typing import Any

_CONNECT_S = 3.0
_USUAL = "7447 for tcp, 7448 for tls"
_PROTOCOLS = ("tcp", "tls", "udp", "quic", "ws")  # of Zenoh; Sextant itself uses the first two
_ALL_ADDRESSES = ("0.0.0.0", "::")  # of a listener
_UNKNOWN = "check its name, or give its IP address"


def place(endpoint: str) -> tuple[str, int]:
    """Return host and port of an endpoint such as tls/robot.local:7448.

    Raises:
        ValueError: The endpoint has no host or port.
    """
    protocol, slash, rest = endpoint.partition("/")
    address = rest.partition("?")[0].partition("#")[0]
    host, colon, port = address.rpartition(":")
    if not (protocol and slash and host and colon and port.isdecimal() and int(port) < 1 << 16):
        missing = bool(protocol and slash and address) and not (colon and port)
        hint = f"; the port is missing: usually {_USUAL}" if missing else ""
        raise ValueError(f"PROTOCOL/HOST:PORT expected, e.g. tls/robot.local:7448, found {endpoint!r}{hint}")
    return host.strip("[]"), int(port)


def for_clients(endpoint: str) -> str:
    """Return the endpoint by which clients reach a listener: the name of this machine in place of all its addresses."""
    host, port = place(endpoint)
    return f"{endpoint.partition('/')[0]}/{socket.gethostname()}:{port}" if host in _ALL_ADDRESSES else endpoint


def fault(endpoints: Iterable[str]) -> str:
    """Return the error in the first malformed endpoint, or an empty text."""
    for endpoint in endpoints:
        try:
            place(endpoint)
        except ValueError as error:
            return str(error)
        if (protocol := endpoint.partition("/")[0]) not in _PROTOCOLS:
            return f"the endpoint {endpoint!r} begins with {protocol!r}: tcp, or tls with certificates, expected"
    return ""


def resolved(endpoint: str) -> tuple[socket.AddressFamily, Any]:
    """Return family and address of an endpoint, for `socket.connect` and `bind`.

    Raises:
        socket.gaierror: The host is unknown.
    """
    host, port = place(endpoint)
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except UnicodeError:  # not a valid host name
        raise socket.gaierror(socket.EAI_NONAME, "not a host name") from None
    return family, address


def connected(endpoint: str) -> socket.socket:
    """Connect to an endpoint.

    Raises:
        OSError: The endpoint cannot be reached (`cannot_connect` gives the reason).
    """
    family, address = resolved(endpoint)
    link = socket.socket(family)
    try:
        link.settimeout(_CONNECT_S)
        link.connect(address)
    except OSError:
        link.close()
        raise
    return link


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
    """Return why an endpoint cannot be reached, or an empty text.

    The call takes a few seconds at most.
    """
    try:
        connected(endpoint).close()
    except OSError as error:
        return cannot_connect(endpoint, error)
    return ""


def unknown_host(endpoint: str) -> str:
    """Return an error text if the host of an endpoint is unknown, or an empty text."""
    try:
        resolved(endpoint)
    except socket.gaierror as error:
        return cannot_connect(endpoint, error)
    return ""


def cannot_listen(endpoint: str, error: OSError) -> str:
    """Return why listening on an endpoint failed."""
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
    """Return why listening on an endpoint is impossible, or an empty text."""
    try:
        listener(endpoint).close()
    except OSError as error:
        return cannot_listen(endpoint, error)
    return ""


def listener(endpoint: str) -> socket.socket:
    """Return a socket that is bound to an endpoint.

    Raises:
        OSError: Listening is impossible (`cannot_listen` gives the reason).
    """
    family, address = resolved(endpoint)
    bound = socket.socket(family)
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # ignore closed connections in TIME_WAIT
        bound.bind(address)
    except OSError:
        bound.close()
        raise
    return bound
