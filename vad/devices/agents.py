"""Remote CSI nodes that appear on zenoh: each is a device whose place is wanted."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from vad.devices.station import StationEvent
from vad.errors import ProtocolError
from vad.health import Health
from vad.streams import DropOldestQueue

INFO_TIMEOUT_S = 1.0
RETRY_S = 2.0
INTERFACE = "agent"
_INBOX = 256

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class AgentSaid:
    """What a node says of itself: the MAC of its card, and its name where a person gave it one."""

    mac: str
    name: str | None = None


class AgentSource:
    """A JoinSource: a node joins with its liveliness token and leaves with it.

    Args:
        session: open; it stays the caller's.
        alive: the pattern of the tokens, `vad/<hub>/agents/*/alive`; a query on a token's key is answered
            with what the node says of itself.
        decode: those bytes as AgentSaid; ProtocolError for anything else.
    """

    def __init__(self, session: zenoh.Session, alive: str, decode: Callable[[bytes], AgentSaid]) -> None:
        self.health = Health("agents")
        self._session = session
        self._alive = alive
        self._decode = decode
        self._present: dict[str, str] = {}  # key of the token -> MAC
        self._silent: set[str] = set()  # tokens whose node has not yet said who it is

    async def run(self, out: DropOldestQueue[StationEvent]) -> None:
        """Emit events into `out` until cancelled; trouble goes into `health`, never out of here."""
        while True:
            try:
                await self._subscribed(out)
            except zenoh.ZError as error:
                self._trouble(f"cannot watch for agents: {error}")
            await asyncio.sleep(RETRY_S)

    async def _subscribed(self, out: DropOldestQueue[StationEvent]) -> None:
        loop = asyncio.get_running_loop()
        inbox: DropOldestQueue[tuple[str, bool]] = DropOldestQueue(_INBOX)

        def arrived(sample: zenoh.Sample) -> None:
            # zenoh's network thread: hand over and return; the loop may have closed in the meantime.
            here = sample.kind == zenoh.SampleKind.PUT
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(inbox.put, (str(sample.key_expr), here))

        handler = zenoh.handlers.Callback(arrived, None, indirect=False)
        # Not in a thread: a cancellation in between would leave a subscription nobody can undeclare.
        subscriber = self._session.liveliness().declare_subscriber(self._alive, handler, history=True)
        try:
            self._ok()
            while True:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(RETRY_S if self._silent else None):
                        key, here = await inbox.get()
                    if not here:
                        self._gone(key, out)
                        continue
                    self._silent.add(key)
                for key in sorted(self._silent):
                    await self._meet(key, out)
        finally:
            # The session may be closed already.
            with contextlib.suppress(zenoh.ZError):
                subscriber.undeclare()  # type: ignore[no-untyped-call]

    async def _meet(self, key: str, out: DropOldestQueue[StationEvent]) -> None:
        """Ask a node who it is; it stays among the silent ones where it does not tell."""
        payload = await asyncio.to_thread(self._ask, key)
        if payload is None:
            self._trouble(f"{_agent(key)} is there and does not say who it is. Is it of another version?")
            return
        try:
            said = self._decode(payload)
        except ProtocolError as error:
            self._silent.discard(key)
            self.health.counters["bad_input"] += 1
            self._trouble(f"{_agent(key)}: {error}")
            return
        self._silent.discard(key)
        if self._present.get(key, said.mac) != said.mac:
            self._gone(key, out)
        self._present[key] = said.mac
        self.health.counters["joined"] += 1
        out.put(self._event("joined", key, said.mac, said.name))
        self._ok()

    def _ask(self, key: str) -> bytes | None:
        """The first answer to a query on the token's key (in a thread: zenoh blocks)."""
        for reply in self._session.get(key, timeout=INFO_TIMEOUT_S):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
        return None

    def _gone(self, key: str, out: DropOldestQueue[StationEvent]) -> None:
        self._silent.discard(key)
        mac = self._present.pop(key, None)
        if mac is not None:
            self.health.counters["left"] += 1
            out.put(self._event("left", key, mac))
        self._ok()

    @staticmethod
    def _event(kind: str, key: str, mac: str, name: str | None = None) -> StationEvent:
        joined = kind == "joined"
        return StationEvent(
            time.monotonic_ns(),
            "joined" if joined else "left",
            mac,
            f"{INTERFACE} {_agent(key)}",
            host_name=name,
            agent=_agent(key),
        )

    def _ok(self) -> None:
        if not self._silent:
            self.health.ok(f"{len(self._present)} agents")

    def _trouble(self, reason: str) -> None:
        level = logging.WARNING if self.health.trouble(reason) else logging.DEBUG
        _log.log(level, "agents: %s", reason)


def _agent(key: str) -> str:
    """The id in `vad/<hub>/agents/<id>/alive`."""
    return key.rsplit("/", 2)[-2]
