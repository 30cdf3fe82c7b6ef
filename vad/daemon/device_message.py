"""What is published of a device: where it is (its record) and who it is (the table)."""

from __future__ import annotations

from typing import Any

from vad.bus import messages as m
from vad.devices.device import Device
from vad.store.records import DeviceRecord


def device_message(
    record: DeviceRecord, device: Device | None, *, in_network: bool, source: m.Source
) -> m.DeviceMessage:
    """The message of a device; without `device` only its place is told."""
    known: dict[str, Any] = {}
    place = record.estimate
    if place is not None:
        known |= {
            "x_m": place.x_m,
            "y_m": place.y_m,
            "covariance_m2": place.covariance_m2,
            "radius90_m": place.radius90_m,
            "region90": place.region90,
            "room": place.room,
            "method": place.method,
            "height90_m": place.height90_m,
        }
    if device is not None:
        known |= {
            "macs": device.macs,
            "random_mac": device.random_mac,
            "ip": device.ip,
            "host_name": device.host_name,
            "vendor": device.vendor,
            "agent": device.agent,
            "in_network": in_network,
            "first_seen": device.first_seen,
            "last_seen": device.last_seen,
            "moved": device.moved,
        }
    return m.DeviceMessage(
        source=source,
        mac=record.mac,
        name=record.name,
        state=record.state,  # type: ignore[arg-type]  # the store keeps text
        reason=record.reason,
        epoch=record.epoch,
        walks=record.walks,
        evidence=record.evidence,
        updated_at=record.updated_at,
        **known,
    )
