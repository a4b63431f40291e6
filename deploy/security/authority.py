"""Create the certificates of a robot.

They are a certificate authority, and one certificate for each role, signed by it.
"""

import ipaddress
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from sextant.shared.files import whole_files
from sextant.shared.files.input_file import FileError, read_bytes
from sextant.shared.wire.access import AUTHORITY, CERTIFICATE, KEY, PROXY, ROLE, ROLES, ROUTER, AccessError

OF_AUTHORITY = "ca"  # folder of the authority; it stays on the machine that created it
_BEFORE = timedelta(minutes=10)  # tolerance for clock differences between machines
HERE = ("localhost", "127.0.0.1")
_MAX_PEM_BYTES = 1_000_000


@dataclass(frozen=True, slots=True)
class Held:
    """One certificate in a folder of keys."""

    role: str
    ends: datetime
    file: Path


class Authority:
    """Certificate authority; its private key is only in memory until `write`."""

    def __init__(self, days: float, now: datetime | None = None):
        """Create an authority that is valid for `days` from `now`."""
        self._from = (now or datetime.now(UTC)) - _BEFORE
        self.ends = (now or datetime.now(UTC)) + timedelta(days=days)
        self._key = ec.generate_private_key(ec.SECP256R1())
        # Each authority has a unique name, so that its certificates are reported as foreign and not as a bad signature.
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
        """Load the authority that `write` has written to a folder."""
        made = cls.__new__(cls)
        made.certificate = _certificate(folder / AUTHORITY)
        pem = _read(folder / KEY)
        try:
            key = load_pem_private_key(pem, password=None)
        except (ValueError, TypeError, UnsupportedAlgorithm):
            raise AccessError(f"{folder / KEY}: a private key in PEM without a password expected") from None
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise AccessError(f"{folder / KEY}: an elliptic curve key expected, found {type(key).__name__}")
        made._key, made._from, made.ends = key, datetime.now(UTC) - _BEFORE, made.certificate.not_valid_after_utc
        return made

    def write(self, folder: Path) -> None:
        """Write the authority: its certificate, and the private key that signs others."""
        folder.mkdir(parents=True, mode=0o700)
        whole_files.write_bytes(folder / AUTHORITY, self.certificate.public_bytes(Encoding.PEM), durable=True)
        _write_private(folder / KEY, _pem_of(self._key))

    def issue(self, folder: Path, role: str, addresses: Sequence[str] = HERE, ends: datetime | None = None) -> None:
        """Write a folder with a new certificate for a role.

        Args:
            folder: The folder to create.
            role: The role; it becomes the common name.
            addresses: Names and IP addresses at which the holder listens.
            ends: Expiry; by default that of the authority.
        """
        folder.mkdir(parents=True, mode=0o700)
        ends = ends or self.ends
        key, certificate = self._signed(role, addresses, ends)
        whole_files.write_bytes(folder / AUTHORITY, self.certificate.public_bytes(Encoding.PEM), durable=True)
        whole_files.write_bytes(folder / CERTIFICATE, certificate, durable=True)
        whole_files.write_text(folder / ROLE, f'role = "{role}"\nends = {ends:%Y-%m-%dT%H:%M:%SZ}\n', durable=True)
        _write_private(folder / KEY, key)
        _write_proxy_keys(folder / PROXY, (ends - datetime.now(UTC)) / timedelta(days=1))

    def _signed(self, name: str, addresses: Sequence[str], ends: datetime) -> tuple[bytes, bytes]:
        """Return a new private key and its certificate, both PEM."""
        key = ec.generate_private_key(ec.SECP256R1())
        both = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH])
        certificate = (
            self._begun(_name(name), key, ends)
            .issuer_name(self.certificate.subject)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.SubjectAlternativeName([_address(address) for address in addresses]), critical=False)
            .add_extension(both, critical=False)
            .sign(self._key, hashes.SHA256())
        )
        return _pem_of(key), certificate.public_bytes(Encoding.PEM)

    def _begun(self, name: x509.Name, key: ec.EllipticCurvePrivateKey, ends: datetime) -> x509.CertificateBuilder:
        begins = min(self._from, ends - _BEFORE)
        serial = x509.random_serial_number()
        builder = x509.CertificateBuilder().subject_name(name).public_key(key.public_key()).serial_number(serial)
        return builder.not_valid_before(begins).not_valid_after(ends)


def new(folder: Path, addresses: Mapping[str, Sequence[str]] | None = None, days: float = 365.0) -> tuple[Held, ...]:
    """Create an authority, and a folder of keys for each role.

    Args:
        folder: The parent folder.
        addresses: Role -> names and IP addresses at which other machines reach this role's machine, in addition to loopback.
        days: Validity.

    Raises:
        AccessError: There are keys already.
        WriteError: They cannot be written; then no files are left behind.
    """
    there = [name for name in (OF_AUTHORITY, *(role.name for role in ROLES)) if (folder / name).exists()]
    if there:
        raise AccessError(f"{folder} already has {', '.join(there)}: keys are not overwritten; give another folder")
    authority = Authority(days)
    try:
        with whole_files.explained(folder):
            authority.write(folder / OF_AUTHORITY)
            for role in ROLES:
                authority.issue(folder / role.name, role.name, (*HERE, *(addresses or {}).get(role.name, ())))
    except whole_files.WriteError:
        for name in (OF_AUTHORITY, *(role.name for role in ROLES)):  # an incomplete set of keys would prevent the next attempt
            shutil.rmtree(folder / name, ignore_errors=True)
        raise
    return tuple(held(folder))


def held(folder: Path) -> Iterator[Held]:
    """Yield the certificates in a folder that `new` has made, or in a role's folder.

    Raises:
        AccessError: There are none.
    """
    places = [place for place in (folder, *(folder / role.name for role in ROLES)) if (place / CERTIFICATE).is_file()]
    if not places:
        raise AccessError(f"no {CERTIFICATE} in {folder}, nor in its role folders; `sextant keys new DIR` makes certificates")
    for place in places:
        certificate = _certificate(place / CERTIFICATE)
        names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        if len(names) != 1:
            raise AccessError(f"{place / CERTIFICATE}: a certificate of one role expected, found {len(names)} common names")
        yield Held(str(names[0].value), certificate.not_valid_after_utc, place / CERTIFICATE)


def _certificate(path: Path) -> x509.Certificate:
    pem = _read(path)
    try:
        certificate = x509.load_pem_x509_certificate(pem)
        _ = certificate.subject, certificate.not_valid_after_utc  # parsed lazily, only on access
    except (ValueError, x509.InvalidVersion):
        raise AccessError(f"{path}: a valid PEM certificate expected") from None
    return certificate


def _read(path: Path) -> bytes:
    try:
        return read_bytes(path, _MAX_PEM_BYTES)
    except FileError as error:
        raise AccessError(str(error)) from None


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _address(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        return x509.DNSName(text)


def _write_proxy_keys(folder: Path, days: float) -> None:
    """Write the certificates for the link between TLS proxy and router of one machine.

    See `sextant.deploy.security.tls_proxy`. Their authority signs nothing else, and its private key is never written.
    """
    folder.mkdir(mode=0o700)
    authority = Authority(days)
    whole_files.write_bytes(folder / AUTHORITY, authority.certificate.public_bytes(Encoding.PEM), durable=True)
    for name in (ROUTER, *(role.name for role in ROLES)):
        key, certificate = authority._signed(name, HERE, authority.ends)
        _write_private(folder / f"{name}.pem", certificate + key)


def _pem_of(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def _write_private(file: Path, pem: bytes) -> None:
    """Write a file that is readable only for its owner from the start."""
    whole_files.write_bytes(file, pem, durable=True, mode=0o600)
