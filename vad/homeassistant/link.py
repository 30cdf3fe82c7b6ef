"""The hub in Home Assistant: keeps an MQTT broker told of what the bus publishes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from vad.bus import messages as m
from vad.bus.board import Form
from vad.bus.keys import parse_key
from vad.bus.node import Bus
from vad.config.mqtt import MqttSettings
from vad.errors import VadError
from vad.health import Health
from vad.homeassistant.broker import BrokerError, connected
from vad.homeassistant.entities import device_announcement, hub_announcement
from vad.homeassistant.picture import draw, scene_of
from vad.homeassistant.retained import GONE, Retained
from vad.homeassistant.states import camera_state, device_state, status_state
from vad.homeassistant.topics import Topics

if TYPE_CHECKING:
    import aiomqtt

FIRST_RETRY_S = 1.0
LAST_RETRY_S = 60.0
"""Between attempts to reach the broker: the first, doubled up to the last."""
STEADY_S = 10.0
"""A connection that held so long was a good one: the next attempt comes soon again."""
DEVICE_EVERY_NS = 1_000_000_000
STATUS_EVERY_NS = 5_000_000_000
"""A topic changes at most so often; what is sent is the newest."""
PICTURE_EVERY_S = 30.0
ON_THEIR_WAY = 8
"""Messages that the broker has not acknowledged yet, at most."""

_log = logging.getLogger(__name__)


class HomeAssistant:
    """Entities for every device and for the hub, as long as `run` runs.

    Args:
        base: where relative paths of the settings begin.
        cache: a folder for what drawing keeps.
        camera: the id of the hub's camera.
    """

    def __init__(self, settings: MqttSettings, bus: Bus, *, base: Path, cache: Path, camera: str) -> None:
        self.health = Health("home assistant")
        self._settings = settings
        self._bus = bus
        self._base = base
        self._cache = cache
        self._topics = Topics(settings.base_topic, settings.discovery_prefix, bus.keys.hub)
        self._retained = Retained(self._every_ns)
        self._news = asyncio.Event()
        self._floor_news = asyncio.Event()
        self._is_connected = asyncio.Event()
        self._devices: dict[str, m.DeviceMessage] = {}
        self._cameras: dict[str, m.CameraMessage] = {}
        self._status: m.StatusMessage | None = None
        self._plan: m.MapMessage | None = None
        self._grid = b""
        self._retained.want(self._topics.hub_config, hub_announcement(camera, self._topics))

    def _every_ns(self, topic: str) -> int:
        return STATUS_EVERY_NS if topic == self._topics.status else DEVICE_EVERY_NS

    async def run(self) -> None:
        """Keep the broker told until cancelled; a broker that is not there is trouble, no more."""
        end_listening = self._bus.listen(self._hear)
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._keep_picture())
                await self._keep_connected()
        finally:
            end_listening()

    def _hear(self, key: str, form: Form | None) -> None:
        """The bus published something: note what follows for the broker."""
        parsed = parse_key(key)
        if parsed is None:
            return
        if parsed.kind == "device":
            self._hear_device(parsed.name, form)
        elif form is not None and parsed.kind in ("map", "grid", "camera"):
            self._hear_floor(parsed.kind, form)
        elif form is not None and parsed.kind == "status":
            self._status = m.decode(form.payload, m.StatusMessage)
            self._say_status()

    def _want(self, topic: str, payload: bytes) -> None:
        if self._retained.want(topic, payload):
            self._news.set()

    def _hear_floor(self, kind: str, form: Form) -> None:
        if kind == "map":
            self._plan = m.decode(form.payload, m.MapMessage)
        elif kind == "grid":
            self._grid = form.payload
        else:
            camera = m.decode(form.payload, m.CameraMessage)
            self._cameras[camera.id] = camera
            self._want(self._topics.camera(camera.id), camera_state(camera))
        self._floor_news.set()

    def _hear_device(self, mac: str, form: Form | None) -> None:
        topics = self._topics
        if form is None:
            self._devices.pop(mac, None)
            self._retained.drop(topics.device_config(mac))
            self._retained.drop(topics.device(mac))
            self._news.set()
        else:
            device = m.decode(form.payload, m.DeviceMessage)
            self._devices[mac] = device
            self._want(topics.device_config(mac), device_announcement(device, topics))
            self._want(topics.device(mac), device_state(device))
        self._say_status()
        self._floor_news.set()

    def _say_status(self) -> None:
        self._want(self._topics.status, status_state(self._status, self._devices.values()))

    async def _keep_connected(self) -> None:
        """Connect, and again where the connection ends, until cancelled."""
        retry_s = FIRST_RETRY_S
        while True:
            begun_s = time.monotonic()
            try:
                await self._one_connection()
            except BrokerError as error:
                if self.health.trouble(str(error)):
                    _log.warning("Home Assistant: %s", error)
            if time.monotonic() - begun_s >= STEADY_S:
                retry_s = FIRST_RETRY_S
            await asyncio.sleep(retry_s)
            retry_s = min(2 * retry_s, LAST_RETRY_S)

    async def _one_connection(self) -> None:
        """Connect and tell until that ends, with BrokerError."""
        topics = self._topics
        async with connected(
            self._settings, self._base, identifier=topics.node, will_topic=topics.availability
        ) as client:
            self._retained.again()
            await client.subscribe([(topic, 0) for topic in (*topics.retained, topics.birth)])
            host, port = self._settings.endpoint
            self.health.counters["connects"] += 1
            self.health.ok(f"connected to {host}:{port}")
            self._is_connected.set()
            listener = asyncio.create_task(self._listen(client), name="home assistant: listen")
            teller = asyncio.create_task(self._tell(client), name="home assistant: tell")
            try:
                await asyncio.wait({listener, teller}, return_when=asyncio.FIRST_COMPLETED)
            finally:
                self._is_connected.clear()
                listener.cancel()
                teller.cancel()
                await asyncio.wait({listener, teller})
            failed = [task.exception() for task in (listener, teller) if not task.cancelled()]
            if error := next(filter(None, failed), None):
                raise error

    async def _listen(self, client: aiomqtt.Client) -> None:
        """Hear of Home Assistant's start, and of what an earlier run left."""
        async for message in client.messages:
            topic = str(message.topic)
            if topic == self._topics.birth:
                # a retained one tells of a start before this connection, after which all was sent
                if not message.retain and message.payload == b"online":
                    self.health.counters["births"] += 1
                    self._retained.again()
                    self._news.set()
            elif message.retain and message.payload and self._retained.found(topic):
                self.health.counters["cleaned_up"] += 1
                self._news.set()

    async def _tell(self, client: aiomqtt.Client) -> None:
        """Send what is due, then `online`; wait for more."""
        while True:
            self._news.clear()
            due = self._retained.due(time.monotonic_ns())
            while some := list(islice(due, ON_THEIR_WAY)):
                await self._publish(client, some)
            self._retained.want(self._topics.availability, b"online")
            next_ns = self._retained.next_ns()
            wait_s = None if next_ns is None else max(0.0, (next_ns - time.monotonic_ns()) / 1e9)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._news.wait()

    async def _publish(self, client: aiomqtt.Client, some: list[tuple[str, bytes]]) -> None:
        """Send these in order, and wait until the broker has them all."""
        sending = (client.publish(topic, payload, qos=1, retain=True) for topic, payload in some)
        for (topic, payload), failed in zip(
            some, await asyncio.gather(*sending, return_exceptions=True), strict=True
        ):
            if failed is not None:
                raise failed
            self._retained.sent(topic, payload, time.monotonic_ns())
            self.health.counters["forgotten" if payload == GONE else "published"] += 1

    async def _keep_picture(self) -> None:
        """Draw the map anew when something on it changed, until cancelled; only while a broker is there."""
        drawn = b""
        while True:
            await self._floor_news.wait()
            await self._is_connected.wait()
            self._floor_news.clear()
            if self._plan is None:
                continue
            scene = scene_of(self._plan, self._grid, self._devices.values(), self._cameras.values())
            if scene == drawn:
                continue
            try:
                png = await draw(scene, self._cache)
            except VadError as error:
                self.health.counters["pictures_failed"] += 1
                self._floor_news.set()
                _log.warning("Home Assistant: %s", error)
            else:
                drawn = scene
                self._want(self._topics.map, png)
            await asyncio.sleep(PICTURE_EVERY_S)
