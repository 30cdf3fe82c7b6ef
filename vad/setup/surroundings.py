"""All that `vad setup` looks for, in one value."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from pathlib import Path

from vad.errors import VadError
from vad.robot.map_server import load_floor_plan
from vad.setup.lan import find_routers, find_valetudo
from vad.setup.usb import Camera, Kinect, Port, find_cameras, find_kinects, find_ports
from vad.setup.wifi import (
    NO_CARD,
    AccessPoint,
    CsiCard,
    Wireless,
    find_access_points,
    find_csi_card,
    find_leases,
    find_wireless,
)


@dataclass(frozen=True, slots=True)
class Plan:
    """A floor plan file. size_m: (2,)."""

    path: str
    size_m: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What is plugged into this hub, what is on its network."""

    cameras: tuple[Camera, ...] = ()
    kinects: tuple[Kinect, ...] = ()
    ports: tuple[Port, ...] = ()
    access_points: tuple[AccessPoint, ...] = ()
    wireless: tuple[Wireless, ...] = ()
    csi_card: CsiCard = NO_CARD
    leases: tuple[str, ...] = ()
    plans: tuple[Plan, ...] = ()
    valetudo: tuple[str, ...] = ()
    routers: tuple[str, ...] = ()


def look_around(root: Path, config_folder: Path, lan_s: float) -> Surroundings:
    """Look at everything, `lan_s` long at the network (0: not at all); blocks for about as long.

    Nothing is changed, and no serial port is opened: some devices start anew when that happens.
    """
    valetudo: list[str] = []
    routers: list[str] = []
    searches = [
        threading.Thread(target=lambda: valetudo.extend(find_valetudo(lan_s)), daemon=True),
        threading.Thread(target=lambda: routers.extend(find_routers(lan_s)), daemon=True),
    ]
    for search in searches if lan_s else ():
        search.start()
    found = Surroundings(
        cameras=tuple(find_cameras(root)),
        kinects=tuple(find_kinects(root)),
        ports=tuple(find_ports(root)),
        access_points=tuple(find_access_points(root)),
        wireless=tuple(find_wireless(root)),
        csi_card=find_csi_card(root),
        leases=tuple(find_leases(root)),
        plans=tuple(find_plans(config_folder)),
    )
    if not lan_s:
        return found
    for search in searches:
        search.join()
    return replace(found, valetudo=tuple(valetudo), routers=tuple(routers))


def find_plans(folder: Path) -> list[Plan]:
    """The map_server files in a folder that can be read; by their names in it."""
    plans = []
    for path in sorted(folder.glob("*.yaml")):
        try:
            plan = load_floor_plan(path, epoch=1)
        except VadError:
            continue  # settings, rooms: other files
        x0, y0, x1, y1 = plan.bounds_m
        plans.append(Plan(path.name, (x1 - x0, y1 - y0)))
    return plans
