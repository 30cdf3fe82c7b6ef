"""The hub itself: settings, daemon, addresses, disk, clock, certificates."""

from __future__ import annotations

import contextlib
import ctypes
import os
import socket
import stat
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import urlsplit

from vad.camera.lens_file import camera_lens
from vad.commands.doctor.visit import Finding, Visit
from vad.config import pki_folder
from vad.errors import VadError
from vad.pki.certificates import days_left, utc_now
from vad.pki.folder import PkiFolder
from vad.report.words import duration

LOOKED_AT = ("robot", "camera", "csi.connector", "csi.follow")
"""Parts that checks of their own speak of."""
DATABASE_MB = 50
"""What the daemon wants to write besides sessions."""
SOON_DAYS = 30
_TIME_ERROR = 5
"""adjtimex(2): the clock is not synchronised."""
_TIMEX_BYTES = 208


async def check_settings(visit: Visit) -> list[Finding]:
    """Whether the files that the settings name can be read, and others cannot read passwords in them."""
    findings = []
    settings = visit.settings
    try:
        camera_lens(settings.camera, visit.config_file.parent)
    except VadError as error:
        findings.append(Finding.of_error("settings", error))
    for name in (settings.vision.model, _path(settings.vision.robot_detector)):
        if name is not None and not visit.resolve(name).is_file():
            remedy = "Correct vision: in the settings, or leave it out for the packaged network"
            findings.append(Finding("settings", "bad", f"{name}: no such file", remedy))
    urls = (getattr(settings.camera.source, "url", None), getattr(settings.robot, "url", None))
    secret = any(urlsplit(url).password for url in urls if url)
    if secret and visit.config_file.exists() and visit.config_file.stat().st_mode & stat.S_IROTH:
        remedy = f"sudo chmod o-r {visit.config_file}, and its group to the service's: sudo chgrp vad ..."
        findings.append(Finding("settings", "warning", "hold a password that every user can read", remedy))
    findings += visit.refused("settings", visit.config_file, "r")
    return findings or [Finding("settings", "ok", f"{visit.config_file} can be used")]


def _path(detector: str) -> str | None:
    return None if detector in ("motion", "packaged") else detector


async def check_daemon(visit: Visit) -> list[Finding]:
    """Whether the daemon answers and what troubles it; where none runs, whether its addresses are free."""
    if visit.status is not None:
        status = visit.status
        told = f"vad {status.version} runs for {duration(status.uptime_s)}: {status.step}"
        wrong = [part for part in status.parts if part.state in ("degraded", "failed")]
        wrong = [part for part in wrong if not part.part.startswith(LOOKED_AT)]
        troubles = [Finding.of_health(part.part, part) for part in wrong]
        return [Finding("daemon", "ok", told), *troubles]
    findings = []
    for endpoint in visit.settings.bus.listen:
        if why := _cannot_bind(endpoint.partition("/")[2]):
            remedy = "Another program listens there: end it (sudo ss -ltnp), or change bus: listen:"
            findings.append(Finding("zenoh", "bad", f"{endpoint}: {why}", remedy))
        else:
            findings.append(Finding("zenoh", "ok", f"no daemon runs; {endpoint} is free for it"))
    for section, port in (("metrics", visit.settings.metrics.port), ("web", visit.settings.web.port)):
        if port is not None and (why := _cannot_bind(f"127.0.0.1:{port}")):
            remedy = f"Change {section}: port:, or end the program that listens there (sudo ss -ltnp)"
            findings.append(Finding(section, "bad", f"port {port}: {why}", remedy))
    return findings


def _cannot_bind(address: str) -> str:
    """Why nobody can listen at host:port; empty where one can."""
    host, _, port = address.rpartition(":")
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)
        family, kind, protocol, _, where = found[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as zenoh does
            probe.bind(where)
            probe.listen()
    except (OSError, ValueError) as error:
        return os.strerror(error.errno).lower() if isinstance(error, OSError) and error.errno else str(error)
    return ""


async def check_state_dir(visit: Visit) -> list[Finding]:
    """Whether the daemon can write where it keeps what it knows, and has room there."""
    folder = visit.state_dir
    if not folder.exists():
        parent = next(parent for parent in folder.parents if parent.exists())
        if parent.is_dir() and os.access(parent, os.W_OK | os.X_OK):
            return [Finding("state", "ok", f"{folder} will be made"), *_disk(visit, parent)]
        remedy = f"sudo install -d -o vad -g vad -m 0750 {folder}"
        return [Finding("state", "bad", f"{folder} does not exist and cannot be made", remedy)]
    owner = folder.stat().st_uid
    strangers = [file.name for file in folder.iterdir() if file.lstat().st_uid != owner]
    if strangers:
        what = f"{folder}: {', '.join(sorted(strangers)[:3])} belongs to another user than the folder"
        return [Finding("state", "bad", what, f"sudo chown -R --reference={folder} {folder}")]
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))
            file.flush()
    except OSError as error:
        remedy = f"sudo chown -R vad:vad {folder}, or free some space on its disk"
        return [Finding("state", "bad", f"{folder} cannot be written ({error.strerror})", remedy)]
    refused = visit.refused("state", folder, "rw")
    return [*(refused or [Finding("state", "ok", f"{folder} can be written")]), *_disk(visit, folder)]


def _disk(visit: Visit, folder: Path) -> list[Finding]:
    disk = os.statvfs(folder)
    free_mb, total_mb = disk.f_bavail * disk.f_frsize // 1_000_000, disk.f_blocks * disk.f_frsize // 1_000_000
    return [disk_finding(free_mb, total_mb, disk.f_favail or 1 << 20, visit)]


def disk_finding(free_mb: int, total_mb: int, free_files: int, visit: Visit) -> Finding:
    """What the room on the state folder's disk means for the daemon."""
    limits = visit.settings.capture
    told = f"{free_mb} MB of {total_mb} MB are free"
    if free_mb < DATABASE_MB or free_files < 100:
        what = told if free_mb < DATABASE_MB else f"{free_files} more files can be made"
        return Finding("disk", "bad", what, f"Free some space: sudo du -xh {visit.state_dir} | sort -h")
    if free_mb < limits.keep_free_mb:
        what = f"{told}, less than capture.keep_free_mb ({limits.keep_free_mb}): walks are deleted early"
        return Finding("disk", "warning", what, "Free some space, or set capture: keep_free_mb: lower")
    if limits.quota_mb + limits.keep_free_mb > total_mb:
        what = f"{told}; capture.quota_mb ({limits.quota_mb}) is more than it can hold"
        return Finding("disk", "warning", what, f"Set capture: quota_mb: {max(10, total_mb // 4)}")
    return Finding("disk", "ok", f"{told}; sessions may take {limits.quota_mb} MB")


async def check_clock(visit: Visit) -> list[Finding]:
    """Whether the time of day is right, and the clock that walks are timed with fine enough."""
    return clock_findings(visit, synchronised=_synchronised(), now=utc_now())


def clock_findings(visit: Visit, *, synchronised: bool, now: datetime) -> list[Finding]:
    """What is wrong with the hub's clocks. now: the time of day."""
    findings = []
    written = visit.config_file.stat().st_mtime if visit.config_file.exists() else 0.0
    if now.timestamp() < written - 60:
        then = datetime.fromtimestamp(written, UTC)
        what = f"says {now:%Y-%m-%d %H:%M}, but the settings were written {then:%Y-%m-%d %H:%M} (UTC)"
        findings.append(Finding("clock", "bad", what, "sudo timedatectl set-ntp true"))
    elif not synchronised:
        what = "is not synchronised: history and certificates may bear a wrong time"
        findings.append(Finding("clock", "warning", what, "sudo timedatectl set-ntp true"))
    if not any((visit.root / "sys/class/rtc").glob("rtc*")):
        what = (
            "this machine has no battery clock: after a power cut it has no time until the network gives one"
        )
        remedy = "sudo apt-get install fake-hwclock, or systemctl enable systemd-time-wait-sync"
        findings.append(Finding("clock", "warning", what, remedy))
    if time.clock_getres(time.CLOCK_MONOTONIC) > 1e-3:
        what = "ticks in steps of more than a millisecond: walks cannot be timed"
        findings.append(Finding("clock", "bad", what, "Boot a kernel with CONFIG_HIGH_RES_TIMERS"))
    return findings or [Finding("clock", "ok", f"synchronised, {now:%Y-%m-%d %H:%M} UTC")]


def _synchronised() -> bool:
    """Whether something keeps the kernel's clock right (adjtimex(2), reading only)."""
    timex = ctypes.create_string_buffer(_TIMEX_BYTES)
    with contextlib.suppress(AttributeError):
        return int(ctypes.CDLL(None, use_errno=True).adjtimex(timex)) not in (-1, _TIME_ERROR)
    return True


async def check_certificates(visit: Visit) -> list[Finding]:
    """Whether clients on the network can be let in, where the settings listen there."""
    if not any(endpoint.startswith("tls/") for endpoint in visit.settings.bus.listen):
        return []
    now = utc_now()
    folder = pki_folder(visit.settings, visit.config_file)
    if folder.exists():
        next(folder.iterdir(), None)  # PermissionError where that is for the service alone
    try:
        files = PkiFolder(folder).hub_files()
    except VadError as error:
        return [Finding.of_error("certificates", error)]
    days = days_left(files.ends_at, now)
    count = len(files.register.in_force(now))
    told = f"{count} in force; the hub's ends in {days:.0f} days"
    if days <= 0:
        return [Finding("certificates", "bad", told, "Is the clock right? If so: `vad pki rotate hub`")]
    if days < SOON_DAYS:
        return [Finding("certificates", "warning", told, "`vad pki rotate hub`")]
    if not count:
        return [Finding("certificates", "warning", told, "`vad pki issue viewer NAME` lets somebody in")]
    return [Finding("certificates", "ok", told)]
