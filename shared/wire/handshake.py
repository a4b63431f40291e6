"""TLS handshake that finds out why a listener refuses a certificate.

Zenoh only reports that it cannot connect.
"""

import ssl

from sextant.shared.wire.access import AUTHORITY, CERTIFICATE, KEY, Keys
from sextant.shared.wire.endpoint import cannot_connect, connected, place

_VERDICT_S = 0.25  # [s] a refusal of the certificate arrives within one round trip after the client's own handshake

_ALERTS = (  # alert of a listener, and its meaning
    ("EXPIRED", "this machine's certificate has expired, or its clock is wrong; make new ones with `sextant keys new`"),
    ("UNKNOWN_CA", "the robot does not trust the authority of this certificate; use keys made together with the robot's"),
    ("DECRYPT_ERROR", "the robot does not trust the authority of this certificate; use keys made together with the robot's"),
    ("CERTIFICATE_REQUIRED", "the robot asks for a certificate; give --keys DIR"),
    ("BAD_CERTIFICATE", "the robot does not accept this certificate; use keys made together with the robot's"),
)


def refusal(endpoint: str, keys: Keys) -> str:
    """Return why the handshake with a listener fails for these keys, or an empty text."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(keys.folder / AUTHORITY)
        context.load_cert_chain(keys.folder / CERTIFICATE, keys.folder / KEY)
    except (ssl.SSLError, OSError) as error:
        return f"the keys in {keys.folder} cannot be read: {error}; copy the folder of this machine's role again"
    return verdict(endpoint, context)


def verdict(endpoint: str, context: ssl.SSLContext, patience_s: float = _VERDICT_S) -> str:
    """Return why a handshake fails, or an empty text.

    The listener accepts if no refusal arrives within `patience_s` [s].
    """
    host, _ = place(endpoint)
    try:
        plain = connected(endpoint)
    except OSError as error:
        return cannot_connect(endpoint, error)
    try:
        with plain, context.wrap_socket(plain, server_hostname=host) as link:
            link.settimeout(patience_s)
            link.recv(1)
    except TimeoutError:
        return ""  # the listener accepted the handshake and waits for data
    except ssl.SSLCertVerificationError as error:
        return f"{endpoint} is not the expected machine: {error.verify_message}; {_of_certificate(error, host)}"
    except ssl.SSLError as error:
        said = next((words for alert, words in _ALERTS if alert in (error.reason or "")), "")
        return f"{endpoint} refused this machine: {said or error.reason or error}"
    except OSError as error:
        return cannot_connect(endpoint, error)
    return f"{endpoint} closed the connection without an answer; does it use TLS, and is the port right?"


def _of_certificate(error: ssl.SSLCertVerificationError, host: str) -> str:
    if "mismatch" in error.verify_message.lower():
        return f"make keys with --robot-address {host}, or connect by a name that the certificate has"
    if "expired" in error.verify_message:
        return "make new keys with `sextant keys new`"
    return "use keys made together with the robot's"
