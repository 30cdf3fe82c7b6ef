"""A headless Chromium, driven over its DevTools protocol: for the page's tests and tools/bench web."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import shutil
import signal
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import aiohttp

START_S = 90.0
ANSWER_S = 60.0
END_S = 20.0
PROGRAMS = ("chromium", "chromium-browser", "google-chrome")


def chromium() -> str | None:
    """The browser's program; None where there is none."""
    return next((found for name in PROGRAMS if (found := shutil.which(name))), None)


STANDS_STILL = """new Promise((found) => {
  let before = '';
  const look = () => {
    const node = document.querySelector(SELECTOR);
    if (!node?.checkVisibility()) before = '';
    else {
      node.scrollIntoView({block: 'nearest'});
      const box = node.getBoundingClientRect();
      const at = [box.left + box.width / 2, box.top + box.height / 2];
      if (String(at) === before && node.contains(document.elementFromPoint(...at))) return found(at);
      before = String(at);
    }
    requestAnimationFrame(look);
  };
  look();
})"""
"""The middle of a node that can be pressed there: the same in two frames, and nothing lies over it."""


class BrowserError(Exception):
    """The browser refused something, or a script in the page failed."""


class Browser:
    """One browser process with a profile of its own, gone when it is left."""

    def __init__(self) -> None:
        self._profile = tempfile.TemporaryDirectory(prefix="vad-browser-", ignore_cleanup_errors=True)
        self._process: asyncio.subprocess.Process | None = None
        self._http: aiohttp.ClientSession | None = None
        self._socket: aiohttp.ClientWebSocketResponse | None = None
        self._reading: asyncio.Task[None] | None = None
        self._draining: asyncio.Task[None] | None = None
        self._asked: dict[int, asyncio.Future[Any]] = {}
        self._listeners: dict[str, Callable[[dict[str, Any]], None]] = {}
        self._number = 0

    async def __aenter__(self) -> Self:
        program = chromium()
        if program is None:
            raise BrowserError(f"none of {', '.join(PROGRAMS)} is installed")
        arguments = [
            "--headless=new",
            "--remote-debugging-port=0",
            f"--user-data-dir={self._profile.name}",
            "--no-first-run",
            "--no-default-browser-check",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--hide-scrollbars",
            *(["--no-sandbox"] if os.geteuid() == 0 else []),  # Chromium's sandbox refuses root
            "about:blank",
        ]
        self._process = await asyncio.create_subprocess_exec(
            program,
            *arguments,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            start_new_session=True,
        )
        try:
            async with asyncio.timeout(START_S):
                address = await self._address()
            self._draining = asyncio.create_task(self._drain())
            self._http = aiohttp.ClientSession()
            self._socket = await self._http.ws_connect(address, max_msg_size=0)
            self._reading = asyncio.create_task(self._read())
        except BaseException:
            await self._end()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._end()

    async def page(
        self, width: int = 1280, height: int = 800, *, dark: bool = False, phone: bool = False
    ) -> Page:
        """A fresh tab with nothing in it, without the cookies of other tabs."""
        context = (await self.call("Target.createBrowserContext"))["browserContextId"]
        target = await self.call(
            "Target.createTarget",
            url="about:blank",
            browserContextId=context,
            width=width,
            height=height,
        )
        session = await self.call("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        page = Page(self, session["sessionId"], target["targetId"])
        self._listeners[page.session] = page.heard
        for domain in ("Page", "Runtime", "Log", "Network"):
            await page.call(f"{domain}.enable")
        await page.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=phone,
        )
        if phone:
            await page.call("Emulation.setTouchEmulationEnabled", enabled=True)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        await page.call("Emulation.setEmulatedMedia", features=[scheme])
        return page

    async def call(
        self, method: str, session: str | None = None, *, within_s: float = ANSWER_S, **parameters: Any
    ) -> Any:
        """Ask the browser; BrowserError where it refuses, TimeoutError where it does not answer."""
        assert self._socket is not None
        self._number += 1
        number = self._number
        answer = self._asked[number] = asyncio.get_running_loop().create_future()
        question: dict[str, Any] = {"id": number, "method": method, "params": parameters}
        if session is not None:
            question["sessionId"] = session
        await self._socket.send_json(question)
        try:
            async with asyncio.timeout(within_s):
                return await answer
        finally:
            del self._asked[number]

    @property
    def pid(self) -> int:
        """Of the browser's first process; it leads a process group of its own."""
        assert self._process is not None
        return self._process.pid

    async def _address(self) -> str:
        """Where the browser listens: it says so on standard error."""
        assert self._process is not None
        assert self._process.stderr is not None
        said = b""
        while line := await self._process.stderr.readline():
            said += line
            if b"DevTools listening on " in line:
                return line.decode().partition("DevTools listening on ")[2].strip()
        raise BrowserError(f"the browser does not start: {said[-500:].decode(errors='replace')}")

    async def _drain(self) -> None:
        """Take what else the browser says on standard error: into a full pipe it would wait to say it."""
        assert self._process is not None
        assert self._process.stderr is not None
        while await self._process.stderr.read(65_536):
            pass

    async def _read(self) -> None:
        assert self._socket is not None
        async for message in self._socket:
            said = json.loads(message.data)
            if "id" in said:
                answer = self._asked.get(said["id"])
                if answer is None or answer.done():
                    continue
                if "error" in said:
                    answer.set_exception(BrowserError(said["error"]["message"]))
                else:
                    answer.set_result(said["result"])
            elif (listener := self._listeners.get(said.get("sessionId", ""))) is not None:
                listener(said)

    async def _end(self) -> None:
        if self._socket is not None:
            await self._socket.close()
        for task in (self._reading, self._draining):
            if task is not None:
                task.cancel()
                await asyncio.wait({task})
        if self._http is not None:
            await self._http.close()
        if self._process is not None:
            for number in (signal.SIGTERM, signal.SIGKILL):
                if self._process.returncode is None:
                    os.killpg(self._process.pid, number)
                try:
                    async with asyncio.timeout(END_S):
                        await self._process.communicate()
                    break
                except TimeoutError:
                    continue
        self._profile.cleanup()


class Page:
    """One tab. problems: what the browser complained of (scripts, refused content, the content policy)."""

    def __init__(self, browser: Browser, session: str, target: str) -> None:
        self.session = session
        self.problems: list[str] = []
        self.requests: list[str] = []
        self._browser = browser
        self._target = target
        self._documents: set[str] = set()  # by what loaded them
        self._loading: set[str] = set()  # requests under way, but for a stream, which never ends
        self._heard = asyncio.Event()

    def heard(self, said: dict[str, Any]) -> None:
        """Something happened in the tab."""
        method, told = said["method"], said["params"]
        self._heard.set()
        if method == "Runtime.exceptionThrown":
            details = told["exceptionDetails"]
            self.problems.append(details.get("exception", {}).get("description", details["text"]))
        elif method == "Log.entryAdded" and told["entry"]["level"] in ("error", "warning"):
            self.problems.append(f"{told['entry']['text']} {told['entry'].get('url', '')}")
        elif method == "Runtime.consoleAPICalled" and told["type"] in ("error", "warning", "assert"):
            self.problems.append(str([a.get("value", a.get("description")) for a in told["args"]]))
        elif method == "Network.requestWillBeSent":
            self.requests.append(told["request"]["url"])
            if told.get("type") != "EventSource":
                self._loading.add(told["requestId"])
        elif method in ("Network.loadingFinished", "Network.loadingFailed"):
            self._loading.discard(told["requestId"])
        elif method == "Page.frameNavigated":
            self._documents.add(told["frame"]["loaderId"])

    async def call(self, method: str, **parameters: Any) -> Any:
        """Ask this tab."""
        return await self._browser.call(method, self.session, **parameters)

    async def go(self, url: str) -> None:
        """Load an address; the page is asked from now on, no longer the one before it."""
        self._loading.clear()
        answer = await self.call("Page.navigate", url=url)
        if "errorText" in answer:
            raise BrowserError(f"{url}: {answer['errorText']}")
        if "loaderId" in answer:  # else it is the same document, elsewhere
            await self._hears(lambda: answer["loaderId"] in self._documents, f"{url} does not appear")

    async def _hears(self, condition: Callable[[], object], trouble: str) -> None:
        """Wait for what the browser tells."""
        try:
            async with asyncio.timeout(ANSWER_S):
                while not condition():
                    self._heard.clear()
                    await self._heard.wait()
        except TimeoutError:
            raise BrowserError(f"not in {ANSWER_S:.0f} s: {trouble}; problems: {self.problems}") from None

    async def value(self, script: str, *, within_s: float = ANSWER_S) -> Any:
        """What an expression, or a promise, comes to in the page."""
        answer = await self.call(
            "Runtime.evaluate",
            within_s=within_s,
            expression=script,
            awaitPromise=True,
            returnByValue=True,
            userGesture=True,
        )
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            raise BrowserError(details.get("exception", {}).get("description", details["text"]))
        return answer["result"].get("value")

    async def until(self, script: str, timeout_s: float = ANSWER_S) -> Any:
        """The expression's value as soon as it is true, looked at in every frame of the page."""
        waiting = (
            "new Promise((found) => { const look = () => { let value = null; "
            f"try {{ value = ({script}); }} catch {{ /* not there yet */ }} "
            "if (value) found(value); else setTimeout(look, 20); }; look(); })"
        )
        try:
            return await self.value(waiting, within_s=timeout_s)
        except TimeoutError:
            raise BrowserError(f"not in {timeout_s:.0f} s: {script}; problems: {self.problems}") from None

    async def click(self, selector: str) -> None:
        """Press the pointer in the middle of what the CSS selector finds, once it is there to be pressed."""
        await self._hears(lambda: not self._loading, f"all that it asked for: {sorted(self._loading)}")
        try:
            x, y = await self.value(STANDS_STILL.replace("SELECTOR", json.dumps(selector)))
        except TimeoutError:
            raise BrowserError(f"cannot be pressed: {selector}; problems: {self.problems}") from None
        for kind in ("mousePressed", "mouseReleased"):
            await self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    async def key(self, key: str, *, text: str = "") -> None:
        """Press a key, e.g. `Tab`, `ArrowDown`, `Enter`."""
        codes = {
            "Tab": 9,
            "Enter": 13,
            "Escape": 27,
            "End": 35,
            "ArrowUp": 38,
            "ArrowRight": 39,
            "ArrowDown": 40,
        }
        typed = text or ("\r" if key == "Enter" else "")
        code = {"windowsVirtualKeyCode": codes[key]} if key in codes else {}
        await self.call("Input.dispatchKeyEvent", type="keyDown", key=key, code=key, text=typed, **code)
        await self.call("Input.dispatchKeyEvent", type="keyUp", key=key, code=key, **code)

    async def type(self, text: str) -> None:
        """Type text where the focus is."""
        await self.call("Input.insertText", text=text)

    async def picture(self, path: Path) -> None:
        """Write what the tab shows as PNG."""
        shot = await self.call("Page.captureScreenshot", format="png", captureBeyondViewport=False)
        path.write_bytes(base64.b64decode(shot["data"]))  # noqa: ASYNC240 - a tool: nothing else runs meanwhile

    async def close(self) -> None:
        """Close the tab."""
        await self._browser.call("Target.closeTarget", targetId=self._target)
