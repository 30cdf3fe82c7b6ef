"""What an agent and its hub say to each other, bytes <-> values; no I/O.

The agent's stream (`csi`) is frames in sequence, MessagePack arrays; the hub's commands (`cmd`) and its time
(`clock`) are JSON.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from vad.capture.handshake import Abort, Answer, Going, Message, Start, Stop
from vad.errors import ProtocolError, VadError
from vad.limits import UNREADABLE
from vad.mac import mac_from_text

VERSION = 1
FRAME_ENCODING = "application/x-msgpack;vad.csi.v1"
COMMAND_ENCODING = "application/json;vad.cmd.v1"
TIME_ENCODING = "application/json;vad.clock.v1"

MAX_RAW_BYTES = 48 << 10
"""CSI bytes of a frame; zenoh sends up to 64 KiB in one piece, a fragment lost is a message lost."""
MAX_FRAME_BYTES = 2 * MAX_RAW_BYTES
MAX_COMMAND_BYTES = 4096

Natural = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]
Signed = Annotated[int, Meta(ge=-(1 << 62), le=1 << 62)]
Text = Annotated[str, Meta(max_length=500)]


class Frame(msgspec.Struct, frozen=True, array_like=True, kw_only=True):
    """One piece of an agent's stream.

    Attributes:
        version: of this layout; later ones only append.
        stream: this run of the agent, a random number.
        seq: the frame's place in the stream, from 0.
        oldest: the first frame that can still be sent (again); those before it arrived or are lost.
        before: packets in all frames before this one: what is missing is counted exactly.
        given_up: how many of them were dropped without having been confirmed.
        offset_ns: to be added to the agent's clock for the hub's; error_ns: how wrong that can be.
        mac: of the agent's card, lower case.
        carrier_hz, bandwidth_mhz: of the channel.
        arrival_ns: int64 little-endian, one for each 0xBB record, the agent's clock.
        raw: 0xBB records in the format of log_to_file, nothing else.
        answers: to the hub's commands, after the packets of this frame.
        trouble: why the card gives nothing; empty where it is well.
    """

    version: int
    stream: Natural
    seq: Natural
    oldest: Natural
    before: Natural
    given_up: Natural
    offset_ns: Signed
    error_ns: Natural
    mac: str
    carrier_hz: Annotated[float, Meta(gt=0)]
    bandwidth_mhz: int
    arrival_ns: bytes = b""
    raw: bytes = b""
    answers: tuple[Answer, ...] = ()
    trouble: Text = ""

    @property
    def packets(self) -> int:
        """How many packets it says it holds."""
        return len(self.arrival_ns) // 8

    def arrivals(self) -> NDArray[np.int64]:
        """When the packets arrived on the hub's clock (N,)."""
        return np.frombuffer(self.arrival_ns, "<i8").astype(np.int64) + self.offset_ns


class Ack(msgspec.Struct, frozen=True, tag=True):
    """Hub -> agent: every frame of the stream before next_seq has arrived, or will not be waited for."""

    stream: Natural
    next_seq: Natural


class HubTime(msgspec.Struct, frozen=True):
    """The hub's answer on `clock`. boot: names the timeline, which ends when the machine does."""

    monotonic_ns: Natural
    boot: Text


Command = Start | Going | Stop | Abort | Ack

_frames = msgspec.msgpack.Decoder(Frame)
_commands: msgspec.json.Decoder[Command] = msgspec.json.Decoder(Command)


def encode_frame(frame: Frame) -> bytes:
    """MessagePack."""
    return msgspec.msgpack.encode(frame)


def decode_frame(payload: bytes) -> Frame:
    """The inverse; ProtocolError for what is no frame of this version or contradicts itself."""
    if len(payload) > MAX_FRAME_BYTES:
        raise ProtocolError("a frame is too long")
    try:
        frame = _frames.decode(payload)
        mac_from_text(frame.mac)
    except (*UNREADABLE, VadError) as error:
        raise ProtocolError(f"not a frame ({error})") from error
    if frame.version != VERSION:
        raise ProtocolError(f"a frame of version {frame.version}, this hub reads {VERSION}")
    if len(frame.arrival_ns) % 8 or frame.oldest > frame.seq or frame.mac != frame.mac.lower():
        raise ProtocolError("a frame contradicts itself")
    return frame


def encode_command(command: Command | Message) -> bytes:
    """JSON."""
    return msgspec.json.encode(command)


def decode_command(payload: bytes) -> Command:
    """The inverse; ProtocolError for anything else."""
    if len(payload) > MAX_COMMAND_BYTES:
        raise ProtocolError("a command is too long")
    try:
        return _commands.decode(payload)
    except UNREADABLE as error:
        raise ProtocolError(f"not a command ({error})") from error


def encode_time(time: HubTime) -> bytes:
    """JSON."""
    return msgspec.json.encode(time)


def decode_time(payload: bytes) -> HubTime:
    """The inverse; ProtocolError for anything else."""
    try:
        return msgspec.json.decode(payload, type=HubTime)
    except UNREADABLE as error:
        raise ProtocolError(f"not a time ({error})") from error
