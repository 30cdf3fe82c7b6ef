"""Whether a Neato answers on a serial port: it is asked for its version, which changes nothing on it."""

from __future__ import annotations

import time
from dataclasses import dataclass

import serial

from vad.robot.neato import NeatoReply, ReplyParser
from vad.robot.neato_source import BAUD

COMMAND = b"\nGetVersion\n"
"""The line end in front ends what somebody else left half said."""
ANSWER_S = 2.0
_SLICE_S = 0.05


@dataclass(frozen=True, slots=True)
class NeatoVersion:
    """What the robot calls itself; empty where it does not say."""

    model: str
    software: str


def version_of(reply: NeatoReply) -> NeatoVersion | None:
    """The version in a reply to GetVersion; None where it is another reply, or not a Neato's."""
    rows = [[word.strip() for word in line.split(",")] for line in reply.lines]
    if not any(row[:1] == ["Component"] for row in rows):
        return None
    values = {row[0]: row[1:] for row in rows if len(row) > 1}
    model = next((word for word in values.get("ModelID", []) if word.strip("-0123456789.")), "")
    software = ".".join(word for word in values.get("Software", [])[:3] if word.isdecimal())
    return NeatoVersion(model, software)


def ask_version(port: str, seconds: float = ANSWER_S) -> NeatoVersion | str:
    """What a Neato on this port (device or URL) answers; a sentence where none does."""
    parser = ReplyParser()
    try:
        with serial.serial_for_url(port, baudrate=BAUD, timeout=_SLICE_S) as line:
            line.reset_input_buffer()
            line.write(COMMAND)
            until_s = time.monotonic() + seconds
            while time.monotonic() < until_s:
                for reply in parser.feed(line.read(4096)):
                    version = version_of(reply)
                    if version is not None:
                        return version
    except (OSError, ValueError) as error:  # pyserial's SerialException is an OSError, a bad URL a ValueError
        return f"cannot be opened: {error}"
    return "no Neato answers"
