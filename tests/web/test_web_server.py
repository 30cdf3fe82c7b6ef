"""The page's server over real sockets: what it serves, whom it refuses, who may change something."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from waiting import free_port, until
from web_world import PLAN, Serving, World, device, mac, world

from vad.bus import messages as m
from vad.web import server as server_module
from vad.web.access import TRIES, Access, TokenFile, write_token
from vad.web.files import static_files
from vad.web.home import HomeFeed
from vad.web.server import MAX_BODY, MAX_CONNECTIONS, PageServer

EVIL = "http://evil.example"


async def ask(made: World, path: str, **options: Any) -> tuple[int, Any, Any]:
    """Status, headers, JSON content."""
    method = options.pop("method", "GET")
    async with made.http.request(method, made.url + path, **options) as answer:
        content = await answer.json() if answer.content_type == "application/json" else await answer.read()
        return answer.status, answer.headers, content


async def login(made: World, token: str | None = None) -> int:
    token = made.token if token is None else token
    return (await ask(made, "/api/login", method="POST", json={"token": token}))[0]


async def wish(made: World, content: Any, **options: Any) -> tuple[int, Any]:
    status, _, said = await ask(made, "/api/wish", method="POST", json=content, **options)
    return status, said


async def test_the_page_and_its_files_come_with_a_strict_policy(serving: Serving) -> None:
    async with serving() as made:
        for name in ("", *static_files()):
            status, headers, content = await ask(made, f"/{name}")
            assert status == 200
            assert content
            policy = headers["Content-Security-Policy"]
            assert "default-src 'none'" in policy
            assert "unsafe" not in policy
            assert "http" not in policy, "nothing from elsewhere"
            assert headers["X-Content-Type-Options"] == "nosniff"
            assert headers["Referrer-Policy"] == "no-referrer"
            assert "aiohttp" not in headers["Server"]
            status, _, content = await ask(made, f"/{name}", headers={"If-None-Match": headers["ETag"]})
            assert (status, content) == (304, b"")


def test_the_files_ask_for_nothing_from_elsewhere_and_never_write_html() -> None:
    files = static_files()
    assert {"index.html", "style.css", "main.js", "icon.svg"} <= set(files)
    for name, file in files.items():
        text = file.content.decode()
        assert "//" not in text.replace("http://www.w3.org/2000/svg", "").replace("// ", ""), name
        for sink in (
            "innerHTML",
            "outerHTML",
            "insertAdjacentHTML",
            "document.write",
            "eval(",
            "new Function",
        ):
            assert sink not in text, name
        if name.endswith(".js"):
            for line in text.splitlines():
                assert "import" not in line or "from" not in line or '"./' in line or line.startswith("//"), (
                    line
                )
    page = files["index.html"].content.decode()
    assert "style=" not in page
    assert "onclick" not in page
    for name in files:
        if name.endswith(".js") and name != "main.js":
            assert f'href="{name}"' in page, f"{name} is loaded with the page, not one after the other"


@pytest.mark.parametrize(
    "path", ["/nothing", "/../app.py", "/%2e%2e/server.py", "/static/main.js", "/api/nothing"]
)
async def test_nothing_else_is_served(serving: Serving, path: str) -> None:
    async with serving() as made:
        status, headers, said = await ask(made, path)
        assert status == 404
        assert said["schema"] == "vad.error.v1"
        assert "Content-Security-Policy" in headers
        for method in ("PUT", "DELETE", "POST"):
            assert (await ask(made, path, method=method))[0] in (404, 405)


async def test_other_names_for_this_address_are_refused(serving: Serving) -> None:
    async with serving(names=("vad.home.arpa",)) as made:
        for host in ("localhost", "127.0.0.1", f"127.0.0.1:{made.page.port}", "[::1]:80", "VAD.home.arpa"):
            assert (await ask(made, "/", headers={"Host": host}))[0] == 200, host
        for host in (
            "evil.example",
            "127.0.0.1.evil.example:80",
            "localhost.evil.example",
            "",
            "vad.home.arpa.x",
        ):
            for path in ("/", "/api/stream", "/api/session"):
                status, _, said = await ask(made, path, headers={"Host": host})
                assert status == 421, host
                assert "web.names" in said["text"]
        assert made.page.health.counters["refused_host"] == 15


async def test_other_sites_get_nothing(serving: Serving) -> None:
    async with serving(names=("vad.home.arpa",)) as made:
        same = f"127.0.0.1:{made.page.port}"
        for headers in (
            {"Sec-Fetch-Site": "cross-site"},
            {"Sec-Fetch-Site": "same-site"},
            {"Origin": EVIL},
            {"Origin": "null"},
            {"Origin": "http://127.0.0.1:1"},
            {"Origin": f"http://{same}", "Sec-Fetch-Site": "cross-site"},
        ):
            for method, path in (("GET", "/api/stream"), ("POST", "/api/wish"), ("POST", "/api/login")):
                status, _, said = await ask(made, path, method=method, headers=headers)
                assert (status, said["code"]) == (403, "origin"), (headers, path)
        link = {"Sec-Fetch-Site": "cross-site"}
        assert (await ask(made, "/", headers=link))[0] == 200, "a link on another page leads here"
        assert (await ask(made, "/", method="POST", headers=link))[0] == 403
        for headers in ({"Origin": f"http://{same}"}, {"Sec-Fetch-Site": "same-origin"}, {}):
            assert (await ask(made, "/api/session", headers=headers))[0] == 200
        proxied = {"Origin": "https://vad.home.arpa", "Host": same}
        assert (await ask(made, "/api/session", headers=proxied))[0] == 200


async def test_without_a_token_nothing_can_be_changed(serving: Serving) -> None:
    async with serving(may_change=False) as made:
        await made.registry.joined(mac(50), "lamp")
        assert (await ask(made, "/api/session"))[2] == {"hub": "home", "may_change": False, "login": False}
        for headers in (
            {},
            {"Authorization": "Bearer "},
            {"Authorization": "Bearer x"},
            {"Cookie": "vad-home="},
        ):
            status, said = await wish(made, {"mac": mac(50), "forget": True}, headers=headers)
            assert (status, said["code"]) == (403, "read_only")
            assert "web.token_file" in said["text"]
        assert (await ask(made, "/api/login", method="POST", json={"token": ""}))[0] == 403
        assert made.registry.knows(mac(50))


async def test_who_gives_the_token_renames_ignores_takes_back_and_forgets(serving: Serving) -> None:
    async with serving() as made:
        await made.registry.joined(mac(50), "lamp")
        status, said = await wish(made, {"mac": mac(50), "name": "x"})
        assert (status, said["code"]) == (401, "log_in")
        assert await login(made, "wrong" * 10) == 401
        assert (await ask(made, "/api/session"))[2]["may_change"] is False
        assert await login(made) == 204
        assert (await ask(made, "/api/session"))[2]["may_change"] is True
        status, said = await wish(made, {"mac": mac(50), "name": "Lamp <b>by</b> the window"})
        assert status == 200
        assert made.registry.get(mac(50)).name == "Lamp <b>by</b> the window"
        status, said = await wish(made, {"mac": mac(50), "ignore": True})
        assert [d["mac"] for d in said["ignored"]] == [mac(50)]
        assert not made.registry.knows(mac(50))
        assert [d["mac"] for d in (await ask(made, "/api/ignored"))[2]["ignored"]] == [mac(50)]
        assert (await wish(made, {"mac": mac(50), "ignore": False}))[0] == 200
        assert made.registry.knows(mac(50))
        assert (await wish(made, {"mac": mac(50), "forget": True}))[0] == 200
        assert not made.registry.knows(mac(50))
        for wrong in ({"mac": mac(99), "forget": True}, {"mac": "x"}, {"mac": mac(50), "nane": "x"}, [], "x"):
            status, said = await wish(made, wrong)
            assert (status, said["code"]) == (400, "bad_wish"), wrong
        assert (await ask(made, "/api/logout", method="POST", json={}))[0] == 204
        assert (await wish(made, {"mac": mac(50), "name": "x"}))[0] == 401


async def test_the_cookie_is_for_this_page_alone_and_ends_with_the_token(serving: Serving) -> None:
    async with serving() as made:
        async with made.http.post(made.url + "/api/login", json={"token": made.token}) as answer:
            cookie = answer.headers["Set-Cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=Strict" in cookie
        assert "Path" not in cookie, "the browser takes the folder, behind a proxy's prefix, too"
        assert "Secure" not in cookie
        assert made.token not in cookie
        forwarded = {"X-Forwarded-Proto": "https"}
        async with made.http.post(
            made.url + "/api/login", json={"token": made.token}, headers=forwarded
        ) as answer:
            assert "; Secure" in answer.headers["Set-Cookie"]
        session = {"Cookie": cookie.partition(";")[0]}
        made.http.cookie_jar.clear()
        assert (await ask(made, "/api/session", headers=session))[2]["may_change"] is True
        write_token(made.folder / "token")
        assert (await ask(made, "/api/session", headers=session))[2]["may_change"] is False
        (made.folder / "token").unlink()
        status, _, said = await ask(made, "/api/session", headers=session)
        assert (status, said["code"]) == (503, "no_token")


async def test_a_program_gives_the_token_in_a_header(serving: Serving) -> None:
    async with serving() as made:
        await made.registry.joined(mac(50), "lamp")
        for given, expected in ((made.token, 200), (made.token[:-1], 401), ("", 401), ("\udcff", 401)):
            bearer = {"Authorization": f"Bearer {given}"}
            try:
                status, _ = await wish(made, {"mac": mac(50), "name": "Lamp"}, headers=bearer)
            except UnicodeEncodeError:
                continue  # no client sends it
            assert status == expected


async def test_a_form_of_another_site_cannot_be_a_wish(serving: Serving) -> None:
    async with serving() as made:
        await made.registry.joined(mac(50), "lamp")
        await login(made)
        for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data"):
            text = json.dumps({"mac": mac(50), "forget": True})
            status, _, said = await ask(
                made, "/api/wish", method="POST", data=text, headers={"Content-Type": kind}
            )
            assert (status, said["code"]) == (415, "not_json")
        assert made.registry.knows(mac(50))


async def test_guessing_tokens_is_stopped(serving: Serving) -> None:
    async with serving() as made:
        assert [await login(made, f"{i}" * 40) for i in range(TRIES)] == [401] * TRIES
        assert await login(made, "another" * 8) == 429
        status, headers, said = await ask(made, "/api/login", method="POST", json={"token": made.token})
        assert status == 429, "the right one, too: who guesses learns nothing"
        assert int(headers["Retry-After"]) > 0
        assert "Try again in" in said["text"]


async def test_large_and_broken_requests_are_refused(serving: Serving) -> None:
    async with serving() as made:
        await login(made)
        status, said = await wish(made, {"mac": mac(50), "name": "x" * MAX_BODY})
        assert status == 413
        status, _, said = await ask(made, "/api/login", method="POST", json=[])
        assert (status, said["code"]) == (400, "bad_request")
        reader, writer = await asyncio.open_connection("127.0.0.1", made.page.port)
        writer.write(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 20_000 + b"\r\n\r\n")
        assert b" 400 " in await asyncio.wait_for(reader.readline(), 40)
        writer.close()
        assert (await ask(made, "/"))[0] == 200


async def test_connections_beyond_the_limit_are_closed_at_once(serving: Serving) -> None:
    async with serving() as made:
        pairs = [
            await asyncio.open_connection("127.0.0.1", made.page.port) for _ in range(MAX_CONNECTIONS + 5)
        ]
        (reader, _) = pairs[-1]
        with pytest.raises((ConnectionResetError, asyncio.IncompleteReadError)):
            await asyncio.wait_for(reader.readexactly(1), 40)
        assert made.page.health.counters["connections_refused"] >= 5
        for _, writer in pairs:
            writer.close()
        for _, writer in pairs:
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()


def decoded(png: bytes) -> np.ndarray[Any, Any]:
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return picture


async def test_the_plan_comes_in_both_themes_with_clear_where_nothing_is_known(serving: Serving) -> None:
    async with serving() as made:
        light, dark = [decoded((await ask(made, f"/api/plan/{t}.png"))[2]) for t in ("light", "dark")]
        cells = PLAN.cells[::-1]
        for picture in (light, dark):
            assert picture.shape == (*cells.shape, 4)
            assert ((picture[..., 3] == 255) == (cells != -1)).all()
            assert len(np.unique(picture[cells == 100], axis=0)) == 1
        assert light[cells == 0].min() > 240, "white floor"
        assert light[cells == 100][:, :3].max() < 120, "dark walls"
        assert dark[cells == 0][:, :3].max() < 80, "dark floor"
        assert (await ask(made, "/api/plan/other.png"))[0] == 404


async def test_a_heatmap_comes_as_a_picture(serving: Serving) -> None:
    async with serving() as made:
        picture = decoded((await ask(made, f"/api/heatmap/{mac(0)}.png"))[2])
        assert picture.shape[2] == 4
        assert picture[..., 3].max() == 255
        for path in (f"/api/heatmap/{mac(1)}.png", "/api/heatmap/x.png", "/api/heatmap/..%2f.png"):
            assert (await ask(made, path))[0] == 404
        made.bus.forget_device(mac(0))
        assert (await ask(made, f"/api/heatmap/{mac(0)}.png"))[0] == 404


async def test_a_wish_that_is_begun_is_brought_to_an_end(tmp_path: Path) -> None:
    """The browser goes, the hub ends: half of a wish would be worse than all of it."""
    begun, go_on, done = asyncio.Event(), asyncio.Event(), asyncio.Event()

    async def wish(_: bytes) -> m.WishReply:
        begun.set()
        await go_on.wait()
        done.set()
        return m.WishReply(source="simulated", text="done")

    async with world(tmp_path) as made:
        home = HomeFeed(made.bus.keys, made.bus.listen)
        access = Access(0, token=TokenFile(tmp_path / "token"))
        page = PageServer(access, "home", home, wish, lambda: None)
        running = asyncio.create_task(page.run())
        await until(lambda: page.health.state == "ok", "the page listens")
        asking = asyncio.create_task(
            made.http.post(
                f"http://127.0.0.1:{page.port}/api/wish",
                json={"mac": mac(1), "forget": True},
                headers={"Authorization": f"Bearer {made.token}"},
            )
        )
        async with asyncio.timeout(40):
            await begun.wait()
        asking.cancel()
        await asyncio.wait({asking})
        running.cancel()
        ended, _ = await asyncio.wait({running}, timeout=1.0)
        assert not ended, "it waits for what was begun"
        go_on.set()
        await asyncio.wait({running}, timeout=40)
        assert running.cancelled()
        assert done.is_set()


async def test_a_port_that_is_taken_is_told_and_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "RETRY_S", 0.02)
    port = free_port()
    other = await asyncio.start_server(lambda *_: None, "127.0.0.1", port)
    async with world(tmp_path, port=port) as made:
        task = asyncio.create_task(made.page.run())
        await until(lambda: made.page.health.state == "degraded", "it says that the port is taken")
        assert str(port) in made.page.health.detail
        other.close()
        await other.wait_closed()
        await until(lambda: made.page.health.state == "ok", "it takes the port")
        assert (await ask(made, "/"))[0] == 200
        task.cancel()
        await asyncio.wait({task})


async def test_it_listens_on_the_loopback_interface_only(serving: Serving) -> None:
    async with serving(port=free_port()) as made:
        own = "127.0.0.1"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
            probe.connect(("192.0.2.1", 9))  # nothing is sent: it only tells the address of this machine
            own = probe.getsockname()[0]
        if own.startswith("127."):
            pytest.skip("this machine has no other address")
        with pytest.raises(OSError, match=r"refused|Connect call failed"):
            await asyncio.open_connection(own, made.page.port)


async def test_devices_that_go_leave_the_page(serving: Serving) -> None:
    async with serving() as made:
        made.bus.publish_device(device(60))
        made.bus.forget_device(mac(60))
        async with made.http.get(made.url + "/api/stream") as stream:
            seen = await asyncio.wait_for(stream.content.readuntil(b'"key":"status"'), 40)
        assert mac(60).encode() not in seen
