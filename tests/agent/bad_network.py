"""A TCP proxy that delays one piece in five by up to a second, and can be cut; in order, as TCP is."""

from __future__ import annotations

import asyncio
import contextlib
import random
import sys
from collections.abc import AsyncIterator

PIECE_BYTES = 1 << 16


class BadNetwork:
    """Between clients and `target_port` on the loopback interface.

    Attributes:
        port: where clients connect.
        share, up_to_s: this share of pieces is late by up to so long; what comes after waits, too.
        connections: how many there have been.
    """

    def __init__(self, target_port: int, *, share: float = 0.2, up_to_s: float = 1.0, seed: int = 1) -> None:
        self.port = 0
        self.share, self.up_to_s = share, up_to_s
        self.connections = 0
        self._target_port = target_port
        self._random = random.Random(seed)
        self._open = asyncio.Event()
        self._open.set()
        self._links: set[asyncio.Task[None]] = set()

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[BadNetwork]:
        """Take connections meanwhile."""
        server = await asyncio.start_server(self._link, "127.0.0.1", 0)
        self.port = server.sockets[0].getsockname()[1]
        try:
            yield self
        finally:
            server.close()
            self.cut()
            await asyncio.gather(*self._links, return_exceptions=True)
            await server.wait_closed()

    def cut(self) -> None:
        """Break every connection; new ones get nowhere until `mend`."""
        self._open.clear()
        for link in self._links:
            link.cancel()

    def mend(self) -> None:
        """The network is back."""
        self._open.set()

    async def _link(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._links.add(task)
        self.connections += 1
        try:
            if not self._open.is_set():
                return
            far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._target_port)
            try:
                async with asyncio.TaskGroup() as group:
                    group.create_task(self._way(reader, far_writer))
                    group.create_task(self._way(far_reader, writer))
            finally:
                far_writer.transport.abort()
        except (ExceptionGroup, OSError, asyncio.CancelledError):
            return  # cut, or one end has gone
        finally:
            writer.transport.abort()
            self._links.discard(task)

    async def _way(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        pieces: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()

        async def deliver() -> None:
            loop = asyncio.get_running_loop()
            while True:
                due_s, piece = await pieces.get()
                if (wait_s := due_s - loop.time()) > 0:
                    await asyncio.sleep(wait_s)
                writer.write(piece)
                await writer.drain()

        delivering = asyncio.create_task(deliver())
        try:
            while piece := await reader.read(PIECE_BYTES):
                late_s = self._random.uniform(0, self.up_to_s) if self._random.random() < self.share else 0.0
                pieces.put_nowait((asyncio.get_running_loop().time() + late_s, piece))
            raise ConnectionResetError
        finally:
            delivering.cancel()
            with contextlib.suppress(asyncio.CancelledError, OSError):
                await delivering


async def _obey(target_port: int, share: float, up_to_s: float) -> None:
    """A process of its own: prints its port, obeys `cut` and `mend` on standard input until that ends."""
    network = BadNetwork(target_port, share=share, up_to_s=up_to_s)
    loop = asyncio.get_running_loop()
    async with network.running():
        print(network.port, flush=True)  # noqa: T201 - told to who started it
        while word := await loop.run_in_executor(None, sys.stdin.readline):
            network.cut() if word.strip() == "cut" else network.mend()


if __name__ == "__main__":
    asyncio.run(_obey(int(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3])))
