"""The selectors of a query on devices: `?room=Kitchen|Hall;state=mapped;max_sigma_m=0.5;mac=..`.

zenoh hands parameters over as they are; so that a room may have any name, a value is percent-decoded here and
percent-encoded by `to_parameters`. `|` separates alternatives. Names that start with `_` are zenoh's own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import get_args
from urllib.parse import quote, unquote

from vad.bus.messages import DeviceMessage, DeviceState
from vad.errors import VadError
from vad.mac import normal_mac

STATES: tuple[str, ...] = get_args(DeviceState)
MAX_LENGTH = 4096
"""Characters of a parameter string that are looked at; a longer one is refused."""

_DEVICE_SELECTORS = ("room", "state", "max_sigma_m", "mac")


class SelectorError(VadError):
    """A selector that cannot be used."""

    code = "bad_selector"


@dataclass(frozen=True, slots=True)
class DeviceSelector:
    """Which devices are wanted; an empty part asks for all.

    max_sigma_m: only devices whose standard deviation along the worst direction is at most this.
    """

    rooms: frozenset[str] = frozenset()
    states: frozenset[str] = frozenset()
    macs: frozenset[str] = frozenset()
    max_sigma_m: float | None = None

    def wants(self, device: DeviceMessage) -> bool:
        """True where `device` is asked for."""
        if self.macs and device.mac not in self.macs:
            return False
        if self.states and device.state not in self.states:
            return False
        if self.rooms and device.room not in self.rooms:
            return False
        if self.max_sigma_m is None:
            return True
        sigma_m = device.sigma_m
        return sigma_m is not None and sigma_m <= self.max_sigma_m

    def to_parameters(self) -> str:
        """The parameter string that `parse_device_selector` reads back; empty where all are wanted."""
        parts = [
            f"{name}={'|'.join(quote(value, safe=':') for value in sorted(values))}"
            for name, values in (("room", self.rooms), ("state", self.states), ("mac", self.macs))
            if values
        ]
        if self.max_sigma_m is not None:
            parts.append(f"max_sigma_m={self.max_sigma_m!r}")
        return ";".join(parts)


def device_selector(
    *,
    rooms: Iterable[str] = (),
    states: Iterable[str] = (),
    macs: Iterable[str] = (),
    max_sigma_m: float | None = None,
) -> DeviceSelector:
    """A checked selector; SelectorError for an unknown state, a wrong MAC or a negative limit."""
    wanted = frozenset(states)
    if unknown := sorted(wanted - set(STATES)):
        raise SelectorError(
            f"{unknown[0]!r} is not a device state", where="state", remedy=f"Use one of {', '.join(STATES)}"
        )
    try:
        normal = frozenset(normal_mac(mac) for mac in macs)
    except VadError as error:
        raise SelectorError(error.what, where="mac", remedy=error.remedy) from error
    if max_sigma_m is not None and not (math.isfinite(max_sigma_m) and max_sigma_m >= 0):
        raise SelectorError(f"{max_sigma_m!r} is not a length in metres", where="max_sigma_m")
    return DeviceSelector(frozenset(rooms), wanted, normal, max_sigma_m)


def parse_device_selector(parameters: str) -> DeviceSelector:
    """The selector that a query's parameters describe; SelectorError for anything unknown or malformed."""
    given = _split(parameters, _DEVICE_SELECTORS)
    sigma_text = given.get("max_sigma_m")
    max_sigma_m = None
    if sigma_text is not None:
        try:
            max_sigma_m = float(unquote(sigma_text))
        except ValueError:
            raise SelectorError(
                f"{sigma_text!r} is not a number", where="max_sigma_m", remedy="Write metres, e.g. 0.5"
            ) from None
    return device_selector(
        rooms=_alternatives(given, "room"),
        states=_alternatives(given, "state"),
        macs=_alternatives(given, "mac"),
        max_sigma_m=max_sigma_m,
    )


def require_no_selector(parameters: str) -> None:
    """SelectorError where a key that takes no selectors is asked with one."""
    _split(parameters, ())


def _split(parameters: str, known: tuple[str, ...]) -> dict[str, str]:
    """`a=b;c=d` as a dict of still encoded values, zenoh's own names left out."""
    if len(parameters) > MAX_LENGTH:
        raise SelectorError(f"the selector is longer than {MAX_LENGTH} characters")
    found: dict[str, str] = {}
    for part in parameters.split(";"):
        name, equals, value = part.partition("=")
        if (not name and not equals) or name.startswith("_"):
            continue
        if name not in known:
            hint = f"This key knows {', '.join(known)}" if known else "This key takes no selectors"
            raise SelectorError(f"{name!r} is not a selector", remedy=hint)
        if not value:
            raise SelectorError("the selector has no value", where=name, remedy=f"Write {name}=...")
        if name in found:
            raise SelectorError("given twice", where=name, remedy="Separate alternatives with |")
        found[name] = value
    return found


def _alternatives(given: dict[str, str], name: str) -> list[str]:
    return [unquote(value) for value in given.get(name, "").split("|") if value]
