"""The page in a real browser, without a screen: what people see, keyboards, phones, names that bite."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import msgspec
import pytest
import pytest_asyncio
from waiting import free_port, until
from web_world import PLAN, Serving, World, device, heatmap, mac, status

from vad.bus import messages as m
from vad.bus.plan import map_message
from vad.web.home import Robot

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

from bench_web_browser import Browser, Page, chromium

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(180),
    pytest.mark.skipif(chromium() is None, reason="no chromium: apt-get install chromium"),
]

WIDTHS = {"phone": (390, 844), "small phone": (360, 640), "tablet": (820, 1180), "desktop": (1280, 800)}
ROW = "document.querySelector('[data-row=\"{mac}\"]')"


@pytest_asyncio.fixture
async def browser() -> AsyncIterator[Browser]:
    async with Browser() as started:
        yield started


async def shown(browser: Browser, made: World, width: int = 1280, height: int = 800, **options: bool) -> Page:
    """The page with all devices in it."""
    page = await browser.page(width, height, **options)
    await page.go(f"{made.url}/")
    count = len(made.bus.device_states())
    assert count
    await page.until(f"document.querySelectorAll('.row').length >= {sum(made.bus.device_states().values())}")
    await page.until("performance.getEntriesByName('vad: plan shown').length")
    await page.until("document.querySelector('#step').textContent")  # the status, which is told of last
    await page.until(
        "document.title.startsWith('home')"
    )  # what this browser may do, which is asked for apart
    return page


def text_of(selector: str) -> str:
    return f"document.querySelector({selector!r})?.textContent"


async def test_devices_rooms_camera_robot_and_reasons_are_seen(serving: Serving, browser: Browser) -> None:
    async with serving(devices=8) as made:
        made.robot = Robot(status="localised", x_m=1.0, y_m=1.5, yaw_rad=0.3, epoch=PLAN.epoch)
        page = await shown(browser, made)
        assert await page.value(text_of("#source")) == "simulated"
        assert "waiting for somebody" in (await page.value(text_of("#step"))).lower()
        placed = sum(device(i).x_m is not None for i in range(8))
        assert await page.value("document.querySelectorAll('.regions polygon').length") == placed
        assert await page.value("document.querySelectorAll('.rooms polygon').length") == len(PLAN.rooms)
        assert await page.value("document.querySelectorAll('.covered polygon').length") == 1
        assert await page.value("document.querySelectorAll('.cameras .camera').length") == 1
        await page.until("document.querySelector('.robot:not([visibility])')")
        rows = await page.value("[...document.querySelectorAll('.row')].map((row) => row.textContent)")
        waiting = next(row for row in rows if "Device 3" in row)
        assert "Waiting for somebody to walk through the picture." in waiting
        assert "3 of" not in waiting
        # where the mark is on the screen is where the device is in the home
        at = await page.value(
            f"(() => {{ const box = document.querySelector('.device[data-mac=\"{mac(0)}\"] .dot')"
            ".getBoundingClientRect(); const plan = document.querySelector('.grid image')"
            ".getBoundingClientRect(); return [(box.x + box.width / 2 - plan.x) / plan.width,"
            " (box.y + box.height / 2 - plan.y) / plan.height]; })()"
        )
        x0, y0, x1, y1 = PLAN.bounds_m
        known = device(0)
        assert known.x_m is not None
        assert known.y_m is not None
        assert at == pytest.approx([(known.x_m - x0) / (x1 - x0), (y1 - known.y_m) / (y1 - y0)], abs=0.01)
        assert page.problems == []
        assert all(address.startswith(made.url) or address == "about:blank" for address in page.requests)


async def test_changes_appear_by_themselves(serving: Serving, browser: Browser) -> None:
    async with serving(devices=3) as made:
        page = await shown(browser, made)
        made.bus.publish_device(device(7))
        await page.until("document.querySelectorAll('.row').length === 4")
        made.bus.publish_device(device(7, name="Kettle", state="capturing"))
        made.bus.publish_capture(
            m.CaptureMessage(
                source="simulated",
                session="s1",
                mac=mac(7),
                state="recording",
                packets=2500,
                walk_s=11,
                progress=0.4,
            )
        )
        await page.until("document.querySelector('#measuring .capture')")
        told = await page.value(text_of("#measuring .capture"))
        assert told == "KettleListens while somebody walks, 11 s of walking, 2,500 packets."
        assert await page.value("document.querySelector('#measuring progress').value") == 0.4
        made.bus.publish_capture(
            m.CaptureMessage(
                source="simulated", session="s1", mac=mac(7), state="done", packets=2500, walk_s=11
            )
        )
        await page.until("document.querySelector('#measuring').hidden")
        made.bus.publish_event(
            m.EventMessage(source="simulated", kind="mapped", mac=mac(7), text="Kettle is mapped")
        )
        await page.click("#tab-events")
        await page.until(f"{text_of('#pane-events')}.includes('Kettle is mapped.')")
        made.bus.forget_device(mac(7))
        await page.until("document.querySelectorAll('.row').length === 3")
        made.bus.publish_status(status("all is well", parts=(m.Part(part="robot", state="ok"),)))
        await page.until("document.querySelector('#health-mark').hidden")
        made.bus.publish_map(msgspec.structs.replace(plan_of(made), epoch=2))
        await page.until("document.querySelectorAll('.regions polygon').length === 0")
        assert page.problems == []


def plan_of(made: World) -> m.MapMessage:
    return map_message(PLAN, "simulated")


async def test_a_click_shows_the_heatmap_and_who_it_is(serving: Serving, browser: Browser) -> None:
    async with serving(devices=3) as made:
        page = await shown(browser, made)
        await page.click(f".device[data-mac='{mac(0)}']")
        await page.until(f"{text_of('.detail-name')} === 'Device 0'")
        await page.until("document.querySelector('.heat image') && !document.querySelector('#legend').hidden")
        first = await page.value("document.querySelector('.heat image').getAttribute('href')")
        made.bus.publish_heatmap(
            heatmap(5).__class__(**(msgspec.structs.asdict(heatmap(5)) | {"mac": mac(0)}))
        )
        await page.until(f"document.querySelector('.heat image').getAttribute('href') !== '{first}'")
        await page.click(".back")
        await page.until("document.querySelector('#detail').hidden && !document.querySelector('.heat image')")
        assert page.problems == []


async def test_names_off_the_air_stay_text(serving: Serving, browser: Browser) -> None:
    evil = "<img src=x onerror=\"document.title='broken into'\">"
    async with serving(devices=2) as made:
        names = (
            evil,
            "\u202eknalb",
            "</script><script>document.title='broken into'</script>",
            "x" * 300,
            "🛋️ Lampe",
        )
        for i, name in enumerate(names):
            made.bus.publish_device(
                device(20 + i, name=name, host_name=name, vendor=name, room=name, reason=name)
            )
            made.bus.publish_event(
                m.EventMessage(source="simulated", kind="joined", mac=mac(20 + i), text=name)
            )
        made.bus.publish_status(status(evil, parts=(m.Part(part=evil, state="failed", detail=evil),)))
        page = await shown(browser, made, 360, 640)
        for tab in ("health", "events", "devices"):
            await page.click(f"#tab-{tab}")
        await page.click(f".row[data-mac='{mac(20)}']")
        await page.until(f"{text_of('.detail-name')}.includes('onerror')")
        assert await page.value("document.title") == "home · Wi-Fi devices"
        assert await page.value("document.querySelectorAll('main img, main script').length") == 0
        assert "\u202e" not in await page.value("document.body.textContent")
        assert await page.value("document.documentElement.scrollWidth") <= 360, (
            "a long name does not widen the page"
        )
        assert page.problems == []


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("screen", list(WIDTHS))
async def test_it_fits_every_screen(
    serving: Serving, browser: Browser, tmp_path: Path, screen: str, dark: bool
) -> None:
    width, height = WIDTHS[screen]
    async with serving(devices=14) as made:
        page = await shown(browser, made, width, height, dark=dark, phone="phone" in screen)
        assert await page.value("document.documentElement.scrollWidth") <= width
        small = await page.value(
            "[...document.querySelectorAll('button')].filter((b) => b.checkVisibility())"
            ".map((b) => [b.id || b.textContent, b.getBoundingClientRect()])"
            ".filter(([, box]) => box.height < 30 || box.width < 24 || box.right > innerWidth + 1)"
            ".map(([name]) => name)"
        )
        assert small == [], "every button can be met with a finger, and is on the screen"
        faint = await page.value(CONTRAST)
        assert faint == [], "text stands out from what is behind it (WCAG AA)"
        await page.picture(tmp_path / "page.png")
        assert (tmp_path / "page.png").stat().st_size > 20_000
        assert page.problems == []


CONTRAST = """(() => {
  const rgb = (text) => text.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b].map((v) => v / 255)
    .map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
    .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const behind = (node) => {
    for (let at = node; at; at = at.parentElement) {
      const colour = rgb(getComputedStyle(at).backgroundColor);
      if (colour.length === 3 || colour[3] === 1) return colour;
    }
    return rgb(getComputedStyle(document.documentElement).backgroundColor);
  };
  const faint = [];
  for (const node of document.querySelectorAll('body *')) {
    const own = [...node.childNodes].some((child) => child.nodeType === 3 && child.data.trim());
    if (!own || node.closest('svg') || !node.checkVisibility() || node.closest('.unseen, noscript')) continue;
    const [a, b] = [light(rgb(getComputedStyle(node).color)), light(behind(node))].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05);
    if (ratio < 4.5) faint.push(`${node.className} ${node.textContent.slice(0, 30)} ${ratio.toFixed(2)}`);
  }
  return faint;
})()"""


async def test_all_of_it_can_be_used_with_the_keyboard(serving: Serving, browser: Browser) -> None:
    async with serving(devices=5) as made:
        page = await shown(browser, made)
        await page.key("Tab")
        assert await page.value("document.activeElement.className") == "skip"
        await page.value("document.querySelector('.row').focus()")
        await page.key("ArrowDown")
        assert await page.value("[...document.querySelectorAll('.row')].indexOf(document.activeElement)") == 1
        await page.key("End")
        chosen = await page.value("document.activeElement.querySelector('bdi').textContent")
        await page.key("Enter")
        await page.until(f"{text_of('.detail-name')} === {chosen!r}")
        assert await page.value("document.activeElement.className") == "detail-name", "and is read out"
        await page.key("Escape")
        await page.until("document.querySelector('#detail').hidden")
        assert await page.value("document.activeElement.querySelector('bdi').textContent") == chosen
        await page.value("document.querySelector('#tab-devices').focus()")
        await page.key("ArrowRight")
        assert await page.value("document.activeElement.id") == "tab-events"
        assert await page.value("document.querySelector('#pane-devices').hidden")
        # Whatever this moved has found its place two frames later.
        await page.value("new Promise((on) => requestAnimationFrame(() => requestAnimationFrame(on)))")
        before = await page.value("document.querySelector('#world').getAttribute('transform')")
        await page.value("document.querySelector('#plan').focus()")
        await page.key("+", text="+")
        assert await page.value("document.querySelector('#world').getAttribute('transform')") != before
        await page.key("0", text="0")
        assert await page.value("document.querySelector('#world').getAttribute('transform')") == before
        unnamed = await page.value(
            "[...document.querySelectorAll('button, input, dialog, [role=tabpanel], progress')]"
            ".filter((node) => !(node.textContent.trim() || node.getAttribute('aria-label')"
            " || node.getAttribute('aria-labelledby') || node.labels?.length)).map((node) => node.outerHTML)"
        )
        assert unnamed == []
        assert page.problems == []


async def test_log_in_rename_ignore_take_back_and_forget(serving: Serving, browser: Browser) -> None:
    async with serving(devices=1) as made:
        await made.registry.joined(mac(50), "lamp")
        page = await shown(browser, made)

        async def choose() -> None:
            await page.until(f"document.querySelector('.row[data-mac=\"{mac(50)}\"]')")
            await page.click(f".row[data-mac='{mac(50)}']")
            await page.until("!document.querySelector('#detail').hidden")

        await choose()
        assert "Log in to rename" in await page.value(text_of("#detail"))
        assert not await page.value("document.querySelector('#detail > .buttons').checkVisibility()")
        await page.click("#account")
        await page.until("document.activeElement.id === 'token'")
        await page.type("wrong" * 10)
        await page.key("Enter")
        await page.until("!document.querySelector('#login-error').hidden")
        await until(lambda: page.problems, "the browser tells of the 401")
        page.problems.clear()
        await page.value("document.querySelector('#token').select()")
        await page.type(made.token)
        await page.key("Enter")
        await page.until(f"{text_of('#account')} === 'Log out'")
        assert made.token not in await page.value("document.cookie + JSON.stringify(localStorage)")
        await page.click("#detail > .buttons button:nth-child(1)")
        await page.until("document.activeElement.id === 'new-name'")
        await page.type("Lamp by the window")
        await page.key("Enter")
        await page.until(f"{text_of('.detail-name')} === 'Lamp by the window'")
        assert made.registry.get(mac(50)).name == "Lamp by the window"
        await page.click("#detail > .buttons button:nth-child(2)")
        await page.until("document.querySelector('#sure').open")
        await page.click("#sure .quiet")
        await page.until("!document.querySelector('#sure').open")
        assert made.registry.knows(mac(50)), "not sure is no"
        await page.click("#detail > .buttons button:nth-child(2)")
        await page.until("document.querySelector('#sure').open")
        await page.click("#sure-yes")
        await page.until("!document.querySelector('#ignored').hidden")
        assert not made.registry.knows(mac(50))
        await page.value("document.querySelector('#ignored').open = true")
        await page.click("#ignored-list button")
        await choose()
        await page.click("#detail > .buttons button:nth-child(3)")
        await page.until("document.querySelector('#sure').open")
        await page.click("#sure-yes")
        await page.until(f"!document.querySelector('.row[data-mac=\"{mac(50)}\"]')")
        assert not made.registry.knows(mac(50))
        await page.click("#account")
        await page.until(f"{text_of('#account')} === 'Log in'")
        assert page.problems == []


async def test_it_says_that_the_hub_is_gone_and_goes_on_when_it_is_back(
    serving: Serving, browser: Browser, tmp_path: Path
) -> None:
    port = free_port()
    async with serving(devices=3, port=port) as made:
        page = await shown(browser, made)
    await page.until("!document.querySelector('#offline').hidden")
    assert "does not answer" in await page.value(text_of("#offline"))
    assert await page.value("document.querySelectorAll('.row').length") == 3, "what was seen stays"
    async with serving(devices=5, port=port) as made:
        await page.until("document.querySelector('#offline').hidden")
        await page.until("document.querySelectorAll('.row').length === 5")
        await until(lambda: made.page.streams.count == 1, "one stream, not two")


async def test_too_many_pages_say_so_and_the_next_one_comes_up_by_itself(
    serving: Serving, browser: Browser
) -> None:
    async with serving(devices=2) as made:
        answers = [await made.http.get(made.url + "/api/stream") for _ in range(16)]
        page = await browser.page()
        await page.go(f"{made.url}/")
        await page.until(f"{text_of('#offline')}.includes('pages are open already')")
        for answer in answers:
            answer.close()
        await page.until("document.querySelectorAll('.row').length === 2")
        await page.until("document.querySelector('#offline').hidden")


async def test_sixty_changes_a_second_are_all_shown(serving: Serving, browser: Browser) -> None:
    # Each of another device: two changes of one may be told as one where the machine is busy.
    async with serving(devices=180) as made:
        page = await shown(browser, made)
        stats = "import('./store.js').then((s) => s.stats)"
        before = await page.value(stats)
        begun_s = asyncio.get_running_loop().time()
        base = [device(i) for i in range(180)]
        for tick, one in enumerate(base):
            made.bus.publish_device(msgspec.structs.replace(one, walks=4 + tick))
            await asyncio.sleep(max(0.0, begun_s + (tick + 1) / 60 - asyncio.get_running_loop().time()))
        last = base[179].mac
        await page.until(f"import('./store.js').then((s) => s.one('device', '{last}').walks === 183)")
        after = await page.value(stats)
        received = after["received"] - before["received"]
        assert received >= 180
        await page.until(f"import('./store.js').then((s) => s.stats.applied >= {before['applied'] + 180})")
        assert page.problems == []
