"""Certificates as values: made, signed, read. No files, no clock: `now` is an argument.

The authority signs the hub's certificate and, for each client, an intermediate certificate ("link") whose
private key signs the client's certificate once and is then thrown away. The hub trusts the links of the
certificates in force and nothing else: taking a link out of that list revokes the one certificate below it,
in the TLS handshake already. zenoh has no revocation lists.
"""

from __future__ import annotations

import ipaddress
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Literal, get_args

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID, ObjectIdentifier

from vad.errors import VadError

Role = Literal["viewer", "agent", "admin"]
ROLES: tuple[Role, ...] = get_args(Role)

AUTHORITY_DAYS = 20 * 365
HUB_DAYS = 365
CLIENT_DAYS = 365
BACKDATED = timedelta(hours=1)
"""A client whose clock is a little behind must not find its new certificate not yet valid."""


@dataclass(frozen=True, slots=True)
class Authority:
    """The hub's certificate authority, both PEM."""

    certificate: bytes
    key: bytes


@dataclass(frozen=True, slots=True)
class Issued:
    """A client's certificate.

    common_name: unique, names it in the hub's list and in the access rules. chain: the certificate, then its
    link, PEM; key: its private key, PEM, kept nowhere else; link: the link alone.
    """

    common_name: str
    chain: bytes
    key: bytes
    link: bytes
    not_before: datetime
    not_after: datetime


def new_authority(hub: str, now: datetime) -> Authority:
    """An authority for one hub, good for AUTHORITY_DAYS."""
    key = _new_key()
    name = _name(f"vad authority of {hub}")
    certificate = (
        _builder(name, name, key.public_key(), key, now, now + timedelta(days=AUTHORITY_DAYS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=1), critical=True)
        .add_extension(_may_sign(), critical=True)
        .sign(key, hashes.SHA256())
    )
    return Authority(_pem(certificate), _key_pem(key))


def new_hub_certificate(authority: Authority, hub: str, addresses: Iterable[str], now: datetime) -> bytes:
    """Certificate and private key of the hub's TLS listener in one PEM, so that both change at once.

    addresses: host names and IP addresses that clients may check it against.
    """
    issuer, issuer_key = _opened(authority)
    key = _new_key()
    certificate = (
        _builder(
            _name(f"vad hub {hub}"),
            issuer.subject,
            key.public_key(),
            issuer_key,
            now,
            _until(issuer, now + timedelta(days=HUB_DAYS)),
        )
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_only_for(ExtendedKeyUsageOID.SERVER_AUTH), critical=False)
        .add_extension(x509.SubjectAlternativeName([_general_name(a) for a in addresses]), critical=False)
        .sign(issuer_key, hashes.SHA256())
    )
    return _pem(certificate) + _key_pem(key)


def new_client(authority: Authority, role: Role, name: str, days: float, now: datetime) -> Issued:
    """A certificate for a viewer, an agent or an admin called `name`, good for `days`."""
    issuer, issuer_key = _opened(authority)
    not_after = _until(issuer, now + timedelta(days=days))
    common_name = f"{role}.{name}.{secrets.token_hex(4)}"
    usage = _only_for(ExtendedKeyUsageOID.CLIENT_AUTH)
    link_key = _new_key()
    link = (
        _builder(
            _name(f"link of {common_name}"), issuer.subject, link_key.public_key(), issuer_key, now, not_after
        )
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_may_sign(), critical=True)
        .add_extension(usage, critical=False)
        .sign(issuer_key, hashes.SHA256())
    )
    key = _new_key()
    certificate = (
        _builder(_name(common_name), link.subject, key.public_key(), link_key, now, not_after)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(usage, critical=False)
        .sign(link_key, hashes.SHA256())
    )
    return Issued(
        common_name,
        _pem(certificate) + _pem(link),
        _key_pem(key),
        _pem(link),
        certificate.not_valid_before_utc,
        certificate.not_valid_after_utc,
    )


def ends_at(pem: bytes) -> datetime:
    """When the first certificate in `pem` ends; VadError where there is none."""
    return _first(pem).not_valid_after_utc


def addresses_of(pem: bytes) -> tuple[str, ...]:
    """The host names and addresses of the first certificate in `pem`."""
    try:
        found = _first(pem).extensions.get_extension_for_class(x509.SubjectAlternativeName)
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in found.value)


def days_left(end: datetime, now: datetime) -> float:
    """Days until `end`; negative when it is past."""
    return (end - now) / timedelta(days=1)


def utc_now() -> datetime:
    """Wall time: what certificates count in."""
    return datetime.now(UTC)


def _first(pem: bytes) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(pem)
    except ValueError as error:
        raise VadError("no certificate in PEM") from error


def _opened(authority: Authority) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    try:
        key = serialization.load_pem_private_key(authority.key, password=None)
    except (ValueError, TypeError) as error:
        raise VadError("the authority's key cannot be read") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise VadError("the authority's key is of a kind that vad does not make")
    return _first(authority.certificate), key


def _new_key() -> ec.EllipticCurvePrivateKey:
    return ec.generate_private_key(ec.SECP256R1())


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    public_key: ec.EllipticCurvePublicKey,
    signer: ec.EllipticCurvePrivateKey,
    now: datetime,
    not_after: datetime,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public_key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(now, not_after) - BACKDATED)
        .not_valid_after(not_after)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public_key), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False
        )
    )


def _until(issuer: x509.Certificate, wanted: datetime) -> datetime:
    """A certificate does not outlive who signed it."""
    return min(wanted, issuer.not_valid_after_utc)


def _may_sign() -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=False,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=True,
        crl_sign=False,
        encipher_only=False,
        decipher_only=False,
    )


def _only_for(use: ObjectIdentifier) -> x509.ExtendedKeyUsage:
    return x509.ExtendedKeyUsage([use])


def _general_name(address: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        pass
    try:
        return x509.DNSName(address)
    except ValueError as error:
        raise VadError("neither a host name nor an IP address", where=address) from error


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
