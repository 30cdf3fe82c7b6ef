"""Certificates: what they are good for, how long, and that the chain holds for others' eyes, too."""

from __future__ import annotations

import subprocess
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from hypothesis import given
from hypothesis import strategies as st

from vad.errors import VadError
from vad.pki.certificates import (
    AUTHORITY_DAYS,
    HUB_DAYS,
    ROLES,
    Authority,
    addresses_of,
    days_left,
    ends_at,
    new_authority,
    new_client,
    new_hub_certificate,
)
from vad.pki.register import SOON_DAYS, Register, check_name, state_of

NOW = datetime(2026, 5, 1, 12, tzinfo=UTC)
AUTHORITY = new_authority("home", NOW)


def test_the_chain_holds_for_openssl(tmp_path: Path) -> None:
    real_now = datetime.now(UTC)
    authority = new_authority("home", real_now)
    issued = new_client(authority, "viewer", "tablet", 10, real_now)
    (tmp_path / "ca.pem").write_bytes(authority.certificate)
    (tmp_path / "chain.pem").write_bytes(issued.chain)
    (tmp_path / "hub.pem").write_bytes(new_hub_certificate(authority, "home", ["hub.local"], real_now))

    def verify(purpose: str, file: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["openssl", "verify", "-x509_strict", "-purpose", purpose, "-CAfile", "ca.pem"]
            + (["-untrusted", file] if file == "chain.pem" else [])
            + [file],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )

    assert verify("sslclient", "chain.pem").returncode == 0, verify("sslclient", "chain.pem").stderr
    assert verify("sslserver", "hub.pem").returncode == 0, verify("sslserver", "hub.pem").stderr
    assert verify("sslserver", "chain.pem").returncode != 0, "a client is no server"
    assert verify("sslclient", "hub.pem").returncode != 0, "the hub is no client"


@pytest.mark.parametrize("role", ROLES)
def test_a_common_name_is_unique_and_short_enough(role: str) -> None:
    names = {new_client(AUTHORITY, "agent", "n" * 32, 1, NOW).common_name for _ in range(5)}
    assert len(names) == 5
    issued = new_client(AUTHORITY, role, "n" * 32, 1, NOW)  # type: ignore[arg-type]
    certificate, link = x509.load_pem_x509_certificates(issued.chain)
    (common_name,) = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    assert common_name.value == issued.common_name
    assert issued.common_name.startswith(f"{role}.")
    assert certificate.issuer == link.subject
    assert x509.load_pem_x509_certificate(issued.link) == link


def test_each_client_hangs_on_a_link_of_its_own_that_signs_nothing_else() -> None:
    one, other = (new_client(AUTHORITY, "viewer", name, 1, NOW) for name in ("a", "b"))
    links = [x509.load_pem_x509_certificates(issued.chain)[1] for issued in (one, other)]
    assert links[0].public_key() != links[1].public_key()
    for link in links:
        constraints = link.extensions.get_extension_for_class(x509.BasicConstraints).value
        assert (constraints.ca, constraints.path_length) == (True, 0)
        usage = link.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        assert list(usage) == [ExtendedKeyUsageOID.CLIENT_AUTH], "nor does it make servers"


def test_nothing_outlives_its_authority() -> None:
    late = NOW + timedelta(days=AUTHORITY_DAYS - 10)
    issued = new_client(AUTHORITY, "viewer", "tablet", 365, late)
    assert issued.not_after == ends_at(AUTHORITY.certificate)
    hub = new_hub_certificate(AUTHORITY, "home", ["h"], late)
    assert days_left(ends_at(hub), late) < 11


def test_the_hubs_names_are_in_its_certificate() -> None:
    addresses = ("hub.local", "192.168.1.10", "fe80::1")
    pem = new_hub_certificate(AUTHORITY, "home", addresses, NOW)
    assert addresses_of(pem) == addresses
    assert days_left(ends_at(pem), NOW) == pytest.approx(HUB_DAYS, abs=0.1)
    assert b"PRIVATE KEY" in pem
    assert addresses_of(AUTHORITY.certificate) == ()
    with pytest.raises(VadError, match="neither a host name"):
        new_hub_certificate(AUTHORITY, "home", ["küche"], NOW)


@pytest.mark.parametrize("key", [b"", b"no key", AUTHORITY.certificate])
def test_a_damaged_authority_is_said(key: bytes) -> None:
    with pytest.raises(VadError, match="authority's key"):
        new_client(Authority(AUTHORITY.certificate, key), "viewer", "a", 1, NOW)
    with pytest.raises(VadError, match="no certificate"):
        new_client(Authority(b"nothing", AUTHORITY.key), "viewer", "a", 1, NOW)


def test_states_follow_the_time() -> None:
    issued = new_client(AUTHORITY, "viewer", "tablet", 100, NOW)
    register = Register(hub="home").with_issued("viewer", "tablet", issued)
    (certificate,) = register.certificates
    assert certificate.state(NOW) == "valid"
    assert certificate.state(NOW + timedelta(days=100 - SOON_DAYS, hours=1)) == "ends soon"
    assert certificate.state(NOW + timedelta(days=101)) == "expired"
    assert register.in_force(NOW + timedelta(days=101)) == ()
    revoked = register.with_revoked([issued.common_name], NOW)
    assert revoked.certificates[0].state(NOW) == "revoked"
    again = revoked.with_revoked([issued.common_name], NOW + timedelta(days=1))
    assert again == revoked, "it keeps the time at which it was taken back"
    assert state_of(NOW, NOW) == "expired"


@given(st.text(max_size=40))
def test_a_name_is_a_chunk_of_a_key_or_refused(name: str) -> None:
    try:
        check_name(name)
    except VadError:
        return
    assert 1 <= len(name) <= 32
    assert not set(name) - set("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_")
