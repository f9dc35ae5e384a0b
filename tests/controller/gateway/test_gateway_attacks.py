"""Attacks on the gateway are refused, and none of them reaches the daemon.

An attack is a request to arm that would be granted but for one thing, as in attacks.yaml, or an
invalid frame. The gateway is a process connected to a daemon that records its calls.
"""

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from cases import read_yaml
from processes.gateways import (
    ARM,
    TOKEN,
    GatewayProcess,
    RawWebSocket,
    ScriptedDaemon,
    frame,
    gateway_process,
    http,
    raw,
    upgrade,
    wait_for_daemon,
)


@pytest.fixture(scope="module")
def gateway(
    daemon: ScriptedDaemon, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[GatewayProcess]:
    """One gateway, which survives all attacks."""
    with gateway_process(tmp_path_factory.mktemp("gateway"), daemon.socket) as process:
        wait_for_daemon(process)
        yield process


@pytest.fixture(scope="module")
def friend(gateway: GatewayProcess) -> Iterator[httpx.Client]:
    """A client that keeps its connection between its requests."""
    headers = {"Authorization": f"Bearer {TOKEN}", "Content-Type": "application/json"}
    with httpx.Client(base_url=gateway.url, headers=headers) as client:
        yield client


@pytest.fixture(autouse=True)
def unaffected(
    daemon: ScriptedDaemon, gateway: GatewayProcess, friend: httpx.Client
) -> Iterator[None]:
    """After each attack: no call of the daemon, no log record, and a valid request is granted."""
    daemon.calls.clear()
    log = gateway.log()
    yield
    assert daemon.calls == []
    assert friend.post("api/v1/arm", content=ARM).status_code == 200
    assert daemon.methods == ["arm"]
    assert gateway.log() == log


ATTACKS = dict(read_yaml(Path(__file__).with_name("attacks.yaml")))
REQUESTS: dict[str, dict[str, Any]] = ATTACKS["requests"]
HEADS: dict[str, list[str]] = ATTACKS["heads"]
HANDSHAKES: dict[str, dict[str, Any]] = ATTACKS["handshakes"]
HEADER = f"""\
POST /api/v1/arm HTTP/1.1
Host: HOST
Authorization: Bearer {TOKEN}
Content-Type: application/json
Connection: close
Content-Length: {len(ARM)}

"""
GRANTED = HEADER.replace("\n", "\r\n") + ARM.decode()
"""A request to arm that is granted."""
LENGTH = f"Content-Length: {len(ARM)}"
CHUNKED = "Transfer-Encoding: chunked"


def filled(value: Any, gateway: GatewayProcess) -> Any:
    """A text, or the texts of a list, with the gateway's own host and token."""
    if isinstance(value, list):
        return [filled(text, gateway) for text in value]
    if isinstance(value, str):
        return value.replace("HOST", gateway.host).replace("TOKEN", TOKEN)
    return value


def filled_values(row: dict[str, Any], gateway: GatewayProcess) -> dict[str, Any]:
    """The values of a row of the file, filled."""
    return {key: filled(value, gateway) for key, value in row.items()}


def altered(gateway: GatewayProcess, old: str, new: str) -> bytes:
    """The request that is granted, with a part replaced."""
    assert old in GRANTED
    return filled(GRANTED.replace(old, new, 1), gateway).encode("latin-1")


@pytest.mark.parametrize("name", REQUESTS)
def test_http_request_is_refused(gateway: GatewayProcess, name: str) -> None:
    """With the right status, and without the content of a file."""
    attack = filled_values(REQUESTS[name], gateway)
    statuses = attack.pop("statuses")
    if "body" in attack:
        attack["body"] = attack["body"].encode("latin-1")

    response = http(gateway, **attack)

    assert response.status in statuses, response
    assert b"root:" not in response.body
    assert b"import" not in response.body


@pytest.mark.parametrize(
    ("body", "status"),
    [
        pytest.param(b'{"owner": "' + b"x" * (1 << 17) + b'"}', 413, id="too large"),
        pytest.param(b"[" * 60_000, 400, id="deep JSON"),
        pytest.param(b'{"lease_s": ' + b"9" * 60_000 + b"}", 400, id="60 000 digits"),
    ],
)
def test_large_body_is_refused(gateway: GatewayProcess, body: bytes, status: int) -> None:
    """By its size, or because its content would take long to read."""
    assert http(gateway, body=body).status == status


@pytest.mark.parametrize(
    ("old", "new", "status"),
    [
        ("HTTP/1.1", "HTTP/2.0", 505),
        ("HTTP/1.1", "HTTP/0.9", 505),
        ("HTTP/1.1\r\nHost: HOST", "HTTP/1.0", 421),
        (LENGTH, "Transfer-Encoding: gzip, chunked", 411),
        (LENGTH, CHUNKED, 411),
    ],
)
def test_http_head_is_refused(gateway: GatewayProcess, old: str, new: str, status: int) -> None:
    """Other versions of HTTP, no host, and bodies without a length."""
    response = raw(gateway, altered(gateway, old, new))

    assert response.status == status
    assert response.headers.startswith("HTTP/")


def test_bytes_that_are_no_http_are_refused(gateway: GatewayProcess) -> None:
    """They get a response of HTTP."""
    noise = bytes(range(256)) * 40
    assert raw(gateway, noise + b"\r\n\r\n").status == 400


@pytest.mark.parametrize(
    ("length", "body", "status"),
    [
        pytest.param("Content-Length: 5000001", b" " * 5_000_000, b"413", id="sized"),
        pytest.param(CHUNKED, b"1\r\n \r\n" * 500_000, b"411", id="chunks"),
    ],
)
def test_refusal_is_read_after_the_whole_body_is_sent(
    gateway: GatewayProcess, length: str, body: bytes, status: bytes
) -> None:
    """By a client that reads only then: the body is discarded meanwhile."""
    head, _, _ = altered(gateway, LENGTH, length).partition(ARM)
    with gateway.connect() as connection:
        connection.sendall(head + body)

        assert connection.recv(1 << 16)[9:12] == status


def get_icon(gateway: GatewayProcess, connection: socket.socket) -> None:
    """Send a request that is served without a token."""
    request = f"GET /icon.svg HTTP/1.1\r\nHost: {gateway.host}\r\n\r\n"
    connection.sendall(request.encode())
    assert b"</svg>" in connection.recv(1 << 16)


def send_in_pieces(gateway: GatewayProcess, request: bytes) -> bytes:
    """Send a request whose head ends after another client was served; all that is received."""
    received = b""
    end_of_head = request.index(b"{") - 5
    with gateway.connect() as connection:
        get_icon(gateway, connection)
        connection.sendall(request[:end_of_head])
        assert http(gateway, target="/api/v1/openapi.json", method="GET").status == 200
        connection.sendall(request[end_of_head:])
        with contextlib.suppress(ConnectionError):
            while part := connection.recv(1 << 16):
                received += part
    return received


@pytest.mark.parametrize("name", HEADS)
def test_head_that_a_proxy_may_misread_is_refused(gateway: GatewayProcess, name: str) -> None:
    """After a request that is served, and in pieces; the connection ends with it."""
    old, new = HEADS[name]
    request = altered(gateway, old.replace("TOKEN", TOKEN), new.replace("TOKEN", TOKEN))

    received = send_in_pieces(gateway, request)

    assert received[9:12] in (b"400", b"411")


def test_head_with_line_feeds_alone_is_refused(gateway: GatewayProcess) -> None:
    """A proxy may see the end of a head where the gateway does not."""
    request = filled(GRANTED, gateway).replace("\r\n", "\n").encode()
    assert send_in_pieces(gateway, request)[9:12] in (b"400", b"411")


@pytest.mark.parametrize("name", HANDSHAKES)
def test_websocket_is_refused(gateway: GatewayProcess, name: str) -> None:
    """For a foreign origin or host, a wrong token, no subprotocol, another path or a body."""
    handshake = upgrade(gateway, **filled_values(HANDSHAKES[name], gateway))
    assert raw(gateway, handshake).status == 403


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"Sec-WebSocket-Key: ", b"Sec-WebSocket-Key: \xe9"),
        (b"HTTP/1.1", b"HTTP/1.0"),
        (b"GET", b"HEAD"),
    ],
)
def test_invalid_handshake_of_a_websocket_is_refused(
    gateway: GatewayProcess, old: bytes, new: bytes
) -> None:
    """A key that is not ASCII, and what is no GET of HTTP/1.1 (RFC 6455 4.1)."""
    handshake = upgrade(gateway).replace(old, new, 1)
    assert raw(gateway, handshake).status == 403


REQUEST = b'{"jsonrpc": "2.0", "id": 1, "method": "arm", "params": ' + ARM + b"}"
FRAGMENT = b" " * 40_000
INVALID_FRAMES = {
    "binary": (frame(b"\x00\x01", first=0x82), 1003),
    "too large": (frame(b" " * ((1 << 16) + 1)), 1009),
    "too large in fragments": (frame(FRAGMENT, first=0x01) + frame(FRAGMENT, first=0x80), 1009),
    "invalid UTF-8": (frame(b"\xff\xfe"), 1007),
    "two lines": (frame(REQUEST + b"\n" + REQUEST), 1003),
}
"""Frames, and close codes of RFC 6455."""


@pytest.mark.parametrize("name", INVALID_FRAMES)
def test_websocket_closes_after_an_invalid_frame(gateway: GatewayProcess, name: str) -> None:
    """With the close code of RFC 6455."""
    frames, code = INVALID_FRAMES[name]
    with RawWebSocket(gateway) as websocket:
        websocket.connection.sendall(frames)

        assert websocket.close_code() == code


def test_websocket_is_accepted_byte_by_byte_after_a_page_without_compression(
    gateway: GatewayProcess,
) -> None:
    """Its head ends with its last byte, wherever the bytes were divided.

    The offer of permessage-deflate is declined.
    """
    with gateway.connect() as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        get_icon(gateway, connection)
        for byte in upgrade(gateway, more=["Sec-WebSocket-Extensions: permessage-deflate"]):
            connection.sendall(bytes([byte]))
        head = connection.recv(1 << 16)
    assert head.startswith(b"HTTP/1.1 101 ")
    assert b"deflate" not in head
