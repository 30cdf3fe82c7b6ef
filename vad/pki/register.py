"""The list of certificates that were issued: who has which, until when, and what was taken back. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import datetime
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from vad.errors import VadError
from vad.pki.certificates import Issued, Role, days_left

State = Literal["valid", "ends soon", "expired", "revoked"]

SOON_DAYS = 30.0
"""From here on a certificate counts as one that ends soon, and the daemon renews the hub's own."""

_NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")


class Certificate(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One issued certificate. link: PEM of the intermediate above it, which the hub trusts while in force."""

    common_name: str
    role: Role
    name: Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{1,32}$")]
    issued_at: datetime
    ends_at: datetime
    revoked_at: datetime | None = None
    link: str

    def state(self, now: datetime) -> State:
        """How it is at `now`."""
        if self.revoked_at is not None:
            return "revoked"
        return state_of(self.ends_at, now)

    def in_force(self, now: datetime) -> bool:
        """Whether the hub lets it in."""
        return self.state(now) in ("valid", "ends soon")


class Register(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything one authority has issued, in order. hub: the hub it is for."""

    schema: Literal["vad.pki.v1"] = "vad.pki.v1"
    hub: str
    certificates: tuple[Certificate, ...] = ()

    def in_force(self, now: datetime) -> tuple[Certificate, ...]:
        """What the hub lets in at `now`."""
        return tuple(c for c in self.certificates if c.in_force(now))

    def named(self, who: str, now: datetime) -> tuple[Certificate, ...]:
        """The certificates in force of a name, or the one of a common name."""
        return tuple(c for c in self.in_force(now) if who in (c.name, c.common_name))

    def find(self, who: str, now: datetime) -> tuple[Certificate, ...]:
        """As `named`; VadError with the names there are where that is nobody."""
        found = self.named(who, now)
        if not found:
            names = sorted({c.name for c in self.in_force(now)})
            hint = f"In force: {', '.join(names)}" if names else "None is in force"
            raise VadError("no certificate in force has this name", where=who, remedy=hint)
        return found

    def with_issued(self, role: Role, name: str, issued: Issued) -> Register:
        """With one more certificate."""
        certificate = Certificate(
            common_name=issued.common_name,
            role=role,
            name=name,
            issued_at=issued.not_before,
            ends_at=issued.not_after,
            link=issued.link.decode("ascii"),
        )
        return msgspec.structs.replace(self, certificates=(*self.certificates, certificate))

    def with_revoked(self, common_names: Iterable[str], now: datetime) -> Register:
        """With these taken back at `now`; one that was taken back before keeps its time."""
        gone = frozenset(common_names)
        return msgspec.structs.replace(
            self,
            certificates=tuple(
                msgspec.structs.replace(c, revoked_at=now)
                if c.common_name in gone and c.revoked_at is None
                else c
                for c in self.certificates
            ),
        )


def state_of(end: datetime, now: datetime) -> State:
    """How a certificate that ends at `end` is at `now`."""
    left = days_left(end, now)
    if left <= 0:
        return "expired"
    return "ends soon" if left <= SOON_DAYS else "valid"


def check_name(name: str) -> str:
    """`name` where it can be a client's name, which is also an agent's key; VadError otherwise."""
    if not _NAME.fullmatch(name):
        raise VadError(
            "not a name for a certificate",
            where=repr(name),
            remedy="Use 1 to 32 letters, digits, '-' or '_', e.g. tablet",
        )
    return name
