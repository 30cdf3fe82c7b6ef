"""What was found, as a table for people."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from vad.camera.v4l2_formats import best_format
from vad.report.words import printable
from vad.setup.surroundings import Surroundings
from vad.setup.usb import Camera


def found_table(found: Surroundings) -> Table:
    """One row for each thing; what is not there is said."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    rows: list[tuple[str, str]] = []
    rows += [
        ("camera", f"{camera.name} ({camera.device}): {camera_words(camera)}") for camera in found.cameras
    ]
    for kinect in found.kinects:
        slow = "; not on a USB 3 port: it will not work there" if kinect.slow else ""
        rows.append(("camera", f"Kinect v2 {kinect.serial}{slow}".rstrip()))
    if not (found.cameras or found.kinects):
        rows.append(("camera", "none on USB"))
    rows += [("serial port", port.path) for port in found.ports] or [("serial port", "none")]
    rows += [("robot", f"Valetudo at {address}") for address in found.valetudo]
    rows += [("robot", f"zenoh router at {endpoint}") for endpoint in found.routers]
    for point in found.access_points:
        channel = (
            f"{point.frequency_mhz} MHz, {point.bandwidth_mhz} MHz wide"
            if point.frequency_mhz
            else "no channel"
        )
        told = point.trouble or f"{point.ssid or 'no name'}, {channel}, {point.stations} stations"
        rows.append(("access point", f"{point.socket}: {told}"))
    for wireless in found.wireless:
        what = ["Intel 5300"] if wireless.csi_card else []
        what += [wireless.driver] if wireless.driver else []
        what += ["access point"] if wireless.access_point else []
        rows.append(("wireless", f"{wireless.name}: {', '.join(what) or 'idle'}"))
    card = found.csi_card
    rows.append(
        (
            "CSI card",
            "none" if not card.present else "Intel 5300" + ("" if card.csi_driver else ", no CSI driver"),
        )
    )
    rows += [("leases", path) for path in found.leases]
    rows += [
        ("floor plan", f"{plan.path}: {plan.size_m[0]:.1f} m x {plan.size_m[1]:.1f} m")
        for plan in found.plans
    ]
    for name, text in rows:
        table.add_row(Text(name, style="bold"), Text(printable(text)))
    return table


def camera_words(camera: Camera) -> str:
    """What a camera offers, shortly."""
    if camera.trouble:
        return camera.trouble
    best = best_format(camera.formats)
    if best is None:
        kinds = sorted({found.fourcc for found in camera.formats})
        return f"neither MJPG nor YUYV, but {', '.join(kinds) or 'nothing'}"
    rate = f" at {max(best.fps):g}/s" if best.fps else ""
    return f"{best.fourcc} {best.width_px}x{best.height_px}{rate}, {len(camera.formats)} formats"
