"""In the guest, confined as the daemon is: what its rarer parts need of the kernel; lines "name: outcome"."""

from __future__ import annotations

import asyncio
import ctypes
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from vad.daemon.solver import Solver
from vad.errors import SessionError


def solver() -> str:
    """The process that solves starts, stands back (nice) and answers: there is no such session."""

    async def ask() -> str:
        asked = Solver()
        try:
            await asked.solve(Path("/var/lib/vad/sessions/none"))
        except SessionError as error:
            return f"answered, {asked.health.counters['died']} died: {error.what}"
        finally:
            await asked.close()
        return "?"

    return asyncio.run(ask())


def gate() -> str:
    """The gate's process starts and reads its order."""
    done = subprocess.run(
        [sys.executable, "-I", "-m", "vad.bus.gate_process"], input=b"{}\n", capture_output=True, check=False
    )
    return "read its order" if b"ValidationError" in done.stderr else done.stderr.decode()[-200:]


def access_point() -> str:
    """The socket that hostapd answers to."""
    path = Path("/run/vad/probe")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(str(path))
        path.unlink()
    return "bound"


def callbacks() -> str:
    """pyusb's callbacks, in memory that is never both written and run."""
    return str(ctypes.CFUNCTYPE(ctypes.c_int)(lambda: 7)())


def internet() -> str:
    """An address outside the home."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        try:
            sock.sendto(b"x", ("203.0.113.7", 9))
        except PermissionError:
            return "refused"
        except OSError as error:
            return str(error)
    return "sent"


def namespaces() -> str:
    """What an intruder would like."""
    libc = ctypes.CDLL(None, use_errno=True)
    return "refused" if libc.unshare(0x1000_0000) and ctypes.get_errno() == 1 else "made"


PROBES: tuple[Callable[[], str], ...] = (solver, gate, access_point, callbacks, internet, namespaces)

for probe in PROBES:
    try:
        outcome = probe()
    except (OSError, MemoryError, ValueError) as error:
        outcome = f"{type(error).__name__} {error}"
    sys.stdout.write(f"{probe.__name__}: {outcome}\n")
