"""A real router on a free loopback port, and messages to put on it."""

from __future__ import annotations

import socket

import pytest


@pytest.fixture
def endpoint() -> str:
    """An endpoint where nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
