"""A loopback port for a real router, and patience with a busy machine."""

from __future__ import annotations

import pytest
from bus_world import PATIENCE_S, STARTED_S
from waiting import free_port

from vad.client import AsyncVadClient, VadClient


@pytest.fixture
def endpoint() -> str:
    """An endpoint where nobody listens."""
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def nothing_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sender waits for a busy gate, where zenoh would cut the link and lose messages."""
    monkeypatch.setattr("vad.bus.session.BLOCK_WAIT_US", 1_000_000 * PATIENCE_S)


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """How long a client, a link or a goodbye may take says how busy the machine is, not whether the code is
    right: what takes the daemon's own limits for an answer sets them itself.
    """
    for client in (VadClient, AsyncVadClient):
        defaults = client.__init__.__kwdefaults__
        assert "timeout_s" in defaults
        monkeypatch.setitem(defaults, "timeout_s", float(PATIENCE_S))
    monkeypatch.setattr("vad.bus.session.OPEN_TIMEOUT_MS", 1000 * PATIENCE_S)
    monkeypatch.setattr("vad.bus.session.LEASE_MS", 1000 * PATIENCE_S)
    monkeypatch.setattr("vad.bus.gate.OPEN_S", float(STARTED_S))
    monkeypatch.setattr("vad.bus.closing.CLOSE_TIMEOUT_S", float(PATIENCE_S))
