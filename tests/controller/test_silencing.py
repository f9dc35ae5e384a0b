"""Requests that silence are carried out whatever is wrong with them, over every transport.

`silencing.yaml` has what may be wrong. The daemon records its calls, the gateway is a process.
"""

import asyncio
import json
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

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
"""Texts in place of these words in the file."""


def filled(text: str, method: str) -> str:
    """A text of the file with a method and long texts in it."""
    for name, long_text in LONG_TEXTS.items():
        text = text.replace(name, long_text)
    escaped = "".join(rf"\u{ord(letter):04x}" for letter in method)
    return text.replace("METHOD", method).replace("ESCAPED", escaped)


@dataclass
class Form:
    """A request in which something is wrong, as in the file."""

    params: str = "{}"
    line: str = '{"jsonrpc": "2.0", "id": 1, "method": "METHOD", "params": PARAMS}'
    client: str | None = None

    def line_of(self, method: str) -> bytes:
        """The request in one line, without its line feed."""
        return filled(self.line.replace("PARAMS", self.params), method).encode()

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


CASES = dict(read_yaml(Path(__file__).with_name("silencing.yaml")))
FORMS = {name: Form(**values) for name, values in CASES["requests"].items()}
HTTP_FORMS: dict[str, dict[str, Any]] = CASES["http"]
FRAMES: dict[str, dict[str, Any]] = CASES["frames"]
JSON_TYPE = "Content-Type: application/json"


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
        self,
        method: str,
        body: bytes,
        *,
        request: str = "POST /api/v1/METHOD HTTP/1.1",
        head: Sequence[str] = (),
        closes: bool = False,
    ) -> tuple[int, str]:
        """Status and error of the gateway; head: in place of type and length of the body."""
        lines = [
            request.replace("METHOD", method),
            f"Host: {self.gateway.host}",
            f"Authorization: Bearer {TOKEN}",
            *(head or [JSON_TYPE, f"Content-Length: {len(body)}"]),
        ]
        with self.gateway.connect() as connection:
            connection.sendall("\r\n".join([*lines, "", ""]).encode() + body)
            if closes:
                connection.shutdown(socket.SHUT_WR)
            with connection.makefile("rb") as received:
                status = int(received.readline().split()[1])
                content = json.loads(received.read(read_length(received)))
                assert not closes or received.read() == b""  # the gateway has closed, too
        return status, content.get("error", "")


def read_length(received: BinaryIO) -> int:
    """Read a head to its end; the length of the body."""
    length = 0
    while line := received.readline().strip():
        name, _, value = line.partition(b": ")
        if name.lower() == b"content-length":
            length = int(value)
    return length


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
    has_arguments = transport.endswith("client")
    is_http = transport.endswith("http")
    for name, form in FORMS.items():
        if has_arguments and form.arguments is None:
            continue
        place.daemon.calls.clear()

        error = TRANSPORTS[transport](place, form, method)

        wait_for(lambda: place.daemon.calls, timeout=PROMPT)
        ((called, params),) = place.daemon.calls
        assert isinstance(params, RequestedBy)
        client = form.client
        if is_http and (client is None or form.params == "{}"):
            client = "http 127.0.0.1"  # of a body that has no name where parameters have it
        assert called == method, name
        assert error, name
        names = (params.client, str(params.client).rpartition(":")[0])  # the gateway adds a port
        assert client in names, name


@pytest.mark.parametrize("method", sorted(SILENCING))
@pytest.mark.parametrize("name", HTTP_FORMS)
def test_http_request_that_silences_is_carried_out_however_it_is_sent(
    place: Place, name: str, method: str
) -> None:
    """If its host, origin and token are right; then its error is reported."""
    form = {"body": "{    }", **HTTP_FORMS[name]}
    status = form.pop("status")
    body = form.pop("body").encode()
    place.daemon.calls.clear()

    assert place.post(method, body, **form)[0] == status

    assert place.daemon.methods == [method]


def test_stop_does_not_wait_for_its_body(place: Place) -> None:
    """Which only names its client; it is answered once the body has come."""
    head = f"POST /api/v1/stop HTTP/1.1\r\nHost: {place.gateway.host}\r\n{JSON_TYPE}\r\n"
    place.daemon.calls.clear()
    with place.gateway.connect() as connection:
        connection.sendall(f"{head}Authorization: Bearer {TOKEN}\r\n".encode())
        connection.sendall(b"Content-Length: 17\r\n\r\n{")
        wait_for(lambda: place.daemon.methods == ["stop"], timeout=PROMPT)
        connection.sendall(b'"client": "hmi"}')
        assert connection.recv(1 << 16)[9:12] == b"200"
    assert place.daemon.methods == ["stop"]


@pytest.mark.parametrize("method", sorted(SILENCING))
@pytest.mark.parametrize("name", FRAMES)
def test_frame_that_silences_is_carried_out_before_it_is_refused(
    place: Place, name: str, method: str
) -> None:
    """The WebSocket is closed with the code of the refusal."""
    frame = FRAMES[name]
    payload = filled(frame["payload"], method).encode("latin-1")
    place.daemon.calls.clear()
    with RawWebSocket(place.gateway) as browser:
        browser.send(payload, first=0x82 if frame.get("is_binary") else 0x81)
        assert browser.close_code() == frame["code"]
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
SCALARS = st.none() | st.booleans() | st.integers() | FLOATS | TEXT


def nested(values: st.SearchStrategy[object]) -> st.SearchStrategy[object]:
    """Lists and objects of JSON values."""
    lists = st.lists(values, max_size=3)
    return lists | st.dictionaries(TEXT, values, max_size=3)


VALUES = st.recursive(SCALARS, nested, max_leaves=6)
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
    pairs = [pair for pair in members.items() if pair[0] != "method"]
    pairs.insert(position, ("method", method))
    request = dict(pairs)
    document = [*batch, request] if is_batch else request
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
    members.pop("method", None)
    for params in (members.get("params"), {"method": "stop"}, [{"method": "disarm"}]):
        documents = [members | {"params": params}]
        for method in ("touch", "Stop", None, ["stop"], {"method": "stop"}):
            documents.append(members | {"method": method, "params": params})
        for document in documents:
            line = json.dumps(document).encode()
            assert read_silencing(line) is None, line


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
