"""Makes the certificates of a robot: an authority of its own, and one certificate for each role that it signs."""

import ipaddress
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from shared.access import AUTHORITY, CERTIFICATE, KEY, ROLE, ROLES, AccessError

OF_AUTHORITY = "ca"  # folder of the authority, which stays where it was made
_BEFORE = timedelta(minutes=10)  # by which clocks of two machines may differ
HERE = ("localhost", "127.0.0.1")


@dataclass(frozen=True, slots=True)
class Held:
    """One certificate of a folder of keys."""

    role: str
    ends: datetime
    file: Path


class Authority:
    """Signs certificates; its private key is in memory alone until `write`."""

    def __init__(self, days: float, now: datetime | None = None):
        """Make one that is good for so many days from `now`."""
        self._from = (now or datetime.now(UTC)) - _BEFORE
        self.ends = (now or datetime.now(UTC)) + timedelta(days=days)
        self._key = ec.generate_private_key(ec.SECP256R1())
        # Each has a name of its own, so that a certificate of another one is called that and not a bad signature.
        name = _name(f"Sextant {x509.random_serial_number():040x}"[:24])
        usage = x509.KeyUsage(
            digital_signature=False,
            content_commitment=False,
            key_encipherment=False,
            data_encipherment=False,
            key_agreement=False,
            key_cert_sign=True,
            crl_sign=True,
            encipher_only=False,
            decipher_only=False,
        )
        self.certificate = (
            self._begun(name, self._key, self.ends)
            .issuer_name(name)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(usage, critical=True)
            .sign(self._key, hashes.SHA256())
        )

    @classmethod
    def load(cls, folder: Path) -> "Authority":
        """The authority that `write` has written to a folder."""
        made = cls.__new__(cls)
        made.certificate = x509.load_pem_x509_certificate((folder / AUTHORITY).read_bytes())
        key = load_pem_private_key((folder / KEY).read_bytes(), password=None)
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise AccessError(f"{folder / KEY}: a key of an elliptic curve expected, found {type(key).__name__}")
        made._key, made._from, made.ends = key, datetime.now(UTC) - _BEFORE, made.certificate.not_valid_after_utc
        return made

    def write(self, folder: Path) -> None:
        """Write the authority: its certificate, and the private key that signs others."""
        folder.mkdir(parents=True, mode=0o700)
        (folder / AUTHORITY).write_bytes(self.certificate.public_bytes(Encoding.PEM))
        _write_key(folder / KEY, self._key)

    def issue(self, folder: Path, role: str, addresses: Sequence[str] = HERE, ends: datetime | None = None) -> None:
        """Write a folder with a new certificate of a role.

        Args:
            folder: To make.
            role: Becomes its common name.
            addresses: Names and IP addresses at which its holder listens.
            ends: When it ends; at the authority's own end by default.
        """
        folder.mkdir(parents=True, mode=0o700)
        key, ends = ec.generate_private_key(ec.SECP256R1()), ends or self.ends
        both = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH])
        certificate = (
            self._begun(_name(role), key, ends)
            .issuer_name(self.certificate.subject)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.SubjectAlternativeName([_address(address) for address in addresses]), critical=False)
            .add_extension(both, critical=False)
            .sign(self._key, hashes.SHA256())
        )
        (folder / AUTHORITY).write_bytes(self.certificate.public_bytes(Encoding.PEM))
        (folder / CERTIFICATE).write_bytes(certificate.public_bytes(Encoding.PEM))
        (folder / ROLE).write_text(f'role = "{role}"\nends = {ends:%Y-%m-%dT%H:%M:%SZ}\n', encoding="utf-8")
        _write_key(folder / KEY, key)

    def _begun(self, name: x509.Name, key: ec.EllipticCurvePrivateKey, ends: datetime) -> x509.CertificateBuilder:
        begins = min(self._from, ends - _BEFORE)
        serial = x509.random_serial_number()
        builder = x509.CertificateBuilder().subject_name(name).public_key(key.public_key()).serial_number(serial)
        return builder.not_valid_before(begins).not_valid_after(ends)


def new(folder: Path, addresses: Mapping[str, Sequence[str]] | None = None, days: float = 365.0) -> tuple[Held, ...]:
    """Make an authority, and a folder of keys for each role.

    Args:
        folder: To make them in.
        addresses: Role -> names and IP addresses at which others reach its machine, beside its own loopback.
        days: For which they are good.

    Raises:
        AccessError: There are keys already.
    """
    there = [name for name in (OF_AUTHORITY, *(role.name for role in ROLES)) if (folder / name).exists()]
    if there:
        raise AccessError(f"{folder} has {', '.join(there)} already: keys are not overwritten; name another folder")
    authority = Authority(days)
    authority.write(folder / OF_AUTHORITY)
    for role in ROLES:
        authority.issue(folder / role.name, role.name, (*HERE, *(addresses or {}).get(role.name, ())))
    return tuple(held(folder))


def held(folder: Path) -> Iterator[Held]:
    """The certificates of a folder that `new` has made, or of the folder of one role.

    Raises:
        AccessError: There are none.
    """
    places = [place for place in (folder, *(folder / role.name for role in ROLES)) if (place / CERTIFICATE).is_file()]
    if not places:
        raise AccessError(f"no {CERTIFICATE} in {folder}, nor in a folder of a role in it; `sextant keys new DIR` makes them")
    for place in places:
        certificate = x509.load_pem_x509_certificate((place / CERTIFICATE).read_bytes())
        (name,) = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        yield Held(str(name.value), certificate.not_valid_after_utc, place / CERTIFICATE)


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _address(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        return x509.DNSName(text)


def _write_key(file: Path, key: ec.EllipticCurvePrivateKey) -> None:
    """Write a private key that its owner alone may read, from the first byte on."""
    pem = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as out:
        out.write(pem)
