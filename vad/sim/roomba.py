"""A Roomba (Create 2) on a pty that streams its sensors like the Open Interface (formats.md, section 5).

Written from the protocol's description, not from `vad.robot.roomba`, so that each can prove the other wrong.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vad.sim.port import VirtualPort

PERIOD_S = 0.015

_START, _STREAM = 128, 148


@dataclass(slots=True)
class RoombaBody:
    """What the robot's sensors show: encoder counts (any integer), wheel drops, standing on the dock."""

    left: int = 0
    right: int = 0
    lifted: bool = False
    docked: bool = False

    def packet(self, number: int) -> bytes:
        """A sensor packet's bytes; KeyError for one this robot does not have."""
        return {
            7: bytes([0x0C if self.lifted else 0]),
            34: bytes([0x02 if self.docked else 0]),
            43: struct.pack(">H", self.left % 65_536),
            44: struct.pack(">H", self.right % 65_536),
        }[number]


class VirtualRoomba:
    """The robot's port. The pty exists from construction until `run` ends or `close` is called.

    Args:
        body: read for every frame. link: a stable name for the port. line: what the line does to a frame
            on its way.
    """

    def __init__(
        self,
        body: RoombaBody,
        *,
        link: Path | None = None,
        line: Callable[[bytes], bytes] = bytes,
    ) -> None:
        self.body = body
        self._line = line
        self._port = VirtualPort(link)
        self._heard = bytearray()
        self._wanted: bytes = b""

    @property
    def path(self) -> str:
        """What a client opens."""
        return self._port.path

    async def run(self) -> None:
        """Stream what was asked for until cancelled; then the port disappears, as when it is unplugged."""
        try:
            while True:
                self._listen()
                if self._wanted:
                    # A serial line has no flow control: what nobody reads is lost.
                    with contextlib.suppress(BlockingIOError):
                        os.write(self._port.master, self._line(self.frame()))
                await asyncio.sleep(PERIOD_S)
        finally:
            self.close()

    def frame(self) -> bytes:
        """The stream's next frame."""
        content = b"".join(bytes([number]) + self.body.packet(number) for number in self._wanted)
        frame = bytes([19, len(content)]) + content
        return frame + bytes([-sum(frame) % 256])

    def close(self) -> None:
        """Unplug the port; a second time does nothing."""
        self._port.close()

    def _listen(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self._heard += os.read(self._port.master, 4096)
        # Nothing is understood before Start.
        begin = self._heard.find(_START)
        del self._heard[: begin if begin >= 0 else len(self._heard)]
        at = self._heard.find(_STREAM)
        if at < 0 or len(self._heard) < at + 2 or len(self._heard) < at + 2 + self._heard[at + 1]:
            return
        end = at + 2 + self._heard[at + 1]
        self._wanted = bytes(self._heard[at + 2 : end])
        del self._heard[1:end]
