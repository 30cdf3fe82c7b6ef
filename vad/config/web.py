"""The page for browsers: where it is, and who may change something there."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

HostName = Annotated[str, Meta(pattern=r"^[a-z0-9]([a-z0-9.-]{0,251}[a-z0-9])?$")]


class WebSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A page for browsers on the loopback interface: the floor plan, its devices, how everything is.

    port: of http://127.0.0.1:<port>/; left out: none
    address: of the loopback interface; the network gets the page through a reverse proxy
    names: host names, in small letters, under which a reverse proxy passes the page on
    token_file: holds a secret (`vad web token FILE` writes one); who gives it on the page may rename, ignore
        and forget devices. Left out: the page only shows
    """

    port: Annotated[int, Meta(ge=1, le=65535, examples=[9748])] | None = None
    address: str = "127.0.0.1"
    names: Annotated[tuple[HostName, ...], Meta(examples=[["vad.home.arpa"]])] = ()
    token_file: Annotated[str, Meta(examples=["/etc/vad/web.token"])] | None = None
