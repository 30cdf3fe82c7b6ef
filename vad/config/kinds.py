"""Kinds of values that several settings share."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

Positive = Annotated[float, Meta(gt=0)]
Id = Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{1,64}$")]
MacText = Annotated[str, Meta(pattern="^[0-9A-Fa-f]{2}(:[0-9A-Fa-f]{2}){5}$")]
AbsolutePath = Annotated[str, Meta(pattern="^/")]
Ipv4Text = Annotated[str, Meta(pattern=r"^((25[0-5]|2[0-4]\d|1?\d?\d)(\.(?!$)|$)){4}$")]
