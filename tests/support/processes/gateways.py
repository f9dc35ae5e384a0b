"""The gateway as a process, with a scripted or a real daemon, raw clients and a real browser.

The browser is a headless Chromium, driven over its own DevTools protocol. All of it blocks: the
test is one thread, the scripted daemon another, the gateway a process.
"""

import asyncio
import base64
import contextlib
import itertools
import json
import os
import re
import socket
import subprocess
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import httpx
import pytest
import websockets
from websockets.client import ClientProtocol
from websockets.frames import Frame, Opcode
from websockets.http11 import Response
from websockets.protocol import Event
from websockets.typing import Subprotocol
from websockets.uri import parse_uri

from controller.api.client import Client
from controller.api.hub import Hub
from controller.api.jsonrpc import ErrorCode, NotSilent, RpcError
from controller.api.methods import (
    METHODS,
    ArmResult,
    EffectsResult,
    HelloParams,
    HelloResult,
    StateEvent,
    StatusResult,
    StopResult,
    SubscribeParams,
)
from controller.api.schema import (
    API_VERSION,
    AmplifierSilence,
    ApiMessage,
    EffectDescription,
    EraPosition,
    LatencySummary,
    RigSummary,
    TableSummary,
    Topic,
)
from controller.api.server import ApiServer, Connection
from kit.api_parameters import API_RESULTS
from kit.plates import write_rig
from model.rig.rig_file import parse_rig
from model.table.table import LocalizationTable
from model.table.table_file import save_table
from processes.daemons import PATIENCE, daemon_table, write_daemon
from processes.installed import ERA, installed_program
from processes.patient_daemon import RESTING

T = TypeVar("T")
TOKEN = "a-token-of-these-tests-only"
_KEY = "dGhlIHNhbXBsZSBub25jZQ=="  # of RFC 6455


class ScriptedDaemon:
    """The daemon's API in a thread of its own; its methods only record their calls."""

    def __init__(self, folder: Path) -> None:
        self.socket = folder / "era.sock"
        self.calls: list[tuple[str, ApiMessage]] = []
        self.callers: list[Connection] = []  # one per call
        self.silence: dict[str, AmplifierSilence] = {}  # after a stop that is not confirmed
        self._rig_text = write_rig(folder / "rig.yaml").read_text(encoding="utf-8")
        self._loop = asyncio.new_event_loop()
        self._serving = threading.Event()
        self._finished = asyncio.Event()
        self._may_arm = asyncio.Event()
        self._may_arm.set()
        self._thread = threading.Thread(target=self._loop.run_until_complete, args=(self._serve(),))

    def __enter__(self) -> "ScriptedDaemon":
        self._thread.start()
        assert self._serving.wait(PATIENCE)
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._finished.set)
        self._thread.join()
        self._loop.close()
        self.socket.unlink()

    def publish(self, topic: Topic, event: ApiMessage) -> None:
        """Send an event to all subscribers."""
        self._loop.call_soon_threadsafe(self._hub.publish, topic, lambda: event)

    @contextmanager
    def holding(self) -> Iterator[None]:
        """Within it `arm` stays pending."""
        self._loop.call_soon_threadsafe(self._may_arm.clear)
        try:
            yield
        finally:
            self._loop.call_soon_threadsafe(self._may_arm.set)

    @property
    def methods(self) -> list[str]:
        """The methods called."""
        return [method for method, _ in self.calls]

    async def _serve(self) -> None:
        self._hub = Hub(
            {"state": _ready, "amplifiers": lambda: None, "latency": lambda: None},
            clock=time.monotonic,
        )
        server = ApiServer(
            {name: self._handler(name) for name in METHODS},
            on_disconnect=self._hub.forget,
            holds_lease=lambda client: False,
        )
        bound = socket.socket(socket.AF_UNIX)
        bound.bind(str(self.socket))
        await server.open(bound)
        self._serving.set()
        await self._finished.wait()
        self._may_arm.set()
        self._hub.close()
        await server.close()

    def _handler(self, name: str) -> Callable[[Connection, ApiMessage], object]:
        def handle(client: Connection, params: ApiMessage) -> object:
            if name == "subscribe" and isinstance(params, SubscribeParams):
                self._hub.subscribe(client, params.topics)
            if name not in ("hello", "subscribe"):  # called by the gateway itself
                self.calls.append((name, params))
                self.callers.append(client)
            if isinstance(params, HelloParams):
                client.name = params.client
            return self._arm() if name == "arm" else self._result(name)

        return handle

    async def _arm(self) -> ApiMessage:
        await self._may_arm.wait()
        return ArmResult(lease="a-lease", lease_s=5.0)

    def _result(self, name: str) -> ApiMessage:
        match name:
            case "hello":
                return self._hello()
            case "effects":
                tap = EffectDescription(name="tap", kind="click", description="", parameters={})
                return EffectsResult(effects=[tap])
            case "play":
                raise RpcError(ErrorCode.REFUSED, "there is no such effect", remedy="see effects")
            case "status":
                return _status()
            case "stop" if self.silence:
                raise NotSilent(self.silence)
            case "stop":
                return StopResult(epoch=1)
            case _:
                return METHODS[name].result.model_validate(API_RESULTS.get(name, {}))

    def _hello(self) -> HelloResult:
        rig = parse_rig("rig.yaml", self._rig_text)
        return HelloResult(
            api_version=API_VERSION,
            software_version="1",
            rig=RigSummary(
                length_m=rig.plate.length,
                width_m=rig.plate.width,
                eras=[
                    EraPosition(
                        name=era.name, x_m=era.x, y_m=era.y, amplifier="main", channel=number
                    )
                    for number, era in enumerate(rig.eras)
                ],
                simulated=True,
                frequency_hz=[rig.limits.frequency_min, rig.limits.frequency_max],
            ),
            table=TableSummary(
                fingerprint="0", mode="switched", frequencies_hz=[110.0], cells_x=4, cells_y=3
            ),
            rig_text=self._rig_text,
            layout=None,
        )


def _ready() -> StateEvent:
    return StateEvent(
        old="READY_TO_SWITCH_ON",
        new="READY_TO_SWITCH_ON",
        cause="it is a script",
        remedy=None,
        epoch=0,
    )


def _status() -> StatusResult:
    return StatusResult(
        time_s=1.0,
        unix_time_s=1.0,
        state="READY_TO_SWITCH_ON",
        cause="it is a script",
        remedy=None,
        epoch=0,
        assume_energised=False,
        lost_for_s=None,
        watchdog_s=0.25,
        armed_by=None,
        lease_left_s=None,
        contacts=[],
        drive={},
        predicted_contrast_db=None,
        predicted_level_db_sl=None,
        amplifiers=[],
        latency_ms=LatencySummary(count=0, median=None, p99=None, p999=None, histogram=[(1.0, 0)]),
        rejected_touches={},
        uptime_s=1.0,
    )


@dataclass
class GatewayProcess:
    """A running gateway."""

    process: "subprocess.Popen[str]"
    url: str
    errors: Path
    token: str

    @property
    def host(self) -> str:
        """Host and port, as in the Host header."""
        return self.url.partition("://")[2].partition("/")[0]

    @property
    def port(self) -> int:
        """The port it listens on."""
        return int(self.host.rpartition(":")[2])

    def connect(self, timeout: float = PATIENCE) -> socket.socket:
        """A TCP connection."""
        name = self.host.rpartition(":")[0].strip("[]")
        return socket.create_connection((name, self.port), timeout=timeout)

    def log(self) -> str:
        """Its standard error so far."""
        return self.errors.read_text(encoding="utf-8")

    def terminate(self) -> int:
        """Send SIGTERM; its exit status."""
        self.process.terminate()
        return self.process.wait(PATIENCE)


@contextmanager
def gateway_process(
    folder: Path,
    daemon: Path,
    *options: str,
    token: str | None = TOKEN,
    program: Sequence[str | Path] = (ERA,),
) -> Iterator[GatewayProcess]:
    """`era gateway` on a free port of the loopback.

    token: None for a random one; program: the command before `gateway`.
    """
    if token is not None:
        file = folder / "token"
        file.write_text(token, encoding="ascii")
        file.chmod(0o600)
        options = (*options, "--token-file", str(file))
    if "--listen" not in options:
        options = (*options, "--listen", "127.0.0.1:0")
    errors = folder / "gateway.log"
    with (
        errors.open("w", encoding="utf-8") as stderr,
        subprocess.Popen(
            [*program, "gateway", "--socket", str(daemon), *options],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
        ) as process,
    ):
        try:
            line = process.stdout.readline()
            assert line.startswith("dashboard: "), errors.read_text()
            url, _, own_token = line.split()[1].partition("#token=")
            yield GatewayProcess(process, url, errors, token or own_token)
        finally:
            process.kill()


def wait_for_daemon(gateway: GatewayProcess) -> None:
    """Wait until the gateway is connected to its daemon."""
    wait_for(lambda: http(gateway, "/api/v1/hello", body=b'{"client": "test"}').status == 200)


@contextmanager
def real_daemon(
    folder: Path,
    more: str = "",
    *,
    table: LocalizationTable | None = None,
) -> Iterator[Path]:
    """The socket of a patient `era daemon` with a simulated amplifier.

    more: further lines of its file; table: by default small.
    """
    save_table(table or daemon_table(), folder / "table.npz")
    config = write_daemon(folder, {}, f"table: table.npz\n{more}")
    daemon_socket = folder / "era.sock"
    with (
        (folder / "daemon.log").open("a", encoding="utf-8") as log,
        subprocess.Popen(
            [*RESTING, "daemon", str(config)],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
        ) as process,
    ):
        try:
            with contextlib.suppress(PermissionError):  # as the daemon's systemd unit does
                os.setpriority(os.PRIO_PROCESS, process.pid, -10)
            wait_for(lambda: daemon_socket.is_socket() or process.poll() is not None)
            assert process.poll() is None, (folder / "daemon.log").read_text()
            yield daemon_socket
        finally:
            process.terminate()
            try:
                process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                process.kill()


def wait_for(condition: Callable[[], T], *, timeout: float = PATIENCE) -> T:
    """Wait until a condition holds, and return what it is then; fails after a timeout [s]."""
    end = time.monotonic() + timeout
    while not (result := condition()):
        assert time.monotonic() < end, "timeout"
        time.sleep(0.01)
    return result


def wait_for_state(era: Client, *states: str) -> str:
    """Wait until the daemon is in one of these states, and return it."""
    end = time.monotonic() + PATIENCE
    while (status := era.status()).state not in states:
        assert time.monotonic() < end, f"the daemon stays in {status.state}: {status.cause}"
        time.sleep(0.01)
    return status.state


ARM = b'{"owner": "me", "lease_s": 5}'


@dataclass(frozen=True)
class HttpResponse:
    """A response over HTTP; status 0 if the connection was closed without one."""

    status: int
    headers: str
    body: bytes


def http(
    gateway: GatewayProcess,
    target: str = "/api/v1/arm",
    *,
    method: str = "POST",
    body: bytes = ARM,
    host: Sequence[str] | None = None,
    token: Sequence[str] | None = None,
    media: str | None = "application/json",
    more: Sequence[str] = (),
    length: int | None = None,
    timeout: float = PATIENCE,
) -> HttpResponse:
    """Send a request that would be granted but for the given changes."""
    lines = [f"{method} {target} HTTP/1.1", "Connection: close"]
    lines += [f"Host: {value}" for value in ([gateway.host] if host is None else host)]
    lines += [f"Authorization: Bearer {value}" for value in ([TOKEN] if token is None else token)]
    lines += [] if media is None else [f"Content-Type: {media}"]
    lines += [*more, f"Content-Length: {len(body) if length is None else length}"]
    head = "\r\n".join(lines).encode("latin-1")
    return raw(gateway, head + b"\r\n\r\n" + body, timeout=timeout)


def raw(gateway: GatewayProcess, data: bytes, *, timeout: float = PATIENCE) -> HttpResponse:
    """Send bytes; return the first response, or what comes until the gateway closes."""
    with gateway.connect(timeout) as connection:
        received = b""
        # It may close before it has received everything.
        with contextlib.suppress(ConnectionError):
            connection.sendall(data)
        with contextlib.suppress(ConnectionError):
            while not _has_body(received):
                part = connection.recv(1 << 16)
                if not part:
                    break
                received += part
    head, _, body = received.partition(b"\r\n\r\n")
    status = head[9:12]
    return HttpResponse(int(status) if status.isdigit() else 0, head.decode("latin-1"), body)


def _has_body(received: bytes) -> bool:
    """Return whether bytes are a response that states its length and has it."""
    head, _, body = received.partition(b"\r\n\r\n")
    stated = re.search(rb"\r\nContent-Length: (\d+)", head)
    return stated is not None and len(body) >= int(stated[1])


def upgrade(
    gateway: GatewayProcess,
    *,
    target: str = "/api/v1/ws",
    host: str | None = None,
    origin: str | None = None,
    protocols: Sequence[str] = ("era-haptics.v1", f"era-haptics.token.{TOKEN}"),
    more: Sequence[str] = (),
) -> bytes:
    """The handshake request of a WebSocket."""
    lines = [f"GET {target} HTTP/1.1", f"Host: {host or gateway.host}", "Upgrade: websocket"]
    lines += ["Connection: Upgrade", "Sec-WebSocket-Version: 13"]
    lines += [f"Sec-WebSocket-Key: {_KEY}"]
    lines += [f"Sec-WebSocket-Protocol: {', '.join(protocols)}"] if protocols else []
    lines += [] if origin is None else [f"Origin: {origin}"]
    return "\r\n".join([*lines, *more, "", ""]).encode()


class RawWebSocket:
    """A WebSocket client that sends any frames, and leaves what it receives as it is.

    hello: the first frame, the daemon's response to the gateway's hello.
    """

    def __init__(self, gateway: GatewayProcess, *, target: str = "/api/v1/ws") -> None:
        self.connection = gateway.connect()
        self._protocol = ClientProtocol(
            parse_uri(f"ws://{gateway.host}"),
            subprotocols=[Subprotocol("era-haptics.v1")],
            max_size=None,
        )
        self._protocol.key = _KEY
        self._events: list[Event] = []
        origin = gateway.url.removesuffix("/")
        self.connection.sendall(upgrade(gateway, target=target, origin=origin))
        head = self._event()
        assert isinstance(head, Response), "no handshake"
        assert head.status_code == 101, head
        _, self.hello = self.next()

    def __enter__(self) -> "RawWebSocket":
        return self

    def __exit__(self, *_: object) -> None:
        self.connection.close()

    def send(self, payload: bytes, *, first: int = 0x81) -> None:
        """Send a frame; first: its first byte, by default FIN and text."""
        self.connection.sendall(frame(payload, first=first))

    def call(self, method: str, params: object, *, id: int = 1) -> None:
        """Send a request."""
        request = {"jsonrpc": "2.0", "id": id, "method": method, "params": params}
        self.send(json.dumps(request).encode())

    def next(self) -> tuple[int, bytes]:
        """Opcode and payload of the next frame; (8, b"") at the end of the connection."""
        event = self._event()
        return (event.opcode, bytes(event.data)) if isinstance(event, Frame) else (8, b"")

    def response(self, id: int | None = 1) -> dict[str, object]:
        """The response with an id; frames before it are skipped."""
        while True:
            opcode, payload = self.next()
            assert opcode != 8, payload
            if opcode == 1 and (content := json.loads(payload)).get("id", ...) == id:
                return dict(content)

    def close_code(self) -> int:
        """The code that the gateway closes with; 0 if without a close frame."""
        while True:
            opcode, payload = self.next()
            if opcode == 8:
                return int.from_bytes(payload[:2], "big")

    def _event(self) -> Event | None:
        """The next head or frame; None at the end of the connection."""
        while not self._events:
            try:
                part = self.connection.recv(1 << 16)
            except ConnectionError:
                return None
            if not part:
                return None
            self._protocol.receive_data(part)
            self._events = self._protocol.events_received()
        return self._events.pop(0)


def frame(payload: bytes, *, first: int = 0x81) -> bytes:
    """A client's frame."""
    return Frame(Opcode(first & 0x0F), payload, fin=bool(first & 0x80)).serialize(mask=True)


UNCONFIRMED = {
    "main": AmplifierSilence(silence="confirmed_silent", may_play_for_s=None, cause="read"),
    "side": AmplifierSilence(silence="may_play", may_play_for_s=0.2, cause="no reply"),
    "rear": AmplifierSilence(silence="watchdog_elapsed", may_play_for_s=None, cause="lost"),
}
"""What a stop may leave: one amplifier of three is confirmed silent."""

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
            reply = await answer
        if "navigated" in reply.get("error", {}).get("message", ""):
            raise Navigated
        assert "error" not in reply, f"{method}: {reply['error']}"
        return dict(reply["result"])

    async def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression; promises are waited for."""
        reply = await self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in reply, reply["exceptionDetails"]
        return reply["result"].get("value")

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

    async def touch(
        self, kind: str, points: Sequence[tuple[float, float]], *, radius: float = 1.0
    ) -> None:
        """Real touches: touchStart, touchMove, touchEnd (no points) at x, y in CSS pixels."""
        sides = {"radiusX": radius, "radiusY": radius / 2}
        fingers = [{"x": x, "y": y, "id": id} | sides for id, (x, y) in enumerate(points)]
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
        reply = await self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(reply["data"]))  # noqa: ASYNC240 (nothing else waits)

    async def _listen(self) -> None:
        with contextlib.suppress(websockets.ConnectionClosed):
            async for line in self._socket:
                message = json.loads(line)
                if "id" in message:
                    answer = self._waiting.pop(message["id"])
                    if not answer.done():
                        answer.set_result(message)
                elif message["method"] == "Log.entryAdded":
                    entry = message["params"]["entry"]
                    if entry["level"] in ("warning", "error"):
                        self.complaints.append(f"{entry['text']} {entry.get('url', '')}")
                elif message["method"] == "Runtime.exceptionThrown":
                    self.complaints.append(str(message["params"]["exceptionDetails"]))


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


def has_ended(connection: socket.socket) -> bool:
    """Whether the other side has closed, without reading."""
    try:
        connection.send(b"")
        is_failed = bool(connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR))
        state = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0]
    except OSError:
        return True
    return is_failed or state != 1  # which is established, see tcp_states.h of Linux
