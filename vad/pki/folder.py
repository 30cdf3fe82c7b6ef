"""The hub's PKI folder: its authority, its own certificate, and the list of what was issued.

| file | what |
|---|---|
| `ca.pem`, `ca.key` | the authority. The key may be kept elsewhere: then nothing is issued or renewed here |
| `hub.pem` | the hub's certificate and private key |
| `certificates.json` | the register (vad.pki.register) |

Everything is 0600 in a folder of 0700. A client's private key is never here: it goes out with its
certificate.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import msgspec

from vad.errors import VadError
from vad.limits import UNREADABLE
from vad.pki.certificates import (
    Authority,
    Issued,
    Role,
    addresses_of,
    ends_at,
    new_authority,
    new_client,
    new_hub_certificate,
)
from vad.pki.files import locked, make_folder, read_private, write_private
from vad.pki.register import Certificate, Register, check_name

_HOW_TO_BEGIN = "`vad pki init` makes the hub's certificate authority"


@dataclass(frozen=True, slots=True)
class HubFiles:
    """What a TLS listener needs. listener: PEM file with certificate and key; ends_at: of the certificate."""

    register: Register
    listener: Path
    ends_at: datetime


class PkiFolder:
    """One hub's PKI folder at `path`; every method raises VadError where it cannot be read or written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.authority_file = path / "ca.pem"
        self.hub_file = path / "hub.pem"
        self.register_file = path / "certificates.json"
        self._key_file = path / "ca.key"

    @property
    def exists(self) -> bool:
        """Whether `init` was done here."""
        return self.register_file.is_file()

    @property
    def can_sign(self) -> bool:
        """Whether the authority's private key is here."""
        return self._key_file.is_file()

    def init(self, hub: str, addresses: Iterable[str], now: datetime) -> None:
        """Make the authority and the hub's certificate; VadError where there is one already."""
        if self.exists:
            raise VadError(
                "there is an authority already",
                where=str(self.path),
                remedy="`vad pki list` shows what it issued. To begin anew, move the folder away: "
                "every client then needs a new certificate",
            )
        make_folder(self.path)
        authority = new_authority(hub, now)
        write_private(self._key_file, authority.key)
        write_private(self.authority_file, authority.certificate)
        write_private(self.hub_file, new_hub_certificate(authority, hub, addresses, now))
        self._save(Register(hub=hub))

    def register(self) -> Register:
        """What was issued."""
        if not self.path.is_dir():
            raise VadError("there are no certificates yet", where=str(self.path), remedy=_HOW_TO_BEGIN)
        try:
            content = self.register_file.read_bytes()
        except FileNotFoundError:
            raise VadError(
                "there are no certificates yet", where=str(self.path), remedy=_HOW_TO_BEGIN
            ) from None
        except OSError as error:
            raise VadError(
                f"cannot be read ({error.strerror})",
                where=str(self.register_file),
                remedy="Run it as the folder's owner, or with sudo",
            ) from error
        try:
            return msgspec.json.decode(content, type=Register)
        except UNREADABLE as error:
            raise VadError(
                f"the list of certificates is damaged ({error})",
                where=str(self.register_file),
                remedy="Put it back from a backup; without it nobody is let in from the network",
            ) from error

    def hub_files(self) -> HubFiles:
        """What the hub's TLS listener needs."""
        register = self.register()
        return HubFiles(register, self.hub_file, ends_at(read_private(self.hub_file)))

    def authority_certificate(self) -> bytes:
        """The authority's certificate, PEM."""
        return read_private(self.authority_file)

    def hub_addresses(self) -> tuple[str, ...]:
        """The names and addresses in the hub's certificate."""
        return addresses_of(read_private(self.hub_file))

    def issue(self, role: Role, name: str, days: float, now: datetime) -> Issued:
        """A certificate for a new name; VadError where the name has one in force."""
        check_name(name)
        with locked(self._existing()):
            register = self.register()
            if holders := register.named(name, now):
                raise VadError(
                    f"there is a certificate in force with this name ({holders[0].role})",
                    where=name,
                    remedy=f"`vad pki rotate {name}` makes its successor; or choose another name",
                )
            return self._issue(register, role, name, days, now)

    def rotate(self, who: str, days: float, now: datetime, *, revoke_old: bool) -> tuple[Certificate, Issued]:
        """A successor for the certificates of a name. revoke_old: the old ones end at once.

        The newest of the old ones and the successor.
        """
        with locked(self._existing()):
            register = self.register()
            old = register.find(who, now)
            if revoke_old:
                register = register.with_revoked((c.common_name for c in old), now)
            return old[-1], self._issue(register, old[-1].role, old[-1].name, days, now)

    def revoke(self, who: str, now: datetime) -> tuple[Certificate, ...]:
        """Take back every certificate in force of a name, or the one of a common name; what was taken."""
        with locked(self._existing()):
            register = self.register()
            taken = register.find(who, now)
            self._save(register.with_revoked((c.common_name for c in taken), now))
            return taken

    def rotate_hub(self, addresses: Iterable[str], now: datetime) -> datetime:
        """A new certificate and key for the hub itself; when it ends."""
        with locked(self._existing()):
            pem = new_hub_certificate(self._authority(), self.register().hub, addresses, now)
            write_private(self.hub_file, pem)
            return ends_at(pem)

    def _issue(self, register: Register, role: Role, name: str, days: float, now: datetime) -> Issued:
        issued = new_client(self._authority(), role, name, days, now)
        self._save(register.with_issued(role, name, issued))
        return issued

    def _authority(self) -> Authority:
        if not self.can_sign:
            raise VadError(
                "the authority's private key is not here",
                where=str(self._key_file),
                remedy="Run this where you keep it, on a copy of this folder, and bring back what changed",
            )
        return Authority(self.authority_certificate(), read_private(self._key_file))

    def _existing(self) -> Path:
        self.register()
        return self.path

    def _save(self, register: Register) -> None:
        text = msgspec.json.format(msgspec.json.encode(register), indent=2)
        write_private(self.register_file, text + b"\n")
