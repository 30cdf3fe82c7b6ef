"""Kinds of values that several settings share."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

Positive = Annotated[float, Meta(gt=0)]
SerialPort = Annotated[str, Meta(examples=["/dev/serial/by-id/usb-NAME-if00"])]
Interface = Annotated[str, Meta(examples=["wlan0"])]
Id = Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{1,64}$")]
MacText = Annotated[str, Meta(pattern="^[0-9A-Fa-f]{2}(:[0-9A-Fa-f]{2}){5}$", examples=["aa:bb:cc:dd:ee:ff"])]
AbsolutePath = Annotated[str, Meta(pattern="^/")]
Ipv4Text = Annotated[
    str, Meta(pattern=r"^((25[0-5]|2[0-4]\d|1?\d?\d)(\.(?!$)|$)){4}$", examples=["192.168.1.20"])
]
