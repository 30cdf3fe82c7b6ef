"""Kinect v2: the protocol alone, and the adapter against a device behind pyusb's back-end interface."""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import Callable
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from camera_world import running
from hypothesis import given
from hypothesis import strategies as st
from usb_world import Kinect, packet
from waiting import until

from vad.camera import kinect2, kinect2_source
from vad.camera.kinect2_source import Kinect2Camera
from vad.errors import ProtocolError


def jpeg(value: int, width: int = 96, height: int = 64) -> bytes:
    image = np.full((height, width, 3), value, np.uint8)
    return bytes(cv2.imencode(".jpg", image)[1].tobytes())


# The protocol.


def test_commands_and_their_answers() -> None:
    data = kinect2.ON.to_bytes(7)
    assert struct.unpack("<9I", data) == (0x06022009, 7, 0, 0x4B, 0, 1, 0x00640064, 0, 0)
    assert struct.unpack("<6I", kinect2.SERIAL.to_bytes(1 << 32)) == (0x06022009, 0, 0x80, 0x22, 0, 1)
    kinect2.check_answer(struct.pack("<4I", 0x0A6FE000, 7, 0, 0), 7)
    for wrong in (
        b"",
        bytes(16),
        struct.pack("<4I", 0x0A6FE000, 8, 0, 0),
        struct.pack("<5I", 0x0A6FE000, 7, 0, 0, 0),
    ):
        with pytest.raises(ProtocolError):
            kinect2.check_answer(wrong, 7)
    assert kinect2.is_ready(struct.pack("<I", 3))
    assert not kinect2.is_ready(struct.pack("<I", 2))
    assert not kinect2.is_ready(b"\1")
    assert kinect2.serial_number("0123\0rest".encode("utf-16-le") + b"x") == "0123"


def feed(assembler: kinect2.PictureAssembler, data: bytes, size: int) -> list[kinect2.ColourPicture]:
    found = [assembler.receive(data[k : k + size]) for k in range(0, len(data), size)]
    return [picture for picture in found if picture is not None]


@given(
    lengths=st.lists(st.integers(0, 3000), min_size=1, max_size=5),
    size=st.integers(64, 4096),
    padding=st.integers(0, 3),
)
def test_pictures_come_whole_from_transfers_of_any_size(lengths: list[int], size: int, padding: int) -> None:
    assembler = kinect2.PictureAssembler()
    for k, length in enumerate(lengths):
        body = b"\xff\xd8" + bytes(length + padding) + b"\xff\xd9"
        (picture,) = feed(assembler, packet(k, 266 * k, body), size)
        assert (picture.sequence, picture.ticks, picture.jpeg) == (k, 266 * k, body)
        assert picture.exposure_ms == 12.5
        assert picture.gain == 1.25
    assert assembler.broken == 0


@given(st.data())
def test_damage_costs_one_picture_and_is_counted(data: st.DataObject) -> None:
    size = data.draw(st.integers(64, 1024))
    transfers = []
    for k in range(3):
        whole = packet(k, k, b"\xff\xd8" + bytes(2000) + b"\xff\xd9")
        transfers.append([whole[i : i + size] for i in range(0, len(whole), size)])
    hurt = transfers[1]
    kind = data.draw(st.sampled_from(["lost", "twice", "cut", "noise", "flipped"]))
    at = data.draw(st.integers(0, len(hurt) - 1))
    if kind == "lost":
        del hurt[at]
    elif kind == "twice":
        hurt.insert(at, hurt[at])
    elif kind == "cut":
        del hurt[at:]
    elif kind == "noise":
        hurt.insert(at, data.draw(st.binary(min_size=1, max_size=200)))
    else:
        changed = bytearray(hurt[at])
        changed[data.draw(st.integers(0, len(changed) - 1))] ^= 1 << data.draw(st.integers(0, 7))
        hurt[at] = bytes(changed)
    assembler = kinect2.PictureAssembler()
    found = [assembler.receive(t) for part in transfers for t in part]
    numbers = [p.sequence for p in found if p is not None]
    assert numbers[0] == 0
    assert numbers[-1] == 2
    if kind in ("lost", "cut") and len(hurt):
        assert numbers == [0, 2]
        assert assembler.broken >= 1


@given(st.lists(st.binary(max_size=300), max_size=20))
def test_no_bytes_break_the_assembler(transfers: list[bytes]) -> None:
    assembler = kinect2.PictureAssembler()
    for transfer in transfers:
        assembler.receive(transfer)
    assembler.receive(struct.pack("<II", 1, 0x42424242) + b"\xff\xd8")
    for transfer in transfers:
        assembler.receive(transfer)


def test_a_picture_that_never_ends_is_given_up() -> None:
    assembler = kinect2.PictureAssembler()
    assembler.receive(struct.pack("<II", 1, 0x42424242) + b"\xff\xd8" + bytes(1 << 20))
    for _ in range(5):
        assert assembler.receive(bytes(1 << 20)) is None
    assert assembler.broken >= 1


# The adapter.


async def test_opening_follows_the_protocol_and_so_does_the_end() -> None:
    device = Kinect()
    device.leave_stale_answer()
    async with running(Kinect2Camera(backend=device, fps=1000.0)) as out:
        await until(device.streaming.is_set)
        device.send(packet(1, 266, jpeg(90, 1920, 1080)))
        async with asyncio.timeout(40.0):
            frame = await out.get()
    assert frame.image.shape == (540, 960, 3)
    assert abs(int(frame.image.mean()) - 90) <= 2
    suspend = ("control", 1, 3, 0, 0x0300)
    mode_magic, mode_off = ("command", 0x4B, 1, 0x00640064, 0, 0), ("command", 0x4B, 0, 0, 0, 0)
    started = [
        ("configuration", 1), ("claim", 0), ("claim", 1), ("control", 0, 49, 40, 0), ("alternate", 1, 0),
        ("control", 0, 3, 48, 0), ("control", 0, 3, 49, 0), suspend, ("control", 1, 3, 0, 0),
        ("command", 0x02), ("command", 0x14), ("command", 0x22, 1), mode_magic, mode_off,
        *[("command", 0x16, 0x090000)] * 3, ("command", 0x09), ("alternate", 1, 1), ("command", 0x2B, 1),
    ]  # fmt: skip
    ended = [
        ("alternate", 1, 0), mode_magic, mode_off, ("command", 0x0A), ("command", 0x2B, 0),
        *[("command", 0x4B, 1, 0, 0, 0), mode_off] * 2, suspend, ("release", 0), ("release", 1), ("close",),
    ]  # fmt: skip
    log = [entry for entry in device.log if entry != ("open",)]
    assert log == started + ended


def arriving(monkeypatch: pytest.MonkeyPatch, device: Kinect, at_s: Callable[[int], float]) -> None:
    """Transfer k, from 0, comes at at_s(k), however long it really takes: stalls would be jitter, too."""
    start_ns = time.monotonic_ns()
    clock = SimpleNamespace(monotonic_ns=lambda: start_ns + round(1e9 * at_s(device.transfers - 1)))
    monkeypatch.setattr(kinect2_source, "time", clock)


async def test_stamps_keep_the_sensors_spacing(monkeypatch: pytest.MonkeyPatch) -> None:
    device = Kinect()
    # Arrival with jitter: only the sensor's own stamps are evenly spaced.
    arriving(monkeypatch, device, lambda k: 0.0332 * k + (0.01 if k % 2 else 0.0))
    camera = Kinect2Camera(backend=device, fps=1000.0)
    start_ticks = 0xFFFFFFFF - 266 * 3  # wraps underway
    async with running(camera) as out:
        await until(device.streaming.is_set)
        for k in range(8):
            device.send(packet(k, (start_ticks + 266 * k) & 0xFFFFFFFF, jpeg(20 * k)))
            await until(lambda k=k: camera.health.counters["frames"] > k)
        frames = out.drain()
    assert camera.health.detail == "Kinect v2, 48x32, stamps: sensor"
    steps_ms = np.diff([f.t_ns for f in frames]) * 1e-6
    assert len(steps_ms) == 7
    assert np.abs(steps_ms - 33.25).max() < 3.0, "the jitter alone would be 10 ms in each"
    assert [f.seq for f in frames] == list(range(8))


async def test_unplugged_and_plugged_in_again() -> None:
    device = Kinect()
    camera = Kinect2Camera(backend=device, fps=1000.0, fraction=1)
    async with running(camera) as out:
        await until(device.streaming.is_set)
        device.send(packet(1, 266, jpeg(40)))
        await until(lambda: len(out) == 1)
        device.plug(False)
        await until(lambda: camera.health.state == "degraded")
        await until(lambda: "no Kinect" in camera.health.detail)
        assert not device.aborts
        device.plug(True)
        await until(device.streaming.is_set)
        device.send(packet(1, 5, jpeg(70)))
        await until(lambda: len(out) == 2)
        assert camera.health.state == "ok"
        frames = out.drain()
        assert [int(f.image.mean()) for f in frames] == [40, 70]
        assert frames[1].t_ns > frames[0].t_ns


async def test_bad_pictures_are_counted_and_do_not_stop_the_good_ones() -> None:
    device = Kinect()
    camera = Kinect2Camera(backend=device, fps=1000.0)
    async with running(camera) as out:
        await until(device.streaming.is_set)
        device.send(packet(1, 266, jpeg(40))[:-20])
        device.send(packet(2, 532, b"\xff\xd8 this is no picture \xff\xd9"))
        device.send(packet(3, 798, jpeg(40)))
        await until(lambda: len(out) == 1)
        device.send(packet(4, 1064, jpeg(40)))
        await until(lambda: len(out) == 2)
        assert camera.health.counters["broken_pictures"] == 1
        assert camera.health.counters["bad_pictures"] == 1


async def test_decodes_no_more_pictures_than_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    device = Kinect()
    arriving(monkeypatch, device, lambda k: 0.01 * k)
    camera = Kinect2Camera(backend=device, fps=10.0)
    async with running(camera) as out:
        await until(device.streaming.is_set)
        for k in range(64):
            device.send(packet(k, 80 * k, jpeg(40)))
            if k % 8 == 7:  # of eight that come within 80 ms the first is decoded
                await until(lambda k=k: len(out) == k // 8 + 1)
        frames = out.drain()
        # What came goes out with the next that is decoded.
        assert 57 <= camera.health.counters["received"] <= 64
        assert np.diff([frame.t_ns for frame in frames]).min() >= 75_000_000


async def test_reasons_that_help() -> None:
    device = Kinect()
    device.forbidden = True
    camera = Kinect2Camera(backend=device)
    async with running(camera):
        await until(lambda: camera.health.state == "degraded")
        assert "may not be opened" in camera.health.detail
        assert "udev" in camera.health.detail
    other = Kinect2Camera(backend=Kinect(serial="1"), serial="2")
    async with running(other):
        await until(lambda: other.health.state == "degraded")
        assert "no Kinect v2 with the serial number 2" in other.health.detail


async def test_one_of_several_is_chosen_by_its_serial_number() -> None:
    device = Kinect(serial="012345678947", product=0x02D8)
    async with running(Kinect2Camera(backend=device, serial="012345678947")):
        await until(device.streaming.is_set)


def test_fractions() -> None:
    with pytest.raises(ValueError, match="fraction"):
        Kinect2Camera(fraction=3)
