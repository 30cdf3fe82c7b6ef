"""Logs whole and in pieces."""

from __future__ import annotations

import itertools
from dataclasses import fields, replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from vad.csi.attribution import Attribution
from vad.csi.bfee import encode_bodies
from vad.csi.dot11 import data_frame
from vad.csi.logfile import LogReader, read_log, record
from vad.csi.packets import CsiPackets
from vad.csi.select import join_packets, take_packets

AP = 0x02_00_00_00_00_FF


def mixed_log(n: int = 40, seed: int = 3) -> bytes:
    """Frames, CSI of several shapes and permutations, other codes, a lying record."""
    rng = np.random.default_rng(seed)
    parts = []
    for i in range(n):
        n_rx, n_tx = rng.integers(1, 4, 2)
        csi = rng.integers(-128, 128, (1, 30, 3, n_tx, 2)).astype(np.int8)
        body = encode_bodies(
            csi,
            n_rx=int(n_rx),
            nic_us=1000 * i,
            bfee_count=65500 + i,
            rssi=(30, 31, 32),
            antenna_sel=0b010010,
        )[0]
        if i % 3 == 0:
            parts.append(record(0xC1, data_frame(0x10 + i, AP, AP, i, bytes(i))))
        if i % 7 == 0:
            parts.append(record(0xD0, bytes(3)) + record(0xC3, bytes(i)))
        parts.append(record(0xBB, body if i != 20 else body[:-1]))
    return b"".join(parts)


def assert_same(a: CsiPackets, b: CsiPackets) -> None:
    for field in fields(CsiPackets):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name), err_msg=field.name)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 30_000), max_size=60))
def test_any_chunking_equals_the_whole(cuts: list[int]) -> None:
    log = mixed_log() + b"\x01\x23\xbb partial"
    whole, stats = read_log(log, Attribution())
    reader = LogReader(Attribution())
    edges = [0, *sorted(min(c, len(log)) for c in cuts), len(log)]
    batches = [reader.feed(log[a:b]) for a, b in itertools.pairwise(edges)]
    assert_same(join_packets([b.packets for b in batches]), whole)
    assert reader.stats == stats
    raw = b"".join(b.raw for b in batches)
    assert raw == log[: len(log) - stats.truncated_bytes]
    for batch in batches:
        for offset, count in zip(batch.raw_offsets, batch.packets.bfee_count, strict=True):
            assert batch.raw[offset + 2] == 0xBB
            assert int.from_bytes(batch.raw[offset + 7 : offset + 9], "little") == count


def test_byte_by_byte() -> None:
    log = mixed_log(6)
    reader = LogReader()
    batches = [reader.feed(log[i : i + 1]) for i in range(len(log))]
    assert_same(join_packets([b.packets for b in batches]), read_log(log)[0])


def test_stats() -> None:
    _, stats = read_log(mixed_log(40))
    assert stats.packets == 39
    assert stats.records == {0xBB: 40, 0xC1: 14, 0xD0: 6, 0xC3: 6}
    assert stats.bad == {"length": 1}
    assert (stats.gaps, stats.lost) == (1, 1)  # the refused record; the wrap of bfee_count is no gap
    assert stats.truncated_bytes == 0


def test_gaps_and_a_restarted_count() -> None:
    csi = np.ones((6, 30, 1, 1, 2), np.int8)
    bodies = encode_bodies(csi, nic_us=7, bfee_count=[65534, 65535, 3, 4, 0, 1], rssi=(1, 0, 0))
    packets, stats = read_log(b"".join(record(0xBB, b) for b in bodies))
    assert (stats.gaps, stats.lost) == (2, 3)
    assert packets.nic_us.tolist() == [7] * 6  # equal timestamps are no reason to drop anything


def test_long_frames_zero_lengths_and_a_mapped_file() -> None:
    csi = np.ones((1, 30, 1, 1, 2), np.int8)
    body = encode_bodies(csi, nic_us=7, bfee_count=9, rssi=(1, 0, 0))[0]
    log = bytes(6) + record(0xC1, bytes(65_000)) + record(0xBB, body) + bytes(1)
    packets, stats = read_log(memoryview(log))
    assert packets.bfee_count.tolist() == [9]
    assert stats.bad == {"empty": 3}
    assert stats.truncated_bytes == 1


def test_restart_gives_up_the_incomplete_record() -> None:
    log = mixed_log(4)
    reader = LogReader()
    reader.feed(log[:-5])
    reader.restart()
    reader.feed(log)
    assert reader.stats.packets == 3 + 4
    assert reader.stats.truncated_bytes == 0


def test_take_and_join() -> None:
    whole, _ = read_log(mixed_log())
    mask = whole.n_rx == 2
    picked = take_packets(whole, mask)
    assert len(picked) == int(mask.sum()) > 0
    assert_same(join_packets([picked, take_packets(whole, np.zeros(0, np.int64))]), picked)
    assert len(join_packets([])) == 0
    narrow = replace(picked, csi=picked.csi[:, :, :, :1])
    assert join_packets([narrow, whole]).csi.shape[3] == 3
