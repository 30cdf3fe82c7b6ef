"""What the tests of the robots share."""

from __future__ import annotations

import pytest

from vad.robot import neato, serial_port


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """No line counts as silent, no reply as missing: both ends are of this machine, which may be slow."""
    monkeypatch.setattr(serial_port, "SILENCE_S", 600.0)
    monkeypatch.setattr(serial_port, "REOPEN_S", 600.0)
    monkeypatch.setattr(serial_port, "JOIN_S", 40.0)
    monkeypatch.setattr(neato, "REPLY_TIMEOUT_NS", 600_000_000_000)
    monkeypatch.setattr(neato, "SCAN_TIMEOUT_NS", 600_000_000_000)
