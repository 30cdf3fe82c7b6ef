"""What a client carries: the authority's certificate, its own, its private key, and settings for zenoh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vad.errors import VadError
from vad.pki.files import make_folder, read_private, write_private

if TYPE_CHECKING:  # who only reads credentials needs no cryptography
    from vad.pki.certificates import Issued

ENVIRONMENT = "VAD_CREDENTIALS"
"""Names the folder for programs that are not told of one."""

_AUTHORITY, _CERTIFICATE, _KEY, _ZENOH = "ca.pem", "client.pem", "client.key", "zenoh.json5"

_SETTINGS = """\
// For any zenoh program, in any language: {common_name}
// Run it in this folder, or write the three file names with their path.
{{
  mode: "client",
  connect: {{ endpoints: ["{endpoint}"] }},
  scouting: {{ multicast: {{ enabled: false }}, gossip: {{ enabled: false }} }},
  transport: {{ link: {{ tls: {{
    root_ca_certificate: "{authority}",
    connect_certificate: "{certificate}",
    connect_private_key: "{key}",
    enable_mtls: true,
    // The authority signs no other server than this hub: its address may change.
    verify_name_on_connect: false,
  }} }} }},
}}
"""


@dataclass(frozen=True, slots=True)
class Credentials:
    """The files of a client, checked to be there and private. Nothing is read into memory but by zenoh."""

    authority: Path
    certificate: Path
    key: Path


def write_credentials(folder: Path, issued: Issued, authority: bytes, endpoint: str) -> None:
    """Make the folder that is carried to a client; VadError where it cannot be, or is not empty.

    endpoint: where the client finds the hub, e.g. tls/192.168.1.10:7448.
    """
    make_folder(folder)
    write_private(folder / _AUTHORITY, authority)
    write_private(folder / _CERTIFICATE, issued.chain)
    write_private(folder / _KEY, issued.key)
    settings = _SETTINGS.format(
        common_name=issued.common_name,
        endpoint=endpoint,
        authority=_AUTHORITY,
        certificate=_CERTIFICATE,
        key=_KEY,
    )
    write_private(folder / _ZENOH, settings.encode())


def load_credentials(folder: Path) -> Credentials:
    """The client's files in `folder`; VadError where one is missing or the key is open to others."""
    found = Credentials(folder / _AUTHORITY, folder / _CERTIFICATE, folder / _KEY)
    for path in (found.authority, found.certificate, found.key):
        if not path.is_file():
            raise VadError(
                "no such file",
                where=str(path),
                remedy="`vad pki issue` on the hub makes the folder; copy all of it here",
            )
    read_private(found.key)
    return found
