#!/usr/bin/env python3
"""Feeds mutated CSI logs, messages and echo replies to the parsers; any exception but theirs is a bug.

Usage: tools/fuzz_csi.py [INPUTS] [SEED]
"""

from __future__ import annotations

import random
import resource
import sys
import time

import numpy as np

from vad.csi import cn
from vad.csi.attribution import Attribution
from vad.csi.bfee import encode_bodies
from vad.csi.dot11 import data_frame
from vad.csi.echo import echo_request, reply_sequence
from vad.csi.heard import HeardStations
from vad.csi.intake import Intake
from vad.csi.logfile import read_log, record
from vad.csi.summary import summarise
from vad.errors import ProtocolError
from vad.health import Health


def seeds() -> list[bytes]:
    """Short sound logs of every shape, with frames."""
    logs = []
    for n_rx in (1, 2, 3):
        for n_tx in (1, 2, 3):
            csi = np.full((2, 30, 3, n_tx, 2), 17, np.int8)
            bodies = encode_bodies(csi, n_rx=n_rx, nic_us=[1, 2], bfee_count=[1, 2], rssi=(30, 31, 32))
            logs.append(b"".join(record(0xC1, data_frame(1, 2, 2, 0)) + record(0xBB, b) for b in bodies))
    return logs


def mutate(log: bytes, rng: random.Random) -> bytes:
    """A few bytes changed, a piece cut out or doubled."""
    mutated = bytearray(log)
    for _ in range(rng.randrange(1, 6)):
        mutated[rng.randrange(len(mutated))] = rng.choice((0, 1, 3, 4, 0x7F, 0x80, 0xBB, 0xC1, 0xFF))
    start = rng.randrange(len(mutated))
    end = start + rng.randrange(40)
    kind = rng.randrange(4)
    if kind == 0:
        del mutated[start:end]
    elif kind == 1:
        mutated[start:start] = mutated[start:end]
    return bytes(mutated)


def main() -> None:
    inputs = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
    rng = random.Random(int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    logs = seeds()
    health = Health("fuzz")
    endless, heard = Intake(health, None), HeardStations()
    reply = bytes((0x45,)) + bytes(19) + b"\0" + echo_request(7, 7, bytes(56))[1:]
    packets = refused = 0
    slowest_s = 0.0
    started, warm_kib = time.monotonic(), 0
    for i in range(inputs):
        log = mutate(rng.choice(logs), rng)
        which = i % 4
        began = time.monotonic()
        if which == 0:
            packets += summarise(log).packets if i % 40 == 0 else read_log(log, Attribution())[1].packets
        elif which == 1:
            batch = endless.feed(log, 1_000_000 * i, None)
            packets += len(batch.packets)
            heard.take(batch, 1_000_000 * i)
        elif which == 2:
            try:
                reply_sequence(mutate(reply, rng), 7)
            except ProtocolError:
                refused += 1
        else:
            message = mutate(cn.build_message(0xBB, log), rng)
            try:
                cn.payload_bytes(message, len(message), cn.IWLAGN_GROUP, cn.IWLAGN_VALUE)
            except ProtocolError:
                refused += 1
        slowest_s = max(slowest_s, time.monotonic() - began)
        if i == inputs // 10:
            warm_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    grown_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - warm_kib
    print(
        f"{inputs} inputs in {time.monotonic() - started:.0f} s: {packets} packets, "
        f"{refused} messages refused, slowest {slowest_s * 1e3:.1f} ms, "
        f"memory grew by {grown_kib} KiB after the first tenth"
    )


if __name__ == "__main__":
    main()
