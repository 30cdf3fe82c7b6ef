#!/usr/bin/env python3
"""CSI live: this process sends through the kernel's connector, another one receives and measures itself."""

from __future__ import annotations

import asyncio
import json
import logging
import socket
import struct
import subprocess
import sys
import time
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.table import Table

from vad.csi import cn
from vad.csi.bfee import encode_bodies
from vad.csi.connector import RECEIVE_BUFFER_BYTES, Connector
from vad.csi.dot11 import data_frame
from vad.csi.packets import CsiBatch
from vad.streams import DropOldestQueue

GROUP = 25  # not the driver's, which may be at work
_NIC_US_AT = cn.HEADER_BYTES + 1
_TICK_S = 0.001


@dataclass(frozen=True, slots=True)
class Case:
    """One measurement. stall_s: how long the receiver's event loop stands still in every second;
    frames: with a 0xC1 message before each packet."""

    name: str
    packets_per_s: int
    stall_s: float = 0.0
    frames: bool = False
    buffer_bytes: int = RECEIVE_BUFFER_BYTES


CASES = (
    Case("10,000/s", 10_000),
    Case("10,000/s with frames", 10_000, frames=True),
    Case("2,500/s", 2_500),
    Case("2,500/s, event loop stalls 400 ms every second", 2_500, stall_s=0.4),
    Case("forced overrun: 10,000/s, stalls, small buffer", 10_000, stall_s=0.4, buffer_bytes=100_000),
)


async def receive(stall_s: float, buffer_bytes: int) -> None:
    """Receive until a line comes on standard input; print counters and the CPU time of this process."""
    logging.disable(logging.WARNING)  # what is lost stands in the table
    source = Connector(GROUP, allow_user_space=True, receive_buffer_bytes=buffer_bytes)
    batches: DropOldestQueue[CsiBatch] = DropOldestQueue(256)
    tasks = [asyncio.create_task(source.run(batches)), asyncio.create_task(consume(batches))]
    while source.health.state == "starting":  # noqa: ASYNC110 - health has no event
        await asyncio.sleep(0.01)
    loop = asyncio.get_running_loop()
    over = loop.run_in_executor(None, sys.stdin.readline)
    cpu_s, wall_s = time.process_time(), time.monotonic()
    print(source.health.detail, flush=True)
    while stall_s and not over.done():
        time.sleep(stall_s)  # noqa: ASYNC251 - the loop shall stand still
        await asyncio.wait({over}, timeout=1 - stall_s)
    await over
    await asyncio.sleep(0.3)
    cpu_s, wall_s = time.process_time() - cpu_s, time.monotonic() - wall_s
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    told = dict(source.health.counters) | {"cpu": cpu_s / wall_s, "queue_dropped": batches.dropped}
    print(json.dumps(told), flush=True)


async def consume(batches: DropOldestQueue[CsiBatch]) -> None:
    """Take everything, like the daemon's ears."""
    while True:
        await batches.get()


def send(case: Case, seconds: float) -> int:
    """Multicast at the rate; the number of messages sent."""
    count = np.arange(4096)
    csi = np.random.default_rng(0).integers(-60, 61, (len(count), 30, 3, 1, 2)).astype(np.int8)
    bodies = encode_bodies(csi, nic_us=0, bfee_count=0, rssi=(30, 31, 32))
    messages = [bytearray(cn.build_message(0xBB, body, group=GROUP)) for body in bodies]
    frame = cn.build_message(0xC1, data_frame(2, 3, 3, 0, bytes(200)), group=GROUP)
    set_counters = struct.Struct("<IH").pack_into
    target = (0, 1 << GROUP - 1)
    total = int(case.packets_per_s * seconds)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, cn.NETLINK_CONNECTOR) as sock:
        sock.bind((0, 0))
        started, sent = time.monotonic(), 0
        while sent < total:
            elapsed_s = time.monotonic() - started
            for i in range(sent, min(total, int(elapsed_s * case.packets_per_s))):
                message = messages[i % len(messages)]
                set_counters(
                    message, _NIC_US_AT, i * 1_000_000 // case.packets_per_s & 0xFFFF_FFFF, i & 0xFFFF
                )
                if case.frames:
                    sock.sendto(frame, target)
                sock.sendto(message, target)
                sent = i + 1
            time.sleep(_TICK_S)
    return total * (2 if case.frames else 1)


def measure(case: Case, seconds: float) -> list[str]:
    """One row of the table."""
    command = [sys.executable, __file__, str(case.stall_s), str(case.buffer_bytes)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as receiver:
        assert receiver.stdout is not None
        ready = receiver.stdout.readline().strip()
        if not ready.startswith("listening"):
            receiver.communicate("\n")
            return [case.name, ready, "", "", "", ""]
        sent = send(case, seconds)
        time.sleep(0.5)
        told = json.loads(receiver.communicate("\n")[0])
    received, dropped = told["messages"], told.get("dropped", 0)
    exact = "yes" if received + dropped == sent else f"no, {sent - received - dropped} unaccounted"
    return [case.name, f"{sent:,}", f"{received:,}", f"{dropped:,}", exact, f"{told['cpu']:.1%}"]


def main(console: Console, seconds: float) -> None:
    table = Table(title="Live through NETLINK_CONNECTOR, 3x1", title_justify="left", box=None)
    table.add_column("case")
    for column in ("messages", "received", "counted as lost", "exact", "receiver's CPU"):
        table.add_column(column, justify="right")
    for case in CASES:
        table.add_row(*measure(case, seconds))
    console.print(table)


if __name__ == "__main__":
    asyncio.run(receive(float(sys.argv[1]), int(sys.argv[2])))
