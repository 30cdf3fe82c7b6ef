"""`vad csi`: CSI logs: what is in one, record one, convert one, play one."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.live import Live
from rich.text import Text

from vad.clock import unwrap_nic_us
from vad.commands.console import EXIT_NOTHING, JsonOption, complain, out, print_json, reported_errors
from vad.commands.signals import until_ended
from vad.csi.attribution import Attribution
from vad.csi.bfee import scaled_csi
from vad.csi.cn import IWLAGN_GROUP
from vad.csi.connector import Connector
from vad.csi.follow import FollowLog
from vad.csi.logfile import read_log
from vad.csi.packets import CsiBatch, CsiPackets, CsiSource
from vad.csi.summary import summarise
from vad.errors import VadError
from vad.finish import to_the_end
from vad.report.csi import log_table, recording_line
from vad.streams import DropOldestQueue

SHOW_S = 0.5
QUEUED_BATCHES = 4096
"""Over a minute of the fastest source: what the disk may hold up without a loss."""

csi_app = typer.Typer(no_args_is_help=True, help="CSI logs: what is in one, record, convert, play.")

LogArgument = Annotated[Path, typer.Argument(help="A log of the CSI Tool's log_to_file.", metavar="FILE")]
GroupOption = Annotated[int, typer.Option(help="Connector group of the driver.", min=1, max=31)]
FifoOption = Annotated[Path | None, typer.Option(help="A FIFO or growing log instead.", metavar="FILE")]


@csi_app.command()
def info(file: LogArgument, as_json: JsonOption = False) -> None:
    """Tell what is in a log: packets by shape, rate, gaps, senders, signal levels, broken parts.

    Example:  vad csi info csi.dat

    Exit code 0: it holds packets; 1: none; 2: it cannot be read.
    """
    with reported_errors():
        log = summarise(_read(file))
    if as_json:
        print_json({"file": str(file)} | asdict(log))
    else:
        out.print(log_table(str(file), log))
    if not log.packets:
        raise typer.Exit(EXIT_NOTHING)


@csi_app.command()
def convert(
    file: LogArgument,
    target: Annotated[Path, typer.Argument(help="The .npz file to write.", metavar="OUT.npz")],
    scaled: Annotated[bool, typer.Option("--scaled", help="Add the channel in absolute units.")] = False,
) -> None:
    """Convert a log to NumPy: one array a field, row i is packet i.

    csi (N, 30, R, T) complex64, time_s (N,) from the first packet, nic_us, bfee_count, n_rx, n_tx,
    rssi (N, 3), noise_dbm, agc, antenna_sel, rate, mac (N,) int64, -1 = unknown; --scaled adds csi_scaled.

    Example:  vad csi convert csi.dat csi.npz

    Exit code 0: done; 1: there is no packet in it; 2: a file cannot be used.
    """
    with reported_errors():
        if target.suffix != ".npz":
            raise VadError("the name does not end in .npz", where=str(target))
        packets, _ = read_log(_read(file), Attribution())
        if not len(packets):
            complain(f"{file}: there is no packet in it")
            raise typer.Exit(EXIT_NOTHING)
        arrays = {f.name: getattr(packets, f.name) for f in fields(CsiPackets) if f.name != "arrival_ns"}
        arrays["time_s"] = (unwrap_nic_us(packets.nic_us) - int(packets.nic_us[0])) / 1e6
        if scaled:
            arrays["csi_scaled"] = scaled_csi(packets)
        try:
            np.savez(target, **arrays)
        except OSError as error:
            raise VadError(f"cannot be written: {error.strerror}", where=str(target)) from error
    shape = "x".join(map(str, packets.csi.shape))
    out.print(Text(f"wrote {target}: {len(packets):,} packets, csi {shape}"), soft_wrap=True)


@csi_app.command()
def record(
    target: Annotated[Path, typer.Argument(help="The log to write.", metavar="OUT.dat")],
    group: GroupOption = IWLAGN_GROUP,
    fifo: FifoOption = None,
    seconds: Annotated[float | None, typer.Option(help="Stop by itself after so long.", min=0.0)] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite a file that is there.")] = False,
    user_space: Annotated[
        bool, typer.Option("--allow-user-space", help="Take what a process sent: emulators only.")
    ] = False,
) -> None:
    """Record live CSI to a log until Ctrl-C, byte for byte as log_to_file writes it.

    Example:  vad csi record csi.dat --seconds 60

    Exit code 0: packets were recorded; 1: none came; 2: the file cannot be written.
    """
    source: CsiSource = Connector(group, allow_user_space=user_space) if fifo is None else FollowLog(fifo)
    recording = _Recording(source, target)
    with reported_errors():
        try:
            with target.open("wb" if force else "xb") as file:
                asyncio.run(until_ended(recording.run(file.fileno(), seconds)))
        except FileExistsError as error:
            raise VadError("is there already", where=str(target), remedy="Use --force") from error
        except OSError as error:
            raise VadError(f"cannot be written: {error.strerror}", where=str(target)) from error
    out.print(recording.line(), soft_wrap=True)
    if not recording.packets:
        raise typer.Exit(EXIT_NOTHING)


@csi_app.command()
def play(
    file: LogArgument,
    group: GroupOption = IWLAGN_GROUP,
    fifo: Annotated[Path | None, typer.Option(help="Through this FIFO, not netlink.", metavar="FILE")] = None,
    speed: Annotated[float, typer.Option(help="2 is twice as fast as it was recorded.", min=0.01)] = 1.0,
) -> None:
    """Play a log as the driver would, over NETLINK_CONNECTOR (root) or through a FIFO.

    Example:  vad csi play csi.dat --fifo csi.fifo --speed 4

    Exit code 0: played; 1: some of it could not be sent; 2: the file or the connector cannot be used.
    """
    from vad.sim import driver
    from vad.sim.log_player import LogPlayer

    with reported_errors():
        player = LogPlayer(_read(file))
        sender = driver.ConnectorSender(group) if fifo is None else driver.FifoSender(fifo)
    end_s = player.length_s + driver.TICK_S * speed
    start_ns = time.monotonic_ns() + int(driver.AHEAD_S * 1e9)
    # From its first record, however long it takes to get there: what is then too late is told.
    playing = driver.run(player, start_ns, sender, speed=speed, from_s=0.0, until_s=end_s)
    asyncio.run(until_ended(playing))
    counters = sender.health.counters
    missed = counters["dropped_records"] + counters["late_records"]
    told = f", {missed:,} not sent: {sender.health.detail or 'too late'}" if missed else ""
    out.print(Text(f"played {counters['records']:,} records{told}"), soft_wrap=True)
    if missed or counters["skipped_ms"]:
        raise typer.Exit(EXIT_NOTHING)


class _Recording:
    """Everything that a source gives, into one file."""

    def __init__(self, source: CsiSource, target: Path) -> None:
        self.packets = 0
        self._source, self._target = source, target
        self._bytes = 0
        self._started_s = self._ended_s = 0.0
        self._recent: tuple[float, int] = (0.0, 0)
        self._rate_per_s = 0.0

    async def run(self, fd: int, seconds: float | None) -> None:
        """Record until cancelled, or for `seconds`; what has come by then is written."""
        batches: DropOldestQueue[CsiBatch] = DropOldestQueue(QUEUED_BATCHES)
        self._started_s = time.monotonic()
        listening = asyncio.create_task(self._source.run(batches))
        try:
            with Live(console=out, auto_refresh=False, transient=True) as live:
                async with asyncio.timeout(seconds):
                    while True:
                        await asyncio.sleep(SHOW_S)
                        await to_the_end(partial(self._write, fd, batches.drain()))
                        live.update(self.line(), refresh=True)
        except TimeoutError:
            pass
        finally:
            listening.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await listening
            self._write(fd, batches.drain())
            self._ended_s = time.monotonic()

    def _write(self, fd: int, batches: list[CsiBatch]) -> None:
        data = memoryview(b"".join(batch.raw for batch in batches))
        self._bytes += len(data)
        self.packets += sum(len(batch.packets) for batch in batches)
        while data:
            data = data[os.write(fd, data) :]

    def line(self) -> Text:
        """How it goes."""
        now_s = self._ended_s or time.monotonic()
        if not self._ended_s and now_s - self._recent[0] >= SHOW_S:
            since_s, packets = self._recent
            self._rate_per_s = (self.packets - packets) / (now_s - since_s)
            self._recent = (now_s, self.packets)
        seconds = now_s - self._started_s
        rate = self.packets / max(seconds, 1e-9) if self._ended_s else self._rate_per_s
        return recording_line(
            str(self._target), self.packets, self._bytes, seconds, rate, self._source.health
        )


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise VadError(f"cannot be read: {error.strerror}", where=str(path)) from error
