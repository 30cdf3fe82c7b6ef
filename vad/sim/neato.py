"""A Neato Botvac on a pty: answers byte for byte like the robot (formats.md, section 5).

Written from the protocol document, not from `vad.robot.neato`, so that each can prove the other wrong.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from vad.sim.port import VirtualPort

Pose = tuple[float, float, float]
"""x_m, y_m, yaw_rad in the robot's map."""

VERSION = "Component,Major,Minor,Build,Aux\r\nModelID,-1,BotVacD5,,\r\nSoftware,4,5,3,142"
_MAX_LINE_BYTES = 256
_END_OF_REPLY = b"\x1a"


class VirtualNeato:
    """The robot's debug port. The pty exists from construction until `run` ends or `close` is called.

    Args:
        pose_at: where the robot is at a time of the timeline; None while it is not localised.
        link: a stable name for the port: a symbolic link to the pty, replaced if it is there.
        latency_s: from command to reply; the pose is the one of the middle.
        scan_at: what the laser sees at a time: 360 distances in mm, counter-clockwise from the front, 0
            without an echo; None while it does not turn.
    """

    def __init__(
        self,
        pose_at: Callable[[int], Pose | None],
        *,
        link: Path | None = None,
        latency_s: float = 0.004,
        scan_at: Callable[[int], Sequence[int] | None] = lambda _t_ns: None,
    ) -> None:
        self._pose_at = pose_at
        self._scan_at = scan_at
        self._latency_s = latency_s
        self._port = VirtualPort(link)
        self._commands: asyncio.Queue[str] = asyncio.Queue()
        self._line = bytearray()
        self.answered = 0

    @property
    def path(self) -> str:
        """What a client opens."""
        return self._port.path

    async def run(self) -> None:
        """Answer commands until cancelled; then the port disappears, as when it is unplugged."""
        loop = asyncio.get_running_loop()
        loop.add_reader(self._port.master, self._readable)
        try:
            while True:
                await self._answer(await self._commands.get())
        finally:
            loop.remove_reader(self._port.master)
            self.close()

    def close(self) -> None:
        """Unplug the port; a second time does nothing."""
        self._port.close()

    def reply_to(self, command: str, t_ns: int) -> bytes:
        """The bytes the robot sends for a command line given at `t_ns` of the timeline."""
        words = command.lower().split()
        known = len(words) == 2 and "getrobotpos".startswith(words[0]) and "smooth".startswith(words[1])
        # "getr" is the shortest abbreviation that only GetRobotPos can mean here.
        if known and len(words[0]) >= len("getr"):
            body = _pose_line(self._pose_at(t_ns), t_ns)
        elif len(words) == 1 and "getldsscan".startswith(words[0]) and len(words[0]) >= len("getld"):
            body = _scan_lines(self._scan_at(t_ns))
        elif len(words) == 1 and "getversion".startswith(words[0]) and len(words[0]) >= len("getv"):
            body = VERSION
        else:
            body = f"Unknown Cmd: '{command}'"
        return f"{command}\r\n{body}\r\n".encode("ascii", "replace") + _END_OF_REPLY

    def _readable(self) -> None:
        try:
            data = os.read(self._port.master, 4096)
        except BlockingIOError:
            return
        for byte in data:
            if byte == ord("\n"):
                self._commands.put_nowait(self._line.decode("ascii", "replace").rstrip("\r"))
                self._line.clear()
            elif len(self._line) < _MAX_LINE_BYTES:
                self._line.append(byte)

    async def _answer(self, command: str) -> None:
        await asyncio.sleep(self._latency_s / 2)
        reply = self.reply_to(command, time.monotonic_ns())
        await asyncio.sleep(self._latency_s / 2)
        # A serial line has no flow control: what nobody reads is lost.
        with contextlib.suppress(BlockingIOError):
            os.write(self._port.master, reply)
        self.answered += 1


def _scan_lines(scan: Sequence[int] | None) -> str:
    """The laser's table; without a turning laser every line is an error."""
    distances = [0] * 360 if scan is None else scan
    lines = ["AngleInDegrees,DistInMM,Intensity,ErrorCodeHEX"]
    lines += [f"{k},{mm},{1000 if mm else 0},{'0' if mm else '8035'}" for k, mm in enumerate(distances)]
    return "\r\n".join([*lines, f"ROTATION_SPEED,{'0.00' if scan is None else '5.00'}"])


def _pose_line(pose: Pose | None, t_ns: int) -> str:
    x_m, y_m, yaw_rad = (0.0, 0.0, 0.0) if pose is None else pose
    theta_deg = math.degrees(yaw_rad) % 360.0
    return f"Robot Smooth pose: X={x_m:.3f}, Y={y_m:.3f}, Theta={theta_deg:.3f}, Time={t_ns / 1e9:.6f}"
