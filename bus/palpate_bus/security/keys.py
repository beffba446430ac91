"""Certificates for a bus of known members: a certificate authority and one certificate per name.

    <folder>/ca.pem, ca.key                     the authority; its key only signs: do not store it on the machines of a run
    <folder>/<name>/ca.pem, cert.pem, key.pem   files of one member (PALPATE_TLS=<folder>/<name>)

Keys are ECDSA on P-256 (RFC 5480), certificates X.509 version 3 (RFC 5280). The name is the subject's common name, by which a
router identifies its members (`access.py`). Needs the `cryptography` package: `pip install 'palpate[run]'`.
"""

import ipaddress
import os
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from palpate_bus.contract import contract
from palpate_bus.security.access import OPERATOR, ROUTER, VIEWER
from palpate_errors import UserError

CA, CERTIFICATE, KEY = "ca.pem", "cert.pem", "key.pem"
CA_KEY = "ca.key"
CA_YEARS = 10
DAYS = 825
"""Default validity of a certificate [days]."""
HOSTS = ("localhost", "127.0.0.1", "::1")
"""Names that every router certificate contains."""
_SKEW = timedelta(minutes=5)
"""Tolerated clock difference."""


class KeysError(UserError):
    """Keys that cannot be created or read. Names the file and what to do."""


class Certificate(NamedTuple):
    """Contents of a certificate."""

    name: str
    path: Path
    until: datetime
    fingerprint: str
    """SHA-256, hexadecimal."""
    hosts: tuple[str, ...]
    """Names and addresses of its owner."""

    @property
    def expired(self) -> bool:
        """True if the certificate has expired."""
        return datetime.now(UTC) >= self.until


def members() -> tuple[str, ...]:
    """Return the names with a certificate: all roles, the router, a viewer (may only read) and an operator (may also stop)."""
    return (*contract().roles, ROUTER, VIEWER, OPERATOR)


def init(folder: Path, names: Sequence[str] = (), hosts: Sequence[str] = (), days: int = DAYS) -> list[Certificate]:
    """Create what is missing in `folder`: the authority, and a certificate for each of `names` (default `members()`).

    `hosts`: further names and addresses of the router. Valid certificates are kept. Expired ones, and the router's if it lacks
    one of `hosts`, are replaced. Returns the new certificates. Raises KeysError if the authority is incomplete.
    """
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    authority, signer = _authority(folder)
    made = []
    for name in names or members():
        place = folder / name
        known = (*HOSTS, *hosts) if name == ROUTER else ()
        if (place / CERTIFICATE).exists():
            before = read(place / CERTIFICATE)
            known = tuple(dict.fromkeys((*before.hosts, *known))) if known else ()
            if not before.expired and set(known) <= set(before.hosts):
                continue
        place.mkdir(exist_ok=True, mode=0o700)
        key = ec.generate_private_key(ec.SECP256R1())
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if known else [])]
        builder = x509.CertificateBuilder(authority.subject, _name(name), key.public_key())
        limits = x509.BasicConstraints(ca=False, path_length=None), True
        called = x509.SubjectAlternativeName([_host(host) for host in known or (name,)]), False
        subject = _sign(builder, days, signer, limits, called, (x509.ExtendedKeyUsage(uses), False))
        _write_key(place / KEY, key)
        (place / CERTIFICATE).write_bytes(subject.public_bytes(serialization.Encoding.PEM))
        (place / CA).write_bytes(authority.public_bytes(serialization.Encoding.PEM))
        made.append(read(place / CERTIFICATE))
    return made


def read(path: Path) -> Certificate:
    """Return the certificate in a PEM file. Raises KeysError."""
    try:
        loaded = x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError) as error:
        raise KeysError(f"{path}: not a certificate: {error}; create it with palpate keys init") from error
    name = str(loaded.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
    hosts: tuple[str, ...] = ()
    with suppress(x509.ExtensionNotFound):
        named = loaded.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        hosts = tuple(str(host.value) for host in named)
    return Certificate(name, path, loaded.not_valid_after_utc, loaded.fingerprint(hashes.SHA256()).hex(), hosts)


def certificates(folder: Path) -> list[Certificate]:
    """Return all certificates in a folder of `init`, the authority's first."""
    return [read(path) for path in (folder / CA, *sorted(folder.glob(f"*/{CERTIFICATE}")))]


def _authority(folder: Path) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    certificate, key_file = folder / CA, folder / CA_KEY
    if certificate.exists() != key_file.exists():
        lacking = key_file if certificate.exists() else certificate
        raise KeysError(f"{lacking}: missing, so certificates cannot be signed; restore it, or choose another folder")
    if certificate.exists():
        key = serialization.load_pem_private_key(key_file.read_bytes(), None)
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise KeysError(f"{key_file}: not an ECDSA key")
        return x509.load_pem_x509_certificate(certificate.read_bytes()), key
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name("Palpate bus authority")
    usage = x509.KeyUsage(
        digital_signature=False, content_commitment=False, key_encipherment=False, data_encipherment=False, key_agreement=False,
        key_cert_sign=True, crl_sign=True, encipher_only=False, decipher_only=False,
    )  # fmt: skip
    limits = x509.BasicConstraints(ca=True, path_length=0), True
    made = _sign(x509.CertificateBuilder(name, name, key.public_key()), 365 * CA_YEARS, key, limits, (usage, True))
    _write_key(key_file, key)
    certificate.write_bytes(made.public_bytes(serialization.Encoding.PEM))
    return made, key


def _sign(
    builder: x509.CertificateBuilder, days: int, signer: ec.EllipticCurvePrivateKey, *extensions: tuple[x509.ExtensionType, bool]
) -> x509.Certificate:
    """Return a certificate that is valid for `days` from now on; `extensions`: each with whether it is critical."""
    now = datetime.now(UTC)
    builder = builder.serial_number(x509.random_serial_number()).not_valid_before(now - _SKEW)
    for extension, critical in extensions:
        builder = builder.add_extension(extension, critical)
    return builder.not_valid_after(now + timedelta(days=days)).sign(signer, hashes.SHA256())


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _write_key(path: Path, key: ec.EllipticCurvePrivateKey) -> None:
    """Write a private key to a file that is created with owner-only permissions."""
    path.unlink(missing_ok=True)
    text = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(text)
