"""The page of a real daemon in a simulated home: a walk is seen while it is measured, then the place."""

from __future__ import annotations

import asyncio
import signal
import socket
import sys
from pathlib import Path

import pytest
from waiting import free_port, until

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "daemon"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

from bench_web_browser import Browser, chromium
from daemon_world import Vad, change_settings, store_calibration

from vad.sim.scenario import make_home
from vad.web.access import write_token

HOME = make_home(1)
START_AT_S = HOME.walks[0].start_s - 4.0


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.skipif(chromium() is None, reason="no chromium: apt-get install chromium")
async def test_a_walk_is_seen_while_it_is_measured_and_the_place_appears(tmp_path: Path) -> None:
    folder, port, web = tmp_path / "home", free_port(), free_port()
    settings = folder / "vad.yaml"
    row = f".row[data-mac='{HOME.device_mac}']"
    arguments = [
        "--dir",
        folder,
        "--seed",
        "1",
        "--bus-port",
        str(port),
        "--fifo",
        "--start-at",
        str(START_AT_S),
    ]
    with Vad("sim", *map(str, arguments), log=tmp_path / "sim.log") as sim:
        await until(settings.exists, "the home's settings", 90)
        store_calibration(folder / "state", HOME)
        write_token(folder / "web.token")
        change_settings(settings, web={"port": web, "token_file": "web.token"})
        with Vad("run", "--config", settings, log=tmp_path / "daemon.log") as vad:
            async with Browser() as browser:
                await until(lambda: answers(web), "the page", 90)
                page = await browser.page()
                await page.go(f"http://127.0.0.1:{web}/")
                await page.until("document.querySelector('#source').textContent === 'simulated'", 30)
                await page.until("document.querySelector('.covered polygon')", 30)
                await page.until("document.querySelector('.robot:not([visibility])')", 30)
                await page.until(f'document.querySelector("{row}")', 30)
                await page.until(
                    "document.querySelector('#measuring .note')?.textContent.includes('of walking')", 60
                )
                await page.until(f"document.querySelector('.device[data-mac=\"{HOME.device_mac}\"]')", 90)
                await page.click(row)
                await page.until("document.querySelector('.heat image')")
                told = await page.value("document.querySelector('.detail-words').textContent")
                assert "In 9 of 10 cases the true place is within" in told
                await page.picture(tmp_path / "page.png")
                await asyncio.to_thread(vad.end, signal.SIGTERM)
                await page.until("!document.querySelector('#offline').hidden")
                assert [p for p in page.problems if "ERR_" not in p] == []
        sim.end(signal.SIGTERM, 20)


def answers(port: int) -> bool:
    """Whether something listens there."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
