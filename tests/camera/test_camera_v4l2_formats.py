"""What a camera offers: the ioctls of linux/videodev2.h, against a camera written byte by byte here."""

from __future__ import annotations

import errno
import struct
from pathlib import Path

import pytest

from vad.camera.v4l2_formats import Format, best_format, describe
from vad.errors import SourceError


class FakeCamera:
    """A UVC camera's answers, with the offsets of the kernel's header and not of our structs."""

    def __init__(self, *, own_capabilities: int = 0x04200001, stepwise: bool = False) -> None:
        self.own = own_capabilities
        self.stepwise = stepwise
        self.asked: list[int] = []

    def __call__(self, _fd: int, request: int, data: bytearray) -> int:
        self.asked.append(request)
        size, number = request >> 16 & 0x3FFF, request & 0xFF
        assert request >> 8 & 0xFF == ord("V")
        assert len(data) == size, "the kernel copies as many bytes as the request says"
        index = int.from_bytes(data[0:4], "little")
        if number == 0:
            data[16:48] = b"Webcam: K\xc3\xbcche".ljust(32, b"\0")
            data[84:88] = (0x84A00001).to_bytes(4, "little")
            data[88:92] = self.own.to_bytes(4, "little")
        elif number == 2:
            assert data[4:8] == b"\1\0\0\0"
            if index > 1:
                raise OSError(errno.EINVAL, "no more")
            data[44:48] = (b"MJPG", b"YUYV")[index]
        elif number == 74:
            sizes = ((640, 480), (1280, 720)) if bytes(data[4:8]) == b"MJPG" else ((640, 480),)
            if index >= (1 if self.stepwise else len(sizes)):
                raise OSError(errno.EINVAL, "no more")
            if self.stepwise:
                data[8:36] = struct.pack("<7I", 3, 160, 1280, 16, 120, 720, 8)
            else:
                data[8:20] = struct.pack("<3I", 1, *sizes[index])
        else:
            assert number == 75
            width, height = struct.unpack("<2I", data[8:16])
            assert width >= height > 0
            intervals = ((1, 30), (1, 15)) if width == 640 else ((1, 10),)
            if index >= len(intervals):
                raise OSError(errno.EINVAL, "no more")
            data[16:28] = struct.pack("<3I", 1, *intervals[index])
        return 0


@pytest.fixture
def node(tmp_path: Path) -> Path:
    path = tmp_path / "video0"
    path.touch()
    return path


def test_every_format_size_and_rate_is_found(node: Path) -> None:
    found = describe(node, FakeCamera())
    assert found is not None
    assert found.card == "Webcam: Küche"
    assert found.formats == (
        Format("MJPG", 640, 480, (30.0, 15.0)),
        Format("MJPG", 1280, 720, (10.0,)),
        Format("YUYV", 640, 480, (30.0, 15.0)),
    )


def test_of_a_range_of_sizes_the_common_ones_that_fit_are_told(node: Path) -> None:
    found = describe(node, FakeCamera(stepwise=True))
    assert found is not None
    sizes = [(one.width_px, one.height_px) for one in found.formats if one.fourcc == "MJPG"]
    assert sizes == [(320, 240), (640, 480), (800, 600), (1280, 720)]


def test_a_node_for_metadata_is_no_camera(node: Path) -> None:
    assert describe(node, FakeCamera(own_capabilities=0x04A00000)) is None


def test_what_cannot_be_opened_or_does_not_answer_says_so(node: Path, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="cannot be opened"):
        describe(tmp_path / "video9", FakeCamera())
    with pytest.raises(SourceError, match="does not answer"):
        describe(node)  # a plain file knows no such ioctl


def test_the_best_format_is_fast_enough_then_near_then_mjpg() -> None:
    fast_yuyv, slow_mjpg = Format("YUYV", 640, 480, (30.0,)), Format("MJPG", 640, 480, (5.0,))
    assert best_format((slow_mjpg, fast_yuyv)) == fast_yuyv
    both = (Format("YUYV", 640, 480, (30.0,)), Format("MJPG", 640, 480, (30.0,)))
    assert best_format(both) == both[1]
    large = Format("MJPG", 1920, 1080, (30.0,))
    assert best_format((large, Format("YUYV", 800, 600, (20.0,)))) == Format("YUYV", 800, 600, (20.0,))
    assert best_format((Format("H264", 640, 480, (30.0,)),)) is None
    assert best_format((Format("MJPG", 640, 480, ()),)) is not None
