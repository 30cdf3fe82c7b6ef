"""Opening a zenoh session with every unsafe default turned off.

zenoh itself listens on all interfaces and multicasts; here nothing is found but what is named, and nothing
leaves the machine.
"""

from __future__ import annotations

import ipaddress
import json
from dataclasses import dataclass
from typing import Literal

import zenoh

from vad.errors import VadError

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"

RETRY = {"period_init_ms": 200, "period_max_ms": 2000, "period_increase_factor": 2}
"""When a client whose router went away knocks again."""

BLOCK_WAIT_US = 500_000
"""How long an answer waits for an asker that does not read, before zenoh cuts its link; it may come again."""

DROP_WAIT_US = 1000
DROP_WAIT_FRAGMENT_US = 5000
"""How long a put with DROP may wait for a reader that does not keep up: puts happen on the event loop."""


@dataclass(frozen=True, slots=True)
class BusSettings:
    """How a session connects.

    hub: the name in every key (`*`, any hub, only for a client). mode: the daemon is its own router; a client
    connects to one and fails at once where there is none. listen, connect: zenoh endpoints.
    """

    hub: str = "home"
    mode: Literal["router", "client"] = "router"
    listen: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    connect: tuple[str, ...] = ()


def check_endpoint(endpoint: str) -> None:
    """VadError where `endpoint` is not `tcp/<loopback address>:<port>`.

    Whoever reaches the port reads and writes everything, so plain TCP stays on the loopback interface.
    """
    protocol, slash, address = endpoint.partition("/")
    host, colon, port = address.rpartition(":")
    if not slash or not colon or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise VadError(
            "not an endpoint",
            where=endpoint,
            remedy=f"Write it as tcp/<address>:<port>, e.g. {DEFAULT_ENDPOINT}",
        )
    if protocol != "tcp":
        raise VadError(
            f"{protocol!r} endpoints are not supported",
            where=endpoint,
            remedy=f"Use tcp on the loopback interface, e.g. {DEFAULT_ENDPOINT}",
        )
    if not _is_loopback(host):
        raise VadError(
            "plain TCP on this address would show the home to everyone on the network; "
            "off this machine TLS with client certificates is required, which this version does not carry",
            where=endpoint,
            remedy=f"Use {DEFAULT_ENDPOINT}; from elsewhere go through `ssh -L 7447:127.0.0.1:7447 <hub>`",
        )


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def open_session(settings: BusSettings) -> zenoh.Session:
    """An open session: no multicast, no gossip, no shared memory, only the endpoints given.

    Blocks for some milliseconds. Raises VadError for an endpoint that is refused, a port that is taken and,
    in client mode, a router that does not answer.
    """
    for endpoint in (*settings.listen, *settings.connect):
        check_endpoint(endpoint)
    listen = settings.listen if settings.mode == "router" else ()
    config = zenoh.Config()
    congestion = "transport/link/tx/queue/congestion_control"
    for key, value in {
        "mode": settings.mode,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(settings.connect),
        "connect/retry": RETRY,
        "scouting/delay": 0,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        f"{congestion}/block/wait_before_close": BLOCK_WAIT_US,
        f"{congestion}/drop/wait_before_drop": DROP_WAIT_US,
        f"{congestion}/drop/max_wait_before_drop_fragments": DROP_WAIT_FRAGMENT_US,
    }.items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise _explain(settings, listen, str(error)) from error


def _explain(settings: BusSettings, listen: tuple[str, ...], cause: str) -> VadError:
    if "Address already in use" in cause:
        return VadError(
            "the port is taken",
            where=", ".join(listen),
            remedy="Another vad or zenoh router runs here: stop it, or listen on another port",
        )
    where = ", ".join((*listen, *settings.connect))
    return VadError(f"zenoh cannot open: {cause}", where=where)
