"""`era gateway` as a process: start, refusals, end, stops during attacks, and reverse proxies.

The proxies serve TLS by the lines of the page on deployment.

Stops through the gateway are passed on or answered, whatever other clients do.
"""

import asyncio
import contextlib
import errno
import json
import os
import re
import signal
import socket
import ssl
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import cast
from unittest.mock import AsyncMock, Mock

import pytest
from aiohttp import WSMessage, WSMsgType, web

import controller
from controller.api import link
from controller.api.client import AsyncClient
from controller.api.jsonrpc import RpcError
from controller.api.link import Unreachable
from controller.api.schema import API_VERSION, ApiMessage, Empty
from controller.demo.demonstration import check_page
from controller.gateway import app, bridge, connections
from controller.gateway.app import Gateway, listening_socket, serve
from controller.gateway.gateway_settings import GatewaySettings, read_token
from controller.gateway.turns import Turns
from kit.clock import in_virtual_time
from model.errors import InputError
from processes.daemons import PATIENCE, until
from processes.gateways import (
    TOKEN,
    GatewayProcess,
    RawWebSocket,
    ScriptedDaemon,
    frame,
    gateway_process,
    http,
    upgrade,
    wait_for,
    wait_for_daemon,
)
from processes.installed import installed_program

PATIENT = (
    *(sys.executable, "-c"),
    f"from controller.api import link; link.RESPONSE_TIMEOUT = {2 * PATIENCE}; "
    "from era_haptics.command import main; main()",
)
"""`era` that waits for its daemon for longer than a test lasts, also on a busy machine."""


def test_gateway_exits_at_sigint_with_open_connections(
    daemon: ScriptedDaemon, tmp_path: Path
) -> None:
    """With open WebSockets, one of which does not read, and requests incomplete and pending.

    It does not wait for the pending request, to which the daemon replies after the test.
    """
    with gateway_process(tmp_path, daemon.socket, program=PATIENT) as gateway:
        wait_for_daemon(gateway)
        with (
            daemon.holding(),
            RawWebSocket(gateway) as ws,
            RawWebSocket(gateway) as deaf,
            gateway.connect() as slow,
            gateway.connect() as held,
        ):
            for id in range(100):
                deaf.call("hello", {"client": "me"}, id=id)
            slow.sendall(b"POST /api/v1/arm HTTP/1.1\r\n")
            held.sendall(
                f"POST /api/v1/arm HTTP/1.1\r\nHost: {gateway.host}\r\nAuthorization: Bearer "
                f"{TOKEN}\r\nContent-Type: application/json\r\nContent-Length: 29\r\n\r\n"
                '{"owner": "me", "lease_s": 5}'.encode()
            )
            wait_for(lambda: "arm" in daemon.methods)
            ws.call("effects", {})
            assert ws.response()["result"]
            gateway.process.send_signal(signal.SIGINT)
            assert gateway.process.wait(PATIENCE) == 0
            assert ws.close_code() == 1012  # service restart
        assert gateway.log() == ""


def test_gateway_serves_outside_the_loopback_by_its_key(
    daemon: ScriptedDaemon, tmp_path: Path
) -> None:
    """On all addresses: HTTP and WebSockets of an allowed host, and metrics, with the key alone."""
    outside = ("--listen", "0.0.0.0:0", "--allow-host", "localhost")
    with gateway_process(tmp_path, daemon.socket, *outside) as gateway:
        assert gateway.url.startswith("http://localhost:")
        wait_for_daemon(gateway)
        for headers, status in ((["Origin: http://evil.example"], 403), ([], 200)):
            assert http(gateway, more=headers).status == status
        for token, status in (([], 401), ([TOKEN], 200)):
            assert http(gateway, token=token).status == status
            read = http(gateway, "/metrics", method="GET", body=b"", token=token)
            assert read.status == status
        with RawWebSocket(gateway) as ws:
            daemon.calls.clear()
            waiting = frame(b" " * 60_000 + b"{}") + frame(b'{"jsonrpc":"2.0","method":"stop"}')
            ws.connection.sendall(waiting)
        wait_for(lambda: daemon.methods == ["stop"])
        assert gateway.terminate() == 0


def test_gateway_refuses_a_port_in_use(tmp_path: Path) -> None:
    """With the port, the reason and the option; a demonstration with its own, at once."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(InputError, match=rf"port {port} \(Address already in use\).*--listen"):
            listening_socket(GatewaySettings(socket=tmp_path / "era.sock", port=port))
        page = f"127.0.0.1:{port}"
        with pytest.raises(InputError, match=rf"{page} \(Address already in use\).*--dashboard "):
            check_page(page)


def test_read_token_refuses_unsafe_and_unreadable_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Readable by others, not text, not a file: a pipe does not block, an endless file ends.

    Nor one of another user, who can read it, also with mode 600.
    """
    file, pipe = tmp_path / "token", tmp_path / "pipe"
    os.mkfifo(pipe, 0o600)
    file.write_text(f"{TOKEN}\n")
    file.chmod(0o600)
    assert read_token(file) == TOKEN
    for mode in (0o640, 0o604, 0o620):
        file.chmod(mode)
        with pytest.raises(InputError, match=f"{file}: .*chmod 600"):
            read_token(file)
    file.chmod(0o600)
    with monkeypatch.context() as patched:
        if file.stat().st_uid == 0:  # root's files are trusted
            os.chown(file, 12345, -1)
        else:
            patched.setattr(os, "geteuid", lambda: file.stat().st_uid + 1)
        with pytest.raises(InputError, match="another user"):
            read_token(file)
    os.chown(file, os.geteuid(), -1)
    file.write_bytes(b"\xff" * 30)
    for path in (pipe, Path("/dev/zero"), tmp_path, tmp_path / "missing", file):
        with pytest.raises(InputError, match=f"{path}: .*--token-file"):
            read_token(path)


SETTINGS: dict[str, tuple[dict[str, object], str]] = {
    "port": ({"port": 65536}, "port .* 65536"),
    "name": ({"host": "localhost"}, "--allow-host"),
    "short token": ({"token": "secret"}, "token .*22 to 128"),
    "token with a space": ({"token": "a b" * 20}, "token .*22 to 128"),
    "all addresses": ({"host": "0.0.0.0"}, "--token-file"),
    "all IPv6 addresses": ({"host": "::"}, "--token-file"),
    "no host": ({"host": "192.0.2.1", "is_token_user_supplied": True}, "--allow-host"),
    "any host": ({"extra_hosts": ("*",)}, "--allow-host"),
    "host with a port": ({"extra_hosts": ("panel.local:80",)}, "--allow-host .*without port"),
    "IPv6 host without brackets": ({"extra_hosts": ("2001:db8::7",)}, r"\[2001:db8::7\]"),
    "origin with a path": ({"origins": ("https://panel.example/x",)}, "--allow-origin"),
    "origin null": ({"origins": ("null",)}, "--allow-origin"),
    "any origin": ({"origins": ("*",)}, "--allow-origin"),
    "host of an address with a zone": ({"extra_hosts": ("[fe80::1%eth0]",)}, "--allow-host"),
    "host by the end of an address": ({"extra_hosts": ("192.168.7",)}, "--allow-host"),
    **{
        f"origin {case}": ({"origins": (case,)}, "--allow-origin must be scheme, host")
        for case in (
            *("https://panel.example/", "https://panel.example:0", "https://panel.example:65536"),
            *("https://me@panel.example", "https://panel..example", "https://*.example"),
            *("https://[panel]", "https://192.168.1", "https://stra\xdfe.example", "https://:443"),
        )
    },
}


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_refuse_what_is_unsafe(name: str) -> None:
    """Before anything listens, with the option to change."""
    options, words = SETTINGS[name]
    with pytest.raises(InputError, match=words):
        GatewaySettings(socket=Path("era.sock"), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("origin", "sent"),
    [
        ("https://plate.local:443", "https://plate.local"),
        ("http://plate.local:80", "http://plate.local"),
        ("http://plate.local:443", "http://plate.local:443"),
        ("HTTPS://Plate.Local:08443", "https://plate.local:8443"),
        ("https://b\xfccher.example", "https://xn--bcher-kva.example"),
        ("https://B\xdcCHER.example", "https://xn--bcher-kva.example"),
        ("https://[2001:DB8:0:0::7]:443", "https://[2001:db8::7]"),
    ],
)
def test_allowed_origin_is_as_browsers_send_it(origin: str, sent: str) -> None:
    """By the serialization of an origin (RFC 6454, 6.2) and the host parser of the URL standard."""
    settings = GatewaySettings(
        socket=Path("era.sock"),
        origins=(origin,),
        extra_hosts=("B\xfccher.example", "[2001:DB8::07]"),
    )
    assert settings.allowed_origins == {sent}
    assert settings.allowed_names >= {"xn--bcher-kva.example", "[2001:db8::7]"}


def test_settings_show_and_allow_the_address_listened_on() -> None:
    """Besides the usual names; for all addresses the first allowed host is shown."""
    settings = GatewaySettings(socket=Path("era.sock"), host="127.0.0.2")
    assert settings.shown_host == "127.0.0.2"
    panel = GatewaySettings(
        socket=Path("era.sock"),
        host="0.0.0.0",
        is_token_user_supplied=True,
        extra_hosts=("panel.local",),
    )
    assert panel.shown_host == "panel.local"
    assert settings.allowed_names == {"localhost", "127.0.0.1", "[::1]", "127.0.0.2"}


async def test_gateway_starts_without_its_priority_and_ends_with_what_it_keeps_of_the_daemon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The filter of system calls of the system service forbids to lower the priority.

    A failure of what is kept is raised: a process that went on would have no connection for a stop.
    """
    forbidden = PermissionError(errno.EPERM, os.strerror(errno.EPERM))
    monkeypatch.setattr("os.nice", Mock(side_effect=forbidden))
    monkeypatch.setattr(Gateway, "keep_connected", AsyncMock(side_effect=ZeroDivisionError))
    with pytest.raises(ZeroDivisionError):
        async with asyncio.timeout(PATIENCE / 6):
            await serve(GatewaySettings(socket=tmp_path / "era.sock"), announce=lambda port: None)


def test_gateway_connects_to_a_daemon_that_starts_later(tmp_path: Path) -> None:
    """503 with the remedy meanwhile, and again after the daemon has ended."""
    with gateway_process(tmp_path, tmp_path / "era.sock") as gateway:
        answer = http(gateway)
        assert answer.status == 503
        assert b"era daemon CONFIG" in answer.body
        for _ in range(2):
            with ScriptedDaemon(tmp_path) as daemon:
                wait_for_daemon(gateway)
                assert http(gateway).status == 200
                assert daemon.methods == ["arm"]
            wait_for(lambda: http(gateway).status == 503)


PAGE = Path(controller.__file__).parents[1] / "docs" / "how-to" / "deployment.md"
CADDY = "{{\n    admin off\n    auto_https disable_redirects\n}}\n{site}"
NGINX = """daemon off;
pid {folder}/nginx.pid;
error_log {folder}/error.log;
events {{}}
http {{
    access_log off;
    client_body_temp_path {folder}/body;
    proxy_temp_path {folder}/proxy;
    fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi;
    scgi_temp_path {folder}/scgi;
    {site}
}}
"""


@dataclass
class Proxy:
    """A reverse proxy on a port of the loopback, as the helpers see a gateway."""

    port: int
    certificate: Path

    @property
    def host(self) -> str:
        """Host and port, as in the Host header."""
        return f"localhost:{self.port}"

    @property
    def url(self) -> str:
        """The URL of the page."""
        return f"https://{self.host}/"

    def connect(self, timeout: float = PATIENCE) -> socket.socket:
        """A connection by TLS that trusts its certificate alone."""
        plain = socket.create_connection(("127.0.0.1", self.port), timeout=timeout)
        trusting = ssl.create_default_context(cafile=self.certificate)
        return trusting.wrap_socket(plain, server_hostname="localhost")


@pytest.fixture
def proxy(tmp_path: Path) -> Proxy:
    """A place for a proxy, with a certificate and its key."""
    certificate, key = tmp_path / "panel.pem", tmp_path / "panel.key"
    make = [installed_program("openssl", package="openssl"), "req", "-x509"]
    make += ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "1"]
    make += ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
    subprocess.run([*make, "-keyout", key, "-out", certificate], check=True, capture_output=True)
    with socket.create_server(("127.0.0.1", 0)) as free:
        return Proxy(free.getsockname()[1], certificate)


@contextmanager
def proxied(
    program: str, proxy: Proxy, behind: GatewayProcess, *, without: str = "(?!)"
) -> Iterator[GatewayProcess]:
    """Run a proxy before a gateway by the lines of the page, but those that match a pattern."""
    folder = proxy.certificate.parent
    begin = {"caddy": "panel.local:8443 {", "nginx": "server {"}[program]
    site = rf"^    {re.escape(begin)}\n(?:^(?:     .*|    }})\n)+"
    (section,) = re.findall(site, PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    lines = "\n".join(line for line in section.splitlines() if not re.search(without, line))
    lines = re.sub(r"/etc/\w+/panel", str(folder / "panel"), lines)
    lines = lines.replace("8138", str(behind.port)).replace("8443", str(proxy.port))
    config = folder / program
    wrapped = {"caddy": CADDY, "nginx": NGINX}[program].format(folder=folder, site=lines)
    config.write_text(wrapped.replace("panel.local", "localhost"), encoding="utf-8")
    arguments = {
        "caddy": ("run", "--adapter", "caddyfile", "--config", str(config)),
        "nginx": ("-p", str(folder), "-c", str(config), "-e", str(folder / "error.log")),
    }[program]
    environment = {"HOME": str(folder), "PATH": "/usr/bin:/bin"}
    with subprocess.Popen(
        [installed_program(program), *arguments], env=environment, stderr=subprocess.PIPE
    ) as process:
        try:

            def is_open() -> bool:
                assert process.poll() is None, process.stderr and process.stderr.read()
                with contextlib.suppress(OSError):
                    proxy.connect().close()
                    return True
                return False

            wait_for(is_open)
            yield cast(GatewayProcess, proxy)
        finally:
            process.terminate()


@pytest.fixture
def behind(daemon: ScriptedDaemon, tmp_path: Path, proxy: Proxy) -> Iterator[GatewayProcess]:
    """A gateway for the pages of the proxy."""
    allowed = ("--allow-host", "localhost", "--allow-origin", proxy.url.removesuffix("/"))
    with gateway_process(tmp_path, daemon.socket, *allowed) as process:
        wait_for_daemon(process)
        yield process


def status(panel: GatewayProcess, request: bytes) -> bytes:
    """The status of the response, after which a proxy keeps the connection."""
    with panel.connect() as connection:
        connection.sendall(request)
        return connection.recv(1 << 16)[9:12]


@pytest.mark.long
@pytest.mark.parametrize("program", ["caddy", "nginx"])
def test_gateway_is_used_through_a_proxy(
    daemon: ScriptedDaemon, proxy: Proxy, behind: GatewayProcess, program: str
) -> None:
    """Page, methods and WebSocket with the key; none without it, or for foreign pages or hosts."""
    with proxied(program, proxy, behind) as panel:
        origin = [f"Origin: {proxy.url.removesuffix('/')}"]
        assert b"<!doctype html>" in http(panel, "/", method="GET", body=b"").body.lower()
        assert http(panel, more=origin).status == 200
        assert http(panel, token=[], more=origin).status == 401
        with RawWebSocket(panel) as browser:
            browser.call("stop", {})
            assert browser.response()["result"]
        assert status(panel, upgrade(panel, protocols=["era-haptics.v1"])) == b"403"
        daemon.calls.clear()
        assert http(panel, more=["Origin: https://evil.example"]).status == 403
        assert b"lease" not in http(panel, host=["evil.example"]).body
        assert daemon.calls == []


def test_stops_are_passed_on_although_other_hosts_connect_often(
    tmp_path: Path, daemon: ScriptedDaemon
) -> None:
    """Whose requests have all places that the daemon has for them; no host had one before."""
    with gateway_process(tmp_path, daemon.socket) as gateway, contextlib.ExitStack() as opened:
        wait_for_daemon(gateway)
        daemon.calls.clear()

        def sent(method: str, host: str) -> socket.socket:
            """A connection of a host over which one request was sent."""
            process = opened.enter_context(
                socket.create_connection(
                    ("127.0.0.1", gateway.port), timeout=PATIENCE, source_address=(host, 0)
                )
            )
            process.sendall(
                f"POST /api/v1/{method} HTTP/1.1\r\nHost: {gateway.host}\r\nConnection: close\r\n"
                f"Authorization: Bearer {TOKEN}\r\nContent-Length: 0\r\n\r\n".encode()
            )
            return process

        for _ in range(45):
            for host in ("127.0.0.2", "127.0.0.3"):
                sent("status", host)
        requests = [sent("stop", "127.0.0.4") for _ in range(70)]
        requests += [sent("disarm", "127.0.0.4") for _ in range(20)]
        assert {connection.recv(1 << 16)[9:12] for connection in requests} == {b"200"}
        assert (daemon.methods.count("stop"), daemon.methods.count("disarm")) == (70, 20)


@contextlib.asynccontextmanager
async def serving(daemon: Path) -> AsyncIterator[int]:
    """The port of a gateway in this event loop."""
    port: asyncio.Future[int] = asyncio.get_running_loop().create_future()
    settings = GatewaySettings(socket=daemon, token=TOKEN)
    running = asyncio.create_task(serve(settings, announce=port.set_result))
    try:
        yield await port
    finally:
        signal.raise_signal(signal.SIGTERM)
        await running


def head_of(method: str, target: str, *headers: str) -> bytes:
    """A request of a client that has the token, without a body."""
    lines = [f"{method} {target} HTTP/1.1", "Host: localhost", *headers]
    return "\r\n".join([*lines, f"Authorization: Bearer {TOKEN}", "", ""]).encode()


async def answer(port: int, request: bytes) -> bytes:
    """The status with which a request of a new client is answered."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(request)
    line = await reader.readline()
    writer.close()
    return line.split()[1]


async def test_what_silences_is_passed_on_while_all_places_for_requests_are_taken(
    daemon: ScriptedDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other methods are refused meanwhile."""
    monkeypatch.setattr("os.nice", lambda _: 0)
    monkeypatch.setattr(app, "MAX_REQUESTS", 0)
    async with serving(daemon.socket) as port:
        daemon.calls.clear()
        for method, status in (("status", b"503"), ("stop", b"200"), ("disarm", b"200")):
            assert await answer(port, head_of("POST", f"/api/v1/{method}")) == status
    assert daemon.methods == ["stop", "disarm"]


PAGE_WITHOUT_TOKEN = b"GET /app.js HTTP/1.1\r\nHost: localhost\r\n\r\n"
FLOODS = {
    "pages": PAGE_WITHOUT_TOKEN,
    "pages with the token": head_of("GET", "/app.js"),
    "methods": head_of("POST", "/api/v1/effects"),
    "stops without the token": PAGE_WITHOUT_TOKEN.replace(b"GET /app.js", b"POST /api/v1/stop"),
}


@pytest.mark.parametrize("name", FLOODS)
async def test_stop_waits_for_few_requests_of_clients_that_do_not_read(
    daemon: ScriptedDaemon, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Of 120 clients, each with sixty requests at once: some tens are begun before it is passed on.

    In time of the processor that is a few milliseconds; all of them would take a second.
    """
    begun = 0
    begun_at_stop: list[int] = []
    begin = connections.ClientConnection.start_request
    send = AsyncClient.request

    def count(connection: connections.ClientConnection, request: web.Request) -> None:
        nonlocal begun
        begun += 1
        begin(connection, request)

    async def note(client: AsyncClient, method: str, params: ApiMessage) -> object:
        if method == "stop":
            begun_at_stop.append(begun)
        return await send(client, method, params)

    monkeypatch.setattr("os.nice", lambda _: 0)
    monkeypatch.setattr(connections.ClientConnection, "start_request", count)
    monkeypatch.setattr(AsyncClient, "request", note)
    async with serving(daemon.socket) as port, contextlib.AsyncExitStack() as opened:
        flooding = []
        for _ in range(120):
            _, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.transport.pause_reading()  # type: ignore[attr-defined]
            opened.callback(writer.transport.abort)
            flooding.append(writer)
        for writer in flooding:
            writer.write(FLOODS[name] * 60)
        await until(lambda: begun > 2 * len(flooding))
        begun_before = begun
        assert await answer(port, head_of("POST", "/api/v1/stop")) == b"200"
    assert begun_at_stop[-1] - begun_before < 40


async def test_requests_that_came_at_once_are_answered_in_their_order(
    daemon: ScriptedDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each whole: a page, a body, line feeds before a head, as HTTP allows, and a stop.

    The client has closed its side, and the gateway closes after the last of them.
    """
    monkeypatch.setattr("os.nice", lambda _: 0)
    body = b'{"client": "GET / HTTP/1.1\\r\\n\\r\\n"}'
    media = "Content-Type: application/json"
    requests = [
        head_of("GET", "/icon.svg"),
        head_of("POST", "/api/v1/clear", media, f"Content-Length: {len(body)}") + body,
        b"\r\n\r\n" + head_of("GET", "/nothing"),
        head_of("POST", "/api/v1/stop"),
    ]
    async with serving(daemon.socket) as port:
        daemon.calls.clear()
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"".join(requests))
        writer.write_eof()
        async with asyncio.timeout(PATIENCE / 6):
            received = await reader.read()
        writer.close()
    statuses = re.findall(rb"HTTP/1.1 (\d+) ", received)
    assert statuses == [b"200", b"422", b"404", b"200"]
    assert daemon.methods == ["stop"]


@pytest.fixture
def full_queue(tmp_path: Path) -> Iterator[Path]:
    """The socket of a daemon that hangs: no further connection is queued."""
    path = tmp_path / "era.sock"
    waiting: list[socket.socket] = []
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(str(path))
        bound.listen(0)
        while True:
            waiting.append(socket.socket(socket.AF_UNIX))
            waiting[-1].setblocking(False)
            try:
                waiting[-1].connect(str(path))
            except BlockingIOError:
                break
        yield path
        for connection in waiting:
            connection.close()


async def test_stop_is_answered_although_the_daemon_hangs(
    full_queue: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise nobody is told to switch the amplifiers off by hand."""
    monkeypatch.setattr(link, "RESPONSE_TIMEOUT", 0.05)
    async with asyncio.timeout(100 * link.RESPONSE_TIMEOUT):
        with pytest.raises(Unreachable, match="does not respond"):
            await link.DaemonLink.open(full_queue, "browser")
        with pytest.raises(Unreachable, match="does not respond"):
            await AsyncClient(full_queue, name="gateway", timeout=0.05).stop()


async def test_clients_that_leave_while_the_daemon_hangs_keep_their_places(
    full_queue: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until their connections have failed: else any number of them would wait for the daemon."""
    monkeypatch.setattr(connections, "RESPONSE_TIMEOUT", 0.3)
    shared = connections.Connections(full_queue)

    def request(*, leaves: bool = True) -> "asyncio.Task[object]":
        client = connections.ClientConnection(Mock(), shared)
        transport = Mock(is_closing=lambda: False, get_extra_info=lambda _: ("192.0.2.1", 1))
        client.connection_made(transport)
        task = asyncio.create_task(client.request("status", Empty()))
        if leaves:
            asyncio.get_running_loop().call_soon(client.connection_lost, None)
        client.admit()
        return task

    waiting = [request() for _ in range(connections.MAX_KEPT)]
    await asyncio.sleep(0.01)
    with pytest.raises(RpcError, match="too many connections"):
        await request(leaves=False)
    with pytest.raises(Unreachable):
        await asyncio.gather(*waiting)
    await until(lambda: not shared.kept)


@in_virtual_time
async def test_connection_that_waits_is_closed(tmp_path: Path) -> None:
    """The oldest beside 128 that wait, and after 5 s without a complete request, bytes or not.

    None before what has come of it is read, and those that had an answer before new ones.
    """
    shared = connections.Connections(tmp_path)
    handlers = [
        connections.ClientConnection(Mock(), shared) for _ in range(connections.MAX_WAITING + 3)
    ]
    wires = [Mock(is_closing=lambda: False) for _ in handlers]
    for handler, wire in zip(handlers, wires, strict=True):
        handler.connection_made(wire)

    def closed() -> list[int]:
        return [number for number, wire in enumerate(wires) if wire.abort.called]

    handlers[4].admit()
    handlers[4].finish()  # answered
    assert closed() == []
    await asyncio.sleep(0.01)
    assert closed() == [0, 1, 4]
    handlers[-2].admit()  # its request has come
    await asyncio.sleep(4.9)
    received(handlers[-1], b"G")
    assert closed() == [0, 1, 4]
    await asyncio.sleep(0.2)
    assert closed() == [handler for handler in range(len(handlers)) if handler != len(handlers) - 2]


def received(connection: connections.ClientConnection, data: bytes) -> None:
    """Let a connection receive bytes."""
    connection.get_buffer(-1)[: len(data)] = data
    connection.buffer_updated(len(data))


LEFT = WSMessage(WSMsgType.CLOSED, None, None)
HELLO = b'{"jsonrpc":"2.0","id":"web","result":{"api_version":"%s"}}\n' % API_VERSION.encode()


class Browser:
    """A WebSocket of a browser that has sent frames, and reads the first that it is sent only.

    leaves: whether it reads on and leaves instead, when it is sent its second frame.
    """

    close_code = None

    def __init__(self, *texts: str, leaves: bool = False) -> None:
        self.frames: asyncio.Queue[WSMessage] = asyncio.Queue()
        self.leaves = leaves
        self.sent = 0
        for text in texts:
            self.frames.put_nowait(WSMessage(WSMsgType.TEXT, text.encode(), ""))

    def __aiter__(self) -> "Browser":
        return self

    async def __anext__(self) -> WSMessage:
        """The next frame."""
        message = await self.frames.get()
        if message is LEFT:
            raise StopAsyncIteration
        return message

    async def send_str(self, _: str) -> None:
        """Send the first frame."""

    async def send_frame(self, _: bytes, opcode: WSMsgType) -> None:
        """Send another; the event loop sees after the first of them that the browser has left."""
        self.sent += 1
        if not self.leaves:
            await asyncio.Event().wait()
        if self.sent == 1:
            asyncio.get_running_loop().call_soon(self.frames.put_nowait, LEFT)

    async def close(self, *, code: int = 1000, drain: bool = True) -> None:
        """Answer that it has left."""

    async def bridged(self, path: Path, *read: "asyncio.Future[list[bytes]]") -> None:
        """Be bridged to a daemon's socket, until it has left or is given up, and all is read."""
        opened = await link.DaemonLink.open(path, "browser")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(link.DaemonLink, "open", AsyncMock(return_value=opened))
            await bridge.bridge(
                cast(bridge.BrowserSocket, self),
                "192.0.2.1:1",
                path,
                None,
                Turns(),
            )
        await asyncio.gather(*read)
        opened.abort()
        await asyncio.sleep(0)


@pytest.fixture
async def busy_daemon(tmp_path: Path) -> AsyncIterator[tuple[Path, asyncio.Future[list[bytes]]]]:
    """The socket of a daemon that sends an event, and reads only later; what it read."""
    path = tmp_path / "era.sock"
    read: asyncio.Future[list[bytes]] = asyncio.get_running_loop().create_future()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readline()
        writer.write(HELLO + b"{}\n")
        writer.transport.pause_reading()  # type: ignore[attr-defined]
        await given_up.wait()
        writer.transport.resume_reading()  # type: ignore[attr-defined]
        read.set_result((await reader.read()).splitlines())
        writer.close()

    given_up = asyncio.Event()
    asyncio.get_running_loop().call_later(0.3, given_up.set)
    async with await asyncio.start_unix_server(serve, path, limit=1 << 12):
        yield path, read


async def test_stop_of_a_browser_that_is_given_up_is_passed_on(
    busy_daemon: tuple[Path, "asyncio.Future[list[bytes]]"], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It waits behind touches that a busy daemon has not read, and the browser does not read.

    However its name is written; what only looks like it is not passed on.
    """
    path, read = busy_daemon
    monkeypatch.setattr(bridge, "SEND_TIMEOUT", 0.05)
    touch = (
        '{"jsonrpc":"2.0","method":"touch","params":{"source":"page","touches":[]}}' + " " * 4000
    )
    stop = '{"jsonrpc":"2.0","id":9,"method":"st\\u006fp"}'
    play = '{"jsonrpc":"2.0","id":8,"method":"play","params":{"effect":"stop","x_m":0,"y_m":0}}'
    async with asyncio.timeout(PATIENCE):
        await Browser(*[touch] * 1000, stop, play).bridged(path, read)
    assert len(read.result()) < 900
    assert json.loads(read.result()[-1])["method"] == "stop"


async def test_others_have_a_turn_after_each_frame(
    busy_daemon: tuple[Path, "asyncio.Future[list[bytes]]"], monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many frames of a browser wait."""
    path, read = busy_daemon
    monkeypatch.setattr(bridge, "SEND_TIMEOUT", 0.5)
    browser, turns = Browser(*["{}"] * 100), 0
    bridging = asyncio.create_task(browser.bridged(path, read))
    async with asyncio.timeout(PATIENCE):
        while not browser.frames.empty():
            await asyncio.sleep(0)
            turns += 1
        browser.frames.put_nowait(LEFT)
        await bridging
    assert turns >= 100
