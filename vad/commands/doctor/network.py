"""Who tells of new devices (hostapd, leases), and who is told of them (Home Assistant's MQTT broker)."""

from __future__ import annotations

import asyncio
import contextlib
import stat
import time
from pathlib import Path

from vad.commands.doctor.visit import Finding, Visit
from vad.devices.hostapd_source import HostapdSource
from vad.devices.lease_source import LeaseSource
from vad.devices.nl80211_source import Nl80211Source
from vad.devices.station import JoinSource, StationEvent
from vad.streams import DropOldestQueue

_SETTLE_S = 3.0
_POLL_S = 0.02


async def check_access_point(visit: Visit) -> list[Finding]:
    """Whether hostapd's control sockets answer, and the kernel tells of the access point's stations."""
    devices = visit.settings.devices
    findings = []
    for name in devices.hostapd:
        path = visit.resolve(name)
        if not path.exists():
            what = f"{name} does not exist"
            remedy = "Is hostapd running, with ctrl_interface=/run/hostapd? sudo systemctl status hostapd"
            findings.append(Finding("hostapd", "bad", what, remedy))
            continue
        refused = visit.refused("hostapd", path, "w")
        own_dir = _shared_dir(visit)
        source = HostapdSource(path, interface=path.name, own_dir=own_dir)
        findings += refused or [await _settled("hostapd", source)]
    if devices.nl80211:
        findings.append(await _settled("nl80211", Nl80211Source(devices.nl80211)))
    if not (devices.hostapd or devices.nl80211 or devices.leases or devices.static or devices.agents):
        what = "nothing tells of devices: none will ever be seen"
        findings.append(Finding("devices", "bad", what, "Name hostapd's socket in devices: hostapd:"))
    return findings


def _shared_dir(visit: Visit) -> Path | None:
    """Where the daemon's answering sockets are; None where there is no such folder, or it is not ours."""
    folder = visit.root / "run/vad"
    return folder if folder.is_dir() and visit.service is not None else None


async def check_leases(visit: Visit) -> list[Finding]:
    """Whether dnsmasq's leases can be read."""
    findings = []
    for name in visit.settings.devices.leases:
        path = visit.resolve(name)
        refused = visit.refused("leases", path, "r")
        findings += refused or [await _settled("leases", LeaseSource(path))]
    return findings


async def _settled(check: str, source: JoinSource) -> Finding:
    """What a source says of itself once it has tried."""
    events: DropOldestQueue[StationEvent] = DropOldestQueue(1024)
    task = asyncio.create_task(source.run(events))
    until_s = time.monotonic() + _SETTLE_S
    try:
        while source.health.state == "starting" and time.monotonic() < until_s:  # noqa: ASYNC110 - no event
            await asyncio.sleep(_POLL_S)
        remedy = "Does it run, and may this user open its socket? sudo vad doctor"
        return Finding.of_health(check, source.health, remedy)
    finally:
        task.cancel()
        await asyncio.wait({task})


async def check_mqtt(visit: Visit) -> list[Finding]:
    """Whether the broker lets the hub in; whether others can read the password."""
    settings, base = visit.settings.mqtt, visit.config_file.parent
    if settings.host is None:
        return []
    from vad.homeassistant.broker import BrokerError, connected

    findings = []
    if settings.password_file is not None:
        file = base / settings.password_file
        with contextlib.suppress(FileNotFoundError):
            if file.stat().st_mode & (stat.S_IROTH | stat.S_IWOTH):
                what = f"every user can read {settings.password_file}"
                findings.append(Finding("mqtt", "warning", what, f"sudo chmod o-rw {file}"))
            file.open("rb").close()  # PermissionError where it is for the service alone
        findings += visit.refused("mqtt", file, "r")
        if not settings.tls and not _is_here(settings.host):
            what = "the password goes over the network for all to read"
            findings.append(
                Finding("mqtt", "warning", what, "Set mqtt: tls: true, and the broker's TLS port")
            )
    host, port = settings.endpoint
    try:
        async with connected(settings, base, identifier=f"vad_{visit.settings.hub}_doctor"):
            findings.append(Finding("mqtt", "ok", f"{host}:{port} lets the hub in"))
    except BrokerError as error:
        findings.append(Finding.of_error("mqtt", error))
    return findings


def _is_here(host: str) -> bool:
    return host in ("localhost", "::1") or host.startswith("127.")
