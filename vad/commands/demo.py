"""`vad demo`: the whole chain on a simulated home, from nothing to a mapped device."""

from __future__ import annotations

import contextlib
import json
import math
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Group
from rich.live import Live
from rich.spinner import Spinner
from rich.text import Text

from vad.bus.messages import CameraMessage, DeviceMessage, StatusMessage
from vad.client import UnreachableError, VadClient
from vad.commands.console import EXIT_NOTHING, err, out
from vad.errors import VadError

POLL_S = 0.5
STOP_S = 5.0
START_S = 30.0
_GOOD_M = 0.5


def demo(
    seed: Annotated[int, typer.Option(help="Which simulated home.")] = 1,
    folder: Annotated[
        Path | None,
        typer.Option("--dir", help="Keep the home's files here.", show_default="removed afterwards"),
    ] = None,
    timeout_s: Annotated[float, typer.Option("--timeout", help="Give up after this many seconds.")] = 170.0,
    fifo: Annotated[bool, typer.Option("--fifo", help="CSI through a FIFO, not netlink.")] = False,
) -> None:
    """Run the daemon in a simulated home until its new device is on the map (about two minutes).

    A virtual robot, camera, radio and hostapd play through their real interfaces; the daemon is the ordinary
    one. In the end `vad devices` asks it over zenoh and prints its answer next to the truth.

    Exit code 0: mapped within 0.5 m of the truth; 1: not.
    """
    with contextlib.ExitStack() as stack:
        home = folder or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="vad-demo-")))
        home.mkdir(parents=True, exist_ok=True)
        port, web_port = _free_port(), _free_port()
        endpoint = f"tcp/127.0.0.1:{port}"
        arguments = ["sim", "--dir", str(home), "--seed", str(seed), "--bus-port", str(port)]
        arguments += ["--web-port", str(web_port)]
        stack.enter_context(_process([*arguments, *(["--fifo"] if fifo else [])], home / "sim.log"))
        config = home / "vad.yaml"
        _wait_for(config, START_S)
        daemon = stack.enter_context(_process(["run", "--config", str(config)], home / "daemon.log"))
        out.print(f"watch it at http://127.0.0.1:{web_port}/", highlight=False)
        mapped = _watch(daemon, endpoint, home, time.monotonic() + timeout_s)
        truth = home / "truth.json"
        shown = subprocess.run(
            [sys.executable, "-m", "vad", "devices", "--endpoint", endpoint, "--truth", str(truth)],
            check=False,
        )
        good = mapped is not None and shown.returncode == 0 and _report(mapped, truth)
        if not good and folder is None:
            for name in ("sim.log", "daemon.log"):
                err.print(f"--- {name}, last lines", style="yellow")
                err.print("\n".join((home / name).read_text().splitlines()[-15:]), markup=False)
    if not good:
        raise typer.Exit(EXIT_NOTHING)


def _watch(daemon: subprocess.Popen[bytes], endpoint: str, home: Path, until: float) -> DeviceMessage | None:
    """Show each step until the device is mapped; None when time is up or the daemon has died."""
    begun = time.monotonic()
    done: list[str] = []
    spinner = Spinner("dots", text="starting the daemon")
    with Live(spinner, console=out, refresh_per_second=8) as live, _connected(endpoint) as client:
        while time.monotonic() < until and daemon.poll() is None:
            time.sleep(POLL_S)
            try:
                status, cameras, found = client.status(), client.cameras(), client.devices()
            except VadError:
                continue  # not up yet
            for line in _milestones(cameras, found):
                if line not in done:
                    done.append(line)
                    out.print(f"[green]✓[/green] {time.monotonic() - begun:4.0f} s  {line}", highlight=False)
            spinner.update(text=Text(f"{time.monotonic() - begun:4.0f} s  {_step(status)}"))
            live.update(Group(spinner))
            mapped = next((d for d in found if d.state == "mapped"), None)
            if mapped is not None:
                live.update(Text(""))
                return mapped
    why = "not mapped in time" if daemon.poll() is None else "the daemon ended"
    err.print(f"{why}; logs are in {home}", style="red", soft_wrap=True)
    return None


@contextlib.contextmanager
def _connected(endpoint: str) -> Iterator[VadClient]:
    """A client of the daemon, which is given START_S to come up."""
    until = time.monotonic() + START_S
    while True:
        try:
            client = VadClient(endpoint)
            client.open()
            break
        except UnreachableError:
            if time.monotonic() > until:
                raise
            time.sleep(POLL_S)
    try:
        yield client
    finally:
        client.close()


def _step(status: StatusMessage | None) -> str:
    return status.step if status is not None else "starting the daemon"


def _milestones(cameras: list[CameraMessage], found: list[DeviceMessage]) -> Iterator[str]:
    """Sentences for what has been reached, each said once."""
    yield "the daemon runs and answers over zenoh"
    for camera in cameras:
        if camera.position_m is not None and camera.state == "valid":
            yield "the camera knows where it is, from the robot's drive"
    for device in found:
        yield f"{device.mac} joined the network"
        for walk in range(1, device.walks + 1):
            yield f"walk {walk} recorded and solved"
        if device.state == "mapped":
            yield f"{device.mac} is mapped"


def _report(device: DeviceMessage, truth: Path) -> bool:
    place = json.loads(truth.read_text())[device.mac]
    assert device.x_m is not None
    assert device.y_m is not None
    error_m = math.hypot(device.x_m - place["x_m"], device.y_m - place["y_m"])
    good = error_m <= _GOOD_M
    mark = "✓" if good else "✗"
    out.print(
        f"{mark} placed {error_m:.2f} m from the truth, stated ±{device.radius90_m:.2f} m (90 %) "
        f"from {device.walks} walks (simulated)",
        style="green" if good else "red",
        highlight=False,
    )
    return good


@contextlib.contextmanager
def _process(arguments: list[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`vad ARGUMENTS` in the background, stopped as a user would: SIGINT, and killed only if that fails."""
    with log.open("wb") as file:
        process = subprocess.Popen([sys.executable, "-m", "vad", *arguments], stdout=file, stderr=file)
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _wait_for(path: Path, timeout_s: float) -> None:
    until = time.monotonic() + timeout_s
    while not path.exists():
        if time.monotonic() > until:
            raise VadError(
                "the simulated home did not start", where=str(path.parent), remedy="See its sim.log"
            )
        time.sleep(0.1)


def _free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])
