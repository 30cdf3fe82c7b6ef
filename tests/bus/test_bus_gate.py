"""The gate's owner: what it says of trouble, and the hub's own certificate renewed in time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from bus_world import STARTED_S
from security_world import network
from waiting import free_port, until

from vad import child
from vad.bus.access import Holder, access_control
from vad.bus.gate import Gate, GateSettings, renew_hub
from vad.pki.certificates import HUB_DAYS, days_left, utc_now
from vad.pki.folder import PkiFolder


@asynccontextmanager
async def running(gate: Gate) -> AsyncIterator[Gate]:
    task = asyncio.create_task(gate.run())
    try:
        yield gate
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


def gate_for(folder: Path, daemon: str = "tcp/127.0.0.1:9", *, hub: str = "home", port: int = 0) -> Gate:
    listen = f"tls/127.0.0.1:{port or free_port()}"
    return Gate(GateSettings(hub, (listen,), daemon), PkiFolder(folder))


@pytest.mark.parametrize(
    ("hub", "age_days", "words"),
    [
        ("attic", 0.0, "these certificates are for the hub 'home'"),
        ("home", HUB_DAYS + 1.0, "nobody is let in"),
    ],
)
async def test_what_keeps_it_closed_is_said(tmp_path: Path, hub: str, age_days: float, words: str) -> None:
    PkiFolder(tmp_path / "pki").init("home", ["h"], utc_now() - timedelta(days=age_days))
    if age_days:
        (tmp_path / "pki" / "ca.key").unlink()  # else it would be renewed
    async with running(gate_for(tmp_path / "pki", hub=hub)) as gate:
        await until(lambda: words in gate.health.detail, words)
        assert gate.health.state == "degraded"


async def test_it_opens_once_there_is_a_pki(tmp_path: Path) -> None:
    pki = PkiFolder(tmp_path / "other")
    async with network(tmp_path) as (world, _), running(gate_for(pki.path, world.daemon)) as gate:
        await until(lambda: "vad pki init" in gate.health.detail, "what to do")
        pki.init("home", ["h"], utc_now())
        await until(lambda: "vad pki issue" in gate.health.detail, "what to do next")
        pki.issue("viewer", "tablet", 1, utc_now())
        pki.issue("viewer", "phone", 1, utc_now())
        await until(lambda: "2 certificates in force" in gate.health.detail, "that it is open", STARTED_S)


async def test_a_taken_port_is_said_and_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    processes: list[asyncio.subprocess.Process] = []
    start = asyncio.create_subprocess_exec

    async def started(*command: str, **options: Any) -> asyncio.subprocess.Process:
        processes.append(await start(*command, **options))
        return processes[-1]

    async with network(tmp_path, ("viewer", "tablet")) as (world, _):
        port = int(world.tls.rpartition(":")[2])
        monkeypatch.setattr(asyncio, "create_subprocess_exec", started)
        async with running(gate_for(world.pki.path, world.daemon, port=port)) as gate:
            await until(lambda: "the port is taken" in gate.health.detail, "that it is taken", STARTED_S)
            await until(lambda: len(processes) == 2, "that it is tried again", STARTED_S)
        assert all(process.returncode is not None for process in processes), "none is left behind"


async def test_who_ends_it_while_its_process_ends_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ending = asyncio.Event()
    gone = child.gone_with_pipes

    async def noted(process: asyncio.subprocess.Process) -> None:
        ending.set()
        processes.append(process)
        await gone(process)

    processes: list[asyncio.subprocess.Process] = []
    async with network(tmp_path, ("viewer", "tablet")) as (world, _):
        monkeypatch.setattr(child, "gone_with_pipes", noted)
        port = int(world.tls.rpartition(":")[2])
        async with running(gate_for(world.pki.path, world.daemon, port=port)):
            await ending.wait()
        (process,) = processes
        assert process.returncode is not None


async def test_an_expired_hub_certificate_is_renewed_at_start(tmp_path: Path) -> None:
    pki = PkiFolder(tmp_path / "other")
    pki.init("home", ["hub.local"], utc_now() - timedelta(days=HUB_DAYS + 1))
    pki.issue("viewer", "tablet", 1, utc_now())
    async with network(tmp_path) as (world, _), running(gate_for(pki.path, world.daemon)) as gate:
        await until(lambda: gate.health.state == "ok", "it is open", STARTED_S)
    assert days_left(pki.hub_files().ends_at, utc_now()) > HUB_DAYS - 1


@pytest.mark.parametrize(("left_days", "renewed"), [(31.0, False), (29.0, True), (-3.0, True)])
def test_the_hubs_certificate_is_renewed_in_time(tmp_path: Path, left_days: float, renewed: bool) -> None:
    now = utc_now()
    pki = PkiFolder(tmp_path / "pki")
    pki.init("home", ["hub.local", "192.168.1.10"], now - timedelta(days=HUB_DAYS - left_days))
    assert renew_hub(pki, now) == ""
    assert (days_left(pki.hub_files().ends_at, now) > 300) is renewed
    assert pki.hub_addresses() == ("hub.local", "192.168.1.10")


def test_where_it_cannot_be_renewed_somebody_is_told(tmp_path: Path) -> None:
    now = utc_now()
    pki = PkiFolder(tmp_path / "pki")
    pki.init("home", ["h"], now - timedelta(days=HUB_DAYS - 10))
    (pki.path / "ca.key").unlink()
    assert "ends in 10 days" in renew_hub(pki, now)


def test_rules_name_only_certificates_in_force() -> None:
    holders = [
        Holder("viewer.t.1", "viewer", "t"),
        Holder("agent.k.2", "agent", "k"),
        Holder("agent.k.3", "agent", "k"),
        Holder("agent.m.4", "agent", "m"),
    ]
    rules = access_control("home", holders)
    assert rules["default_permission"] == "deny"
    subjects = {s["id"]: s.get("cert_common_names") for s in rules["subjects"]}
    assert subjects == {
        "daemon": None,
        "viewer": ["viewer.t.1"],
        "agent k": ["agent.k.2", "agent.k.3"],
        "agent m": ["agent.m.4"],
    }
    own = {rule["id"]: rule["key_exprs"] for rule in rules["rules"] if rule["id"].startswith("agent ")}
    assert own["agent k"] == ["vad/home/agents/k/**"]
    assert access_control("home", [])["subjects"] == [{"id": "daemon", "link_protocols": ["tcp"]}]
