"""`vad devices`, `vad map`, `vad status` against a real bus: what people and scripts see, and exit codes."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner
from waiting import free_port, until

from vad.bus import messages as m
from vad.bus.grid import grid_to_png
from vad.bus.node import Bus
from vad.bus.selectors import HistoryQuestion
from vad.bus.session import BusSettings
from vad.commands.device_past import heatmap, history
from vad.commands.devices import devices
from vad.commands.map import map_
from vad.commands.status import status
from vad.report.words import duration, printable

ROOT = Path(__file__).parents[2]
TV, LAMP, PHONE = (f"aa:bb:cc:dd:ee:0{i}" for i in (1, 2, 3))

app = typer.Typer()
app.command("devices")(devices)
app.command("map")(map_)
app.command("status")(status)
app.command("history")(history)
app.command("heatmap")(heatmap)


@pytest.fixture
def endpoint() -> str:
    """An endpoint where nobody listens."""
    return f"tcp/127.0.0.1:{free_port()}"


async def run(endpoint: str, *arguments: str, code: int = 0) -> tuple[str, str]:
    """Standard output and error of a command, without colours; its exit code must be `code`."""
    result = await asyncio.to_thread(CliRunner().invoke, app, [*arguments, "--endpoint", endpoint])
    assert result.exit_code == code, (result.output, result.exception)
    return result.stdout, result.stderr


def fill(bus: Bus) -> None:
    """A small home."""
    square = ((0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0))
    bus.publish_map(
        m.MapMessage(
            source="simulated",
            epoch=2,
            bounds_m=(0, 0, 8, 3),
            resolution_m=0.1,
            origin=(0, 0, 0),
            width=80,
            height=30,
            rooms=(
                m.Room(name="Living room", polygon_m=square),
                m.Room(name="Kitchen", polygon_m=tuple((x + 4, y) for x, y in square)),
            ),
        )
    )
    grid = np.zeros((30, 80), np.int8)
    grid[[0, -1], :] = grid[:, [0, 39, -1]] = 100
    bus.publish_grid(grid_to_png(grid))
    bus.publish_camera(
        m.CameraMessage(
            source="simulated",
            id="front",
            state="valid",
            percent=100,
            position_m=(0.3, 0.3, 2.1),
            map_from_camera=((0.7, 0.4, 0.6), (-0.7, 0.4, 0.6), (0.0, -0.8, -0.5)),
            deviation_m=0.04,
        )
    )
    common = {"source": "simulated", "state": "mapped", "epoch": 2, "walks": 3}
    bus.publish_device(
        m.DeviceMessage(**common, mac=TV, name="TV", room="Living room", x_m=2.0, y_m=1.0, radius90_m=0.5)  # type: ignore[arg-type]
    )
    bus.publish_device(
        m.DeviceMessage(
            **common,  # type: ignore[arg-type]
            mac=LAMP,
            name="lamp $x$ [red]\x1b[2J",
            room="Kitchen",
            x_m=6.0,
            y_m=1.5,
            radius90_m=0.3,
            covariance_m2=((0.02, 0.01), (0.01, 0.02)),
            region90=((5.8, 1.3), (6.2, 1.3), (6.0, 1.8)),
        )
    )
    bus.publish_device(
        m.DeviceMessage(source="simulated", mac=PHONE, state="waiting", reason="nobody has walked yet")
    )


async def test_devices_are_listed(endpoint: str) -> None:
    async with Bus(BusSettings(listen=(endpoint,))) as bus:
        fill(bus)
        text, _ = await run(endpoint, "devices")
        lines = text.splitlines()
        assert re.fullmatch(r"MAC +Name +Room +x m +y m +±90 % m +State +Reason +Source *", lines[0])
        assert re.match(rf"{TV} +TV +Living room +2\.00 +1\.00 +±0\.50 +mapped +simulated", lines[1])
        assert "lamp $x$ [red]\N{REPLACEMENT CHARACTER}[2J" in lines[2]
        assert "\x1b" not in text
        assert re.match(rf"{PHONE} +– +– +– +– +– +waiting +nobody has walked yet +simulated", lines[3])
        narrowed, _ = await run(endpoint, "devices", "--room", "Kitchen", "--state", "mapped")
        assert [line[:17] for line in narrowed.splitlines()[1:]] == [LAMP]
        sharp, _ = await run(endpoint, "devices", "--max-sigma", "0.2")
        assert [line[:17] for line in sharp.splitlines()[1:]] == [LAMP]


async def test_devices_as_json_are_the_messages(endpoint: str) -> None:
    async with Bus(BusSettings(listen=(endpoint,))) as bus:
        fill(bus)
        text, _ = await run(endpoint, "devices", "--json")
        plain = json.loads(text)
        assert [one["mac"] for one in plain] == [TV, LAMP, PHONE]
        assert all(one["schema"] == "vad.device.v1" and one["source"] == "simulated" for one in plain)
        assert "truth" not in plain[0]


async def test_truth_shows_the_error(endpoint: str, tmp_path: Path) -> None:
    truth = tmp_path / "truth.json"
    truth.write_text(json.dumps({TV.upper(): {"x_m": 2.3, "y_m": 1.4}, LAMP: {"x_m": 6.0, "y_m": 1.4}}))
    async with Bus(BusSettings(listen=(endpoint,))) as bus:
        fill(bus)
        text, _ = await run(endpoint, "devices", "--truth", str(truth))
        assert re.search(rf"{TV} .* 2\.30 +1\.40 +0\.50 +mapped", text)
        assert "median 0.30 m, worst 0.50 m; 2 of 2 inside" in text
        plain = json.loads((await run(endpoint, "devices", "--json", "--truth", str(truth)))[0])
        assert plain[0]["error_m"] == pytest.approx(0.5)
        assert plain[0]["truth"] == {"x_m": 2.3, "y_m": 1.4}
        assert plain[2]["truth"] is None
        truth.write_text('{"aa": {"x_m": 1}}')
        _, complaint = await run(endpoint, "devices", "--truth", str(truth), code=2)
        assert "y_m" in complaint
        _, complaint = await run(endpoint, "devices", "--truth", str(tmp_path / "none"), code=2)
        assert "No such file" in complaint


async def test_exit_codes_tell_nothing_bad_input_and_no_daemon_apart(endpoint: str) -> None:
    for command in ("devices", "map", "status"):
        _, complaint = await run(endpoint, command, code=3)
        assert f"no vad daemon answers at {endpoint}. Start it" in complaint
        _, complaint = await run("tcp/192.168.1.1:7447", command, code=2)
        assert "plain TCP" in complaint
    async with Bus(BusSettings(listen=(endpoint,))):
        assert "no device is known yet" in (await run(endpoint, "devices", code=1))[1]
        assert "no device fits" in (await run(endpoint, "devices", "--room", "Attic", code=1))[1]
        assert json.loads((await run(endpoint, "devices", "--json", code=1))[0]) == []
        assert (
            "'maped' is not a device state" in (await run(endpoint, "devices", "--state", "maped", code=2))[1]
        )
        assert "no map yet" in (await run(endpoint, "map", code=1))[1]
        assert "just started" in (await run(endpoint, "status", code=1))[1]
        await run(endpoint, "devices", "--colour", "red", code=2)
        assert "as hub 'cellar'" in (await run(endpoint, "status", "--hub", "cellar", code=3))[1]


async def test_status_tells_the_parts_and_whether_all_is_well(endpoint: str) -> None:
    robot = m.Part(part="robot", state="ok", detail="20 Hz", counters={"poses": 812})
    camera = m.Part(part="camera", state="degraded", detail="reopening", last_error="unplugged")
    async with Bus(BusSettings(listen=(endpoint,))) as bus:
        message = m.StatusMessage(
            source="live",
            version="0.1.0",
            uptime_s=3725.0,
            step="waiting for somebody to walk",
            parts=(robot,),
        )
        bus.publish_status(message)
        text, _ = await run(endpoint, "status")
        assert text.startswith("vad 0.1.0 on home, up 1 h 2 min\nnow: waiting for somebody to walk\n")
        assert re.search(r"robot +ok +20 Hz +poses 812", text)
        bus.publish_status(
            m.StatusMessage(source="live", version="0.1.0", uptime_s=1.0, parts=(robot, camera))
        )
        text, _ = await run(endpoint, "status", code=1)
        assert re.search(r"camera +degraded +reopening +unplugged", text)
        assert (
            json.loads((await run(endpoint, "status", "--json", code=1))[0])["parts"][1]["part"] == "camera"
        )


async def test_status_tells_rates_losses_and_since_when(endpoint: str) -> None:
    csi = m.Part(
        part="csi",
        state="ok",
        last_error="unplugged",
        last_error_at="2026-01-31T12:00:00.000Z",
        counters={"packets": 4000, "lost": 7},
        rates_per_s={"packets": 398.5},
        latencies={"batch": m.Latency(count=9, total_s=0.1, p50_ms=0.5, p99_ms=12.25, max_ms=13.0)},
    )
    async with Bus(BusSettings(listen=(endpoint,))) as bus:
        bus.publish_status(m.StatusMessage(source="live", version="1", uptime_s=1.0, parts=(csi,)))
        text, _ = await run(endpoint, "status")
        assert "2026-01-31T12:00:00.000Z: unplugged" in text
        assert "lost 7, packets 4000 (398.5/s)" in text
        assert "batch 0.5 / 12.25" in text


NOON = "2026-01-31T12:00:00.000Z"


class Memory:
    """What a store would know: the TV, mapped since noon."""

    async def devices_at(self, at: str, mac: str | None) -> list[m.DeviceMessage]:
        if mac not in (None, TV) or at < NOON:
            return []
        return [m.DeviceMessage(source="live", mac=TV, name="old TV", state="mapped", x_m=1.0, y_m=1.0)]

    async def history(self, mac: str, question: HistoryQuestion) -> m.HistoryMessage | None:
        entry = m.HistoryEntry(at=NOON, state="mapped", epoch=2, x_m=1.0, y_m=1.25, room="Hall", walks=3)
        entries = (entry,) * (question.since is None)
        return m.HistoryMessage(source="live", mac=mac, entries=entries) if mac == TV else None


async def test_devices_narrowed_then_and_as_geojson(endpoint: str) -> None:
    async with Bus(BusSettings(listen=(endpoint,))) as bus:
        fill(bus)
        bus.ask_past(Memory())
        boxed, _ = await run(endpoint, "devices", "--bbox", "5,0,8,3")
        assert [line[:17] for line in boxed.splitlines()[1:]] == [LAMP]
        one, _ = await run(endpoint, "devices", "--mac", PHONE.upper())
        assert [line[:17] for line in one.splitlines()[1:]] == [PHONE]
        assert (
            "no device fits" in (await run(endpoint, "devices", "--since", "2099-01-01T00:00:00Z", code=1))[1]
        )
        then, _ = await run(endpoint, "devices", "--at", "2026-01-31T13:00:00+01:00")
        assert "old TV" in then
        assert "no device fits" in (await run(endpoint, "devices", "--at", "2026-01-31T11:59:59Z", code=1))[1]
        places = json.loads((await run(endpoint, "devices", "--geojson", "--room", "Kitchen"))[0])
        assert [(f["id"], f["geometry"]["coordinates"]) for f in places["features"]] == [(LAMP, [6.0, 1.5])]
        assert "not a box" in (await run(endpoint, "devices", "--bbox", "1,2,3", code=2))[1]
        assert "not an RFC 3339 time" in (await run(endpoint, "devices", "--at", "noon", code=2))[1]
        assert "--geojson goes" in (await run(endpoint, "devices", "--geojson", "--watch", code=2))[1]


async def test_the_history_of_a_device(endpoint: str) -> None:
    async with Bus(BusSettings(listen=(endpoint,))) as bus:
        assert "keeps no history" in (await run(endpoint, "history", TV, code=2))[1]
        bus.ask_past(Memory())
        text, _ = await run(endpoint, "history", TV)
        assert re.search(rf"{NOON} +mapped +Hall +1\.00 +1\.25 +– +3 +2", text)
        assert json.loads((await run(endpoint, "history", TV, "--json"))[0])["entries"][0]["walks"] == 3
        assert "nothing is kept" in (await run(endpoint, "history", TV, "--since", NOON, code=1))[1]
        assert "does not know" in (await run(endpoint, "history", LAMP, code=1))[1]


async def test_a_heatmap_becomes_a_file(endpoint: str, tmp_path: Path) -> None:
    heat = m.heatmap_message(
        np.arange(1.0, 7.0).reshape(2, 3), source="live", mac=TV, epoch=1, bounds_m=(0, 0, 3, 2), step_m=1
    )
    async with Bus(BusSettings(listen=(endpoint,))) as bus:
        bus.publish_heatmap(heat)
        for name in ("tv.png", "tv.npy", "tv.json"):
            text, _ = await run(endpoint, "heatmap", TV, str(tmp_path / name))
            assert text == f"wrote {tmp_path / name}\n"
        picture = cv2.imread(str(tmp_path / "tv.png"), cv2.IMREAD_UNCHANGED)
        assert picture is not None
        assert picture.shape == (2, 3, 4)
        np.testing.assert_allclose(
            np.load(tmp_path / "tv.npy"), np.arange(1, 7).reshape(2, 3) / 21, rtol=1e-6
        )
        assert json.loads((tmp_path / "tv.json").read_text())["bounds_m"] == [0, 0, 3, 2]
        assert "does not end in" in (await run(endpoint, "heatmap", TV, "tv.jpg", code=2))[1]
        assert "yet" in (await run(endpoint, "heatmap", LAMP, str(tmp_path / "lamp.png"), code=1))[1]


async def test_the_map_in_words(endpoint: str) -> None:
    async with Bus(BusSettings(listen=(endpoint,))) as bus:
        fill(bus)
        text, _ = await run(endpoint, "map")
        assert "map of home, epoch 2: 8.0 m x 3.0 m" in text
        assert re.search(r"Living room +12\.0 +TV ±0\.50", text)
        assert "camera front: at 0.30, 0.30, height 2.10 m, floor error 0.04 m (valid)" in text
        assert "devices: 2 mapped, 1 waiting" in text


async def test_the_map_as_pictures(endpoint: str, tmp_path: Path) -> None:
    png, svg = tmp_path / "home.png", tmp_path / "home.svg"
    async with Bus(BusSettings(listen=(endpoint,))) as bus:
        fill(bus)
        text, _ = await run(endpoint, "map", "--png", str(png), "--svg", str(svg))
        assert text == f"wrote {png}\nwrote {svg}\n"
        picture = cv2.imread(str(png))
        assert picture is not None
        assert min(picture.shape[:2]) > 500
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100
        drawn = svg.read_text(encoding="utf-8")
        for said in (
            "KITCHEN",
            "LIVING ROOM",
            "TV",
            "±0.30 m",
            "camera front",
            "SIMULATED",
            "nobody has walked yet",
        ):
            assert said in drawn
        _, complaint = await run(endpoint, "map", "--png", str(tmp_path / "no" / "home.png"), code=2)
        assert "cannot be written: No such file" in complaint
        _, complaint = await run(endpoint, "map", "--png", "home.jpg", code=2)
        assert "does not end in .png" in complaint


@pytest.mark.parametrize("command", ["devices", "map", "status"])
def test_help_teaches_with_an_example(command: str) -> None:
    result = CliRunner().invoke(app, [command, "--help"])
    assert result.exit_code == 0
    assert f"Example:  vad {command}" in result.output
    assert "Exit code 0" in result.output


async def watching(endpoint: str, *arguments: str) -> asyncio.subprocess.Process:
    code = "import typer\nfrom vad.commands.devices import devices\ntyper.run(devices)\n"
    return await asyncio.create_subprocess_exec(
        sys.executable, "-c", code, "--watch", *arguments, "--endpoint", endpoint,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT,
    )  # fmt: skip


async def shown(bus: Bus) -> None:
    """Wait until what is published now has been shown.

    The first question that is answered from now on may have been asked before, and the answer to the second
    is shown for sure when the third is asked.
    """
    asked = bus.health.counters["queries"]
    await until(lambda: bus.health.counters["queries"] >= asked + 3, "three questions")


async def test_watching_shows_changes_and_ends_with_ctrl_c(endpoint: str) -> None:
    async with Bus(BusSettings(listen=(endpoint,))) as bus:
        fill(bus)
        process = await watching(endpoint, "--json")
        assert process.stdout is not None
        first = json.loads(await asyncio.wait_for(process.stdout.readline(), 40))
        assert [one["state"] for one in first] == ["mapped", "mapped", "waiting"]
        bus.publish_device(m.DeviceMessage(source="simulated", mac=PHONE, state="capturing"))
        second = json.loads(await asyncio.wait_for(process.stdout.readline(), 40))
        assert second[2]["state"] == "capturing"
        process.send_signal(signal.SIGINT)
        rest, complaint = await asyncio.wait_for(process.communicate(), 40)
        assert (process.returncode, rest, complaint) == (0, b"", b"")


async def test_a_watched_table_outlives_the_daemon(endpoint: str) -> None:
    async with Bus(BusSettings(listen=(endpoint,))) as bus:
        fill(bus)
        process = await watching(endpoint)
        await shown(bus)
    async with Bus(BusSettings(listen=(endpoint,))) as bus:
        bus.publish_device(m.DeviceMessage(source="live", mac=PHONE, name="back again", state="waiting"))
        await shown(bus)
        assert process.returncode is None
        process.send_signal(signal.SIGINT)
        text, _ = await asyncio.wait_for(process.communicate(), 40)
        assert process.returncode == 0
        assert "back again" in text.decode()


def test_words() -> None:
    assert [duration(s) for s in (0.4, 59, 60, 3599, 7800, 360000)] == [
        "0 s",
        "59 s",
        "1 min 0 s",
        "59 min 59 s",
        "2 h 10 min",
        "4 d 4 h",
    ]
    assert printable("Küche\n\x07") == "Küche\N{REPLACEMENT CHARACTER}\N{REPLACEMENT CHARACTER}"
