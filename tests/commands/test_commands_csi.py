"""`vad csi`: what people and scripts see, and exit codes."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner
from waiting import wait_until

from vad.commands.csi import csi_app
from vad.csi.bfee import encode_bodies, scaled_csi
from vad.csi.dot11 import data_frame
from vad.csi.logfile import read_log, record
from vad.mac import mac_from_text
from vad.sim import driver

PHONE, AP = "02:00:00:00:00:01", "02:00:00:00:00:ff"


def log_of(n: int, step_us: int = 2000, first: int = 0, lost: int = 0) -> bytes:
    count = np.arange(first, first + n)
    csi = np.random.default_rng(first).integers(-60, 60, (n, 30, 3, 2, 2)).astype(np.int8)
    bodies = encode_bodies(
        csi,
        nic_us=count * step_us,
        bfee_count=count + lost * (count >= first + n // 2),
        rssi=(30, 31, 32),
        noise_dbm=-90,
        agc=40,
    )
    frame = record(0xC1, data_frame(mac_from_text(PHONE), mac_from_text(AP), mac_from_text(AP), 0))
    return b"".join(frame + record(0xBB, body) for body in bodies)


def run(*arguments: str, code: int = 0) -> tuple[str, str]:
    result = CliRunner().invoke(csi_app, list(arguments))
    assert result.exit_code == code, (result.output, result.exception)
    return result.stdout, result.stderr


def test_info_tells_what_is_in_a_log(tmp_path: Path) -> None:
    path = tmp_path / "csi.dat"
    path.write_bytes(log_of(501, lost=3) + log_of(1)[:100])
    out, _ = run("info", str(path))
    for said in (
        r"packets +501: 501 3x2 20 MHz",
        r"time +1\.000 s, 500\.0 packets/s",
        r"intervals +2\.000 ms \(2\.000 to 2\.000\)",
        r"gaps +1 in bfee_count, 3 packets missing",
        rf"senders +{PHONE}: 500",
        r"unknown: 1",
        r"unknown because +1 after_loss",
        r"RSSI B +31 dB",
        r"noise +-90 dBm",
        r"AGC +40 dB",
        r"truncated +\d+ bytes",
    ):
        assert re.search(said, out), (said, out)


def test_info_as_json(tmp_path: Path) -> None:
    path = tmp_path / "csi.dat"
    path.write_bytes(log_of(11) + record(0xBB, bytes(40)))
    told = json.loads(run("info", str(path), "--json")[0])
    assert told["packets"] == 11
    assert told["shapes"] == {"3x2 20 MHz": 11}
    assert told["senders"] == [{"mac": PHONE, "packets": 11, "rate_per_s": pytest.approx(500)}]
    assert told["bad"] == {"shape": 1}
    assert told["records"] == {"0xbb": 12, "0xc1": 12 - 1}
    assert told["span_s"] == pytest.approx(0.02)


def test_info_of_a_log_without_time(tmp_path: Path) -> None:
    path = tmp_path / "csi.dat"
    path.write_bytes(log_of(20, step_us=0))
    assert "never advances" in run("info", str(path))[0]
    told = json.loads(run("info", str(path), "--json")[0])
    assert told["counter_still"]
    assert told["rate_per_s"] is None


def test_info_of_nothing(tmp_path: Path) -> None:
    path = tmp_path / "empty.dat"
    path.write_bytes(b"\0")
    assert "truncated" in run("info", str(path), code=1)[0]
    assert "cannot be read" in run("info", str(tmp_path / "absent"), code=2)[1]


def test_convert(tmp_path: Path) -> None:
    path, target = tmp_path / "csi.dat", tmp_path / "csi.npz"
    path.write_bytes(log_of(50))
    packets, _ = read_log(path.read_bytes())
    out, _ = run("convert", str(path), str(target), "--scaled")
    assert "50 packets, csi 50x30x3x2" in out
    with np.load(target) as arrays:
        np.testing.assert_array_equal(arrays["csi"], packets.csi)
        np.testing.assert_array_equal(arrays["rssi"], packets.rssi)
        np.testing.assert_allclose(arrays["time_s"], np.arange(50) * 0.002)
        np.testing.assert_array_equal(arrays["csi_scaled"], scaled_csi(packets))
        assert set(arrays["mac"].tolist()) == {mac_from_text(PHONE)}


def test_convert_refuses(tmp_path: Path) -> None:
    path = tmp_path / "csi.dat"
    path.write_bytes(b"")
    assert ".npz" in run("convert", str(path), str(tmp_path / "csi.mat"), code=2)[1]
    assert "no packet" in run("convert", str(path), str(tmp_path / "csi.npz"), code=1)[1]
    path.write_bytes(log_of(2))
    assert "cannot be written" in run("convert", str(path), str(tmp_path / "absent" / "a.npz"), code=2)[1]


@contextmanager
def vad(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "vad", "csi", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.kill()


def test_record_until_ctrl_c(tmp_path: Path) -> None:
    fifo, target = tmp_path / "fifo", tmp_path / "csi.dat"
    os.mkfifo(fifo)
    log = log_of(300)
    recording = vad("record", str(target), "--fifo", str(fifo))
    # Opening the FIFO waits until the recorder reads.
    with recording as recorder, fifo.open("wb", buffering=0) as writer:
        writer.write(log)
        wait_until(lambda: target.stat().st_size >= len(log) or recorder.poll() is not None)
        writer.write(log_of(10, first=300))
        recorder.send_signal(signal.SIGINT)
        out, err = recorder.communicate(timeout=40)
    assert recorder.returncode == 0, err
    assert err == ""
    assert re.search(r"csi\.dat: 3[01]\d packets, 0\.\d MB", out)
    assert target.read_bytes()[: len(log)] == log


def test_record_without_packets_and_over_a_file(tmp_path: Path) -> None:
    target = tmp_path / "csi.dat"
    run("record", str(target), "--fifo", str(tmp_path / "absent"), "--seconds", "0.1", code=1)
    assert target.read_bytes() == b""
    assert "--force" in run("record", str(target), "--seconds", "0.1", code=2)[1]
    missing = str(tmp_path / "no" / "csi.dat")
    assert "cannot be written" in run("record", missing, "--seconds", "0.1", code=2)[1]


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a machine that is never busy: what comes late is sent all the same."""
    monkeypatch.setattr(driver, "CATCH_UP_S", 60.0)


@pytest.mark.usefixtures("patient")
def test_a_log_is_played_into_a_recording(tmp_path: Path) -> None:
    fifo, source, target = tmp_path / "fifo", tmp_path / "csi.dat", tmp_path / "again.dat"
    log = log_of(500)
    source.write_bytes(log)
    os.mkfifo(fifo)
    with vad("record", str(target), "--fifo", str(fifo)) as recorder:
        os.close(os.open(fifo, os.O_WRONLY))  # returns when the recorder reads
        out, _ = run("play", str(source), "--fifo", str(fifo), "--speed", "4")
        assert "played 1000 records" in out.replace(",", "")
        wait_until(lambda: target.stat().st_size >= len(log) or recorder.poll() is not None)
        recorder.send_signal(signal.SIGTERM)
        recorder.communicate(timeout=40)
    assert target.read_bytes() == log


@pytest.mark.usefixtures("patient")
def test_play_without_a_reader_says_so(tmp_path: Path) -> None:
    source = tmp_path / "csi.dat"
    source.write_bytes(log_of(10))
    out, _ = run("play", str(source), "--fifo", str(tmp_path / "fifo"), code=1)
    assert "not sent" in out
    assert "no reader" in out
