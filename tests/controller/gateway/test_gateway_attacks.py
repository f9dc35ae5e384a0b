"""Attacks on the gateway, each refused while the daemon is asked nothing at all.

Every attack is a request to arm that would be granted but for one thing, or a frame that should not
be. The gateway is a real process before a daemon that notes whatever it is asked.
"""

import json
import pickle
from collections.abc import Callable, Iterator
from typing import TypeAlias

import pytest

from controller.gateway.connections import MAX_FRAGMENTS
from gateway_bench import (
    ARM,
    TOKEN,
    GatewayProcess,
    HttpResponse,
    RawWebSocket,
    ScriptedDaemon,
    frame,
    gateway_process,
    http,
    raw,
    upgrade,
    wait_for_daemon,
)

Attack: TypeAlias = Callable[[GatewayProcess], HttpResponse]
Misuse: TypeAlias = Callable[[RawWebSocket], None]


@pytest.fixture(scope="module")
def gateway(
    daemon: ScriptedDaemon, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[GatewayProcess]:
    """One for all attacks: it must survive them."""
    with gateway_process(tmp_path_factory.mktemp("gateway"), daemon.socket) as made:
        wait_for_daemon(made)
        yield made


@pytest.fixture(autouse=True)
def untouched(daemon: ScriptedDaemon, gateway: GatewayProcess) -> Iterator[None]:
    """After an attack the daemon was asked nothing, what is allowed is granted as ever, and no line
    was written to the log: who attacks could fill it.
    """
    daemon.calls.clear()
    logged = gateway.log()
    yield
    assert daemon.calls == []
    assert http(gateway).status == 200
    assert daemon.methods == ["arm"]
    assert gateway.log() == logged


def body(value: object) -> bytes:
    """As JSON."""
    return json.dumps(value).encode()


def arm(**changes: object) -> bytes:
    """Parameters of arm with these instead."""
    return body({"owner": "me", "lease_s": 5, **changes})


def form(media: str | None) -> Attack:
    """What a foreign form or a fetch without preflight can send."""
    return lambda g: http(g, media=media)


def origin(*origins: str) -> Attack:
    """A page of these origins."""
    return lambda g: http(g, more=[f"Origin: {each}" for each in origins])


def host(*hosts: str) -> Attack:
    """These Host headers."""
    return lambda g: http(g, host=hosts)


def token(*tokens: str, target: str = "/api/v1/arm", more: tuple[str, ...] = ()) -> Attack:
    """These tokens."""
    return lambda g: http(g, target, token=tokens, more=more)


def saying(said: bytes) -> Attack:
    """This body."""
    return lambda g: http(g, body=said)


def getting(target: str, *, method: str = "GET") -> Attack:
    """A request without a body."""
    return lambda g: http(g, target, method=method, body=b"", media=None)


def bytes_of(said: bytes) -> Attack:
    """These bytes, with HOST and TOKEN filled in."""
    return lambda g: raw(
        g, said.replace(b"HOST", g.host.encode()).replace(b"TOKEN", TOKEN.encode())
    )


def handshake(**how: object) -> Attack:
    """A WebSocket's handshake, different in one thing."""
    return lambda g: raw(g, upgrade(g, **how))  # type: ignore[arg-type]


_HEAD = (
    b"POST /api/v1/arm HTTP/1.1\r\nHost: HOST\r\nAuthorization: Bearer TOKEN\r\n"
    b"Content-Type: application/json\r\nConnection: close\r\n"
)
_CHUNKED = _HEAD + b"Transfer-Encoding: chunked\r\n\r\n"

ATTACKS: dict[str, tuple[Attack, set[int]]] = {
    # pages of others
    "form, text/plain": (form("text/plain"), {415}),
    "form, urlencoded": (form("application/x-www-form-urlencoded"), {415}),
    "form, multipart": (form("multipart/form-data; boundary=x"), {415}),
    "form, no type": (form(None), {415}),
    "json in a parameter of the type": (form("text/plain; application/json"), {415}),
    "yaml": (form("application/yaml"), {415}),
    "pickle by its type": (form("application/python-pickle"), {415}),
    "foreign origin": (origin("http://evil.example"), {403}),
    "origin null": (origin("null"), {403}),
    "origin, another port": (origin("http://127.0.0.1:1"), {403}),
    "origin, another scheme": (lambda g: http(g, more=[f"Origin: https://{g.host}"]), {403}),
    "origin, own and foreign": (
        lambda g: http(g, more=[f"Origin: http://{g.host}", "Origin: http://evil.example"]),
        {403},
    ),
    "origin, own as a prefix": (
        lambda g: http(g, more=[f"Origin: http://{g.host}.evil.example"]),
        {403},
    ),
    "script of a foreign page": (
        lambda g: http(
            g, "/api/v1/openapi.json", method="GET", body=b"", more=["Sec-Fetch-Site: cross-site"]
        ),
        {403},
    ),
    "preflight of a foreign page": (
        lambda g: http(
            g,
            method="OPTIONS",
            body=b"",
            token=(),
            more=["Origin: http://evil.example", "Access-Control-Request-Method: POST"],
        ),
        {403},
    ),
    # names that are made to point here
    "rebinding": (host("evil.example"), {421}),
    "rebinding with the port": (lambda g: http(g, host=[f"evil.example:{g.port}"]), {421}),
    "host as a prefix": (host("127.0.0.1.evil.example"), {421}),
    "host with a user": (host("127.0.0.1@evil.example"), {421}),
    "host with a path": (host("127.0.0.1/evil"), {421, 400}),
    "host with a trailing dot": (host("localhost."), {421}),
    "host, another loopback address": (host("127.0.0.2"), {421}),
    "host, decimal address": (host("2130706433"), {421}),
    "host, not ASCII": (host("localhos\xfe"), {421}),
    "host, empty": (host(""), {421}),
    "host, two": (lambda g: http(g, host=[g.host, "evil.example"]), {400, 421}),
    "host, none": (host(), {400}),
    "host, none, HTTP/1.0": (
        bytes_of(b"POST /api/v1/arm HTTP/1.0\r\nContent-Length: 0\r\n\r\n"),
        {421},
    ),
    "host said by a proxy": (
        lambda g: http(g, host=["evil.example"], more=[f"X-Forwarded-Host: {g.host}"]),
        {421},
    ),
    "absolute target": (lambda g: http(g, "http://evil.example/api/v1/arm"), {404, 405}),
    # tokens
    "token missing": (token(), {401}),
    "token empty": (token(""), {401, 400}),
    "token wrong": (token("x" * len(TOKEN)), {401}),
    "token cut": (token(TOKEN[:-1]), {401}),
    "token lengthened": (token(TOKEN + "x"), {401}),
    "token in capitals": (token(TOKEN.upper()), {401}),
    "token not ASCII": (token("\xfe" * len(TOKEN)), {401}),
    "token twice": (token(TOKEN, TOKEN), {401}),
    "token and a wrong one": (token(TOKEN, "x"), {401}),
    "token in the query": (token(target=f"/api/v1/arm?token={TOKEN}"), {401}),
    "token in a cookie": (token(more=(f"Cookie: token={TOKEN}",)), {401}),
    "token as a password": (token(more=(f"Authorization: Basic {TOKEN}",)), {401}),
    "address said by a proxy": (token(more=("X-Forwarded-For: 127.0.0.1",)), {401}),
    "path with an escaped slash, no token": (token(target="/api%2Fv1%2Farm"), {401}),
    "path in capitals, no token": (token(target="/API/v1/arm"), {404, 405}),
    "path with two slashes, no token": (token(target="//api/v1/arm"), {404, 405}),
    "path with dots, no token": (token(target="/x/../api/v1/arm"), {404, 405}),
    # other files than the page's
    **{
        f"traversal {target}": (getting(target), {400, 404})
        for target in (
            "/../../../../etc/passwd",
            "/..%2f..%2f..%2f..%2fetc/passwd",
            "/%2e%2e/%2e%2e/%2e%2e/%2e%2e/etc/passwd",
            "/%252e%252e%252f%252e%252e%252fetc/passwd",
            "/....//....//....//etc/passwd",
            "/..%5c..%5c..%5cetc%5cpasswd",
            "/%c0%ae%c0%ae/%c0%ae%c0%ae/etc/passwd",
            "//etc/passwd",
            "/%2fetc%2fpasswd",
            "/app.js%00.png",
            "/../gateway/access.py",
            "/%2e%2e/settings.py",
            "/" + "a" * 5000,
            "/file:///etc/passwd",
        )
    },
    # more than anybody needs
    "body said to be large": (lambda g: http(g, length=1 << 40), {413}),
    "body too large": (saying(b'{"owner": "' + b"x" * (1 << 17) + b'"}'), {413}),
    "chunked bomb": (bytes_of(_CHUNKED + (b"10000\r\n" + b" " * 65536 + b"\r\n") * 8), {413}),
    "chunk that claims too much": (bytes_of(_CHUNKED + b"f" * 40 + b"\r\n"), {400}),
    "header too large": (lambda g: http(g, more=["X: " + "x" * (1 << 17)]), {400}),
    "headers too many": (lambda g: http(g, more=[f"X-{n}: x" for n in range(20_000)]), {400}),
    "promise to send a lot": (
        lambda g: http(g, length=1 << 30, more=["Expect: 100-continue"]),
        {413},
    ),
    # JSON and what is none
    "JSON, deep": (saying(b"[" * 60_000), {400}),
    "JSON, deep objects": (saying(b'{"a":' * 10_000 + b"1" + b"}" * 10_000), {400, 422}),
    "JSON, a number of 60 000 digits": (
        saying(b'{"owner": "me", "lease_s": ' + b"9" * 60_000 + b"}"),
        {400},
    ),
    "JSON, infinite": (saying(b'{"owner": "me", "lease_s": 1e999}'), {422}),
    "JSON, NaN": (saying(b'{"owner": "me", "lease_s": NaN}'), {400, 422}),
    "JSON, a list": (saying(b"[" + ARM + b"]"), {400}),
    "JSON, cut": (saying(ARM[:-1]), {400}),
    "JSON, two": (saying(ARM + ARM), {400}),
    "JSON, UTF-16 with a mark": (saying(b"\xff\xfe" + ARM), {400}),
    "JSON, broken UTF-8": (saying(b'{"owner": "\xff\xfe", "lease_s": 5}'), {400}),
    "YAML tag": (saying(b'!!python/object/apply:os.system ["true"]'), {400}),
    "YAML aliases": (saying(b"a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n"), {400}),
    "pickle": (saying(pickle.dumps({"owner": "me", "lease_s": 5.0})), {400}),
    "pickle's own keys": (saying(arm(owner={"__reduce__": ["os.system", ["true"]]})), {422}),
    # limits and keys
    "longer lease than allowed": (saying(arm(lease_s=1e6)), {422}),
    "lease as a text": (saying(arm(lease_s="5")), {422}),
    "lease as true": (saying(arm(lease_s=True)), {422}),
    "negative lease": (saying(arm(lease_s=-5)), {422}),
    "unknown key": (saying(arm(watchdog_s=60)), {422}),
    "limit raised": (saying(arm(limits={"level_max": 9})), {422}),
    "prototype": (saying(arm(__proto__={"lease_s": 60})), {422}),
    "constructor": (saying(arm(constructor={"prototype": {}})), {422}),
    "level of an effect raised": (
        lambda g: http(
            g, "/api/v1/play", body=body({"effect": "tap", "x_m": 0, "y_m": 0, "level": 9})
        ),
        {422},
    ),
    "touches without number": (
        lambda g: http(
            g,
            "/api/v1/touch",
            body=body({"source": "x", "touches": [{"id": 1, "x_m": 0.1, "y_m": 0.1}] * 65}),
        ),
        {422},
    ),
    "touch without a name": (
        lambda g: http(g, "/api/v1/touch", body=body({"source": "", "touches": []})),
        {422},
    ),
    "method of Python": (lambda g: http(g, "/api/v1/__class__"), {404}),
    "method of the WebSocket alone": (
        lambda g: http(g, "/api/v1/subscribe", body=body({"topics": ["log"]})),
        {404},
    ),
    "method with a path": (lambda g: http(g, "/api/v1/arm/../stop"), {404, 405}),
    # logs
    "new line in a name": (saying(arm(owner='me\n{"level": "info"}')), {422}),
    "escape codes in a name": (saying(arm(owner="\x1b[2Jme")), {422}),
    "new line in a method": (lambda g: http(g, "/api/v1/arm%0aERROR:%20all%20is%20lost"), {404}),
    "escape codes in a method": (lambda g: http(g, "/api/v1/%1b%5b2J"), {404}),
    "new line in a header": (lambda g: http(g, more=["X: a\n\nb"]), {400, 422}),
    # what HTTP is not
    "two lengths": (bytes_of(_HEAD + b"Content-Length: 29\r\nContent-Length: 0\r\n\r\n"), {400}),
    "length not a number": (bytes_of(_HEAD + b"Content-Length: +29\r\n\r\n" + ARM), {400}),
    "length and chunks, a request within": (
        bytes_of(
            b"POST /api/v1/x HTTP/1.1\r\nHost: HOST\r\nContent-Length: 4\r\n"
            b"Transfer-Encoding: chunked\r\nConnection: close\r\n\r\n0\r\n\r\n" + _HEAD
        ),
        {400, 401},
    ),
    "folded header": (bytes_of(_HEAD + b" X: y\r\nTransfer-Encoding : chunked\r\n\r\n"), {400}),
    "HTTP/0.9": (bytes_of(b"GET /api/v1/arm\r\n\r\n"), {400}),
    "HTTP/2": (bytes_of(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"), {400, 421}),
    "TLS to a plain port": (
        bytes_of(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n"),
        {400},
    ),
    "noise": (bytes_of(bytes(range(256)) * 40 + b"\r\n\r\n"), {400}),
    "TRACE": (getting("/api/v1/arm", method="TRACE"), {405}),
    "OPTIONS": (getting("/api/v1/arm", method="OPTIONS"), {405}),
    "CONNECT": (getting("evil.example:443", method="CONNECT"), {404, 405}),
    "GET": (getting("/api/v1/arm"), {405}),
    "PUT": (getting("/api/v1/arm", method="PUT"), {405}),
    "DELETE": (getting("/api/v1/arm", method="DELETE"), {405}),
    "method overridden": (
        lambda g: http(g, method="GET", body=b"", more=["X-HTTP-Method-Override: POST"]),
        {405},
    ),
    # WebSockets that are not let in
    "socket of a foreign page": (handshake(origin="http://evil.example"), {403}),
    "socket of origin null": (handshake(origin="null"), {403}),
    "socket, rebinding": (handshake(host="evil.example"), {403}),
    "socket, no token": (handshake(protocols=["era-haptics.v1"]), {403}),
    "socket, wrong token": (
        handshake(protocols=["era-haptics.v1", "era-haptics.token.x"]),
        {403},
    ),
    "socket, two tokens": (
        handshake(protocols=["era-haptics.v1", *[f"era-haptics.token.{TOKEN}"] * 2]),
        {403},
    ),
    "socket, token in the query": (
        handshake(target=f"/api/v1/ws?token={TOKEN}", protocols=["era-haptics.v1"]),
        {403},
    ),
    "socket, no protocol": (handshake(protocols=[f"era-haptics.token.{TOKEN}"]), {403}),
    "socket elsewhere": (handshake(target="/api/v1/arm"), {403}),
}


@pytest.mark.parametrize("name", ATTACKS)
def test_an_attack_over_http_is_refused(gateway: GatewayProcess, name: str) -> None:
    """With the status that fits, in JSON or nothing, and no file's content in it."""
    attack, statuses = ATTACKS[name]
    answer = attack(gateway)
    assert answer.status in statuses, answer
    assert b"root:" not in answer.body
    assert b"import" not in answer.body


def texts(said: bytes) -> Misuse:
    """One text frame."""
    return lambda ws: ws.send(said)


MISUSES: dict[str, tuple[Misuse, set[int]]] = {
    "binary": (lambda ws: ws.send(b"\x00\x01", first=0x82), {1003}),
    "compressed": (lambda ws: ws.send(b"\x00" * 20, first=0xC1), {1002}),
    "reserved bits": (lambda ws: ws.send(b"{}", first=0xB1), {1002}),
    "reserved opcode": (lambda ws: ws.send(b"{}", first=0x83), {1002}),
    "not masked": (lambda ws: ws.send(b"{}", is_masked=False), {1002}),
    "too large": (texts(b" " * ((1 << 16) + 1)), {1009}),
    "said to be endless": (
        lambda ws: ws.connection.sendall(b"\x81\xff" + b"\x7f" + b"\xff" * 7),
        {1009, 1002},
    ),
    "too large in fragments": (
        lambda ws: ws.connection.sendall(
            frame(b" " * 40_000, first=0x01) + frame(b" " * 40_000, first=0x80)
        ),
        {1009},
    ),
    "fragments without end": (
        lambda ws: ws.connection.sendall(
            frame(b"", first=0x01) + frame(b"", first=0x00) * (2 * MAX_FRAGMENTS)
        ),
        {0},
    ),
    "fragment of nothing": (lambda ws: ws.send(b"{}", first=0x80), {1002}),
    "long ping": (lambda ws: ws.send(b"x" * 126, first=0x89), {1002}),
    "flood of pings": (lambda ws: ws.connection.sendall(frame(b"", first=0x89) * 10_000), {0}),
    "flood of pongs": (lambda ws: ws.connection.sendall(frame(b"", first=0x8A) * 10_000), {0}),
    "no UTF-8": (texts(b"\xff\xfe"), {1007}),
}


@pytest.mark.parametrize("name", MISUSES)
def test_a_frame_that_should_not_be_ends_the_socket(gateway: GatewayProcess, name: str) -> None:
    """With the close code of RFC 6455 that fits; 0: without one."""
    misuse, codes = MISUSES[name]
    with RawWebSocket(gateway) as ws:
        misuse(ws)
        assert ws.close_code() in codes


REQUESTS: dict[str, tuple[bytes, int]] = {
    "no JSON": (b"arm", -32700),
    "deep": (b"[" * 60_000, -32700),
    "NaN": (b'{"jsonrpc": "2.0", "id": NaN, "method": "arm", "params": {}}', -32700),
    "batch": (b'[{"jsonrpc": "2.0", "id": 1, "method": "stop"}]', -32600),
    "version 1": (b'{"id": 1, "method": "stop", "params": {}}', -32600),
    "unknown member": (b'{"jsonrpc": "2.0", "id": 1, "method": "stop", "x": 1}', -32600),
    "id that is an object": (b'{"jsonrpc": "2.0", "id": {}, "method": "stop"}', -32600),
    "unknown method": (b'{"jsonrpc": "2.0", "id": 1, "method": "set_limit"}', -32601),
    "escape codes in a method": (
        b'{"jsonrpc": "2.0", "id": 1, "method": "\\u001b[2J"}',
        -32601,
    ),
    "limit raised": (
        b'{"jsonrpc": "2.0", "id": 1, "method": "arm", '
        b'"params": {"owner": "me", "lease_s": 5, "level_max": 9}}',
        -32602,
    ),
    "new line in a name": (
        b'{"jsonrpc": "2.0", "id": 1, "method": "arm", '
        b'"params": {"owner": "me\\n[ERROR]", "lease_s": 5}}',
        -32602,
    ),
    "touch of infinity": (
        b'{"jsonrpc": "2.0", "id": 1, "method": "touch", '
        b'"params": {"source": "x", "touches": [{"id": 1, "x_m": 1e999, "y_m": 0}]}}',
        -32602,
    ),
    "topic that is none": (
        b'{"jsonrpc": "2.0", "id": 1, "method": "subscribe", "params": {"topics": ["__proto__"]}}',
        -32602,
    ),
}


@pytest.mark.parametrize("name", REQUESTS)
def test_a_request_that_should_not_be_is_told_why(gateway: GatewayProcess, name: str) -> None:
    """It is answered with the error's code, without control characters, and the socket stays."""
    said, code = REQUESTS[name]
    with RawWebSocket(gateway) as ws:
        ws.send(said)
        opcode, payload = ws.next()
        assert opcode == 1
        error = json.loads(payload)["error"]
        assert error["code"] == code
        assert error["message"].isprintable()
        ws.call("no_such", {}, id=2)
        assert ws.response(2)["error"]


def test_compression_is_not_agreed_on(gateway: GatewayProcess) -> None:
    """Whoever offers permessage-deflate gets a WebSocket without it."""
    said = upgrade(gateway, more=["Sec-WebSocket-Extensions: permessage-deflate"])
    with gateway.connect() as connection:
        connection.sendall(said)
        head = connection.recv(1 << 16)
    assert head.startswith(b"HTTP/1.1 101 ")
    assert b"deflate" not in head
