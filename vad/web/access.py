"""Where the page is, and who may change something: the token in a file, the cookie that stands for it.

Tokens and cookies are compared in constant time.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import os
import secrets
import stat
from collections import deque
from dataclasses import dataclass
from pathlib import Path

from vad.errors import ConfigError

MIN_CHARACTERS = 32
"""Of a token: nobody guesses one."""
MAX_BYTES = 1024
LOGIN_S = 30 * 86_400
"""How long a log-in lasts."""
TRIES, TRIES_S = 10, 60.0
"""So many wrong tokens in so long, then the page waits."""


def new_token() -> str:
    """A fresh secret."""
    return secrets.token_urlsafe(32)


def write_token(path: Path) -> str:
    """Write a fresh token in place of what was there; the token.

    Only its owner can read it, and its group where the folder hands its own on: that is the daemon's then.
    """
    token = new_token()
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            if path.absolute().parent.stat().st_mode & stat.S_ISGID:
                os.fchmod(file.fileno(), 0o640)
            file.write(f"{token}\n")
        draft.replace(path)
    except OSError as error:
        draft.unlink(missing_ok=True)
        raise ConfigError(f"cannot be written ({error.strerror})", where=str(path)) from error
    return token


class TokenFile:
    """The file with the token, read whenever it is asked for: a new token counts at once."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> bytes:
        """The token; ConfigError where there is none that can be trusted."""
        remedy = f"Make one with: vad web token {self.path}"
        try:
            with self.path.open("rb") as file:
                mode = os.fstat(file.fileno()).st_mode
                text = file.read(MAX_BYTES + 1)
        except OSError as error:
            raise ConfigError(
                f"the token cannot be read ({error.strerror})", where=str(self.path), remedy=remedy
            ) from error
        if mode & (stat.S_IRWXO | stat.S_IWGRP):
            raise ConfigError(
                "others than its owner can read or change the token",
                where=str(self.path),
                remedy=f"Keep them out: chmod 600 {self.path}",
            )
        token = text.strip()
        if not MIN_CHARACTERS <= len(token) <= MAX_BYTES or not token.isascii() or len(token.split()) != 1:
            raise ConfigError(
                f"the token is not one word of {MIN_CHARACTERS} letters or more",
                where=str(self.path),
                remedy=remedy,
            )
        return token


@dataclass(frozen=True, slots=True)
class Access:
    """Where the page is and who may change something. token: None where nobody may."""

    port: int
    address: str = "127.0.0.1"
    names: tuple[str, ...] = ()
    token: TokenFile | None = None


def check_address(address: str, *, where: str) -> None:
    """ConfigError for an address that others than the hub itself could reach."""
    try:
        loopback = ipaddress.ip_address(address).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        raise ConfigError(
            f"the page is served on the loopback interface only, and {address!r} is none of its addresses",
            where=where,
            remedy="Leave it at 127.0.0.1; to see the page from elsewhere let a reverse proxy with TLS and a "
            "log-in (Caddy, nginx) or Home Assistant's ingress pass it on, and name its host in web.names",
        )


def same_token(token: bytes, given: str) -> bool:
    """Whether this is the token; takes as long where it is not."""
    ours, theirs = (hashlib.sha256(text).digest() for text in (token, _bytes(given.strip())))
    return hmac.compare_digest(ours, theirs)


def make_cookie(token: bytes, now_s: float) -> str:
    """What a browser that gave the token shows from now on. now_s: wall time."""
    until = f"{int(now_s) + LOGIN_S}"
    return f"{until}.{_seal(token, until)}"


def cookie_holds(token: bytes, cookie: str, now_s: float) -> bool:
    """Whether the cookie was made with this token and has not run out."""
    until, _, seal = cookie.partition(".")
    sealed = hmac.compare_digest(_seal(token, until).encode(), _bytes(seal))
    return sealed and until.isascii() and until.isdigit() and now_s < int(until)


def _bytes(text: str) -> bytes:
    return text.encode(errors="replace")  # headers may hold what is no text


def _seal(token: bytes, until: str) -> str:
    key = hashlib.sha256(b"vad web log-in\0" + token).digest()
    return hmac.new(key, until.encode(), hashlib.sha256).hexdigest()


class Tries:
    """Counts wrong tokens, so that guessing is slow."""

    def __init__(self) -> None:
        self._wrong_s: deque[float] = deque(maxlen=TRIES)

    def wait_s(self, now_s: float) -> float:
        """How long nobody may try any more; 0 where anybody may. now_s: of a clock that never goes back."""
        if len(self._wrong_s) < TRIES:
            return 0.0
        return max(0.0, self._wrong_s[0] + TRIES_S - now_s)

    def wrong(self, now_s: float) -> None:
        """Somebody gave a wrong one."""
        self._wrong_s.append(now_s)
