#!/usr/bin/env python3
"""The page in a headless Chromium: how soon it is seen, whether 60 changes a second are held, the cost."""

from __future__ import annotations

import asyncio
import json
import os
import statistics
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import typer
from bench_web_browser import Browser, Page, chromium
from bench_web_hub import Hub
from rich.console import Console
from rich.table import Table

FIRST_PAINT_MS = 1000.0
FRAME_LOSS = 0.1

PAINTED = """(() => {
  const paint = performance.getEntriesByName('first-contentful-paint')[0];
  const plan = performance.getEntriesByName('vad: plan shown')[0];
  return paint && plan && document.querySelectorAll('.row').length >= %d
    ? [paint.startTime, plan.startTime, performance.now()] : null;
})()"""
WATCH = """(() => {
  const begun = performance.now();
  const seen = window.framesSeen = { count: 0, longest: 0, last: begun, begun };
  const frame = () => {
    const now = performance.now();
    seen.longest = Math.max(seen.longest, now - seen.last);
    seen.last = now;
    seen.count += 1;
    requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
})()"""
STATS = (
    "import('./store.js').then((store) => ({ ...store.stats, ...window.framesSeen, now: performance.now() }))"
)


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table. kept: whether the limit holds, where there is one."""

    what: str
    value: str
    limit: str = ""
    kept: bool = True


async def paints(browser: Browser, hub: Hub, devices: int, loads: int) -> tuple[list[Row], list[list[float]]]:
    """Cold loads: nothing of the page is in the browser's cache."""
    found = []
    for _ in range(loads):
        page = await browser.page()
        await page.go(f"http://127.0.0.1:{hub.port}/")
        found.append(await page.until(PAINTED % devices))
        await page.close()
    first, plan, complete = (sorted(times) for times in zip(*found, strict=True))

    def told(times: list[float]) -> str:
        return f"{statistics.median(times):.0f} ms, worst {times[-1]:.0f} ms"

    rows = [
        Row(f"first paint ({loads} cold loads)", told(first), "< 1000 ms", first[-1] < FIRST_PAINT_MS),
        Row("floor plan on the screen", told(plan)),
        Row(f"all {devices} devices listed", told(complete)),
    ]
    return rows, found


async def held(page: Page, hub: Hub, rate_hz: float, seconds: float) -> tuple[list[Row], dict[str, Any]]:
    """Changes sent against changes shown, and frames meanwhile."""
    await page.value(WATCH)
    before = await page.value(STATS)
    took = await hub.change(rate_hz, seconds)
    await page.until(
        f"import('./store.js').then((s) => s.stats.applied >= {before['applied'] + took['sent']})", 10
    )
    after = await page.value(STATS)
    received = after["received"] - before["received"]
    applied = after["applied"] - before["applied"]
    frames_s = after["count"] / ((after["last"] - after["begun"]) / 1000)
    told = took["counters"].get("told", 0)
    sent_s = took["sent"] / took["wall_s"]
    all_there = received >= told and applied >= took["sent"]
    smooth = frames_s >= 60 * (1 - FRAME_LOSS)
    rows = [
        Row(f"changes sent in {took['wall_s']:.0f} s", f"{took['sent']}, {sent_s:.1f}/s", f"{rate_hz:g}/s"),
        Row("told to the browser, with the robot's", str(told)),
        Row("superseded on the way", str(took["counters"].get("coalesced", 0))),
        Row("received and drawn by the browser", f"{received}, {applied}", "all", all_there),
        Row("frames meanwhile", f"{frames_s:.1f}/s, longest {after['longest']:.0f} ms", "60/s", smooth),
    ]
    return rows, took


async def measure(devices: int, loads: int, seconds: float) -> tuple[list[Row], dict[str, Any]]:
    """Everything."""
    with Hub(devices) as hub:
        alone = await hub.change(60, seconds)
        async with Browser() as browser:
            rows, found = await paints(browser, hub, devices, loads)
            page = await browser.page()
            await page.go(f"http://127.0.0.1:{hub.port}/")
            await page.until(PAINTED % devices)
            quiet = await hub.change(0, seconds)
            more, busy = await held(page, hub, 60, seconds)
            problems = page.problems
    share = {
        name: 100 * took["cpu_s"] / took["wall_s"]
        for name, took in (("alone", alone), ("quiet", quiet), ("busy", busy))
    }
    rows += more
    rows += [
        Row("hub: 60 changes/s, nobody looks", f"{share['alone']:.1f} % of a core"),
        Row("hub: 60 changes/s, one page open", f"{share['busy']:.1f} % of a core"),
        Row("hub: only the robot moves, one page open", f"{share['quiet']:.1f} % of a core"),
        Row("what the browser complained of", str(len(problems)), "0", not problems),
    ]
    return rows, {"paints_ms": found, "cpu_percent": share, "busy": busy, "problems": problems}


def main(
    devices: Annotated[int, typer.Option(help="In the home.")] = 100,
    loads: Annotated[int, typer.Option(help="How often the page is opened anew.")] = 9,
    seconds: Annotated[float, typer.Option(help="How long each rate is held.")] = 20.0,
    alone: Annotated[
        bool, typer.Option("--alone", help="Leave other programs out: real-time priority (root).")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="JSON instead of a table.")] = False,
) -> None:
    """Measure the page; exit code 1 where a limit is not kept, 2 where there is no Chromium."""
    out = Console()
    if chromium() is None:
        Console(stderr=True).print("there is no Chromium; install it: apt-get install chromium")
        raise typer.Exit(2)
    if alone:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))  # the hub and the browser inherit it
    rows, facts = asyncio.run(measure(devices, loads, seconds))
    kept = all(row.kept for row in rows)
    if as_json:
        print(json.dumps({"rows": [asdict(row) for row in rows], **facts, "kept": kept}, indent=1))
    else:
        table = Table(title=f"{devices} devices, headless Chromium without a GPU, 1280x800")
        for column in ("what", "measured", "limit", ""):
            table.add_column(column)
        for row in rows:
            table.add_row(row.what, row.value, row.limit, "" if row.kept else "MISSED")
        out.print(table)
    raise typer.Exit(0 if kept else 1)


if __name__ == "__main__":
    typer.run(main)
