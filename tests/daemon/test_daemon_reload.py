"""SIGHUP on the real daemon: what changes at once, what begins anew, what is refused, what systemd hears."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml
from daemon_world import WAIT_S, wait_for
from waiting import free_port

from vad.client import UnreachableError, VadClient
from vad.errors import VadError
from vad.robot.map_server import save_floor_plan
from vad.sim.home import floor_plan
from vad.sim.scenario import make_home

pytestmark = pytest.mark.timeout(600)

LAMP, CAM = "f4:f5:d8:00:00:01", "f4:f5:d8:00:00:02"


class Service:
    """`vad run` as systemd runs it: no terminal, and a socket that hears what it says."""

    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        self.file = folder / "vad.yaml"
        self.heard: list[str] = []
        save_floor_plan(floor_plan(make_home(1)), folder / "floor.yaml")
        self.plain: dict[str, Any] = {
            "state_dir": "state",
            "map": {"file": "floor.yaml"},
            "robot": {"type": "neato", "port": "neato.tty"},
            "camera": {"source": {"type": "mjpeg", "url": "http://127.0.0.1:9/stream"}},
            "radio": {"source": {"type": "follow", "path": "csi.fifo"}},
            "devices": {"static": [{"mac": LAMP, "name": "Lamp"}]},
            "bus": {"listen": [f"tcp/127.0.0.1:{self.port}"]},
        }
        self.write()
        self._log = folder / "log"
        self._ear = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._ear.bind(str(folder / "notify"))
        self._listening = threading.Thread(target=self._listen)
        self._listening.start()
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "vad", "run", "--config", str(self.file)],
                env=os.environ | {"NOTIFY_SOCKET": str(folder / "notify"), "WATCHDOG_USEC": "600000"},
                cwd=Path(__file__).parents[2],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def write(self, **sections: Any) -> None:
        """The settings file, with these sections replaced."""
        self.plain |= sections
        self.file.write_text(yaml.safe_dump(self.plain))

    def _listen(self) -> None:
        """Hear all along: the kernel keeps ten messages, and the daemon waits for nobody to take them."""
        while message := self._ear.recv(4096):
            self.heard += message.decode().splitlines()

    def count(self, line: str) -> int:
        """How often it has told this."""
        assert self.process.poll() is None, self.log
        return self.heard.count(line)

    @property
    def log(self) -> str:
        """What it has written."""
        return self._log.read_text()

    def reload(self) -> None:
        """SIGHUP; returns when it says that it is through."""
        before = self.count("RELOADING=1")
        self.process.send_signal(signal.SIGHUP)

        def through() -> bool:
            if self.count("RELOADING=1") == before:
                return False
            latest_first = self.heard[::-1]  # a copy: it grows meanwhile
            return "READY=1" in latest_first[: latest_first.index("RELOADING=1")]

        wait_for(through, "reloaded")

    def end(self) -> None:
        """SIGTERM, and what it owes then."""
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(WAIT_S) == 0, self.log
        wait_for(lambda: "STOPPING=1" in self.heard, "it says that it ends")
        assert self.heard[-1] == "STOPPING=1"

    def close(self) -> None:
        """Free everything."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self._ear.shutdown(socket.SHUT_RD)
        self._listening.join()
        self._ear.close()


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    with closing(Service(tmp_path)) as running:
        wait_for(lambda: running.count("READY=1"), "ready")
        # That it answers is all that this says: on a busy disk the lamp comes later.
        with connected(running.port) as client:
            wait_for(lambda: names(client) == {LAMP: "Lamp"}, "the lamp")
        yield running


@contextmanager
def connected(port: int) -> Iterator[VadClient]:
    """A client, as soon as somebody answers there."""

    def opened() -> VadClient | None:
        client = VadClient(f"tcp/127.0.0.1:{port}")
        try:
            client.open()
        except VadError:
            client.close()
            return None
        return client

    client = wait_for(opened, "somebody answers")
    try:
        yield client
    finally:
        client.close()


def names(client: VadClient) -> dict[str, str | None]:
    """What the devices are called; nothing while the daemon does not answer."""
    try:
        return {device.mac: device.name for device in client.devices()}
    except UnreachableError:
        return {}


@pytest.mark.slow
def test_names_ignored_devices_and_limits_change_at_once(service: Service) -> None:
    with connected(service.port) as client:
        wait_for(lambda: names(client) == {LAMP: "Lamp"}, "the lamp")
        begun = service.log.count("waiting for")
        service.write(
            devices={"static": [{"mac": LAMP, "name": "Floor lamp"}, {"mac": CAM, "name": "Doorbell"}]},
            capture={"max_s": 20.0},
        )
        service.reload()
        wait_for(lambda: names(client) == {LAMP: "Floor lamp", CAM: "Doorbell"}, "names")
        service.write(devices={**service.plain["devices"], "ignore": [LAMP]})
        service.reload()
        wait_for(lambda: names(client) == {CAM: "Doorbell"}, "the lamp is gone")
        service.write(devices={**service.plain["devices"], "ignore": []})
        service.reload()
        wait_for(lambda: names(client) == {LAMP: "Floor lamp", CAM: "Doorbell"}, "it is back")
    assert "beginning anew" not in service.log, "none of this needs another start"
    assert service.log.count("waiting for") == begun
    service.end()


@pytest.mark.slow
def test_another_port_begins_anew_in_the_same_process(service: Service) -> None:
    pid, port = service.process.pid, free_port()
    service.write(bus={"listen": [f"tcp/127.0.0.1:{port}"]})
    service.reload()
    with connected(port) as client:
        wait_for(lambda: names(client) == {LAMP: "Lamp"}, "the lamp at the new port")
    assert service.process.pid == pid
    assert service.count("STOPPING=1") == 0, "systemd must not take a new beginning for the end"
    fed = service.count("WATCHDOG=1")
    wait_for(lambda: service.count("WATCHDOG=1") > fed + 2, "the new core is watched")
    service.end()


def test_a_file_that_cannot_be_used_is_refused_and_the_old_settings_go_on(service: Service) -> None:
    with connected(service.port) as client:
        service.file.write_text("robot: {type: neato, prot: x}")
        service.reload()
        wait_for(lambda: any("not in force" in part.detail for part in parts(client)), "it says so")
        assert any(line.startswith("STATUS=the settings file is not in force") for line in service.heard)
        assert "$.robot" in service.log
        wait_for(lambda: names(client) == {LAMP: "Lamp"}, "it answers as before")
        assert "beginning anew" not in service.log
        service.write()
        service.reload()
        wait_for(lambda: not any("not in force" in part.detail for part in parts(client)), "mended")
    service.end()


@pytest.mark.slow
def test_settings_that_cannot_start_give_way_to_those_of_before(service: Service) -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        connected(service.port) as client,
    ):
        old = service.plain["bus"]
        service.write(bus={"listen": [f"tcp/127.0.0.1:{taken.getsockname()[1]}"]})
        service.reload()
        assert "it cannot start" in service.log
        assert "the port is taken" in service.log
        wait_for(lambda: names(client) == {LAMP: "Lamp"}, "the old port answers")
        service.write(bus=old)
    service.end()


def parts(client: VadClient) -> list[Any]:
    """The status's parts; none while the daemon does not answer."""
    try:
        found = client.status()
    except UnreachableError:
        return []
    return list(found.parts) if found is not None else []
