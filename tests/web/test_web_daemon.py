"""The page of a daemon in a simulated home: what there is, a walk while it is measured, then the place."""

from __future__ import annotations

import asyncio
import signal
import socket
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from waiting import free_port, running, until

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "daemon"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

from bench_web_browser import Browser, chromium
from daemon_world import Vad, change_settings, store_calibration
from test_daemon_parts import PLAYED_S, heard, hub

from vad.bus.plan import map_message
from vad.csi.packets import CsiBatch
from vad.daemon.wishes import Wishes
from vad.sim.calibration import true_calibration
from vad.sim.home import floor_plan
from vad.sim.radio import Radio
from vad.sim.render import Renderer
from vad.sim.scenario import make_home
from vad.vision.people import PoseNetwork
from vad.web.access import Access, write_token
from vad.web.home import HomeFeed
from vad.web.server import PageServer

HOME = make_home(1)
WALK = HOME.walks[0]
ROW = f".row[data-mac='{HOME.device_mac}']"
PATIENCE_S = 180.0
WALKED_S = 2.0 * PLAYED_S
"""Beside a browser that draws the page."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(chromium() is None, reason="no chromium: apt-get install chromium"),
]


async def test_the_page_of_a_daemon_shows_its_home_until_it_ends(tmp_path: Path) -> None:
    folder, port, web = tmp_path / "home", free_port(), free_port()
    settings = folder / "vad.yaml"
    after_all_walks = str(HOME.walks[-1].end_s + 1.0)
    arguments = ["--seed", "1", "--bus-port", str(port), "--fifo", "--start-at", after_all_walks]
    with Vad("sim", "--dir", folder, *arguments, log=tmp_path / "sim.log") as sim:
        await until(settings.exists, "the home's settings", PATIENCE_S)
        store_calibration(folder / "state", HOME)
        write_token(folder / "web.token")
        change_settings(settings, web={"port": web, "token_file": "web.token"})
        with Vad("run", "--config", settings, log=tmp_path / "daemon.log") as vad:
            async with Browser() as browser:
                await until(lambda: answers(web), "the page", PATIENCE_S)
                page = await browser.page()
                await page.go(f"http://127.0.0.1:{web}/")
                await page.until("document.querySelector('#source').textContent === 'simulated'", PATIENCE_S)
                await page.until("document.querySelector('.covered polygon')", PATIENCE_S)
                await page.until("document.querySelector('.robot:not([visibility])')", PATIENCE_S)
                await page.until(f'document.querySelector("{ROW}")', PATIENCE_S)
                await page.picture(tmp_path / "page.png")
                await asyncio.to_thread(vad.end, signal.SIGTERM)
                await page.until("!document.querySelector('#offline').hidden")
                assert [p for p in page.problems if "ERR_" not in p] == []
        sim.end(signal.SIGTERM, 20)


async def test_a_walk_is_seen_while_it_is_measured_and_the_place_appears(tmp_path: Path) -> None:
    """The home waits where the machine is behind, and for the page to have shown the walk."""
    limits = {"min_s": 3.0, "max_s": 6.0, "mapped_radius_m": 5.0, "min_walks": 1}
    network, renderer = await asyncio.to_thread(lambda: (PoseNetwork(), Renderer(HOME)))
    radio, shown = Radio(HOME, seed=1), threading.Event()
    async with hub(tmp_path, network, true_calibration(HOME), capture=limits) as world, Browser() as browser:
        bus = world.registry._bus
        bus.publish_map(map_message(floor_plan(HOME), "simulated"))
        wishes = Wishes(bus.keys, world.registry, "simulated")
        home = HomeFeed(bus.keys, bus.listen)
        page_server = PageServer(Access(free_port()), "home", home, wishes.answer, lambda: None)

        def picture(t_s: float) -> np.ndarray[Any, np.dtype[np.uint8]]:
            if world.registry.get(HOME.device_mac).state == "capturing":
                shown.wait(WALKED_S)
            return renderer.frame(t_s)

        def hearing(from_s: float, to_s: float, start_ns: int) -> CsiBatch:
            return heard(radio, from_s, to_s, start_ns)

        async with running(page_server.run()):
            await until(lambda: page_server.health.state == "ok", "the page listens")
            page = await browser.page()
            await page.go(f"http://127.0.0.1:{page_server.port}/")
            await world.registry.joined(HOME.device_mac, "lamp")
            await page.until(f'document.querySelector("{ROW}")')
            async with world.shown(picture, hearing, WALK.start_s + 3.0, WALK.end_s):
                try:
                    await page.until(
                        "document.querySelector('#measuring .note')?.textContent.includes('of walking')",
                        WALKED_S,
                    )
                finally:
                    shown.set()
                await page.until(
                    f"document.querySelector('.device[data-mac=\"{HOME.device_mac}\"]')", WALKED_S
                )
            await page.click(ROW)
            await page.until("document.querySelector('.heat image')")
            told = await page.value("document.querySelector('.detail-words').textContent")
            assert "In 9 of 10 cases the true place is within" in told
            assert page.problems == []


def answers(port: int) -> bool:
    """Whether something listens there."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
