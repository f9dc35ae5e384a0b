"""Attacks on the gateway are refused, and none of them reaches the daemon.

An attack is a request to arm that would be granted but for one thing, or an invalid frame. The
gateway is a process connected to a daemon that records its calls.
"""

import contextlib
import socket
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import httpx
import pytest

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
    with gateway_process(tmp_path_factory.mktemp("gateway"), daemon.socket) as made:
        wait_for_daemon(made)
        yield made


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


def filled(value: Any, gateway: GatewayProcess) -> Any:
    """A value with the gateway's host in place of HOST."""
    match value:
        case str():
            return value.replace("HOST", gateway.host)
        case bytes():
            return value.replace(b"HOST", gateway.host.encode())
        case list():
            return [filled(each, gateway) for each in value]
        case dict():
            return {key: filled(each, gateway) for key, each in value.items()}
    return value


def origin(*origins: str) -> dict[str, Any]:
    """A request of pages of these origins."""
    return {"more": [f"Origin: {each}" for each in origins]}


def get(target: str, method: str = "GET") -> dict[str, Any]:
    """A request without a body."""
    return {"target": target, "method": method, "body": b"", "media": None}


ATTACKS: dict[str, tuple[dict[str, Any], set[int]]] = {
    # foreign pages: content types that need no preflight
    "text/plain": ({"media": "text/plain"}, {415}),
    "urlencoded form": ({"media": "application/x-www-form-urlencoded"}, {415}),
    "multipart form": ({"media": "multipart/form-data; boundary=x"}, {415}),
    "no type": ({"media": None}, {415}),
    "json as a parameter of the type": ({"media": "text/plain; application/json"}, {415}),
    "foreign origin": (origin("http://evil.example"), {403}),
    "origin null": (origin("null"), {403}),
    "empty origin at an impossible port": (origin("") | {"host": ["localhost:99999"]}, {403}),
    "origin with another port": (origin("http://127.0.0.1:1"), {403}),
    "origin with another scheme": (origin("https://HOST"), {403}),
    "own and foreign origin": (origin("http://HOST", "http://evil.example"), {403}),
    "own origin as a prefix": (origin("http://HOST.evil.example"), {403}),
    "script of a foreign page": (
        get("/api/v1/openapi.json") | {"more": ["Sec-Fetch-Site: cross-site"]},
        {403},
    ),
    "preflight of a foreign page": (
        get("/api/v1/arm", "OPTIONS")
        | {
            "token": [],
            "more": ["Origin: http://evil.example", "Access-Control-Request-Method: POST"],
        },
        {403},
    ),
    # DNS rebinding
    "foreign host": ({"host": ["evil.example"]}, {421}),
    "foreign host with a port": ({"host": ["evil.example:8137"]}, {421}),
    "host as a prefix": ({"host": ["127.0.0.1.evil.example"]}, {421}),
    "host with a user": ({"host": ["127.0.0.1@evil.example"]}, {421}),
    "host with a path": ({"host": ["127.0.0.1/evil"]}, {421, 400}),
    "host with a trailing dot": ({"host": ["localhost."]}, {421}),
    "another loopback address": ({"host": ["127.0.0.2"]}, {421}),
    "decimal address": ({"host": ["2130706433"]}, {421}),
    "host not ASCII": ({"host": ["localhos\xfe"]}, {421}),
    "empty host": ({"host": [""]}, {421}),
    "two hosts": ({"host": ["HOST", "evil.example"]}, {400, 421}),
    "forwarded host": ({"host": ["evil.example"], "more": ["X-Forwarded-Host: HOST"]}, {421}),
    "absolute target": ({"target": "http://evil.example/api/v1/arm"}, {400}),
    # tokens
    "no token": ({"token": []}, {401}),
    "empty token": ({"token": [""]}, {401, 400}),
    "wrong token": ({"token": ["x" * len(TOKEN)]}, {401}),
    "shortened token": ({"token": [TOKEN[:-1]]}, {401}),
    "lengthened token": ({"token": [TOKEN + "x"]}, {401}),
    "token in capitals": ({"token": [TOKEN.upper()]}, {401}),
    "token not ASCII": ({"token": ["\xfe" * len(TOKEN)]}, {401}),
    "token twice": ({"token": [TOKEN, TOKEN]}, {401}),
    "right and wrong token": ({"token": [TOKEN, "x"]}, {401}),
    "token in the query": ({"token": [], "target": f"/api/v1/arm?token={TOKEN}"}, {401}),
    "token awaited with the body": ({"token": [], "more": ["Expect: 100-continue"]}, {401}),
    "token in a cookie": ({"token": [], "more": [f"Cookie: token={TOKEN}"]}, {401}),
    "token as a password": ({"token": [], "more": [f"Authorization: Basic {TOKEN}"]}, {401}),
    "forwarded address": ({"token": [], "more": ["X-Forwarded-For: 127.0.0.1"]}, {401}),
    "escaped slash, no token": ({"token": [], "target": "/api%2Fv1%2Farm"}, {401}),
    "path in capitals, no token": ({"token": [], "target": "/API/v1/arm"}, {404, 405}),
    "two slashes, no token": ({"token": [], "target": "//api/v1/arm"}, {404, 405}),
    "path with dots, no token": ({"token": [], "target": "/x/../api/v1/arm"}, {404, 405}),
    # stops, which are carried out before anything but these is checked
    "stop without a token": ({"target": "/api/v1/stop", "token": []}, {401}),
    "stop with a wrong token": ({"target": "/api/v1/stop", "token": ["x" * len(TOKEN)]}, {401}),
    "stop of a foreign origin": (
        origin("http://evil.example") | {"target": "/api/v1/stop"},
        {403},
    ),
    "stop of a foreign host": ({"target": "/api/v1/stop", "host": ["evil.example"]}, {421}),
    "stop of a foreign page without an origin": (
        {"target": "/api/v1/stop", "more": ["Sec-Fetch-Site: cross-site"]},
        {403},
    ),
    "stop by an absolute target": ({"target": "http://evil.example/api/v1/stop"}, {400}),
    "disarm without a token": ({"target": "/api/v1/disarm", "token": []}, {401}),
    "preflight of a stop": (get("/api/v1/stop", "OPTIONS"), {200}),
    # files other than the page's
    "file outside": (get("/../../../../etc/passwd"), {400, 404}),
    "file outside, escaped": (get("/%2e%2e/settings.py"), {400, 404}),
    "file outside, escaped slashes": (get("/..%2f..%2f..%2f..%2fetc/passwd"), {400, 404}),
    # size and content of the body
    "body of a large length": ({"length": 1 << 40}, {413}),
    "body too large": ({"body": b'{"owner": "' + b"x" * (1 << 17) + b'"}'}, {413}),
    "deep JSON": ({"body": b"[" * 60_000}, {400}),
    "number of 60 000 digits": ({"body": b'{"lease_s": ' + b"9" * 60_000 + b"}"}, {400}),
    "infinity": ({"body": b'{"owner": "me", "lease_s": 1e999}'}, {422}),
    "NaN": ({"body": b'{"owner": "me", "lease_s": NaN}'}, {400, 422}),
    "list": ({"body": b"[" + ARM + b"]"}, {400}),
    "incomplete JSON": ({"body": ARM[:-1]}, {400}),
    "UTF-16": ({"body": b"\xff\xfe" + ARM}, {400}),
    "invalid UTF-8": ({"body": b'{"owner": "\xff\xfe", "lease_s": 5}'}, {400}),
    "pickle": ({"body": b"\x80\x04}\x94."}, {400}),
    "lease too long": ({"body": b'{"owner": "me", "lease_s": 1e6}'}, {422}),
    "raised limit": ({"body": b'{"owner": "me", "lease_s": 5, "level_max": 9}'}, {422}),
    "escape codes in a name": ({"body": b'{"owner": "\\u001b[2J", "lease_s": 5}'}, {422}),
    # methods
    "method of Python": ({"target": "/api/v1/__class__"}, {404}),
    "method of the WebSocket": ({"target": "/api/v1/subscribe"}, {404}),
    "escape codes in a method": ({"target": "/api/v1/%1b%5b2J"}, {400}),
    "line feed in a method": ({"target": "/api/v1/arm%0aERROR:%20lost"}, {400}),
    "GET": (get("/api/v1/arm"), {405}),
}


@pytest.mark.parametrize("name", ATTACKS)
def test_http_request_is_refused(gateway: GatewayProcess, name: str) -> None:
    """With the right status, and without the content of a file."""
    changes, statuses = ATTACKS[name]
    response = http(gateway, **filled(changes, gateway))
    assert response.status in statuses, response
    assert b"root:" not in response.body
    assert b"import" not in response.body


CHUNKED = (
    b"POST /api/v1/arm HTTP/1.1\r\nHost: HOST\r\nAuthorization: Bearer "
    + TOKEN.encode()
    + b"\r\nContent-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n"
)

GRANTED = CHUNKED.replace(
    b"Transfer-Encoding: chunked", b"Connection: close\r\nContent-Length: %d" % len(ARM)
)
GRANTED += ARM


@pytest.mark.parametrize(
    ("data", "statuses"),
    [
        pytest.param(
            b"POST /api/v1/arm HTTP/1.0\r\nContent-Length: 0\r\n\r\n", {421}, id="no host"
        ),
        pytest.param(CHUNKED + (b"10000\r\n" + b" " * 65536 + b"\r\n") * 8, {411}, id="chunks"),
        pytest.param(
            CHUNKED.replace(b"chunked", b"gzip, chunked") + b"0\r\n\r\n", {411}, id="two encodings"
        ),
        pytest.param(GRANTED.replace(b"HTTP/1.1", b"HTTP/2.0"), {505}, id="HTTP/2.0"),
        pytest.param(GRANTED.replace(b"HTTP/1.1", b"HTTP/0.9"), {505}, id="HTTP/0.9"),
        pytest.param(bytes(range(256)) * 40 + b"\r\n\r\n", {400}, id="noise"),
    ],
)
def test_http_bytes_are_refused(gateway: GatewayProcess, data: bytes, statuses: set[int]) -> None:
    """Without Host, bodies without a length, other versions of HTTP, and no HTTP at all."""
    response = raw(gateway, filled(data, gateway))
    assert response.status in statuses
    assert response.headers.startswith("HTTP/")


@pytest.mark.parametrize("body", [b" " * 5_000_000, b"1\r\n \r\n" * 500_000])
def test_refusal_is_read_after_the_whole_body_is_sent(gateway: GatewayProcess, body: bytes) -> None:
    """By a client that reads only then: sized or in chunks, the body is discarded meanwhile."""
    head = filled(CHUNKED, gateway)
    if body.startswith(b" "):
        head = head.replace(b"Transfer-Encoding: chunked", b"Content-Length: 5000001")
    with gateway.connect() as connection:
        connection.sendall(head + body)
        assert connection.recv(1 << 16)[9:12] in (b"411", b"413")


LENGTH = b"Content-Length: %d" % len(ARM)
AMBIGUOUS = {
    "line feeds alone": GRANTED.replace(b"\r\n", b"\n"),
    "one line feed alone": GRANTED.replace(TOKEN.encode() + b"\r\n", TOKEN.encode() + b"\n"),
    "one carriage return alone": GRANTED.replace(b"Type: ", b"Type: x\rX-a: "),
    "folded line": GRANTED.replace(b"Type: ", b"Type:\r\n "),
    "two ways to give the length": GRANTED.replace(
        LENGTH, b"Transfer-Encoding: chunked\r\n" + LENGTH
    ),
    "two lengths": GRANTED.replace(LENGTH, b"Content-Length: 3\r\n" + LENGTH),
    "length with a sign": GRANTED.replace(b"Length: ", b"Length: +"),
    "negative length": GRANTED.replace(b"Length: ", b"Length: -"),
    "unknown encoding": GRANTED.replace(LENGTH, b"Transfer-Encoding: xchunked"),
    "tab before the colon": GRANTED.replace(b"Length: ", b"Length\t: "),
    "space before the colon": GRANTED.replace(b"Length: ", b"Length : "),
}


@pytest.mark.parametrize("name", AMBIGUOUS)
def test_head_that_a_proxy_may_misread_is_refused(gateway: GatewayProcess, name: str) -> None:
    """After a request that is served, and in pieces; the connection ends with it."""
    head, _, body = filled(AMBIGUOUS[name], gateway).partition(b"\r\n\r\n")
    first = f"GET /icon.svg HTTP/1.1\r\nHost: {gateway.host}\r\n\r\n".encode()
    with gateway.connect() as connection:
        connection.sendall(first)
        assert b"</svg>" in connection.recv(1 << 16)
        connection.sendall(head[:-1])
        assert http(gateway, target="/api/v1/openapi.json", method="GET").status == 200
        connection.sendall(head[-1:] + b"\r\n\r\n" + body)
        received = b""
        with contextlib.suppress(ConnectionError):
            while part := connection.recv(1 << 16):
                received += part
    assert received[9:12] in (b"400", b"411")


OWN = f"era-haptics.token.{TOKEN}"


KEY = b"Sec-WebSocket-Key: "


@pytest.mark.parametrize(
    "changes",
    [
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"host": "evil.example"},
        {"protocols": ["era-haptics.v1"]},
        {"protocols": ["era-haptics.v1", "era-haptics.token.x"]},
        {"protocols": ["era-haptics.v1", OWN, OWN]},
        {"protocols": ["era-haptics.v1"], "target": f"/api/v1/ws?token={TOKEN}"},
        {"protocols": [OWN]},
        {"protocols": []},
        {"target": "/api/v1/arm"},
        {"more": ["Content-Length: 100"]},
        {"more": ["Transfer-Encoding: chunked"]},
        {"replaced": (KEY, KEY + b"\xe9")},
        {"replaced": (b"HTTP/1.1", b"HTTP/1.0")},
        {"replaced": (b"GET", b"HEAD")},
    ],
    ids=str,
)
def test_websocket_is_refused(gateway: GatewayProcess, changes: dict[str, Any]) -> None:
    """A foreign origin or host, a missing, wrong or repeated token, no subprotocol, other paths.

    A body, a key that is not ASCII, and what is no GET of HTTP/1.1 (RFC 6455 4.1).
    """
    given = {key: value for key, value in changes.items() if key != "replaced"}
    asked = upgrade(gateway, **given).replace(*changes.get("replaced", (b"", b"")), 1)
    assert raw(gateway, asked).status == 403


Misuse: TypeAlias = Callable[[RawWebSocket], None]

REQUEST = b'{"jsonrpc": "2.0", "id": 1, "method": "arm", "params": ' + ARM + b"}"

MISUSES: dict[str, tuple[Misuse, set[int]]] = {
    "binary": (lambda ws: ws.send(b"\x00\x01", first=0x82), {1003}),
    "too large": (lambda ws: ws.send(b" " * ((1 << 16) + 1)), {1009}),
    "too large in fragments": (
        lambda ws: ws.connection.sendall(
            frame(b" " * 40_000, first=0x01) + frame(b" " * 40_000, first=0x80)
        ),
        {1009},
    ),
    "invalid UTF-8": (lambda ws: ws.send(b"\xff\xfe"), {1007}),
    "two lines": (lambda ws: ws.send(REQUEST + b"\n" + REQUEST), {1003}),
}


@pytest.mark.parametrize("name", MISUSES)
def test_websocket_closes_after_an_invalid_frame(gateway: GatewayProcess, name: str) -> None:
    """With the close code of RFC 6455, or 0: without a close frame."""
    misuse, codes = MISUSES[name]
    with RawWebSocket(gateway) as ws:
        misuse(ws)
        assert ws.close_code() in codes


def test_websocket_is_accepted_byte_by_byte_after_a_page_without_compression(
    gateway: GatewayProcess,
) -> None:
    """Its head ends with its last byte, wherever the bytes were divided.

    The offer of permessage-deflate is declined.
    """
    first = f"GET /icon.svg HTTP/1.1\r\nHost: {gateway.host}\r\n\r\n".encode()
    with gateway.connect() as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.sendall(first)
        assert b"</svg>" in connection.recv(1 << 16)
        for byte in upgrade(gateway, more=["Sec-WebSocket-Extensions: permessage-deflate"]):
            connection.sendall(bytes([byte]))
        head = connection.recv(1 << 16)
    assert head.startswith(b"HTTP/1.1 101 ")
    assert b"deflate" not in head
