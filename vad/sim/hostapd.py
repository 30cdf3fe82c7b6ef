"""hostapd's control socket without a radio: Unix datagrams (formats.md, section 8)."""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path

from vad.mac import normal_mac

_DATAGRAM_BYTES = 4096


class HostapdEmulator:
    """Answers PING, STATUS, ATTACH, DETACH, STA-FIRST, STA-NEXT; tells attached clients who comes and goes.

    The socket exists while `run` runs. Stations may be announced before; they are listed then.
    """

    def __init__(self, socket_path: Path) -> None:
        self._path = socket_path
        self._sock: socket.socket | None = None
        self._stations: dict[str, None] = {}
        self._attached: set[str] = set()

    @property
    def attached(self) -> int:
        """How many clients receive events."""
        return len(self._attached)

    async def run(self) -> None:
        """Serve until cancelled; then say so to the attached and remove the socket, as hostapd does."""
        loop = asyncio.get_running_loop()
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            sock.setblocking(False)
            _bind(sock, self._path)
            self._sock = sock
            try:
                while True:
                    data, client = await loop.sock_recvfrom(sock, _DATAGRAM_BYTES)
                    if client:  # without a name of its own there is nowhere to answer
                        self._send(self._reply(data.decode("ascii", "replace").strip(), client), client)
            finally:
                self._tell("<3>CTRL-EVENT-TERMINATING ")
                self._sock = None
                self._attached.clear()
                _remove(self._path)

    def announce(self, mac: str, words: str = "") -> None:
        """A station is let in; `words` are appended to the event as newer versions do."""
        mac = normal_mac(mac)
        self._stations[mac] = None
        self._tell(f"<3>AP-STA-CONNECTED {mac}{words and ' ' + words}")

    def leave(self, mac: str) -> None:
        """A station goes."""
        mac = normal_mac(mac)
        self._stations.pop(mac, None)
        self._tell(f"<3>AP-STA-DISCONNECTED {mac}")

    def _reply(self, command: str, client: str) -> str:
        name, _, argument = command.partition(" ")
        macs = list(self._stations)
        match name:
            case "PING":
                return "PONG\n"
            case "STATUS":
                return f"state=ENABLED\nnum_sta[0]={len(macs)}\n"
            case "ATTACH":
                self._attached.add(client)
                return "OK\n"
            case "DETACH":
                known = client in self._attached
                self._attached.discard(client)
                return "OK\n" if known else "FAIL\n"
            case "STA-FIRST":
                return _entry(macs[0]) if macs else ""
            case "STA-NEXT" if argument.lower() in self._stations:
                after = macs.index(argument.lower()) + 1
                return _entry(macs[after]) if after < len(macs) else ""
            case "STA-NEXT":
                return "FAIL\n"
            case _:
                return "UNKNOWN COMMAND\n"

    def _tell(self, event: str) -> None:
        for client in sorted(self._attached):
            self._send(event, client)

    def _send(self, text: str, client: str) -> None:
        if self._sock is None:
            return
        try:
            self._sock.sendto(text.encode(), client)
        except OSError:  # the client is gone or reads nothing
            self._attached.discard(client)


def _entry(mac: str) -> str:
    return f"{mac}\nflags=[AUTH][ASSOC][AUTHORIZED]\naid=1\ncapability=0x0\nlisten_interval=0\n"


def _bind(sock: socket.socket, path: Path) -> None:
    path.unlink(missing_ok=True)
    sock.bind(str(path))


def _remove(path: Path) -> None:
    path.unlink(missing_ok=True)
