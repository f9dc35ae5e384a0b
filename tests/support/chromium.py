"""A real headless Chromium, driven over its own DevTools protocol."""

import asyncio
import base64
import contextlib
import itertools
import json
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import Any

import httpx
import pytest
import websockets

from installed_program import installed_program

BINARIES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-features=SpareRendererForSitePerProcess",  # a process more for every page
    "--no-first-run",
    "--remote-debugging-port=0",
    "about:blank",
)
STARTING = 180.0  # s; a loaded machine takes its time
WAITING = 180.0  # s; for anything that should be seen


class Navigated(Exception):
    """The page was left while it was asked something."""


class Page:
    """One tab; everything that it writes to its console as a warning or error is kept."""

    def __init__(self, socket: websockets.ClientConnection) -> None:
        self.complaints: list[str] = []
        self._socket = socket
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._listening = asyncio.create_task(self._listen())

    async def close(self) -> None:
        """Leave it."""
        await self._socket.close()
        await asyncio.gather(self._listening, return_exceptions=True)

    async def call(self, method: str, **params: Any) -> dict[str, Any]:
        """One command of the DevTools protocol."""
        number = next(self._numbers)
        answer = self._waiting[number] = asyncio.get_running_loop().create_future()
        await self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        async with asyncio.timeout(WAITING):
            said = await answer
        if "navigated" in said.get("error", {}).get("message", ""):
            raise Navigated
        assert "error" not in said, f"{method}: {said['error']}"
        return dict(said["result"])

    async def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression; promises are waited for."""
        said = await self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in said, said["exceptionDetails"]
        return said["result"].get("value")

    async def until(self, expression: str, accepts: Callable[[Any], bool] = bool) -> Any:
        """The value of an expression as soon as it is accepted."""
        value = None
        try:
            async with asyncio.timeout(WAITING):
                while True:
                    with contextlib.suppress(Navigated):
                        if accepts(value := await self.evaluate(expression)):
                            break
                    await asyncio.sleep(0.05)
        except TimeoutError:
            pytest.fail(f"{expression} stayed {value!r}; the page complains of {self.complaints}")
        return value

    async def show(
        self, url: str, *, width: int = 1280, height: int = 800, is_phone: bool = False
    ) -> None:
        """Go to a URL with a screen of a size, that of a phone or a desktop."""
        for domain in ("Page", "Runtime", "Log"):
            await self.call(f"{domain}.enable")
        await self.fit(width, height, is_phone=is_phone)
        await self.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=10)
        # Another fragment alone would not load the page anew.
        await self.call("Page.navigate", url="about:blank")
        await self.call("Page.navigate", url=url)
        await self.until("location.protocol !== 'about:' && document.readyState === 'complete'")

    async def fit(self, width: int, height: int, *, is_phone: bool = False) -> None:
        """Take a screen of a size, in CSS pixels."""
        await self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=2 if is_phone else 1,
            mobile=is_phone,
        )

    async def dark(self, is_dark: bool) -> None:
        """Prefer dark or light colours."""
        scheme = {"name": "prefers-color-scheme", "value": "dark" if is_dark else "light"}
        await self.call("Emulation.setEmulatedMedia", features=[scheme])

    async def touch(self, kind: str, points: Sequence[tuple[float, float]]) -> None:
        """Real touches: touchStart, touchMove, touchEnd (no points) at x, y in CSS pixels."""
        fingers = [{"x": x, "y": y, "id": id} for id, (x, y) in enumerate(points)]
        await self.call("Input.dispatchTouchEvent", type=kind, touchPoints=fingers)

    async def mouse(
        self, kind: str, x: float, y: float, *, button: str = "left", shift: bool = False
    ) -> None:
        """Real mouse events: mousePressed, mouseMoved, mouseReleased; shift: with that key."""
        place = {"x": x, "y": y, "button": button, "clickCount": 1}
        await self.call("Input.dispatchMouseEvent", type=kind, modifiers=8 * shift, **place)

    async def press(self, key: str, code: str | None = None) -> None:
        """A key, down and up."""
        for kind in ("keyDown", "keyUp"):
            await self.call("Input.dispatchKeyEvent", type=kind, key=key, code=code or key)

    async def click(self, selector: str) -> None:
        """Click an element as a mouse would, once it is enabled, uncovered and has stopped moving.

        What is disabled would take the click without a word; what moves would miss it.
        """
        place = await self.until(
            f"(async () => {{ const e = document.querySelector({json.dumps(selector)});"
            "if (!e || e.matches(':disabled')) return null;"
            "e.scrollIntoView({block: 'nearest'});"
            "const middle = () => { const b = e.getBoundingClientRect();"
            " return [b.x + b.width / 2, b.y + b.height / 2]; };"
            "const frame = () => new Promise(requestAnimationFrame);"
            "const before = middle(); await frame(); await frame(); const [x, y] = middle();"
            "const isStill = x === before[0] && y === before[1];"
            "return isStill && e.contains(document.elementFromPoint(x, y)) ? [x, y] : null; })()"
        )
        await self.mouse("mousePressed", *place)
        await self.mouse("mouseReleased", *place)

    async def screenshot(self, path: Path) -> None:
        """What is to be seen, as a PNG file."""
        said = await self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(said["data"]))  # noqa: ASYNC240 (nothing else waits)

    async def _listen(self) -> None:
        with contextlib.suppress(websockets.ConnectionClosed):
            async for line in self._socket:
                said = json.loads(line)
                if "id" in said:
                    answer = self._waiting.pop(said["id"])
                    if not answer.done():
                        answer.set_result(said)
                elif said["method"] == "Log.entryAdded":
                    entry = said["params"]["entry"]
                    if entry["level"] in ("warning", "error"):
                        self.complaints.append(f"{entry['text']} {entry.get('url', '')}")
                elif said["method"] == "Runtime.exceptionThrown":
                    self.complaints.append(str(said["params"]["exceptionDetails"]))


class Browser:
    """A running Chromium that opens tabs."""

    def __init__(self, port: int) -> None:
        self._port = port

    @contextlib.asynccontextmanager
    async def open_page(self) -> AsyncIterator[Page]:
        """Open a tab of its own, closed at the end.

        Chromium 156 delivers no emulated touch to a tab that was navigated after two fingers had
        touched it, so each test gets a fresh one.
        """
        async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{self._port}/json") as client:
            tab = (await client.put("/new?about:blank")).json()
            url = tab["webSocketDebuggerUrl"]
            async with websockets.connect(url, max_size=None, compression=None) as socket:
                page = Page(socket)
                try:
                    yield page
                finally:
                    await page.close()
            await client.get(f"/close/{tab['id']}")


@contextlib.asynccontextmanager
async def open_browser(profile: Path) -> AsyncIterator[Browser]:
    """Start a browser; profile: an empty folder."""
    process = await asyncio.create_subprocess_exec(
        *(installed_program(*BINARIES, package="chromium"), f"--user-data-dir={profile}", *FLAGS),
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.DEVNULL,
    )
    try:
        async with asyncio.timeout(STARTING):
            port_file = profile / "DevToolsActivePort"
            # A file that another process writes sets no event.
            while not (port_file.exists() and len(port_file.read_text().splitlines()) == 2):  # noqa: ASYNC110
                await asyncio.sleep(0.05)
        yield Browser(int(port_file.read_text().splitlines()[0]))
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()
