"""What the tests of the daemon share: `vad` as real processes, a camera that knows its place, waiting."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self, TypeVar

import yaml

from vad.client import VadClient
from vad.config import Settings, parse_settings
from vad.errors import VadError
from vad.sim.calibration import true_calibration
from vad.sim.scenario import Scenario
from vad.store.records import CameraRecord
from vad.store.store import Store

T = TypeVar("T")

STOP_S = 2.0
"""How long the daemon may take to end, on a machine that has nothing else to do."""
WAIT_S = 60.0
"""A start is 2.4 s of work, and there may be several programs to a core."""
ASK_S = 30.0
"""How long an answer may take; a client's own patience is for people."""
LONG_AGO = "2026-01-01T00:00:00.000Z"

_PIECE, _PIECES_PER_S = 250_000, 200
"""Of work like the daemon's: 3 ms of computing and one write, as often as an idle machine does that."""


def wait_for(ask: Callable[[], T | None], what: str, timeout_s: float = WAIT_S) -> T:
    """The first answer that is something; `what` is told of where none comes in time."""
    until = time.monotonic() + timeout_s
    while True:
        if answer := ask():
            return answer
        if time.monotonic() > until:  # looked at after asking: one look at least, however late it is
            raise AssertionError(f"not in {timeout_s:.0f} s: {what}")
        time.sleep(0.02)


def patience(seconds: float, folder: Path) -> Iterator[None]:
    """Goes on for so long; on a slow or busy machine for as long as work takes that an idle one does in it.

    So a limit holds for what is waited for in vain, and not for the processor or for the disk of `folder`.
    """
    begun, done = time.monotonic(), 0
    with tempfile.TemporaryFile(dir=folder) as file:
        while done < seconds * _PIECES_PER_S or time.monotonic() - begun < seconds:
            yield
            os.pwrite(file.fileno(), sum(range(_PIECE)).to_bytes(8, "big"), 0)
            os.fsync(file.fileno())
            done += 1


def store_calibration(state_dir: Path, scenario: Scenario) -> None:
    """Leave the camera's place in the store, as an earlier run would."""
    with Store(state_dir / "vad.sqlite") as store:
        store.save_camera(CameraRecord("main", 1, true_calibration(scenario).to_dict(), LONG_AGO))


def change_settings(file: Path, **sections: Any) -> None:
    """Replace top-level sections of a settings file."""
    settings = yaml.safe_load(file.read_text())
    file.write_text(yaml.safe_dump(settings | sections))


def settings_for(folder: Path, **sections: Any) -> Settings:
    """Settings with everything in `folder`, sections replaced as given."""
    plain = {
        "source": "simulated",
        "state_dir": str(folder),
        "map": {"file": "floor.yaml"},
        "robot": {"type": "neato", "port": "neato.tty"},
        "camera": {"source": {"type": "mjpeg", "url": "http://127.0.0.1:9/stream"}},
        "radio": {"source": {"type": "follow", "path": "csi.fifo"}},
        "devices": {"hostapd": ["hostapd.sock"]},
        "capture": {"mapped_radius_m": 0.8, "min_walks": 2, "max_walks": 8},
    }
    return parse_settings(yaml.safe_dump(plain | sections), where="vad.yaml")


class Vad:
    """`vad ARGUMENTS` as a process of its own; what it says goes into `log`. Killed where a test fails."""

    def __init__(self, *arguments: str | Path, log: Path) -> None:
        self.log = log
        command = [sys.executable, "-m", "vad", *map(str, arguments)]
        with log.open("wb") as file:
            self._process = subprocess.Popen(command, stdout=file, stderr=file, cwd=Path(__file__).parents[2])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()

    @property
    def said(self) -> str:
        """Everything it has printed."""
        return self.log.read_text()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """True until it has ended."""
        return self._process.poll() is None

    @property
    def catches_signals(self) -> bool:
        """True from the program's first line on; before, there is Python alone."""
        status = Path(f"/proc/{self._process.pid}/status").read_text()
        (caught,) = (int(line.split()[1], 16) for line in status.splitlines() if line.startswith("SigCgt:"))
        return bool(caught & 1 << (signal.SIGTERM - 1))

    def send(self, number: signal.Signals) -> None:
        """Send a signal."""
        self._process.send_signal(number)

    def end(self, number: signal.Signals, timeout_s: float = STOP_S) -> None:
        """Send the signal to what still runs; see `ends`."""
        assert self.running, self.said
        self.send(number)
        self.ends(timeout_s)

    def ends(self, timeout_s: float = STOP_S) -> None:
        """It ends within `timeout_s` (see `patience`), exit code 0, no traceback."""
        for _ in patience(timeout_s, self.log.parent):
            if not self.running:
                break
        else:
            raise AssertionError(f"runs on after {timeout_s} s:\n{self.said}")
        assert self._process.returncode == 0, self.said
        assert "Traceback" not in self.said, self.said
        assert "Error" not in self.said, self.said


def connect(vad: Vad, port: int, timeout_s: float = WAIT_S) -> VadClient:
    """A client of the daemon `vad` that comes up at `port`; to be closed."""

    def attempt() -> VadClient | None:
        assert vad.running, vad.said
        client = VadClient(f"tcp/127.0.0.1:{port}", timeout_s=ASK_S)
        try:
            client.open()
        except VadError:
            client.close()
            return None
        return client

    return wait_for(attempt, f"a daemon at port {port}", timeout_s)
