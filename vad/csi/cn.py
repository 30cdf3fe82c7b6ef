"""Messages of the kernel connector as the 5300's driver sends them (formats.md 2); no I/O.

Byte order is the host's: the messages never leave it.
"""

from __future__ import annotations

import struct

from vad.errors import ProtocolError

NETLINK_CONNECTOR = 11
SOL_NETLINK = 270
NETLINK_ADD_MEMBERSHIP = 1
IWLAGN_GROUP = 26
IWLAGN_VALUE = 1
HEADER_BYTES = 36

_NLMSG_DONE = 3
# nlmsghdr {len, type, flags, seq, pid}, cn_msg {idx, val, seq, ack, len, flags}
_HEADER = struct.Struct("=IHHIIIIIIHH")
# idx, val and len of cn_msg; seq and ack between them say nothing
_CN_MSG = struct.Struct("=II8xH")
_CN_MSG_AT = 16


def build_message(code: int, body: bytes, *, group: int = IWLAGN_GROUP, value: int = IWLAGN_VALUE) -> bytes:
    """The whole netlink message of one log record."""
    size = HEADER_BYTES + 1 + len(body)
    head = _HEADER.pack(size, _NLMSG_DONE, 0, 0, 0, group, value, 0, 0, len(body) + 1, 0)
    return head + bytes((code,)) + body


def payload_bytes(message: bytearray | memoryview | bytes, received: int, group: int, value: int) -> int:
    """Length of the record (code and body, from HEADER_BYTES on) in a message of `received` bytes.

    Raises ProtocolError, whose `what` is one of a few fixed texts, for a message which is not of this
    group and value or whose length does not fit.
    """
    if received <= HEADER_BYTES:
        raise ProtocolError("short message")
    size: int
    idx, val, size = _CN_MSG.unpack_from(message, _CN_MSG_AT)
    if idx != group or val != value:
        raise ProtocolError("foreign message")
    if not 1 <= size <= received - HEADER_BYTES:
        raise ProtocolError("message length that lies")
    return size
