"""Requests that silence are carried out whatever is wrong with them, over every transport.

`silencing.yaml` has what may be wrong. The daemon records its calls, the gateway is a process.
"""

import asyncio
import json
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cases import read_yaml
from controller.api.client import AsyncClient, Client
from controller.api.methods import METHODS, SILENCING, RequestedBy
from controller.api.silencing import read_silencing, readable_params
from model.errors import InputError
from processes.daemons import PATIENCE, ServedApi
from processes.gateways import (
    TOKEN,
    GatewayProcess,
    RawWebSocket,
    ScriptedDaemon,
    gateway_process,
    wait_for,
    wait_for_daemon,
)

PROMPT = 10.0  # s; within which a request is carried out, on a busy machine
LONG_TEXTS = {
    "DIGITS": "9" * 5000,
    "KEYS": ",".join(f'"{number}":1' for number in range(3000)),
    "DEPTH": "[" * 600 + "]" * 600,
    "LENGTH": "x" * 70_000,
}


@dataclass
class Form:
    """A request in which something is wrong, as in the file."""

    params: str = "{}"
    line: str = '{"jsonrpc": "2.0", "id": 1, "method": "METHOD", "params": PARAMS}'
    client: str | None = None

    def line_of(self, method: str) -> bytes:
        """The request in one line, without its line feed."""
        text = self.line.replace("PARAMS", self.params)
        for name, long_text in LONG_TEXTS.items():
            text = text.replace(name, long_text)
        escaped = "".join(rf"\u{ord(letter):04x}" for letter in method)
        return text.replace("METHOD", method).replace("ESCAPED", escaped).encode()

    def body_of(self, method: str) -> bytes:
        """The parameters as a body, or the whole request where that is what is wrong."""
        return self.line_of(method) if self.params == "{}" else self.params.encode()

    @property
    def arguments(self) -> dict[str, Any] | None:
        """The parameters as arguments of the Python clients; None if they cannot be."""
        try:
            params = json.loads(self.params)
        except ValueError:
            return None
        is_given = isinstance(params, dict) and len(params) > 0
        return params if is_given else None


FORMS = {
    name: Form(**keys)
    for name, keys in read_yaml(Path(__file__).with_name("silencing.yaml")).items()
}


@dataclass
class Place:
    """A daemon that records its calls, and a gateway to it."""

    daemon: ScriptedDaemon
    gateway: GatewayProcess

    def send_line(self, data: bytes, *, closes: bool = False) -> str:
        """The daemon's error in reply to bytes; closes: whether the client closes its side."""
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(PATIENCE)
            connection.connect(str(self.daemon.socket))
            connection.sendall(data)
            if closes:
                connection.shutdown(socket.SHUT_WR)
            with connection.makefile("rb") as received:
                return str(json.loads(received.readline())["error"]["message"])

    def post(
        self, method: str, body: bytes, *, head: str = "", request: str = "", closes: bool = False
    ) -> tuple[int, str]:
        """Status and error of the gateway; head: in place of type and length of the body."""
        request = request or f"POST /api/v1/{method} HTTP/1.1"
        head = head or f"Content-Type: application/json\r\nContent-Length: {len(body)}"
        credentials = f"Host: {self.gateway.host}\r\nAuthorization: Bearer {TOKEN}"
        with self.gateway.connect() as connection:
            connection.sendall(f"{request}\r\n{credentials}\r\n{head}\r\n\r\n".encode() + body)
            if closes:
                connection.shutdown(socket.SHUT_WR)
            with connection.makefile("rb") as received:
                status = int(received.readline().split()[1])
                length = 0
                while (line := received.readline().strip()) != b"":
                    name, _, value = line.partition(b": ")
                    if name.lower() == b"content-length":
                        length = int(value)
                content = json.loads(received.read(length))
                assert not closes or received.read() == b""  # the gateway has closed, too
        return status, content.get("error", "")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    """One for all requests."""
    with (
        ScriptedDaemon(tmp_path_factory.mktemp("daemon")) as daemon,
        gateway_process(tmp_path_factory.mktemp("gateway"), daemon.socket) as gateway,
    ):
        wait_for_daemon(gateway)
        yield Place(daemon, gateway)


def over_socket(place: Place, form: Form, method: str) -> str:
    """Send a line to the daemon."""
    return place.send_line(form.line_of(method) + b"\n")


def over_half_closed_socket(place: Place, form: Form, method: str) -> str:
    """Send a line without its line feed, and close the side of the client."""
    return place.send_line(form.line_of(method), closes=True)


def over_http(place: Place, form: Form, method: str) -> str:
    """Post a body."""
    status, error = place.post(method, form.body_of(method))
    assert status in (400, 413, 422), status
    return error


def over_half_closed_http(place: Place, form: Form, method: str) -> str:
    """Post a body, and close the side of the client."""
    status, error = place.post(method, form.body_of(method), closes=True)
    assert status in (400, 413, 422), status
    return error


def over_websocket(place: Place, form: Form, method: str) -> str:
    """Send a frame, which the gateway closes for if it is too long."""
    line = form.line_of(method)
    with RawWebSocket(place.gateway) as browser:
        browser.send(line)
        if len(line) > 1 << 16:
            assert browser.close_code() == 1009
            return "too long"
        _, reply = browser.next()
        return str(json.loads(reply)["error"]["message"])


def over_async_client(place: Place, form: Form, method: str) -> str:
    """Call the method of the client for asyncio."""

    async def call() -> None:
        async with await AsyncClient.connect(place.daemon.socket) as client:
            await getattr(client, method)(**form.arguments)

    with pytest.raises((InputError, TypeError)) as caught:
        asyncio.run(call())
    return str(caught.value)


def over_blocking_client(place: Place, form: Form, method: str) -> str:
    """Call the method of the blocking client."""
    with (
        Client.connect(place.daemon.socket) as client,
        pytest.raises((InputError, TypeError)) as caught,
    ):
        getattr(client, method)(**form.arguments)
    return str(caught.value)


TRANSPORTS: dict[str, Callable[[Place, Form, str], str]] = {
    function.__name__.removeprefix("over_"): function
    for function in (
        over_socket,
        over_half_closed_socket,
        over_http,
        over_half_closed_http,
        over_websocket,
        over_async_client,
        over_blocking_client,
    )
}


@pytest.mark.parametrize("method", sorted(SILENCING))
@pytest.mark.parametrize("transport", TRANSPORTS)
def test_request_that_silences_is_carried_out_whatever_is_wrong_with_it(
    place: Place, transport: str, method: str
) -> None:
    """Once, with those of its parameters that can be read; then its error is reported."""
    failures: dict[str, object] = {}
    for name, form in FORMS.items():
        if transport.endswith("client") and form.arguments is None:
            continue
        place.daemon.calls.clear()
        error = TRANSPORTS[transport](place, form, method)
        wait_for(lambda: place.daemon.calls, timeout=PROMPT)
        ((called, params),) = place.daemon.calls
        assert isinstance(params, RequestedBy)
        client = form.client
        if transport.endswith("http") and (client is None or form.params == "{}"):
            client = "http 127.0.0.1"  # of a body that has no name where parameters have it
        is_named = str(params.client).rpartition(":")[0] == client or params.client == client
        if called != method or not is_named or not error:
            failures[name] = (called, params, error)
    assert failures == {}


MEDIA = "Content-Type: application/json\r\n"
HTTP_FORMS: dict[str, tuple[dict[str, Any], int]] = {
    "a form's content type": (
        {"head": "Content-Type: application/x-www-form-urlencoded\r\nContent-Length: 6"},
        415,
    ),
    "text": ({"head": "Content-Type: text/plain\r\nContent-Length: 6"}, 415),
    "no content type": ({"head": "Content-Length: 6"}, 415),
    "chunks": (
        {"head": MEDIA + "Transfer-Encoding: chunked", "body": b"6\r\n{    }\r\n0\r\n\r\n"},
        411,
    ),
    "a body that is too long": ({"head": MEDIA + "Content-Length: 100000000"}, 413),
    "a body that does not come": (
        {"head": MEDIA + "Content-Length: 100", "closes": True},
        408,
    ),
    "HTTP/2.0": ({"request": "POST /api/v1/METHOD HTTP/2.0"}, 505),
    "GET": ({"request": "GET /api/v1/METHOD HTTP/1.1", "head": "Accept: */*", "body": b""}, 405),
    "PUT": ({"request": "PUT /api/v1/METHOD HTTP/1.1"}, 405),
}


@pytest.mark.parametrize("method", sorted(SILENCING))
@pytest.mark.parametrize("name", HTTP_FORMS)
def test_http_request_that_silences_is_carried_out_however_it_is_sent(
    place: Place, name: str, method: str
) -> None:
    """If its host, origin and token are right; then its error is reported."""
    changes, status = HTTP_FORMS[name]
    sent = {"body": b"{    }"} | changes
    if "request" in sent:
        sent["request"] = sent["request"].replace("METHOD", method)
    place.daemon.calls.clear()
    assert place.post(method, **sent)[0] == status
    assert place.daemon.methods == [method]


def test_stop_does_not_wait_for_its_body(place: Place) -> None:
    """Which only names its client; it is answered once the body has come."""
    head = f"POST /api/v1/stop HTTP/1.1\r\nHost: {place.gateway.host}\r\n{MEDIA}"
    place.daemon.calls.clear()
    with place.gateway.connect() as connection:
        connection.sendall(f"{head}Authorization: Bearer {TOKEN}\r\n".encode())
        connection.sendall(b"Content-Length: 17\r\n\r\n{")
        wait_for(lambda: place.daemon.methods == ["stop"], timeout=PROMPT)
        connection.sendall(b'"client": "hmi"}')
        assert connection.recv(1 << 16)[9:12] == b"200"
    assert place.daemon.methods == ["stop"]


FRAMES: dict[str, tuple[bytes, int, int]] = {
    "binary": (b'{"jsonrpc": "2.0", "id": 1, "method": "METHOD"}', 0x82, 1003),
    "two lines": (b'{"jsonrpc": "2.0",\n "id": 1, "method": "METHOD"}', 0x81, 1003),
    "a line feed behind it": (b'{"jsonrpc": "2.0", "id": 1, "method": "METHOD"}\n', 0x81, 1003),
    "not UTF-8": (b'{"method": "METHOD", "params": {"client": "\xff"}}', 0x81, 1007),
    "the method behind 64 KiB": (
        b'{"params": {"client": "' + b"x" * 70_000 + b'"}, "method": "METHOD"}',
        0x81,
        1009,
    ),
}


@pytest.mark.parametrize("method", sorted(SILENCING))
@pytest.mark.parametrize("name", FRAMES)
def test_frame_that_silences_is_carried_out_before_it_is_refused(
    place: Place, name: str, method: str
) -> None:
    """The WebSocket is closed with the code of the refusal."""
    frame, first, code = FRAMES[name]
    place.daemon.calls.clear()
    with RawWebSocket(place.gateway) as browser:
        browser.send(frame.replace(b"METHOD", method.encode()), first=first)
        assert browser.close_code() == code
    wait_for(lambda: place.daemon.methods == [method], timeout=PROMPT)


@pytest.mark.parametrize(
    ("arguments", "options"),
    [((), {"client": "x" * 81}), ((), {"reason": "door"}), (("hmi",), {})],
    ids=["long name", "unknown keyword", "positional argument"],
)
def test_client_ends_renewal_before_it_complains_about_a_stop(
    place: Place, arguments: tuple[str, ...], options: dict[str, str]
) -> None:
    """Of both clients: the lease is not renewed, as the end of the block does not disarm."""

    async def stop() -> None:
        async with (
            await AsyncClient.connect(place.daemon.socket) as client,
            client.armed("me", lease_s=1.0),
        ):
            with pytest.raises((InputError, TypeError)):
                await client.stop(*arguments, **options)  # type: ignore[arg-type, misc]
            await asyncio.sleep(0)  # a cancelled task ends in the next turn
            assert "lease" not in {task.get_name() for task in asyncio.all_tasks()}

    place.daemon.calls.clear()
    asyncio.run(stop())
    assert place.daemon.methods == ["arm", "stop"]
    with (
        Client.connect(place.daemon.socket) as client,
        client.armed("me", lease_s=1.0),
        pytest.raises((InputError, TypeError)),
    ):
        client.stop(*arguments, **options)  # type: ignore[arg-type, misc]
    assert place.daemon.methods == ["arm", "stop"] * 2


def test_disarm_is_restricted_to_its_lease_whatever_else_is_wrong(place: Place) -> None:
    """Over every transport; a lease that cannot be read restricts nothing."""
    for lease, restricts_to in (("a-lease", "a-lease"), ("", None)):
        form = Form(params=f'{{"lease": "{lease}", "reason": "door open"}}')
        for transport in TRANSPORTS.values():
            place.daemon.calls.clear()
            transport(place, form, "disarm")
            ((_, params),) = place.daemon.calls
            assert params.model_dump()["lease"] == restricts_to


TEXT = st.text(st.characters(codec="utf-8"), max_size=8)
FLOATS = st.floats(allow_nan=False, allow_infinity=False)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | FLOATS | TEXT,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=6,
)
KEYS = TEXT | st.sampled_from(["jsonrpc", "id", "params", "method"])


@given(
    method=st.sampled_from(sorted(SILENCING)),
    members=st.dictionaries(KEYS, VALUES, max_size=5),
    batch=st.lists(VALUES, max_size=2),
    is_batch=st.booleans(),
    position=st.integers(0, 5),
)
def test_any_object_whose_method_silences_silences(
    method: str, members: dict[str, Any], batch: list[Any], is_batch: bool, position: int
) -> None:
    """Whatever else it has, and whatever else is in its batch; it is called once."""
    pairs = [*members.items()]
    pairs = [pair for pair in pairs if pair[0] != "method"]
    pairs.insert(position, ("method", method))
    document: Any = [*batch, dict(pairs)] if is_batch else dict(pairs)
    line = json.dumps(document).encode() + b"\n"

    async def served() -> list[str]:
        api = ServedApi()
        client, _ = api.client()
        await api.takes(client, line)
        return api.names

    assert asyncio.run(served()) == [method]


@given(st.dictionaries(KEYS, VALUES, max_size=5))
def test_no_other_object_silences(members: dict[str, Any]) -> None:
    """Nor does one whose parameters name a method that does."""
    for params in (members.get("params"), {"method": "stop"}, [{"method": "disarm"}]):
        for method in ("touch", "Stop", None, ["stop"], {"method": "stop"}):
            document = members | {"method": method, "params": params}
            assert read_silencing(json.dumps(document).encode()) is None
        members.pop("method", None)
        assert read_silencing(json.dumps(members | {"params": params}).encode()) is None


def test_every_parameter_of_a_method_that_silences_is_optional() -> None:
    """Else it could not be carried out without those that cannot be read."""
    for method in SILENCING:
        assert readable_params(method, None) == METHODS[method].params()


@pytest.mark.parametrize(
    "line", [b"stop", b'"stop"', b'["stop"]', b'{"stop": 1}', b'{"method":"stop']
)
def test_line_that_names_no_method_silences_nothing(line: bytes) -> None:
    """Nor does text that is not JSON and names none."""
    assert read_silencing(line) is None
