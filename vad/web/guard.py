"""What every request must be before it is looked at, and what every answer says to the browser."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from urllib.parse import urlsplit

from aiohttp import web

from vad.bus.messages import ErrorMessage, encode
from vad.health import Health

ITS_NAMES = frozenset({"localhost", "127.0.0.1", "[::1]"})

HEADERS = {
    "Content-Security-Policy": "; ".join(
        (
            "default-src 'none'",
            "script-src 'self'",
            "style-src 'self'",
            "img-src 'self'",
            "connect-src 'self'",
            "manifest-src 'self'",
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'self'",  # Home Assistant's ingress shows it in a frame of its own origin
            "require-trusted-types-for 'script'",
            "trusted-types 'none'",
        )
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=(), payment=(), usb=()",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Server": "vad",
}

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class RefusedError(Exception):
    """A request that is not done: status, a code for programs, a sentence for people."""

    def __init__(self, status: int, code: str, text: str, headers: dict[str, str] | None = None) -> None:
        self.status, self.code, self.text, self.headers = status, code, text, headers or {}
        super().__init__(text)

    def response(self) -> web.Response:
        """The refusal as an answer."""
        body = encode(ErrorMessage(code=self.code, text=self.text))
        return web.Response(
            body=body, status=self.status, content_type="application/json", headers=self.headers
        )


def host_of(netloc: str) -> str:
    """The host of `host:port`, in small letters."""
    host, colon, port = netloc.rpartition(":")
    return (host if colon and port.isdigit() else netloc).lower()


class Guard:
    """Middleware: refuses what no browser that shows this page would send; counts what it refused."""

    def __init__(self, names: Sequence[str], health: Health, *, most: int) -> None:
        self._named = frozenset(names)
        self._health = health
        self._most = most
        self._now = 0

    async def check(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """The answer of `handler`, or a refusal."""
        try:
            self._check_host(request)
            self._check_origin(request)
            return await self._admitted(request, handler)
        except RefusedError as refusal:
            self._health.counters[f"refused_{refusal.code}"] += 1
            return refusal.response()
        except web.HTTPException as error:
            if error.status < 400:
                raise
            self._health.counters[f"refused_{error.status}"] += 1
            return RefusedError(error.status, "bad_request", f"{error.reason}.").response()

    async def _admitted(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        if self._now >= self._most:
            text = "The page answers too many questions at once; try again in a second."
            raise RefusedError(503, "busy", text, {"Retry-After": "1"})
        self._now += 1
        self._health.counters["requests"] += 1
        try:
            return await handler(request)
        finally:
            self._now -= 1

    def _check_host(self, request: web.Request) -> None:
        """A site of elsewhere that has its own name point here (DNS rebinding) gives itself away by it."""
        if host_of(request.headers.get("Host", "")) not in ITS_NAMES | self._named:
            raise RefusedError(
                421,
                "host",
                "This page is called localhost or 127.0.0.1. The name that a reverse proxy gives it goes "
                "into web.names of vad.yaml.",
            )

    def _check_origin(self, request: web.Request) -> None:
        """Scripts of other sites get nothing and change nothing; plain programs send neither header."""
        site = request.headers.get("Sec-Fetch-Site")
        reads_page = request.method in ("GET", "HEAD") and not request.path.startswith("/api/")
        if site is not None:
            foreign = site not in ("same-origin", "none") and not reads_page
        else:
            origin = request.headers.get("Origin")
            netloc = urlsplit(origin).netloc if origin else None
            foreign = origin is not None and (
                netloc != request.headers.get("Host") and host_of(netloc or "") not in self._named
            )
        if foreign:
            raise RefusedError(403, "origin", "Another site may not ask this page for anything.")


async def add_headers(_: web.Request, response: web.StreamResponse) -> None:
    """What the browser is to keep to, on every answer."""
    response.headers.update(HEADERS)
    response.headers.setdefault("Cache-Control", "no-store")
