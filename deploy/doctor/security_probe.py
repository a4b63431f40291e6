"""Security check from outside: try to connect without a valid certificate.

Clients have no certificate, a foreign one or an expired one, or only listen. Nothing is published that could move a robot: the
handshake and received messages show whether a client is accepted.
"""

import ssl
import tempfile
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

from sextant.deploy.doctor.check import Check, Level
from sextant.deploy.security.authority import OF_AUTHORITY, Authority
from sextant.shared.wire.access import CERTIFICATE, KEY
from sextant.shared.wire.endpoint import place
from sextant.shared.wire.handshake import verdict
from sextant.shared.wire.transport import TransportError, overhear, scout

_LISTEN_S = 2.0
_VERDICT_S = 3.0  # [s] for a refusal: a robot that refuses slowly must not count as open
_ADVICE = "start the robot with --keys DIR and without --open (docs/access.md)"


def examine(
    endpoint: str, keys: Path | None = None, find: Callable[[float], list[str]] = scout, listen_s: float = _LISTEN_S
) -> list[Check]:
    """Try to connect.

    Args:
        endpoint: Endpoint of the robot, e.g. tls/hexapod.local:7448.
        keys: Folder made by `sextant keys new` with its authority, to sign an expired certificate.
        find: Scouts for a time [s], and returns the endpoints found.
        listen_s: [s] to listen if a client is accepted.
    """
    checks = [_plain(endpoint, listen_s)]
    if endpoint.startswith("tls/"):
        checks.append(_shown(endpoint, "stranger without a certificate", None))
        with tempfile.TemporaryDirectory() as folder:
            Authority(days=1).issue(Path(folder) / "foreign", "console")
            checks.append(_shown(endpoint, "stranger with a certificate of a foreign authority", Path(folder) / "foreign"))
            checks.append(_expired(endpoint, keys, Path(folder) / "expired"))
    return [*checks, _scouting(endpoint, find)]


def _plain(endpoint: str, listen_s: float) -> Check:
    """Check a client that uses Zenoh without TLS."""
    name, (host, port) = "stranger without TLS", place(endpoint)
    try:
        heard = overhear(f"tcp/{host}:{port}", listen_s)
    except TransportError:
        return Check(name, Level.OK, f"{endpoint}: refused")
    said = f"; it received {sum(heard.values())} messages on {', '.join(sorted(heard)[:4])}" if heard else ""
    return Check(name, Level.FAIL, f"{endpoint}: accepted, and may publish on any key{said}", _ADVICE)


def _shown(endpoint: str, name: str, folder: Path | None) -> Check:
    """Check a client with the given certificate, or without one.

    It does not verify the robot's certificate.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    if folder is not None:
        context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
    refused = verdict(endpoint, context, _VERDICT_S)
    if "cannot be reached" in refused:
        return Check(name, Level.FAIL, refused, "give the endpoint on which the robot listens for other machines")
    if refused:
        return Check(name, Level.OK, f"refused: {refused}")
    return Check(name, Level.FAIL, f"{endpoint}: accepted", _ADVICE)


def _expired(endpoint: str, keys: Path | None, folder: Path) -> Check:
    name = "stranger with an expired certificate"
    if keys is None or not (keys / OF_AUTHORITY / KEY).is_file():
        advice = "give --keys DIR, the folder of `sextant keys new` with its ca/, to try this too"
        return Check(name, Level.WARN, "not tried: only the robot's own authority can issue one", advice)
    Authority.load(keys / OF_AUTHORITY).issue(folder, "console", ends=datetime.now(UTC) - timedelta(hours=1))
    return _shown(endpoint, name, folder)


def _scouting(endpoint: str, find: Callable[[float], list[str]]) -> Check:
    """Check a client that scouts by multicast."""
    name, (host, _) = "stranger that scouts", place(endpoint)
    found = find(1.0)
    if not found:
        return Check(name, Level.OK, "no answer")
    level = Level.FAIL if any(place(one)[0] == host for one in found) else Level.WARN
    advice = "Sextant never answers scouting, so this is another Zenoh program; check that it does not bypass the router"
    return Check(name, level, f"{', '.join(found[:4])} answered", advice)
