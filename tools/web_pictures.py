#!/usr/bin/env python3
"""The README's pictures of the page: a simulated home after two days, measured by the daemon's own estimator.

tools/web_pictures.py [FOLDER [HOME]] writes web_desktop.png and web_phone.png to FOLDER, else tools/pictures;
HOME keeps the simulated home's store for the next time. The two days take some minutes. Needs Chromium.
"""

from __future__ import annotations

import asyncio
import sys
import tempfile
from pathlib import Path

from bench_web_browser import Browser
from bench_week_sim import Simulation, settings_for

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "web"))

from waiting import until
from web_world import status

from vad.bus import messages as m
from vad.bus.grid import grid_to_png
from vad.bus.node import Bus
from vad.bus.plan import map_message
from vad.bus.session import BusSettings
from vad.daemon.registry import Registry
from vad.daemon.wishes import Wishes
from vad.mapping.camera_floor import floor_in_picture
from vad.sim.calibration import true_calibration
from vad.sim.household import DAY_S, Household, make_household
from vad.store.worker import StoreWorker
from vad.web.access import Access
from vad.web.home import HomeFeed, Robot
from vad.web.server import PageServer

DAYS = 2
SCREENS = {"web_desktop": (1280, 800, False), "web_phone": (390, 844, True)}


def camera(house: Household) -> m.CameraMessage:
    """The home's camera, as after a drive of the robot."""
    known = true_calibration(house.home)
    assert known.position_m is not None
    assert known.camera_from_map is not None
    turn = known.camera_from_map.inverse().rotation.tolist()
    x_m, y_m, z_m = known.position_m.tolist()
    return m.CameraMessage(
        source="simulated",
        id="main",
        state="valid",
        percent=100,
        position_m=(x_m, y_m, z_m),
        map_from_camera=(tuple(turn[0]), tuple(turn[1]), tuple(turn[2])),
        deviation_m=known.deviation_m,
        epoch=house.plan.epoch,
        floor_m=floor_in_picture(known, house.plan.bounds_m),
    )


async def show(house: Household, folder: Path, pictures: Path) -> None:
    """Serve what the days left in the store, and photograph it."""
    bus = Bus(BusSettings(), source="simulated")
    async with StoreWorker(folder / "vad.sqlite") as store:
        registry = Registry(settings_for(folder, 200), house.plan, bus, store)
        await registry.load()
        for device in house.devices:
            await registry.joined(device.mac, device.name)
        bus.publish_map(map_message(house.plan, "simulated"))
        bus.publish_grid(grid_to_png(house.plan.cells))
        bus.publish_camera(camera(house))
        parts = (m.Part(part="robot", state="ok"),)
        bus.publish_status(status("waiting for somebody to walk through the picture", parts=parts))
        x_m, y_m, yaw_rad = map(float, house.home.robot_at(house.home.drive_start_s + 20))
        robot = Robot(status="localised", x_m=x_m, y_m=y_m, yaw_rad=yaw_rad, epoch=house.plan.epoch)
        wishes = Wishes(bus.keys, registry, "simulated")
        page = PageServer(Access(0), "home", HomeFeed(bus.keys, bus.listen), wishes.answer, lambda: robot)
        running = asyncio.create_task(page.run())
        try:
            await until(lambda: page.health.state == "ok", "the page listens")
            async with Browser() as browser:
                for name, (width, height, phone) in SCREENS.items():
                    shown = await browser.page(width, height, dark=phone, phone=phone)
                    await shown.go(f"http://127.0.0.1:{page.port}/")
                    await shown.until(f"document.querySelectorAll('.row').length >= {len(house.devices)}")
                    await shown.until("document.querySelector('.robot:not([visibility])')")
                    if phone:
                        await shown.click(f".row[data-mac='{house.devices[5].mac}']")
                        await shown.value("document.activeElement.blur(); scrollTo(0, 0)")
                        await shown.until("document.querySelector('.heat image')")
                    await asyncio.sleep(1)  # pictures come, labels find their places
                    await shown.picture(pictures / f"{name}.png")
        finally:
            running.cancel()
            await asyncio.wait({running})


def main() -> None:
    """Simulate, then photograph."""
    pictures = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "pictures"
    house = make_household(1, days=DAYS, moved_after_s=1.2 * DAY_S, joined_within_s=0.5 * DAY_S)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(sys.argv[2] if len(sys.argv) > 2 else name)
        if not (folder / "vad.sqlite").exists():
            asyncio.run(Simulation(house, DAYS, folder, settings_for(folder, 200)).run())
        asyncio.run(show(house, folder, pictures))


if __name__ == "__main__":
    main()
