"""The agent's wires: one zenoh session to the hub, which comes back by itself (formats.md 7)."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import zenoh
from zenoh import handlers

from vad.agent.collector import Collector
from vad.agent.frames import FRAME_ENCODING, MAX_COMMAND_BYTES, decode_command, decode_time
from vad.agent.info import ENCODING, AgentInfo, encode_info
from vad.bus.closing import close_in_time
from vad.bus.keys import HubKeys
from vad.bus.session import BusSettings, open_session
from vad.errors import ProtocolError, VadError
from vad.handover import Handover, Intake
from vad.health import Health

log = logging.getLogger(__name__)

RETRY_FIRST_S = 1.0
RETRY_LAST_S = 30.0
"""Between tries where no hub answers; once it has answered, zenoh comes back by itself."""
LOOK_S = 0.25
"""How often the outbox is looked at where nothing wakes the sender: for what has to be sent again."""
CLOCK_FIRST = 50
CLOCK_OFTEN_S = 0.1
"""How often the hub's clock is asked at first, and in a session."""
CLOCK_EVERY_S = 1.0
CLOCK_TIMEOUT_S = 4.0
COMMANDS = Intake(max_bytes=MAX_COMMAND_BYTES, per_s=200.0, burst=200)


class HubLink:
    """Sends the collector's frames and brings it what the hub says.

    A put that waits for a slow network waits in a thread of its own; what is put while there is no link is
    lost without a word, so frames stay in the outbox until the hub confirms them.
    """

    def __init__(self, bus: BusSettings, info: AgentInfo, collector: Collector) -> None:
        self.health = Health("hub")
        self._bus = bus
        self._info = info
        self._keys = HubKeys(bus.hub)
        self._collector = collector
        self._wake = asyncio.Event()
        self._met = asyncio.Event()  # the hub is there, since just now
        self._hub_there = False

    def wake(self) -> None:
        """There is something to send."""
        self._wake.set()

    async def run(self) -> None:
        """Stay connected until cancelled."""
        where = ", ".join(self._bus.connect)
        pause_s = RETRY_FIRST_S
        while True:
            try:
                async with self._opened() as session:
                    # Said only where it lasts: a hub that is there shows itself at once.
                    self.health.trouble(f"connected to {where}, but no hub {self._bus.hub!r} is there yet")
                    await self._linked(session)
            except (VadError, zenoh.ZError) as error:
                self._trouble(str(error))
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, RETRY_LAST_S)

    @contextlib.asynccontextmanager
    async def _opened(self) -> AsyncIterator[zenoh.Session]:
        opening = asyncio.ensure_future(asyncio.to_thread(open_session, self._bus))
        try:
            session = await asyncio.shield(opening)
        except asyncio.CancelledError:
            # A session that opens after all must not live on unseen.
            with contextlib.suppress(VadError):
                await close_in_time(await opening)
            raise
        try:
            yield session
        finally:
            await close_in_time(session)

    async def _linked(self, session: zenoh.Session) -> None:
        loop = asyncio.get_running_loop()
        commands = Handover(loop, self._told, COMMANDS, self.health.counters)

        def on_command(sample: zenoh.Sample) -> None:
            commands(sample.payload)

        def on_hub(sample: zenoh.Sample) -> None:
            there = sample.kind == zenoh.SampleKind.PUT
            with contextlib.suppress(RuntimeError):  # the loop may have closed in the meantime
                loop.call_soon_threadsafe(self._hub, there)

        payload = encode_info(self._info)
        alive = self._keys.agent_alive(self._info.id)

        def on_question(query: zenoh.Query) -> None:
            with query:
                try:
                    query.reply(alive, payload, encoding=ENCODING)
                except zenoh.ZError as error:
                    log.debug("a question was not answered: %s", error)

        # indirect=False: no Python thread of its own; closing the session takes all of them back.
        session.declare_subscriber(
            self._keys.agent_cmd(self._info.id), handlers.Callback(on_command, indirect=False)
        )
        session.declare_queryable(alive, handlers.Callback(on_question, indirect=False), complete=True)
        session.liveliness().declare_subscriber(
            self._keys.alive, handlers.Callback(on_hub, indirect=False), history=True
        )
        token = session.liveliness().declare_token(alive)
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._send(session), name="agent frames")
                group.create_task(self._compare_clocks(session), name="agent clock")
        finally:
            self._hub_there = False
            with contextlib.suppress(zenoh.ZError):
                token.undeclare()  # type: ignore[no-untyped-call]

    async def _send(self, session: zenoh.Session) -> None:
        loop = asyncio.get_running_loop()
        put = partial(
            session.put,
            self._keys.agent_csi(self._info.id),
            encoding=FRAME_ENCODING,
            # After a break, 1.2 MB over 300 and 600 kB/s: all there in 6.1 and 3.1 s; with DROP, which loses
            # frames without a word, in 7.0 and 4.1 s. zenoh cuts a link that takes nothing for BLOCK_WAIT_US.
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.DATA_HIGH,
        )
        thread = ThreadPoolExecutor(1, thread_name_prefix="vad-agent-put")
        try:
            while True:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(LOOK_S):
                        await self._wake.wait()
                self._wake.clear()
                while self._hub_there:
                    payload = self._collector.next_frame(time.monotonic_ns())
                    if payload is None:
                        break
                    try:
                        await loop.run_in_executor(thread, put, payload)
                    except zenoh.ZError as error:
                        self._trouble(f"a frame could not be sent: {error}")
                        break
        finally:
            thread.shutdown(wait=False, cancel_futures=True)  # what hangs in a put ends in BLOCK_WAIT_US

    async def _compare_clocks(self, session: zenoh.Session) -> None:
        while True:
            await self._met.wait()
            self._met.clear()
            asked = 0
            while self._hub_there and not self._met.is_set():
                self._ask_clock(session)
                asked += 1
                often = asked < CLOCK_FIRST or self._collector.recording
                await asyncio.sleep(CLOCK_OFTEN_S if often else CLOCK_EVERY_S)

    def _ask_clock(self, session: zenoh.Session) -> None:
        loop = asyncio.get_running_loop()
        asked_ns = time.monotonic_ns()

        def on_reply(reply: zenoh.Reply) -> None:
            answered_ns = time.monotonic_ns()
            if reply.ok is not None:
                with contextlib.suppress(RuntimeError):
                    payload = reply.ok.payload.to_bytes()
                    loop.call_soon_threadsafe(self._clock, asked_ns, payload, answered_ns)

        try:
            session.get(
                self._keys.agent_clock(self._info.id),
                handlers.Callback(on_reply, indirect=False),
                timeout=CLOCK_TIMEOUT_S,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )
        except zenoh.ZError as error:
            self._trouble(f"the hub's clock cannot be asked: {error}")

    def _clock(self, asked_ns: int, payload: bytes, answered_ns: int) -> None:
        try:
            told = decode_time(payload)
        except ProtocolError:
            self.health.counters["bad_clock"] += 1
            return
        first = not self._collector.clock.known
        self._collector.compared(asked_ns, told.monotonic_ns, answered_ns, told.boot)
        self.health.counters["clock_answers"] += 1
        if first:
            self.wake()

    def _told(self, payload: bytes, arrival_ns: int) -> None:
        try:
            command = decode_command(payload)
        except ProtocolError as error:
            if not self.health.counters["bad_commands"]:
                log.warning("the hub's command cannot be read: %s", error)
            self.health.counters["bad_commands"] += 1
            return
        self._collector.told(command, arrival_ns)
        self.wake()

    def _hub(self, there: bool) -> None:
        where = ", ".join(self._bus.connect)
        if there:
            self.health.counters["met"] += 1
            self.health.ok(f"hub {self._bus.hub!r} at {where}")
            log.info("the hub is there: %s", where)
            # What was put into a link that broke is lost; the hub knows what it has already.
            self._collector.outbox.begin_again(time.monotonic_ns())
            self._hub_there = True
            self._met.set()
            self.wake()
        elif self._hub_there:
            self._hub_there = False
            self._trouble(f"the hub at {where} is gone; recording goes on")

    def _trouble(self, reason: str) -> None:
        level = logging.WARNING if self.health.trouble(reason) else logging.DEBUG
        log.log(level, "%s", reason)
