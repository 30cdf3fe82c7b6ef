"""0xBB records: a hand-computed one, round trips, records that lie."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vad.csi.bfee import BFEE_CODE, decode_bodies, encode_bodies, permutation, scaled_csi
from vad.csi.logfile import read_log, record
from vad.csi.packets import UNKNOWN_ARRIVAL, CsiPackets
from vad.mac import UNKNOWN_MAC


def decode(bodies: list[bytes]) -> tuple[CsiPackets, dict[str, int]]:
    lengths = np.array([len(b) for b in bodies], np.int64)
    offsets = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64)
    decoded = decode_bodies(b"".join(bodies), offsets, lengths)
    return decoded.packets, dict(decoded.bad)


def one_body(n_rx: int = 1, n_tx: int = 1, antenna_sel: int = 0b100100, **fields: object) -> bytes:
    csi = np.ones((1, 30, 3, n_tx, 2), np.int8)
    given: dict[str, object] = {"nic_us": 0, "bfee_count": 0, "rssi": (30, 0, 0)} | fields
    return encode_bodies(csi, n_rx=n_rx, antenna_sel=antenna_sel, **given)[0]  # type: ignore[arg-type]


def test_a_record_written_bit_by_bit() -> None:
    """2 chains, 1 stream; chain 0 is antenna C, chain 1 antenna A; written as one big integer."""
    bits = 0
    for subcarrier in range(30):
        start = subcarrier * (2 * 16 + 3) + 3
        for k, value in enumerate((subcarrier, -subcarrier, -128, 127)):
            bits |= (value & 0xFF) << start + 8 * k
    payload = bits.to_bytes(60 * 2 + 12, "little")
    header = bytes.fromhex("78563412 ffff 0000 02 01 14 00 1e 81 25 12 8400 0105".replace(" ", ""))
    packets, bad = decode([header + payload])
    assert not bad
    assert packets.nic_us.tolist() == [0x12345678]
    assert packets.bfee_count.tolist() == [0xFFFF]
    assert packets.rssi.tolist() == [[20, 0, 30]]
    assert packets.noise_dbm.tolist() == [-127]
    assert packets.agc.tolist() == [0x25]
    assert packets.rate.tolist() == [0x0501]
    assert packets.csi.shape == (1, 30, 3, 1)
    assert packets.csi[0, :, 2, 0].tolist() == [complex(i, -i) for i in range(30)]
    assert packets.csi[0, :, 0, 0].tolist() == [complex(-128, 127)] * 30
    assert not packets.csi[0, :, 1].any()
    assert packets.arrival_ns.tolist() == [UNKNOWN_ARRIVAL]
    assert packets.mac.tolist() == [UNKNOWN_MAC]


@st.composite
def packet(draw: st.DrawFn) -> dict[str, int]:
    n_rx = draw(st.integers(1, 3))
    perm = draw(st.permutations(range(3)))
    return {
        "n_rx": n_rx,
        "n_tx": draw(st.integers(1, 3)),
        "antenna_sel": sum(a << 2 * j for j, a in enumerate(perm)) | draw(st.integers(0, 3)) << 6,
        "nic_us": draw(st.integers(0, 2**32 - 1)),
        "bfee_count": draw(st.integers(0, 2**16 - 1)),
        "noise_dbm": draw(st.integers(-128, 127)),
        "agc": draw(st.integers(0, 255)),
        "rate": draw(st.integers(0, 2**16 - 1)),
    }


@settings(max_examples=60, deadline=None)
@given(st.lists(packet(), min_size=1, max_size=12), st.integers(0, 2**32 - 1))
def test_decode_undoes_encode(drawn: list[dict[str, int]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    bodies, values, rssi = [], [], []
    for fields in drawn:
        used = permutation(fields["antenna_sel"], fields["n_rx"])
        assert used is not None
        csi = np.zeros((1, 30, 3, fields["n_tx"], 2), np.int8)
        csi[:, :, list(used)] = rng.integers(-128, 128, (1, 30, fields["n_rx"], fields["n_tx"], 2))
        rssi.append(rng.integers(0, 256, 3))
        rest = {k: v for k, v in fields.items() if k not in ("n_tx", "n_rx")}
        bodies += encode_bodies(csi, rssi=rssi[-1], n_rx=fields["n_rx"], **rest)
        values.append(csi[0, ..., 0].astype(np.complex64) + 1j * csi[0, ..., 1])
    packets, bad = decode(bodies)
    assert not bad
    assert packets.csi.shape[3] == max(f["n_tx"] for f in drawn)
    for name in drawn[0]:
        assert getattr(packets, name).tolist() == [f[name] for f in drawn]
    np.testing.assert_array_equal(packets.rssi, rssi)
    for i, value in enumerate(values):
        rows, columns = packets.csi.shape[2:]
        expected = np.zeros((30, rows, columns), np.complex64)
        expected[:, :, : value.shape[2]] = value[:, :rows]
        np.testing.assert_array_equal(packets.csi[i], expected)
        assert not value[:, rows:].any()


def test_more_records_than_one_block_of_one_shape() -> None:
    rng = np.random.default_rng(5)
    csi = rng.integers(-128, 128, (1300, 30, 3, 2, 2)).astype(np.int8)
    sel = rng.choice([0b100100, 0b011000, 0b000110], 1300)
    for antenna_sel in (0b100100, sel):
        packets, _ = decode(
            encode_bodies(csi, nic_us=0, bfee_count=np.arange(1300), rssi=(1, 2, 3), antenna_sel=antenna_sel)
        )
        np.testing.assert_array_equal(packets.csi.view(np.float32).reshape(csi.shape), csi)
        assert packets.bfee_count.tolist() == list(range(1300))


@pytest.mark.parametrize(
    ("at", "value", "reason"),
    [
        (8, 0, "shape"),
        (8, 4, "shape"),
        (9, 255, "shape"),
        (8, 2, "length"),
        (16, 0, "length"),
        (15, 0b11, "perm"),
    ],
)
def test_records_that_lie_are_counted_and_skipped(at: int, value: int, reason: str) -> None:
    liar = bytearray(one_body())
    liar[at] = value
    packets, bad = decode([one_body(bfee_count=1), bytes(liar), one_body(bfee_count=2)])
    assert bad == {reason: 1}
    assert packets.bfee_count.tolist() == [1, 2]


def test_an_antenna_named_twice_is_refused() -> None:
    body = bytearray(one_body(n_rx=2))
    body[15] = 0b0000
    assert decode([bytes(body)])[1] == {"perm": 1}


def test_short_long_and_empty_bodies() -> None:
    body = one_body()
    packets, bad = decode([body[:19], body[:-1], body + b"\0", b"", body])
    assert bad == {"short": 2, "length": 2}
    assert len(packets) == 1


def test_encode_refuses_antennas_that_are_not_there() -> None:
    with pytest.raises(ValueError, match="antenna_sel"):
        encode_bodies(
            np.zeros((1, 30, 2, 1, 2), np.int8), nic_us=0, bfee_count=0, rssi=(1, 1, 1), antenna_sel=0b0110
        )


def test_scaled_csi_by_hand() -> None:
    """3x2, all CSI 3+4j, RSSI 33 on A only, AGC 40, noise -90 dBm."""
    csi = np.zeros((1, 30, 3, 2, 2), np.int8)
    csi[..., 0], csi[..., 1] = 3, 4
    packets, _ = decode(encode_bodies(csi, nic_us=0, bfee_count=0, rssi=(33, 0, 0), agc=40, noise_dbm=-90))
    scale = 10 ** ((33 - 44 - 40) / 10) / (25 * 6)
    gain = math.sqrt(scale / (10**-9.0 + scale * 6)) * math.sqrt(2)
    np.testing.assert_allclose(scaled_csi(packets), (3 + 4j) * gain, rtol=1e-12)


def test_scaled_csi_of_nothing_is_zero() -> None:
    csi = np.zeros((2, 30, 3, 1, 2), np.int8)
    csi[1] = 5
    packets, _ = decode(encode_bodies(csi, nic_us=0, bfee_count=0, rssi=[[30, 30, 30], [0, 0, 0]]))
    assert not scaled_csi(packets).any()


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_mutated_logs_never_raise(data: st.DataObject) -> None:
    whole = b"".join(record(BFEE_CODE, one_body(n_rx=n, n_tx=4 - n, bfee_count=n)) for n in (1, 2, 3))
    mutated = bytearray(whole + record(0xC1, b"\x88\x01" + bytes(40)))
    for _ in range(data.draw(st.integers(1, 8))):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    end = data.draw(st.integers(0, len(mutated)))
    packets, stats = read_log(bytes(mutated[:end]))
    assert stats.packets == len(packets)
    assert stats.packets + sum(n for r, n in stats.bad.items() if r != "empty") == stats.records[BFEE_CODE]


@given(st.binary(max_size=600))
def test_any_bytes_are_read(blob: bytes) -> None:
    packets, stats = read_log(blob)
    assert stats.n_bytes == len(blob)
    assert len(packets) == stats.packets
