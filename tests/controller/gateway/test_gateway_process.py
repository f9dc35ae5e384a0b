"""`era gateway` as a process: start, refusals, end, stops during attacks, and reverse proxies.

The proxies serve TLS by the lines of the page on deployment.
"""

import asyncio
import contextlib
import errno
import os
import re
import signal
import socket
import ssl
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import cast
from unittest.mock import AsyncMock

import pytest

import controller
from controller.demo.demonstration import check_page
from controller.gateway.app import Gateway, listen, serve
from controller.gateway.gateway_settings import GatewaySettings, read_token
from daemons import PATIENCE
from gateway_attacks import ATTACKS, LIMIT, attack
from gateway_bench import (
    TOKEN,
    GatewayProcess,
    RawWebSocket,
    ScriptedDaemon,
    frame,
    gateway_process,
    http,
    real_daemon,
    upgrade,
    wait_for,
    wait_for_daemon,
)
from model.errors import InputError
from typed_page import installed_program


def test_gateway_exits_at_sigint_with_open_connections(
    daemon: ScriptedDaemon, tmp_path: Path
) -> None:
    """With open WebSockets, one of which does not read, and requests incomplete and pending."""
    with gateway_process(tmp_path, daemon.socket) as gateway:
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
            assert gateway.process.wait(10) == 0  # the arm that is pending would take longer
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
        for more, status in ((["Origin: http://evil.example"], 403), ([], 200)):
            assert http(gateway, more=more).status == status
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


def test_gateway_prints_an_ipv6_url_with_a_random_token(
    daemon: ScriptedDaemon, tmp_path: Path
) -> None:
    """Of the loopback, in brackets; other hosts are refused, and tokens of other gateways."""
    other = GatewaySettings(socket=tmp_path).token
    with gateway_process(tmp_path, daemon.socket, "--listen", "[::1]:0", token=None) as gateway:
        assert gateway.url.startswith("http://[::1]:")
        token = [gateway.token]
        wait_for(lambda: http(gateway, token=token).status == 200)
        assert http(gateway, token=token, more=[f"Origin: http://{gateway.host}"]).status == 200
        assert http(gateway, token=token, host=["evil.example"]).status == 421
        assert http(gateway, token=[other]).status == 401
        assert len({gateway.token, other, GatewaySettings(socket=tmp_path).token}) == 3
        assert len(gateway.token) == len(other) == 43  # 256 bits


def test_gateway_refuses_a_port_in_use(tmp_path: Path) -> None:
    """With the port, the reason and the option; a demonstration with its own, at once."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=rf"port {port} \(Address already in use\).*--listen"):
            listen(GatewaySettings(socket=tmp_path / "era.sock", port=port))
        page = f"127.0.0.1:{port}"
        with pytest.raises(InputError, match=rf"{page} \(Address already in use\).*--dashboard "):
            check_page(page)


def test_read_token_refuses_unsafe_and_unreadable_files(tmp_path: Path) -> None:
    """Readable by others, not text, not a file: a pipe does not block, an endless file ends."""
    file = tmp_path / "token"
    file.write_text(f"{TOKEN}\n")
    file.chmod(0o600)
    assert read_token(file) == TOKEN
    for mode in (0o640, 0o604, 0o620):
        file.chmod(mode)
        with pytest.raises(InputError, match=f"{file}: .*chmod 600"):
            read_token(file)
    file.chmod(0o600)
    file.write_bytes(b"\xff" * 30)
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe, 0o600)
    for path in (pipe, Path("/dev/zero"), tmp_path, tmp_path / "missing", file):
        with pytest.raises(InputError, match=f"{path}: .*--token-file"):
            read_token(path)


def test_read_token_refuses_a_file_of_another_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its owner can read it, also with mode 600."""
    file = tmp_path / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    if file.stat().st_uid == 0:  # root's files are trusted
        os.chown(file, 12345, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: file.stat().st_uid + 1)
    with pytest.raises(InputError, match="another user"):
        read_token(file)


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
        f"origin {each}": ({"origins": (each,)}, "--allow-origin must be scheme, host")
        for each in (
            *("https://panel.example/", "https://panel.example:0", "https://panel.example:65536"),
            *("https://me@panel.example", "https://panel..example", "https://*.example"),
            *("https://[panel]", "https://192.168.1", "https://stra\xdfe.example", "https://:443"),
        )
    },
}


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_refuse_what_is_unsafe(name: str) -> None:
    """Before anything listens, with the option to change."""
    given, words = SETTINGS[name]
    with pytest.raises(InputError, match=words):
        GatewaySettings(socket=Path("era.sock"), **given)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "sent"),
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
def test_allowed_origin_is_as_browsers_send_it(given: str, sent: str) -> None:
    """By the serialization of an origin (RFC 6454, 6.2) and the host parser of the URL standard."""
    settings = GatewaySettings(
        socket=Path("era.sock"),
        origins=(given,),
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


async def test_gateway_starts_where_its_priority_cannot_be_lowered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As within the system service, whose filter of system calls forbids it."""

    def forbidden(_: int) -> int:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    def reached(_: object) -> None:
        raise InputError("reached")

    monkeypatch.setattr("os.nice", forbidden)
    monkeypatch.setattr("controller.gateway.app.listen", reached)
    with pytest.raises(InputError, match="reached"):
        await serve(GatewaySettings(socket=Path("era.sock")), announce=lambda port: None)


async def test_gateway_ends_with_what_it_keeps_of_the_daemon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A failure there is raised: a process that went on would have no connection for a stop."""
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


MAX_GROWTH = 400.0  # MB; of responses that are not read


@pytest.fixture(scope="module")
def attacked_daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The socket of a real daemon for all attacks."""
    with real_daemon(tmp_path_factory.mktemp("daemon")) as path:
        yield path


@pytest.fixture
def attacked(attacked_daemon: Path, tmp_path: Path) -> Iterator[GatewayProcess]:
    """A gateway that logs nothing."""
    with gateway_process(tmp_path, attacked_daemon) as gateway:
        wait_for_daemon(gateway)
        yield gateway
        assert gateway.log() == ""


@pytest.mark.long
@pytest.mark.real_time
@pytest.mark.alone
@pytest.mark.parametrize("name", ATTACKS)
def test_stops_get_through_an_attack(attacked: GatewayProcess, name: str) -> None:
    """Each is carried out, and the gateway takes less than half a second of a processor meanwhile.

    Other programs do not lengthen that, unlike the duration on a busy machine.
    """
    outcome = attack(attacked, name, seconds=6.0)
    print(outcome.row(name))  # noqa: T201 (with -s it is the table)
    assert len(outcome.stops) >= 5
    assert all(each.is_done for each in outcome.stops)
    assert max(each.processor for each in outcome.stops) < LIMIT
    grown = outcome.memory_most - outcome.memory_before
    assert grown < MAX_GROWTH


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


def site(program: str) -> str:
    """The lines of the page for a program."""
    text = PAGE.read_text(encoding="utf-8")
    begin = {"caddy": "panel.local:8443 {", "nginx": "server {"}[program]
    (lines,) = re.findall(
        rf"^    {re.escape(begin)}\n(?:^(?:     .*|    }})\n)+", text, re.MULTILINE
    )
    return lines


@pytest.fixture
def proxy(tmp_path: Path) -> Proxy:
    """A place for a proxy, with a certificate and its key."""
    certificate, key = tmp_path / "panel.pem", tmp_path / "panel.key"
    make = (installed_program("openssl", package="openssl"), "req", "-x509", "-newkey", "ec")
    make += (
        "-pkeyopt",
        "ec_paramgen_curve:P-256",
        "-nodes",
        "-days",
        "1",
        "-subj",
        "/CN=localhost",
    )
    make += (
        "-addext",
        "subjectAltName=DNS:localhost",
        "-keyout",
        str(key),
        "-out",
        str(certificate),
    )
    subprocess.run(make, check=True, capture_output=True)
    with socket.create_server(("127.0.0.1", 0)) as free:
        return Proxy(free.getsockname()[1], certificate)


@contextmanager
def proxied(
    program: str, proxy: Proxy, behind: GatewayProcess, *, without: str = "(?!)"
) -> Iterator[GatewayProcess]:
    """Run a proxy before a gateway by the lines of the page, but those that match a pattern."""
    folder = proxy.certificate.parent
    lines = "\n".join(line for line in site(program).splitlines() if not re.search(without, line))
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
    with gateway_process(tmp_path, daemon.socket, *allowed) as made:
        wait_for_daemon(made)
        yield made


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
        own = [f"Origin: {proxy.url.removesuffix('/')}"]
        assert b"<!doctype html>" in http(panel, "/", method="GET", body=b"").body.lower()
        assert http(panel, more=own).status == 200
        assert http(panel, token=[], more=own).status == 401
        with RawWebSocket(panel) as browser:
            browser.call("stop", {})
            assert browser.response()["result"]
        assert status(panel, upgrade(panel, protocols=["era-haptics.v1"])) == b"403"
        daemon.calls.clear()
        assert http(panel, more=["Origin: https://evil.example"]).status == 403
        assert b"lease" not in http(panel, host=["evil.example"]).body
        assert daemon.calls == []


@pytest.mark.long
@pytest.mark.parametrize("line", ["Upgrade", "Connection", "proxy_http_version"])
def test_page_without_a_header_of_nginx_has_no_websocket(
    proxy: Proxy, behind: GatewayProcess, line: str
) -> None:
    """The page and the methods are there all the same."""
    with proxied("nginx", proxy, behind, without=line) as panel:
        assert http(panel).status == 200
        assert status(panel, upgrade(panel)) == b"403"


@pytest.mark.long
def test_page_without_host_of_nginx_is_served_to_foreign_hosts(
    proxy: Proxy, behind: GatewayProcess
) -> None:
    """The gateway sees the name by which nginx calls it."""
    for without, expected in (("(?!)", 421), ("Host", 200)):
        with proxied("nginx", proxy, behind, without=without) as panel:
            assert http(panel, host=["evil.example"]).status == expected


@pytest.mark.long
def test_page_of_a_proxy_is_foreign_unless_it_is_allowed(
    daemon: ScriptedDaemon, tmp_path: Path, proxy: Proxy
) -> None:
    """Its origin has another scheme than the gateway's own."""
    with (
        gateway_process(tmp_path, daemon.socket, "--allow-host", "localhost") as behind,
        proxied("caddy", proxy, behind) as panel,
    ):
        wait_for_daemon(behind)
        assert http(panel, more=[f"Origin: {proxy.url.removesuffix('/')}"]).status == 403
