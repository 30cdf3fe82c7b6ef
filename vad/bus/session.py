"""Opening a zenoh session with every unsafe default turned off.

zenoh itself listens on all interfaces and multicasts; here nothing is found but what is named. Plain TCP does
not leave the machine; a client off the hub comes over TLS with a certificate (vad.bus.gate lets it in).
"""

from __future__ import annotations

import ipaddress
import json
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import zenoh

from vad.errors import VadError
from vad.pki.credentials import ENVIRONMENT, load_credentials

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
TLS = "tls"

Mode = Literal["router", "peer", "client"]
Values = dict[str, Any]
"""Path in zenoh's configuration -> value."""

RETRY = {"period_init_ms": 200, "period_max_ms": 2000, "period_increase_factor": 2}
"""When a client whose router went away knocks again."""

_ENDPOINT = re.compile(r"([a-z]+)/([A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):([0-9]{1,5})")

LEASE_MS = 5000
"""A link that is silent for so long is dead: zenoh says something on it four times as often."""
OPEN_TIMEOUT_MS = 5000
"""How long a connection may take to open before it is tried again; a network that comes back is met soon."""

MAX_MESSAGE_BYTES = 64 * 1024 * 1024
"""What is put together from fragments, at most; zenoh's own limit is 1 GiB. A robot's map may be some MiB."""

TX_BATCHES = 16
"""64 KiB each, what may wait to be written to a link: 500 devices in one answer (0.6 MB) go out at once; with
zenoh's own 2 the sender and its writer wait for each other, five times as long."""

BLOCK_WAIT_US = 500_000
"""How long an answer waits for an asker that does not read, before zenoh cuts its link; it may come again."""

DROP_WAIT_US = 1000
DROP_WAIT_FRAGMENT_US = 5000
"""How long a put with DROP may wait for a reader that does not keep up: puts happen on the event loop."""


@dataclass(frozen=True, slots=True)
class BusSettings:
    """How a session connects.

    hub: the name in every key (`*`, any hub, only for a client). mode: the daemon is its own router, its gate
    a peer of that; a client
    connects to one and fails at once where there is none. listen, connect: zenoh endpoints. credentials: the
    folder of `vad pki issue`, for a client over TLS; None: the one that VAD_CREDENTIALS names.
    """

    hub: str = "home"
    mode: Mode = "router"
    listen: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    connect: tuple[str, ...] = ()
    credentials: Path | None = None


def check_endpoint(endpoint: str) -> None:
    """VadError where `endpoint` is neither `tcp/<loopback address>:<port>` nor `tls/<address>:<port>`.

    Whoever reaches a TCP port reads and writes everything, so plain TCP stays on the loopback interface.
    """
    parts = _ENDPOINT.fullmatch(endpoint)
    protocol, host, port = parts.groups() if parts else ("", "", "0")
    if not 0 < int(port) < 65536:
        raise VadError(
            "not an endpoint",
            where=endpoint,
            remedy=f"Write it as tcp/<address>:<port>, e.g. {DEFAULT_ENDPOINT}",
        )
    if protocol not in ("tcp", TLS):
        raise VadError(
            f"{protocol!r} endpoints are not supported",
            where=endpoint,
            remedy=f"Use tcp on the loopback interface, e.g. {DEFAULT_ENDPOINT}, or tls on the network, "
            f"e.g. tls/{host}:7448",
        )
    if protocol == "tcp" and not _is_loopback(host):
        raise VadError(
            "plain TCP on this address would show the home to everyone on the network",
            where=endpoint,
            remedy=f"Use {DEFAULT_ENDPOINT} on the hub. For the network: `vad pki init` and `vad pki issue "
            f"viewer NAME` on the hub, tls/0.0.0.0:7448 in its bus: listen:, and from elsewhere tls/<the "
            f"hub's address>:7448 with {ENVIRONMENT} naming the folder that was issued",
        )


def is_tls(endpoint: str) -> bool:
    """Whether an endpoint is for the network."""
    return endpoint.partition("/")[0] == TLS


def local_endpoints(endpoints: Iterable[str]) -> tuple[str, ...]:
    """Those on the loopback interface: what a daemon's own router listens on."""
    return tuple(endpoint for endpoint in endpoints if not is_tls(endpoint))


def tls_endpoints(endpoints: Iterable[str]) -> tuple[str, ...]:
    """Those for the network: what the gate listens on (vad.bus.gate)."""
    return tuple(endpoint for endpoint in endpoints if is_tls(endpoint))


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def plain_config(mode: Mode, *, listen: Iterable[str] = (), connect: Iterable[str] = ()) -> Values:
    """zenoh's settings with every unsafe default turned off, by their path in its configuration."""
    congestion = "transport/link/tx/queue/congestion_control"
    return {
        "mode": mode,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/retry": RETRY,
        "scouting/delay": 0,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
        "transport/unicast/open_timeout": OPEN_TIMEOUT_MS,
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        "transport/link/tx/queue/size/data": TX_BATCHES,
        f"{congestion}/block/wait_before_close": BLOCK_WAIT_US,
        f"{congestion}/drop/wait_before_drop": DROP_WAIT_US,
        f"{congestion}/drop/max_wait_before_drop_fragments": DROP_WAIT_FRAGMENT_US,
    }


def open_config(values: Values) -> zenoh.Session:
    """An open session with these settings; zenoh.ZError where it cannot be."""
    config = zenoh.Config()
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def open_session(settings: BusSettings) -> zenoh.Session:
    """An open session: no multicast, no gossip, no shared memory, only the endpoints given.

    Blocks for some milliseconds. Raises VadError for an endpoint that is refused, a port that is taken,
    missing credentials and, in client mode, a router that does not answer or does not let us in.
    """
    for endpoint in (*settings.listen, *settings.connect):
        check_endpoint(endpoint)
    listen = settings.listen if settings.mode == "router" else ()
    values = plain_config(settings.mode, listen=listen, connect=settings.connect)
    secure = tls_endpoints((*listen, *settings.connect))
    if secure and settings.mode == "router":
        raise VadError("a router of its own has no TLS; the gate has", where=", ".join(secure))
    if secure:
        values |= _client_tls(settings, secure)
    try:
        return open_config(values)
    except zenoh.ZError as error:
        raise _explain(settings, listen, str(error)) from error


def _client_tls(settings: BusSettings, secure: tuple[str, ...]) -> Values:
    folder = settings.credentials or os.environ.get(ENVIRONMENT)
    if not folder:
        raise VadError(
            "this endpoint asks for a certificate",
            where=", ".join(secure),
            remedy=f"Set {ENVIRONMENT} to the folder that `vad pki issue` on the hub made for you",
        )
    credentials = load_credentials(Path(folder))
    tls = "transport/link/tls"
    return {
        f"{tls}/root_ca_certificate": str(credentials.authority),
        f"{tls}/connect_certificate": str(credentials.certificate),
        f"{tls}/connect_private_key": str(credentials.key),
        f"{tls}/enable_mtls": True,
        f"{tls}/close_link_on_expiration": True,
        # The authority signs no other server than its hub, and certificates of clients are not for servers:
        # the hub's address may change as it likes.
        f"{tls}/verify_name_on_connect": False,
    }


def _explain(settings: BusSettings, listen: tuple[str, ...], cause: str) -> VadError:
    if "Address already in use" in cause:
        return VadError(
            "the port is taken",
            where=", ".join(listen),
            remedy="Another vad or zenoh router runs here: stop it, or listen on another port",
        )
    where = ", ".join((*listen, *settings.connect))
    if tls_endpoints(settings.connect):
        return VadError(
            "no hub answers, or it does not let this certificate in",
            where=where,
            remedy="On the hub, `vad pki list` shows whether it is in force and `vad status` why "
            "connections were refused",
        )
    return VadError(f"zenoh cannot open: {cause}", where=where)
