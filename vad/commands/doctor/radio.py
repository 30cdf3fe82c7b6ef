"""The CSI card: rights, driver, firmware, packets (formats of the Linux 802.11n CSI Tool)."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
import time
from pathlib import Path

from vad.commands.doctor.unit import unit_file, unit_values
from vad.commands.doctor.visit import Finding, Visit
from vad.config import ConnectorCsi, FollowCsi
from vad.csi import cn
from vad.streams import DropOldestQueue

_CAP_NET_ADMIN = 12
_REMEDY = "As root: sudo vad doctor --only radio"
_INTEL, _CARDS = "0x8086", ("0x4235", "0x4236")
"""PCI ids of the 5300; no other card of Intel's gives CSI with this driver."""
_FIRMWARE = "iwlwifi-5000-*.ucode"
_CSI_FIRMWARE = "sigcomm2010"
"""How the CSI Tool names its firmware: iwlwifi-5000-2.ucode.sigcomm2010, which the driver's name links to."""
_CSI, _FRAMES = 0x1, 0x4
"""Bits of the module's parameter connector_log: CSI; the frames, which tell who sent."""


async def check_rights(visit: Visit) -> list[Finding]:
    """Whether the daemon may join the driver's group: CAP_NET_ADMIN, as the unit gives it or as here."""
    if not isinstance(visit.settings.radio.source, ConnectorCsi):
        return []
    unit = unit_file(visit.root)
    if unit is not None:
        given = " ".join(unit_values(visit.root, "AmbientCapabilities")).split()
        user = (unit_values(visit.root, "User") or ["root"])[-1]
        dynamic = (unit_values(visit.root, "DynamicUser") or ["no"])[-1] in ("yes", "true", "1", "on")
        if "CAP_NET_ADMIN" in given or (user == "root" and not dynamic):
            return [Finding("rights", "ok", f"{unit} gives CAP_NET_ADMIN")]
        what = f"{unit} does not give CAP_NET_ADMIN, which joining the CSI group takes"
        return [Finding("rights", "bad", what, "sudo vad install, which writes the unit to fit the settings")]
    if effective_capabilities(visit.root) >> _CAP_NET_ADMIN & 1:
        return [Finding("rights", "ok", "there is no vad.service; who asks has CAP_NET_ADMIN")]
    what = "no CAP_NET_ADMIN here, and there is no vad.service that would give it"
    return [Finding("rights", "bad", what, "sudo vad install, or run as root: sudo vad run")]


def effective_capabilities(root: Path) -> int:
    """Of this process, a bit mask; 0 where that is not told."""
    with contextlib.suppress(OSError, ValueError):
        for line in (root / "proc/self/status").read_text().splitlines():
            if line.startswith("CapEff:"):
                return int(line.split()[1], 16)
    return 0


async def check_connector(visit: Visit) -> list[Finding]:
    """Whether the kernel's connector is there and its group can be joined, by joining it."""
    source = visit.settings.radio.source
    if not isinstance(source, ConnectorCsi):
        return []
    try:
        kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC
        with socket.socket(socket.AF_NETLINK, kind, cn.NETLINK_CONNECTOR) as sock:
            sock.bind((0, 0))
            sock.setsockopt(cn.SOL_NETLINK, cn.NETLINK_ADD_MEMBERSHIP, source.group)
    except PermissionError:
        if unit_file(visit.root) is not None:
            what = f"joining group {source.group} is not permitted to you; the service is asked about above"
            return [Finding("connector", "warning", what, "To try it: sudo vad doctor")]
        what = f"joining group {source.group} is not permitted"
        return [Finding("connector", "bad", what, "Run it as root: sudo vad doctor")]
    except OSError as error:
        if error.errno == errno.EPROTONOSUPPORT:
            what, remedy = (
                "this kernel has no connector",
                "sudo modprobe cn, or a kernel with CONFIG_CONNECTOR=y",
            )
        else:
            what, remedy = f"group {source.group}: {error.strerror}", "Set radio: source: group: 26"
        return [Finding("connector", "bad", what, remedy)]
    return [Finding("connector", "ok", f"group {source.group} can be joined")]


async def check_card(visit: Visit) -> list[Finding]:
    """Whether the card, its modified driver and its firmware are there."""
    if not isinstance(visit.settings.radio.source, ConnectorCsi):
        return []
    return [_card(visit.root), *_driver(visit), _firmware(visit.root)]


def _card(root: Path) -> Finding:
    devices = (root / "sys/bus/pci/devices").glob("*")
    found = [d.name for d in devices if _text(d / "vendor") == _INTEL and _text(d / "device") in _CARDS]
    if found:
        return Finding("card", "ok", f"Intel 5300 at PCI {', '.join(sorted(found))}")
    remedy = "Put one in (lspci -nn shows 8086:4235 or 8086:4236), or use a card elsewhere: vad agent"
    return Finding("card", "bad", "there is no Intel 5300 in this machine", remedy)


def _driver(visit: Visit) -> list[Finding]:
    module = visit.root / "sys/module/iwlwifi"
    if not module.is_dir():
        return [
            Finding(
                "driver", "bad", "the module iwlwifi is not loaded", "sudo modprobe iwlwifi connector_log=0x5"
            )
        ]
    said = _text(module / "parameters/connector_log")
    if not said:
        what = "iwlwifi here is the kernel's own: it has no connector_log and gives no CSI"
        return [Finding("driver", "bad", what, "Build and load the driver of the Linux 802.11n CSI Tool")]
    try:
        flags = int(said, 0)
    except ValueError:
        return [Finding("driver", "bad", f"connector_log is {said!r}", _reload("0x5"))]
    told = f"connector_log is {flags:#x}"
    if not flags & _CSI:
        return [Finding("driver", "bad", f"{told}: the driver keeps its CSI to itself", _reload("0x5"))]
    if not flags & _FRAMES and visit.settings.radio.transmitter is None:
        return [Finding("driver", "bad", f"{told}: nobody tells whose packets they are", _reload("0x5"))]
    return [Finding("driver", "ok", told)]


def _reload(flags: str) -> str:
    return (
        f"echo 'options iwlwifi connector_log={flags}' | sudo tee /etc/modprobe.d/vad-csi.conf; "
        f"sudo modprobe -r iwldvm iwlwifi; sudo modprobe iwlwifi"
    )


def _firmware(root: Path) -> Finding:
    folder = root / "lib/firmware"
    files = sorted(folder.glob(_FIRMWARE))
    if not files:
        what = f"there is no {folder / _FIRMWARE}"
        return Finding("firmware", "bad", what, "Install the CSI Tool's iwlwifi-5000-2.ucode.sigcomm2010")
    tools = [file.read_bytes() for file in folder.glob(f"iwlwifi-5000-*{_CSI_FIRMWARE}*")]
    if any(_CSI_FIRMWARE in file.resolve().name or file.read_bytes() in tools for file in files):
        return Finding("firmware", "ok", "the CSI Tool's")
    what = f"{files[-1].name} looks like Intel's own, which gives no CSI"
    remedy = (
        f"sudo ln -sf iwlwifi-5000-2.ucode.{_CSI_FIRMWARE} /lib/firmware/iwlwifi-5000-2.ucode, then reboot"
    )
    return Finding("firmware", "warning", what, remedy)


async def check_csi(visit: Visit) -> list[Finding]:
    """Whether packets with CSI come: from the running daemon, or by listening."""
    if (part := visit.part("csi.connector") or visit.part("csi.follow")) is not None:
        if part.state != "ok":
            return [Finding.of_health("csi", part, _REMEDY)]
        rate = part.rates_per_s.get("packets", 0.0)
        return [_heard(f"{rate:g} packets a second; {part.detail}", rate > 0)]
    from vad.csi.open_source import open_source
    from vad.csi.packets import CsiBatch

    settings = visit.settings.radio
    if isinstance(settings.source, FollowCsi) and not visit.resolve(settings.source.path).exists():
        what = f"{settings.source.path} does not exist"
        return [
            Finding(
                "csi", "bad", what, "mkfifo it and start log_to_file into it, or correct radio: source: path"
            )
        ]
    if isinstance(settings.source, FollowCsi):
        refused = visit.refused("csi", visit.resolve(settings.source.path), "r")
        if refused:
            return refused
    source = open_source(settings.source, visit.config_file.parent)
    batches: DropOldestQueue[CsiBatch] = DropOldestQueue(1024)
    task = asyncio.create_task(source.run(batches))
    packets, begun_s = 0, time.monotonic()
    try:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(visit.listen_s):
                while packets == 0 or time.monotonic() - begun_s < min(1.0, visit.listen_s):
                    packets += len((await batches.get()).packets)
    finally:
        task.cancel()
        await asyncio.wait({task})
    if source.health.state != "ok":
        return [Finding.of_health("csi", source.health, _REMEDY)]
    rate = packets / (time.monotonic() - begun_s)
    return [_heard(f"{rate:.0f} packets a second; {source.health.detail}", packets > 0)]


def _heard(told: str, heard: bool) -> Finding:
    if heard:
        return Finding("csi", "ok", told)
    remedy = "Make a device of the network send: ping it from the hub, and run this again"
    return Finding("csi", "warning", f"no packet with CSI came; {told}", remedy)


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return ""
