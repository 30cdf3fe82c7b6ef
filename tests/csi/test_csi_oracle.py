"""Every Intel log beside the checkout, equal to csiread."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vad.csi.bfee import permutation, scaled_csi
from vad.csi.logfile import read_log

csiread = pytest.importorskip("csiread", reason="csiread has no wheel for this machine")


def logs(shared_data: Path, where: str) -> list[Path]:
    found = sorted((shared_data / "csi" / where).rglob("*.dat"))
    assert found
    return found


@pytest.mark.parametrize("where", ["parser/intel5300", "witraj"])
def test_equal_to_csiread(shared_data: Path, where: str) -> None:
    for path in logs(shared_data, where):
        packets, stats = read_log(path.read_bytes())
        oracle = csiread.Intel(str(path), nrxnum=3, ntxnum=3, if_report=False)
        oracle.read()
        rows, columns = packets.csi.shape[2:]
        assert len(packets) == oracle.count == stats.packets, path
        assert not stats.bad
        np.testing.assert_array_equal(packets.csi, oracle.csi[:, :, :rows, :columns], err_msg=str(path))
        assert not oracle.csi[:, :, rows:].any()
        assert not oracle.csi[:, :, :, columns:].any()
        rssi = np.stack([oracle.rssi_a, oracle.rssi_b, oracle.rssi_c], axis=1)
        for ours, theirs in (
            (packets.rssi, rssi),
            (packets.agc, oracle.agc),
            (packets.noise_dbm, oracle.noise),
            (packets.nic_us, oracle.timestamp_low),
            (packets.bfee_count, oracle.bfee_count),
            (packets.n_rx, oracle.Nrx),
            (packets.n_tx, oracle.Ntx),
            (packets.rate, oracle.rate),
        ):
            np.testing.assert_array_equal(ours, theirs, err_msg=str(path))
        for n_rx, antenna_sel, perm in {
            (int(n), int(sel), tuple(perm.tolist()))
            for n, sel, perm in zip(packets.n_rx, packets.antenna_sel, oracle.perm, strict=True)
        }:
            assert permutation(antenna_sel, n_rx) == perm[:n_rx]
        theirs = oracle.get_scaled_csi()[:, :, :rows, :columns]
        np.testing.assert_allclose(scaled_csi(packets), theirs, rtol=1e-9, atol=0, err_msg=str(path))


def test_truncated_end_of_a_real_recording(shared_data: Path) -> None:
    path = shared_data / "csi" / "witraj" / "circle_ccw_corridor_t1_rx1" / "csi.dat"
    packets, stats = read_log(path.read_bytes())
    assert len(packets) == 5886
    assert stats.truncated_bytes == 174
    assert stats.n_bytes == path.stat().st_size


def test_injection_log_is_attributed_to_the_constant_address(shared_data: Path) -> None:
    from vad.csi.attribution import Attribution
    from vad.csi.dot11 import INJECTED_MAC

    path = shared_data / "csi" / "parser" / "intel5300" / "sample_0x5_64_3000.dat"
    packets, stats = read_log(path.read_bytes(), Attribution())
    assert stats.records == {0xC1: 2998, 0xBB: 2998}
    # Its addr3 is the broadcast address, which names nobody.
    assert set(packets.mac.tolist()) == {INJECTED_MAC}
