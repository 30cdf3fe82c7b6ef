"""Whose packet it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from vad.csi.attribution import AFTER_LOSS, LEGACY_FRAME, NO_FRAME, Attribution
from vad.csi.bfee import encode_bodies
from vad.csi.dot11 import INJECTED_MAC, data_frame
from vad.csi.logfile import LogReader, read_log, record
from vad.mac import UNKNOWN_MAC

AP = 0x02_00_00_00_00_FF
ACK = bytes.fromhex("d4000000") + bytes(6) + bytes(4)
BEACON = b"\x80\x00" + bytes(60)
ONES = np.ones((1, 30, 1, 1, 2), np.int8)


def csi_record(count: int) -> bytes:
    return record(0xBB, encode_bodies(ONES, nic_us=count, bfee_count=count, rssi=(30, 0, 0))[0])


def frame_record(mac: int, length: int = 60) -> bytes:
    return record(0xC1, data_frame(mac, AP, AP, 0, bytes(length)))


def null_frame(mac: int) -> bytes:
    return b"\x48\x01\0\0" + AP.to_bytes(6, "big") + mac.to_bytes(6, "big") + AP.to_bytes(6, "big") + bytes(6)


@dataclass
class Traffic:
    records: list[bytes]
    senders: list[int]  # of each record; 0 for a frame without CSI


def eight_stations(n: int, rng: np.random.Generator) -> Traffic:
    stations = [0x0200_0000_0000 + k for k in range(1, 9)]
    legacy = [ACK, BEACON, ACK[:10], *(null_frame(mac) for mac in stations)]
    traffic = Traffic([], [])
    for count in range(n):
        for _ in range(rng.integers(0, 3)):
            traffic.records.append(record(0xC1, legacy[rng.integers(len(legacy))]))
            traffic.senders.append(0)
        mac = stations[rng.integers(8)]
        for _ in range(rng.integers(1, 3)):  # an aggregate has one CSI for several frames
            traffic.records.append(frame_record(mac))
            traffic.senders.append(mac)
        traffic.records.append(csi_record(65_000 + count))
        traffic.senders.append(mac)
    return traffic


@pytest.mark.parametrize("seed", range(5))
def test_eight_stations_with_loss_are_never_confused(seed: int) -> None:
    rng = np.random.default_rng(seed)
    traffic = eight_stations(3000, rng)
    kept = np.flatnonzero(rng.random(len(traffic.records)) >= 0.05)
    truth = [traffic.senders[i] for i in kept if traffic.records[i][2] == 0xBB]
    packets, _ = read_log(b"".join(traffic.records[i] for i in kept), Attribution())
    mac, true = packets.mac, np.array(truth)
    known = mac != UNKNOWN_MAC
    assert (mac[known] == true[known]).all()
    assert known.mean() > 0.88


def test_without_loss_every_packet_is_known() -> None:
    traffic = eight_stations(500, np.random.default_rng(1))
    packets, _ = read_log(b"".join(traffic.records), Attribution())
    truth = [m for m, r in zip(traffic.senders, traffic.records, strict=True) if r[2] == 0xBB]
    assert packets.mac.tolist() == truth


def test_state_goes_on_over_batches() -> None:
    traffic = eight_stations(60, np.random.default_rng(2))
    log = b"".join(traffic.records)
    reader = LogReader(Attribution())
    macs = [m for at in range(0, len(log), 50) for m in reader.feed(log[at : at + 50]).packets.mac.tolist()]
    assert macs == read_log(log, Attribution())[0].mac.tolist()


def test_after_a_marked_loss_the_next_packet_is_unknown() -> None:
    attribution = Attribution()
    reader = LogReader(attribution)
    reader.feed(frame_record(1) + csi_record(1) + frame_record(2))
    attribution.mark_loss()
    assert reader.feed(csi_record(2)).packets.mac.tolist() == [UNKNOWN_MAC]
    assert reader.feed(frame_record(3) + csi_record(3)).packets.mac.tolist() == [3]
    assert attribution.unknown == {AFTER_LOSS: 1}


def test_reasons() -> None:
    attribution = Attribution()
    log = frame_record(1) + csi_record(1) + csi_record(2) + record(0xC1, BEACON) + csi_record(3)
    log += frame_record(4) + csi_record(5) + record(0xC1, ACK[:9]) + csi_record(6)
    packets, _ = read_log(log, attribution)
    assert packets.mac.tolist() == [1] + [UNKNOWN_MAC] * 4
    assert attribution.unknown == {NO_FRAME: 1, LEGACY_FRAME: 2, AFTER_LOSS: 1}


def test_a_refused_record_takes_its_frame_along() -> None:
    log = frame_record(1) + csi_record(1) + frame_record(2) + record(0xBB, bytes(30)) + csi_record(2)
    assert read_log(log, Attribution())[0].mac.tolist() == [1, UNKNOWN_MAC]


def test_injected_frames_are_told_by_addr3() -> None:
    log = record(0xC1, data_frame(INJECTED_MAC, INJECTED_MAC, 0x0011_2233_4455, 0)) + csi_record(1)
    log += record(0xC1, data_frame(INJECTED_MAC, INJECTED_MAC, 0xFFFF_FFFF_FFFF, 0)) + csi_record(2)
    assert read_log(log, Attribution())[0].mac.tolist() == [0x0011_2233_4455, INJECTED_MAC]


def test_a_fixed_transmitter_needs_no_frames() -> None:
    assert read_log(csi_record(1) + csi_record(9), Attribution(AP))[0].mac.tolist() == [AP, AP]
    assert read_log(csi_record(1))[0].mac.tolist() == [UNKNOWN_MAC]


def test_frames_alone() -> None:
    attribution = Attribution()
    reader = LogReader(attribution)
    assert len(reader.feed(frame_record(7)).packets) == 0
    assert reader.feed(csi_record(1)).packets.mac.tolist() == [7]
