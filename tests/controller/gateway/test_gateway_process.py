"""`era gateway` as a process: start, refusals, TLS, end, and stops during attacks."""

import asyncio
import contextlib
import errno
import os
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import AsyncMock

import pytest
from aiohttp import web

from controller.demo.demonstration import check_page
from controller.gateway.app import Gateway, listen, load_certificate, serve
from controller.gateway.connections import MAX_HANDSHAKES, ConnectionAcceptor
from controller.gateway.gateway_settings import GatewaySettings, read_token
from daemons import PATIENCE, until
from gateway_attacks import ATTACKS, LIMIT, attack, attacked_gateway, make_certificate
from gateway_bench import (
    TOKEN,
    GatewayProcess,
    RawWebSocket,
    ScriptedDaemon,
    frame,
    gateway_process,
    has_ended,
    http,
    raw,
    real_daemon,
    upgrade,
    wait_for,
    wait_for_daemon,
)
from long_form import shortly
from model.errors import InputError
from typed_page import installed_program


def openssl() -> str:
    """The program that makes certificates."""
    return installed_program("openssl", package="openssl")


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A self-signed certificate of localhost, and its key."""
    return make_certificate(tmp_path_factory.mktemp("tls"))


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


STOP = (
    b"POST /api/v1/stop HTTP/1.1\r\nHost: %s\r\nContent-Length: 0\r\nAuthorization: Bearer "
    + TOKEN.encode()
    + b"\r\n\r\n"
)


def test_gateway_serves_tls(
    daemon: ScriptedDaemon, tmp_path: Path, pair: tuple[Path, Path]
) -> None:
    """To a tablet: on all addresses, HTTP and WebSockets over a verified certificate, TLS alone."""
    certificate, key = pair
    tls = ("--certificate", str(certificate), "--key", str(key))
    outside = ("--listen", "0.0.0.0:0", "--allow-host", "localhost")
    with gateway_process(tmp_path, daemon.socket, *tls, *outside) as gateway:
        assert gateway.url.startswith("https://localhost:")
        plain = f"POST /api/v1/stop HTTP/1.1\r\nHost: {gateway.host}\r\n\r\n".encode()
        assert raw(gateway, plain).status == 0
        with contextlib.ExitStack() as stack:
            half = [stack.enter_context(gateway.connect()) for _ in range(3 * MAX_HANDSHAKES)]
            for each in half:
                each.sendall(b"\x16\x03\x01\x02\x00\x01")  # the beginning of a handshake
            wait_for(
                lambda: sum(not has_ended(each) for each in half) <= MAX_HANDSHAKES,
                timeout=PATIENCE / 6,
            )
        gateway.trust(certificate)
        wait_for_daemon(gateway)
        assert http(gateway).status == 200
        assert http(gateway, more=[f"Origin: https://{gateway.host}"]).status == 200
        assert http(gateway, more=[f"Origin: http://{gateway.host}"]).status == 403
        assert raw(gateway, upgrade(gateway, origin=f"http://{gateway.host}")).status == 403
        daemon.calls.clear()
        for _ in range(20):  # clients that leave at once, and politely by TLS
            with gateway.connect() as connection:
                connection.sendall(STOP % gateway.host.encode())
        for _ in range(3):
            with RawWebSocket(gateway) as ws:
                waiting = frame(b" " * 60_000 + b"{}") + frame(b'{"jsonrpc":"2.0","method":"stop"}')
                ws.connection.sendall(waiting)
        wait_for(lambda: daemon.methods.count("stop") == 23)
        with gateway.connect() as connection:
            connection.sendall(upgrade(gateway, origin=f"https://{gateway.host}"))
            assert connection.recv(1 << 16).startswith(b"HTTP/1.1 101 ")
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


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
async def test_accepted_connections_have_no_delay(host: str, tmp_path: Path) -> None:
    """Without TCP_NODELAY a response's body waits 40 ms for the acknowledgement of its head."""
    listening = listen(GatewaySettings(socket=tmp_path / "era.sock", host=host, port=0))
    server = web.Server(AsyncMock())
    accepting = asyncio.create_task(ConnectionAcceptor(server, None).run(listening))
    _, ours = await asyncio.open_connection(host, listening.getsockname()[1])
    await until(lambda: bool(server.connections))
    theirs = server.connections[0].transport
    assert theirs is not None
    assert theirs.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
    accepting.cancel()
    await server.shutdown()
    ours.close()
    listening.close()


def test_gateway_refuses_a_port_in_use(tmp_path: Path) -> None:
    """With the port, the reason and the option; a demonstration with its own, at once."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=rf"port {port} \(Address already in use\).*--listen"):
            listen(GatewaySettings(socket=tmp_path / "era.sock", port=port))
        page = f"127.0.0.1:{port}"
        with pytest.raises(InputError, match=rf"{page} \(Address already in use\).*--dashboard "):
            check_page(page)


def test_gateway_refuses_unusable_certificates(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    """The key of another certificate, a key with a password, and a file without a certificate."""
    certificate, _ = pair
    other, locked = tmp_path / "other.key", tmp_path / "locked.key"
    new = (openssl(), "genpkey", "-algorithm", "EC", "-pkeyopt", "ec_paramgen_curve:P-256")
    for path, more in ((other, ()), (locked, ("-aes256", "-pass", "pass:secret"))):
        subprocess.run([*new, *more, "-out", str(path)], check=True, capture_output=True)
    text = tmp_path / "text"
    text.write_text("no certificate")
    for first, second in ((certificate, other), (certificate, locked), (text, text)):
        with pytest.raises(InputError, match=f"{first} and {second}.*without password"):
            load_certificate(GatewaySettings(socket=tmp_path, certificate=first, key=second))


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


FILE = Path(__file__)
TLS: dict[str, object] = {"host": "0.0.0.0", "certificate": FILE, "key": FILE}
SETTINGS: dict[str, tuple[dict[str, object], str]] = {
    "port": ({"port": 65536}, "port .* 65536"),
    "name": ({"host": "localhost"}, "--allow-host"),
    "short token": ({"token": "secret"}, "token .*22 to 128"),
    "token with a space": ({"token": "a b" * 20}, "token .*22 to 128"),
    "certificate alone": ({"certificate": Path("x")}, "--key"),
    "missing certificate": ({"certificate": Path("x"), "key": Path("x")}, "^x: .*--certificate"),
    "all addresses": ({"host": "0.0.0.0"}, "--certificate, --key and --token-file"),
    "all IPv6 addresses": ({"host": "::"}, "--certificate, --key and --token-file"),
    "only a token": (
        {"host": "192.0.2.1", "is_token_user_supplied": True},
        "--certificate, --key and",
    ),
    "TLS without a token": ({**TLS, "extra_hosts": ("panel.local",)}, "--token-file"),
    "TLS without a host": ({**TLS, "is_token_user_supplied": True}, "--allow-host"),
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
        socket=Path("era.sock"), **TLS, is_token_user_supplied=True, extra_hosts=("panel.local",)
    )  # type: ignore[arg-type]
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
    monkeypatch.setattr("controller.gateway.app.load_certificate", reached)
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


SHORT = ("8 WebSockets, texts of 2 bytes",)
MAX_MEMORY = 150.0  # MB; with handshakes that never end
MAX_GROWTH = 400.0  # MB; a storm of TLS connections is garbage for a while


@pytest.fixture(scope="module")
def attacked_daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The socket of a real daemon for all attacks."""
    with real_daemon(tmp_path_factory.mktemp("daemon")) as path:
        yield path


@pytest.fixture
def attacked(attacked_daemon: Path, tmp_path: Path) -> Iterator[tuple[GatewayProcess, Path]]:
    """A gateway over TLS, which logs nothing, and its certificate."""
    with attacked_gateway(tmp_path, attacked_daemon) as (gateway, certificate):
        yield gateway, certificate
        assert gateway.log() == ""


@pytest.mark.real_time
@pytest.mark.alone
@pytest.mark.parametrize("name", shortly(ATTACKS, SHORT))
def test_stops_get_through_an_attack(attacked: tuple[GatewayProcess, Path], name: str) -> None:
    """Each is carried out, and the gateway takes less than half a second of a processor meanwhile.

    Other programs do not lengthen that, unlike the duration on a busy machine.
    """
    gateway, certificate = attacked
    outcome = attack(gateway, name, certificate, seconds=6.0)
    print(outcome.row(name))  # noqa: T201 (with -s it is the table)
    assert len(outcome.stops) >= 5
    assert all(each.is_done for each in outcome.stops)
    assert max(each.processor for each in outcome.stops) < LIMIT
    grown = outcome.memory_most - outcome.memory_before
    assert grown < MAX_GROWTH
    assert "handshake" not in name or outcome.memory_most < MAX_MEMORY
