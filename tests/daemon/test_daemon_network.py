"""The whole way as a user goes it: `vad pki`, the settings, `vad run`, and a viewer over TLS."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import closing, suppress
from pathlib import Path

import pytest
import yaml
from daemon_world import Vad, change_settings, connect, wait_for
from waiting import free_port

from vad.client import UnreachableError, VadClient

pytestmark = pytest.mark.timeout(600)

ROOT = Path(__file__).parents[2]


def vad(*arguments: str, settings: Path, rc: int = 0) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "vad", *arguments],
        env=os.environ | {"VAD_CONFIG": str(settings)},
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == rc, done.stdout + done.stderr
    return done.stdout + done.stderr


def reached(endpoint: str, credentials: Path) -> VadClient | None:
    client = VadClient(endpoint, credentials=credentials)
    try:
        client.open()
    except UnreachableError:
        client.close()
        return None
    return client


def gates(process: int) -> list[int]:
    """The gate's processes below a daemon."""
    found = []
    for task in Path(f"/proc/{process}/task").iterdir():
        with suppress(OSError):  # a thread that has ended since
            for child in (task / "children").read_text().split():
                if b"gate_process" in Path(f"/proc/{child}/cmdline").read_bytes():
                    found.append(int(child))
    return found


@pytest.mark.slow
def test_a_viewer_over_tls_until_it_is_revoked(tmp_path: Path) -> None:
    local, network = free_port(), free_port()
    tls = f"tls/127.0.0.1:{network}"
    folder = tmp_path / "home"
    settings = folder / "vad.yaml"
    play = ["sim", "--dir", folder, "--seed", "1", "--bus-port", str(local), "--fifo"]
    with Vad(*play, log=tmp_path / "sim.log") as sim:
        wait_for(settings.exists, "the home's settings")
        wait_for(lambda: "bus" in (yaml.safe_load(settings.read_text()) or {}), "all of them")
        change_settings(settings, bus={"listen": [f"tcp/127.0.0.1:{local}", tls]})
        said = vad("check-config", settings=settings, rc=2)
        assert "vad pki init" in said, "TLS without certificates is refused before anything runs"
        vad("pki", "init", settings=settings)
        credentials = tmp_path / "tablet"
        vad("pki", "issue", "viewer", "tablet", "--out", str(credentials), settings=settings)
        vad("check-config", settings=settings)
        with Vad("run", "--config", settings, log=tmp_path / "daemon.log") as daemon:
            with closing(connect(daemon, local)) as own:
                viewer = wait_for(lambda: reached(tls, credentials), "the viewer is let in")
                with closing(viewer):
                    assert viewer.hubs() == own.hubs()

                    def told() -> str:
                        found = own.status()
                        parts = found.parts if found is not None else ()
                        return next((part.detail for part in parts if part.part == "bus tls"), "")

                    wait_for(lambda: "connected: viewer.tablet." in told(), "the status names it")
                    vad("pki", "revoke", "tablet", settings=settings)
                    wait_for(lambda: "nobody is let in" in told(), "the gate is closed")
                    assert reached(tls, credentials) is None
                    vad("pki", "issue", "viewer", "phone", "--out", str(tmp_path / "p"), settings=settings)
                    with closing(wait_for(lambda: reached(tls, tmp_path / "p"), "the phone")) as phone:
                        assert phone.hubs() == own.hubs()
                    assert reached(tls, credentials) is None
            below = gates(daemon.pid)
            assert len(below) == 1
            daemon.end(signal.SIGTERM)
            assert not Path(f"/proc/{below[0]}").exists(), "the gate ends with it"
        sim.end(signal.SIGTERM)


def test_plain_tcp_on_the_network_is_refused_with_what_to_do(tmp_path: Path) -> None:
    config = yaml.safe_load((ROOT / "config" / "vad.yaml").read_text())
    config["bus"] = {"listen": ["tcp/0.0.0.0:7447"]}
    settings = tmp_path / "vad.yaml"
    settings.write_text(yaml.safe_dump(config))
    floor = tmp_path / "floor.pgm"
    floor.write_bytes(b"P5 2 2 255\n" + bytes(4))
    (tmp_path / "floor.yaml").write_text(
        "{image: floor.pgm, resolution: 0.05, origin: [0, 0, 0], negate: 0,"
        " occupied_thresh: 0.65, free_thresh: 0.196}"
    )
    said = vad("check-config", settings=settings, rc=2)
    for words in ("would show the home to everyone", "vad pki init", "tls/0.0.0.0:7448"):
        assert words in said
    config["bus"] = {"listen": ["tls/0.0.0.0:7448"]}
    settings.write_text(yaml.safe_dump(config))
    assert "Add tcp/127.0.0.1:7447" in vad("check-config", settings=settings, rc=2)
