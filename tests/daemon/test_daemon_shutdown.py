"""Ctrl-C and SIGTERM end the daemon at every step: soon, with exit code 0, and with nothing half done.

Real processes: `vad sim` plays a home, `vad run` is the daemon.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from daemon_world import Vad, change_settings, connect, store_calibration, wait_for
from waiting import free_port

from vad.client import VadClient
from vad.sim.scenario import make_home

pytestmark = pytest.mark.timeout(600)

SIGNALS = (signal.SIGINT, signal.SIGTERM)
HOME = make_home(1)
WALK_START_S = HOME.walks[0].start_s
WALKS_S = 280.0
"""On a busy machine a walk may be seen in too few pictures; the home has twelve of them in four minutes."""


@contextmanager
def home(tmp_path: Path, start_at_s: float = 0.0) -> Iterator[tuple[Path, int]]:
    """A simulated home: its settings file and the port of the daemon's bus."""
    port = free_port()
    folder = tmp_path / "home"
    arguments = ["sim", "--dir", folder, "--seed", "1", "--bus-port", str(port), "--fifo"]
    with Vad(*arguments, "--start-at", str(start_at_s), log=tmp_path / "sim.log") as sim:
        wait_for((folder / "vad.yaml").exists, "the home's settings")
        yield folder / "vad.yaml", port
        sim.end(signal.SIGTERM)


def daemon(settings: Path) -> Vad:
    return Vad("run", "--config", settings, log=settings.parent.parent / "daemon.log")


def step(client: VadClient, words: str) -> bool:
    found = client.status()
    return found is not None and words in found.step


def session_states(settings: Path) -> list[str]:
    """The first session's first."""
    files = sorted((settings.parent / "state" / "sessions").glob("*/session.json"))
    return [json.loads(file.read_text())["capture"]["state"] for file in files]


@pytest.mark.parametrize("number", SIGNALS)
def test_while_it_loads_and_opens(tmp_path: Path, number: signal.Signals) -> None:
    with home(tmp_path) as (settings, port):
        with daemon(settings) as vad:
            wait_for(lambda: vad.catches_signals, "its first line")
            vad.end(number)
        with daemon(settings) as vad:
            wait_for((settings.parent / "state" / "vad.sqlite").exists, "that it opens")
            vad.end(number)
        # What it had opened is free again.
        with daemon(settings) as vad, closing(connect(vad, port)) as client:
            wait_for(lambda: step(client, "calibrating"), "a status")
            vad.end(number)


def test_a_second_ctrl_c_does_not_cut_the_first_one_short(tmp_path: Path) -> None:
    with home(tmp_path) as (settings, port), daemon(settings) as vad, closing(connect(vad, port)):
        assert vad.running, vad.said
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGINT):
            vad.send(number)  # to nobody where it has ended already
        vad.ends()


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS)
def test_while_it_calibrates(tmp_path: Path, number: signal.Signals) -> None:
    with home(tmp_path) as (settings, port), daemon(settings) as vad, closing(connect(vad, port)) as client:
        wait_for(lambda: any(c.pairs > 8 for c in client.cameras()), "a camera that collects", 100)
        vad.end(number)
    assert session_states(settings) == []


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS)
def test_while_a_capture_is_recorded(tmp_path: Path, number: signal.Signals) -> None:
    with home(tmp_path, WALK_START_S - 4.0) as (settings, port):
        store_calibration(settings.parent / "state", HOME)
        with daemon(settings) as vad, closing(connect(vad, port)) as client:
            wait_for(
                lambda: any(c.state == "recording" and c.packets >= 100 for c in client.captures()),
                "a capture",
                WALKS_S,
            )
            assert session_states(settings)[-1] == "recording"
            vad.end(number)
        assert session_states(settings)[-1] == "aborted"
        assert "recording" not in session_states(settings)
        # The next run knows the device and waits for another walk.
        with daemon(settings) as vad, closing(connect(vad, port)) as client:
            (device,) = wait_for(client.devices, "the device")
            assert device.state in ("waiting", "capturing")
            vad.end(number)


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS)
def test_while_it_solves(tmp_path: Path, number: signal.Signals) -> None:
    with home(tmp_path, WALK_START_S - 4.0) as (settings, port):
        store_calibration(settings.parent / "state", HOME)
        change_settings(settings, capture={"min_s": 4.0, "max_s": 8.0})
        with daemon(settings) as vad, closing(connect(vad, port)) as client:
            # Who asks too late for that finds it done.
            solving = ("solving", "done")
            wait_for(
                lambda: any(c.state in solving for c in client.captures()), "a walk being solved", WALKS_S
            )
            vad.end(number)
        assert set(session_states(settings)) <= {"done", "aborted"}
