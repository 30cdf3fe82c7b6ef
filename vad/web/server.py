"""The page's server: HTTP on the loopback interface, on the daemon's event loop."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable

import msgspec
from aiohttp import web

from vad.bus import messages as m
from vad.errors import ConfigError
from vad.health import Health
from vad.web.access import LOGIN_S, Access, Tries, cookie_holds, make_cookie, same_token
from vad.web.files import static_files
from vad.web.guard import Guard, RefusedError, add_headers
from vad.web.home import HomeFeed, Robot, Theme
from vad.web.stream import MAX_STREAMS, Streams

log = logging.getLogger(__name__)

MAX_CONNECTIONS = 64
MAX_REQUESTS = MAX_STREAMS + 16
MAX_BODY = 4096
IDLE_S = 30.0
"""A connection without a request is closed after so long."""
ROBOT_EVERY_S = 0.1
RETRY_S = 5.0
"""A port that is taken is tried again."""
END_S = 0.5
"""Answers under way may take so long when the daemon ends."""

Wish = Callable[[bytes], Awaitable[m.WishReply | m.ErrorMessage]]


class _Login(msgspec.Struct, forbid_unknown_fields=True):
    token: str


class _Session(msgspec.Struct, kw_only=True):
    """What the browser may do. login: whether there is a token to be given."""

    hub: str
    may_change: bool
    login: bool


class PageServer:
    """Serves the page until `run` is cancelled.

    home: what is shown; wish: grants DeviceWish JSON; robot: where it is, asked while somebody looks.
    """

    def __init__(
        self, access: Access, hub: str, home: HomeFeed, wish: Wish, robot: Callable[[], Robot | None]
    ) -> None:
        self.health = Health("web")
        self.port = access.port
        self.streams = Streams(home.feed, self.health)
        self._access = access
        self._hub = hub
        self._home = home
        self._wish = wish
        self._robot = robot
        self._tries = Tries()
        self._granting: set[asyncio.Task[m.WishReply | m.ErrorMessage]] = set()
        self._cookie_name = f"vad-{hub}"
        self._files = static_files()

    async def run(self) -> None:
        """Serve until cancelled."""
        silence = self._home.open()
        runner = web.AppRunner(
            self._application(),
            access_log=None,
            handle_signals=False,
            handler_cancellation=True,
            keepalive_timeout=IDLE_S,
            shutdown_timeout=END_S,
        )
        server: asyncio.Server | None = None
        try:
            await runner.setup()
            server = await self._listen(runner)
            await self._follow_robot()
        finally:
            silence()
            if server is not None:
                server.close()
            self.streams.close()
            await runner.cleanup()
            if self._granting:
                await asyncio.wait(self._granting)
            if server is not None:
                await server.wait_closed()

    def _application(self) -> web.Application:
        guard = Guard(self._access.names, self.health, most=MAX_REQUESTS)

        @web.middleware
        async def check(
            request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
        ) -> web.StreamResponse:
            return await guard.check(request, handler)

        application = web.Application(middlewares=[check], client_max_size=MAX_BODY)
        application.on_response_prepare.append(add_headers)
        application.add_routes(
            [
                web.get("/api/stream", self.streams.serve, allow_head=False),
                web.get("/api/plan/{theme:light|dark}.png", self._plan),
                web.get("/api/heatmap/{mac}.png", self._heatmap),
                web.get("/api/session", self._session),
                web.get("/api/ignored", self._ignored),
                web.post("/api/login", self._login),
                web.post("/api/logout", self._logout),
                web.post("/api/wish", self._grant),
                web.get("/{name:.*}", self._file),
            ]
        )
        return application

    async def _listen(self, runner: web.AppRunner) -> asyncio.Server:
        """Take the port; where it is taken, try again until it is free."""
        serve = runner.server
        assert serve is not None

        def connected() -> asyncio.Protocol:
            if len(serve.connections) >= MAX_CONNECTIONS:
                self.health.counters["connections_refused"] += 1
                return _TurnAway()
            return serve()

        loop, access = asyncio.get_running_loop(), self._access
        while True:
            try:
                server = await loop.create_server(connected, access.address, access.port)
                break
            except OSError as error:
                reason = f"port {access.port} cannot be used ({error.strerror}); change web.port"
                if self.health.trouble(reason):
                    log.warning("web: %s", reason)
                await asyncio.sleep(RETRY_S)
        self.port = server.sockets[0].getsockname()[1]
        host = f"[{access.address}]" if ":" in access.address else access.address
        self.health.ok(f"http://{host}:{self.port}/")
        return server

    async def _follow_robot(self) -> None:
        """Ask where the robot is, while somebody looks."""
        while True:
            await self.streams.watched.wait()
            robot = self._robot()
            if robot is not None:
                self._home.see_robot(robot)
            await asyncio.sleep(ROBOT_EVERY_S)

    async def _file(self, request: web.Request) -> web.Response:
        file = self._files.get(request.match_info["name"] or "index.html")
        if file is None:
            raise RefusedError(404, "not_found", "There is no such page.")
        headers = {"ETag": file.etag, "Cache-Control": "no-cache"}
        if request.headers.get("If-None-Match") == file.etag:
            return web.Response(status=304, headers=headers)
        return web.Response(body=file.content, content_type=file.kind, charset=file.charset, headers=headers)

    async def _plan(self, request: web.Request) -> web.Response:
        theme: Theme = "dark" if request.match_info["theme"] == "dark" else "light"
        return self._picture(await self._home.plan_png(theme))

    async def _heatmap(self, request: web.Request) -> web.Response:
        return self._picture(await self._home.heatmap_png(request.match_info["mac"]))

    @staticmethod
    def _picture(png: bytes | None) -> web.Response:
        if png is None:
            raise RefusedError(404, "not_found", "There is no such picture yet.")
        # the page asks with the number of the change, so that a new picture has a new address
        return web.Response(
            body=png, content_type="image/png", headers={"Cache-Control": "private, max-age=3600"}
        )

    async def _session(self, request: web.Request) -> web.Response:
        may = self._access.token is not None and await self._may_change(request)
        return _json(_Session(hub=self._hub, may_change=may, login=self._access.token is not None))

    async def _ignored(self, _: web.Request) -> web.Response:
        return await self._granted(m.encode(m.DeviceWish()))

    async def _login(self, request: web.Request) -> web.Response:
        body = await self._body(request)
        if wait_s := self._tries.wait_s(time.monotonic()):
            text = f"Too many wrong tokens. Try again in {wait_s + 1:.0f} s."
            raise RefusedError(429, "too_many_tries", text, {"Retry-After": f"{wait_s + 1:.0f}"})
        try:
            given = msgspec.json.decode(body, type=_Login).token
        except msgspec.DecodeError as error:
            raise RefusedError(400, "bad_request", f"Not a log-in: {error}.") from error
        token = await self._token()
        if not same_token(token, given):
            self._tries.wrong(time.monotonic())
            raise RefusedError(
                401, "wrong_token", "That is not the token; it is in the file web.token_file names."
            )
        self.health.counters["logins"] += 1
        cookie = self._cookie(make_cookie(token, time.time()), LOGIN_S)
        if request.headers.get("X-Forwarded-Proto") == "https":
            cookie += "; Secure"
        return web.Response(status=204, headers={"Set-Cookie": cookie})

    async def _logout(self, request: web.Request) -> web.Response:
        await self._body(request)
        return web.Response(status=204, headers={"Set-Cookie": self._cookie("", 0)})

    def _cookie(self, value: str, age_s: int) -> str:
        """Without a path: the browser takes this address's folder, also where a proxy puts one in front."""
        return f"{self._cookie_name}={value}; Max-Age={age_s}; HttpOnly; SameSite=Strict"

    async def _grant(self, request: web.Request) -> web.Response:
        body = await self._body(request)
        if self._access.token is None:
            text = "This page only shows. To change something here, set web.token_file in vad.yaml."
            raise RefusedError(403, "read_only", text)
        if not await self._may_change(request):
            raise RefusedError(401, "log_in", "Give the token first.")
        return await self._granted(body)

    async def _granted(self, wish: bytes) -> web.Response:
        # in a task of its own: what is begun is brought to an end, also where the browser goes
        task = asyncio.create_task(_await(self._wish(wish)), name="web: wish")
        self._granting.add(task)
        task.add_done_callback(self._granting.discard)
        reply = await asyncio.shield(task)
        if isinstance(reply, m.ErrorMessage):
            raise RefusedError(400, reply.code, reply.text)
        return _json(reply)

    async def _may_change(self, request: web.Request) -> bool:
        token = await self._token()
        kind, _, given = request.headers.get("Authorization", "").partition(" ")
        if kind.lower() == "bearer":
            return same_token(token, given)
        return cookie_holds(token, request.cookies.get(self._cookie_name, ""), time.time())

    async def _token(self) -> bytes:
        if self._access.token is None:
            raise RefusedError(403, "read_only", "There is no token to log in with; see web.token_file.")
        try:
            return await asyncio.to_thread(self._access.token.read)
        except ConfigError as error:
            raise RefusedError(503, "no_token", str(error)) from error

    @staticmethod
    async def _body(request: web.Request) -> bytes:
        """What was sent; only a script of this page, or a program, can send JSON."""
        if request.content_type != "application/json":
            raise RefusedError(415, "not_json", "Send application/json.")
        return await request.read()


class _TurnAway(asyncio.Protocol):
    """Closes the connection: there are too many."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        transport.abort()


async def _await(wish: Awaitable[m.WishReply | m.ErrorMessage]) -> m.WishReply | m.ErrorMessage:
    return await wish


def _json(message: msgspec.Struct) -> web.Response:
    return web.Response(body=msgspec.json.encode(message), content_type="application/json")
