"""The link to the broker, running in a test."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from vad.bus.node import Bus
from vad.bus.session import BusSettings
from vad.config.mqtt import MqttSettings
from vad.homeassistant.link import HomeAssistant
from vad.homeassistant.topics import Topics

TOPICS = Topics("vad", "homeassistant", "home")


def closed_bus() -> Bus:
    """A bus that is not opened: what is published is heard inside the daemon all the same."""
    return Bus(BusSettings(hub="home", listen=("tcp/127.0.0.1:1",)))


@asynccontextmanager
async def home_assistant(bus: Bus, folder: Path, port: int, **settings: Any) -> AsyncIterator[HomeAssistant]:
    """The link to the broker, running; it ends without a trace."""
    told = MqttSettings(host="127.0.0.1", port=port, **settings)
    running = HomeAssistant(told, bus, base=folder, cache=folder / "cache", camera="main")
    task = asyncio.create_task(running.run())
    try:
        yield running
    finally:
        task.cancel()
        await asyncio.wait({task})
        assert task.cancelled() or task.exception() is None, task.exception()
