"""The API's server: refusals, the order of service, which touches count, and its connections.

Their bounds, to the byte and the request, their turns, counted in requests, and daemons of a later
version; in virtual time.
"""

import asyncio
import contextlib
import json
import re
import socket
from collections import Counter
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, cast
from unittest.mock import Mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.api import server
from controller.api.client import AsyncClient, Client
from controller.api.hub import Hub
from controller.api.jsonrpc import (
    ErrorCode,
    InvalidRequest,
    RpcError,
    error_line,
    read_params,
    read_request,
    request_line,
    result_line,
)
from controller.api.methods import (
    METHODS,
    TOPICS,
    ArmParams,
    ContactsEvent,
    EventParams,
    LogEvent,
    StatusResult,
    SubscribeParams,
)
from controller.api.schema import MAX_RATE, ApiMessage, Empty
from controller.api.server import MAX_UNREAD_BYTES, ApiServer, Connection
from controller.gateway.field import DrawnField
from kit.api_parameters import API_PARAMETERS
from kit.clock import feed, in_virtual_time
from kit.courses import Taken, courses, follow
from processes.daemons import (
    PATIENCE,
    PLACE,
    ServedApi,
    Wire,
    holding,
    request,
    running_daemon,
    serving,
    until_state,
)
from registry import threads

PARAMS = {
    **{name: json.dumps(API_PARAMETERS[name]) for name in ("arm", "hello", "play", "renew")},
    "disarm level": '{"level":2}',
    "effects x": '{"x":1}',
    "renew stop": '{"lease":"stop"}',
    "stop x": '{"x":1}',
    "touch": '{"source":"a","touches":[]}',
    "touch down": '{"source":"a","touches":[{"id":1,"x_m":0.1,"y_m":0.1}]}',
}
"""Parameters of requests by their names, of which the first word is the method."""


def bytes_of(line: str | Mapping[Any, Any]) -> bytes:
    """A request by its name, so many of a line, or raw bytes."""
    if isinstance(line, Mapping):
        ((key, each),) = line.items()
        return each.encode("latin-1") if key == "raw" else key * bytes_of(each)
    name, _, id = line.partition(" #")
    return request(name.split()[0], PARAMS.get(name, "{}"), id=id or None)


@dataclass
class Clients(Taken):
    """Clients of a server in memory, by their names, and what they do; marked: of the calls."""

    served: ServedApi = field(init=False)
    made: dict[str, tuple[Connection, Wire]] = field(default_factory=dict)
    marked: int = 0
    patch: pytest.MonkeyPatch = field(default_factory=pytest.MonkeyPatch)

    def __post_init__(self) -> None:
        """Make the server, which counts time from now on."""
        began = threads.now()
        self.served = ServedApi(clock=lambda: threads.now() - began)

    def of(self, name: str) -> list[tuple[Connection, Wire]]:
        """The client of a name, or those that differ by a number."""
        return [each for key, each in self.made.items() if name in (key, key.rpartition(" ")[0])]

    def connects(self, name: str) -> None:
        """Connect a client."""
        self.connects_of(1, name)

    def connects_of(self, process: int, name: str) -> None:
        """Connect a client of a process."""
        self.made[name] = self.served.client(process=process)

    def connects_many(self, count: int, name: str) -> None:
        """Connect so many more, whose names end in numbers."""
        for _ in range(count):
            self.connects(f"{name} {len(self.made)}")

    def sends(self, name: str, *lines: str | Mapping[Any, Any]) -> None:
        """Let clients send lines at once."""
        for client, _ in self.of(name):
            feed(client, b"".join(map(bytes_of, lines)))

    async def takes(self, name: str, *lines: str | Mapping[Any, Any]) -> None:
        """Do the same for one after the other, and serve what is to be served at once."""
        for client, _ in self.of(name):
            await self.served.takes(client, b"".join(map(bytes_of, lines)))

    async def turns(self, count: int) -> None:
        """Let the event loop turn so often."""
        for _ in range(count):
            await asyncio.sleep(0)

    def hears(self, name: str, *lines: str) -> None:
        """Require the responses to each of some clients since the last that it read."""
        for _, wire in self.of(name):
            found = [
                f"{json.dumps(each['id'])} {each.get('error', {}).get('code', 'result')}"
                for each in wire.lines()
            ]
            assert found == [*lines]

    def reads(self) -> None:
        """Let all clients read, and forget, what was sent to them."""
        for _, wire in self.made.values():
            wire.waiting = b""

    @property
    def sent(self) -> str:
        """All that clients have not read yet."""
        return "".join(wire.waiting.decode() for _, wire in self.made.values())

    def results_fail(self) -> None:
        """Let the result of `status` be one that cannot be sent."""
        self.patch.setattr(StatusResult, "model_dump_json", Mock(side_effect=UnicodeError))

    def ends_its_input(self, name: str) -> None:
        """Let a client close its side."""
        self.made[name][0].eof_received()

    def leaves(self, name: str) -> None:
        """Let a client be gone."""
        client, wire = self.made[name]
        wire.abort()
        client.connection_lost(None)

    def holds_the_lease(self, name: str) -> None:
        """Let a client be its holder."""
        self.served.holder = self.made[name][0]

    def marks(self) -> None:
        """Look at the calls from now on."""
        self.marked = len(self.names)

    @property
    def names(self) -> list[str]:
        """Names of the methods called."""
        return self.served.names

    @property
    def runs(self) -> list[tuple[str, int]]:
        """Names of calls since the mark, and how often in a row."""
        return [(name, len([*some])) for name, some in groupby(self.names[self.marked :])]

    @property
    def open_clients(self) -> Mapping[str, int]:
        """How many are connected of each name, numbers left out."""
        names = [name for name, (client, _) in self.made.items() if client.is_open]
        return Counter(re.sub(r" \d+$", "", name) for name in names)

    @property
    def in_reserve(self) -> list[str]:
        """Clients with a place in reserve."""
        return [name for name, (client, _) in self.made.items() if client.is_reserve]


@asynccontextmanager
async def clients(*, turn: float = 0.0) -> AsyncIterator[Clients]:
    """A server without clients; turn [s]: how long one is, none for a line of each client."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(server, "MAX_TURN", turn)
        found = Clients(patch=patch)
        yield found
        found.served.may_arm.set()
        await found.served.settle()


COURSES = courses(Path(__file__).with_name("served.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_clients_are_served_by_their_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow(COURSES[name], clients)


async def test_connection_that_is_accepted_amid_closing_is_closed(tmp_path: Path) -> None:
    """However far it has come when the server looks at those that are open."""
    for iterations in range(6):
        api = ApiServer({}, on_disconnect=Mock(), holds_lease=lambda client: False)
        bound = socket.socket(socket.AF_UNIX)
        bound.bind(str(tmp_path / f"{iterations}.sock"))
        await api.open(bound)
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(tmp_path / f"{iterations}.sock"))
            for _ in range(iterations):
                await asyncio.sleep(0)
            await api.close()
            client.setblocking(False)
            with suppress(ConnectionResetError):  # it was never accepted
                async with asyncio.timeout(PATIENCE / 6):
                    assert await asyncio.get_running_loop().sock_recv(client, 1) == b""


@pytest.mark.parametrize(
    ("where", "is_called"),
    [("silencing.parse_json", True), ("server.read_params", True), ("the method", False)],
)
async def test_server_stops_although_a_stop_fails_on_its_way(
    monkeypatch: pytest.MonkeyPatch, where: str, is_called: bool
) -> None:
    """A bug in reading its line does not keep it from its method; one in the method stops all.

    Its client is not told of success.
    """
    served = ServedApi()

    def fail(*_: object) -> None:
        raise ZeroDivisionError("a bug")

    if where == "the method":
        served.called = fail
    else:
        monkeypatch.setattr(f"controller.api.{where}", fail)
        monkeypatch.setattr("controller.api.server.read_request", fail)
    client, wire = served.client()
    await served.takes(client, request("stop", id=1))
    assert (served.names, served.stops) == (["stop"], 0 if is_called else 1)
    assert [line["error"]["code"] for line in wire.lines()] == [ErrorCode.INTERNAL]


TOUCH = '{"id":1,"x_m":0.1,"y_m":0.1}'


def test_request_of_the_specification_is_read() -> None:
    """The first example with named parameters of the JSON-RPC 2.0 specification.

    A notification lacks the member id; null is an id. Requests of the client have the same id and
    parameters at the server.
    """
    example = read_request(
        b'{"jsonrpc": "2.0", "method": "subtract", '
        b'"params": {"subtrahend": 23, "minuend": 42}, "id": 3}'
    )
    assert (example.method, example.id, example.expects_response) == ("subtract", 3, True)
    assert example.params == {"subtrahend": 23, "minuend": 42}
    for id, expected in (("", False), (',"id":null', True), (',"id":"a"', True)):
        line = f'{{"jsonrpc":"2.0","method":"stop"{id}}}'.encode()
        assert read_request(line).expects_response is expected
    for params in (
        ArmParams(owner="Zoë", lease_s=5.0),
        SubscribeParams(topics=["state"], rate_hz=None),
        SubscribeParams(topics=["amplifiers", "log"], rate_hz=60.0),
        Empty(),
    ):
        written = read_request(
            request_line(7, "any", params.model_dump_json(exclude_none=True).encode())
        )
        assert written.id == 7
        assert read_params(type(params), written) == params


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (b"", ErrorCode.PARSE),
        (b"hello", ErrorCode.PARSE),
        (b"\xff\xfe", ErrorCode.PARSE),
        (b'{"jsonrpc":"2.0","id":1,"method":"stop"', ErrorCode.PARSE),
        (b'{"jsonrpc":"2.0","id":1,"method":"\\ud800"}', ErrorCode.INVALID_REQUEST),
        (
            request("touch", '{"source":"a","touches":[{"id":1,"x_m":NaN,"y_m":0}]}', id=1),
            ErrorCode.PARSE,
        ),
        (request("arm", '{"owner":"me","lease_s":Infinity}', id=1), ErrorCode.PARSE),
        (b"[" * 60_000, ErrorCode.PARSE),
        (b"1", ErrorCode.INVALID_REQUEST),
        (b"[]", ErrorCode.INVALID_REQUEST),
        (b'[{"jsonrpc":"2.0","id":1,"method":"stop"}]', ErrorCode.INVALID_REQUEST),
        (b"{}", ErrorCode.INVALID_REQUEST),
        (b'{"jsonrpc":"1.0","id":1,"method":"stop"}', ErrorCode.INVALID_REQUEST),
        (b'{"jsonrpc":"2.0","id":1}', ErrorCode.INVALID_REQUEST),
        (b'{"jsonrpc":"2.0","id":1,"method":7}', ErrorCode.INVALID_REQUEST),
        (b'{"jsonrpc":"2.0","id":1.5,"method":"stop"}', ErrorCode.INVALID_REQUEST),
        (b'{"jsonrpc":"2.0","id":true,"method":"stop"}', ErrorCode.INVALID_REQUEST),
        (request("stop", id="1" + "0" * 4000), ErrorCode.INVALID_REQUEST),
        (request("stop", id=f'"{"i" * 81}"'), ErrorCode.INVALID_REQUEST),
        (request("stop", "[1]", id=1), ErrorCode.INVALID_REQUEST),
        (b'{"jsonrpc":"2.0","id":1,"method":"stop","more":1}', ErrorCode.INVALID_REQUEST),
    ],
)
def test_line_that_is_no_request_is_refused(line: bytes, code: ErrorCode) -> None:
    """-32700 for invalid JSON, -32600 for JSON that is not one request with named parameters."""
    with pytest.raises(RpcError) as caught:
        read_request(line)
    assert caught.value.code is code
    assert caught.value.data.remedy


@pytest.mark.parametrize(
    ("line", "id"),
    [
        (b'{"jsonrpc":"1.0","id":7,"method":"stop"}', 7),
        (b'{"id":"a","method":1}', "a"),
        (b'{"jsonrpc":"2.0","id":7,"method":"stop","method":"arm"}', 7),
        (b'{"jsonrpc":"2.0","id":7,"method":"stop","params":{"a":1,"a":1}}', 7),
        (b'{"jsonrpc":"2.0","id":7,"method":"stop","params":{"a":NaN}}', 7),
        (b'{"jsonrpc":"1.0","id":1.5,"method":"stop"}', None),
        (b'{"jsonrpc":"2.0","id":7,"method":"stop"', None),
        (b'[{"id":7}]', None),
    ],
)
def test_invalid_request_is_refused_with_its_id_if_that_can_be_read(
    line: bytes, id: int | str | None
) -> None:
    """JSON that is no request, repeats a key or has NaN; null as JSON-RPC 2.0 has it otherwise."""
    with pytest.raises(InvalidRequest) as caught:
        read_request(line)
    assert caught.value.id == id


@pytest.mark.parametrize(
    ("method", "params", "key"),
    [
        ("arm", "{}", "owner"),
        ("arm", '{"owner":"me","lease_s":0.99}', "lease_s"),
        ("arm", '{"owner":"me","lease_s":61}', "lease_s"),
        ("arm", '{"owner":"me","lease_s":"5"}', "lease_s"),
        ("arm", '{"owner":"me","lease_s":1e999}', "lease_s"),
        ("arm", '{"owner":"me","lease_s":true}', "lease_s"),
        ("arm", '{"owner":"","lease_s":5}', "owner"),
        ("arm", '{"owner":"a\\nb","lease_s":5}', "owner"),
        ("arm", '{"owner":"a\\u001b[2J","lease_s":5}', "owner"),
        ("arm", '{"owner":"a\\u009b2J","lease_s":5}', "owner"),
        ("arm", '{"owner":"a\\u202eb","lease_s":5}', "owner"),
        ("arm", '{"owner":"me","lease_s":5,"level":2}', "level"),
        ("stop", '{"file":"/etc/passwd"}', "file"),
        ("hello", '{"client":"' + "c" * 81 + '"}', "client"),
        ("touch", '{"source":"a","touches":[{"id":1.5,"x_m":0,"y_m":0}]}', "touches.0.id"),
        ("touch", '{"source":"a","touches":[{"id":1,"x_m":null,"y_m":0}]}', "touches.0.x_m"),
        ("touch", '{"source":"a","touches":[{"id":9e99,"x_m":0,"y_m":0}]}', "touches.0.id"),
        ("touch", f'{{"source":"a","touches":[{",".join([TOUCH] * 65)}]}}', "touches"),
        ("subscribe", '{"topics":["weather"]}', "topics.0"),
        ("subscribe", '{"topics":["state"],"rate_hz":61}', "rate_hz"),
        ("subscribe", '{"topics":[]}', "topics"),
    ],
)
def test_parameter_that_is_wrong_is_refused_with_its_key(
    method: str, params: str, key: str
) -> None:
    """-32602 and the key of what is missing, unknown, of another type or out of range."""
    with pytest.raises(RpcError) as caught:
        read_params(METHODS[method].params, read_request(request(method, params, id=1)))
    assert caught.value.code is ErrorCode.INVALID_PARAMS
    assert caught.value.data.where == key
    assert caught.value.data.remedy


def test_response_has_the_members_of_the_specification() -> None:
    """Result and error objects of JSON-RPC 2.0, one line each."""
    assert json.loads(result_line("a", '{"lease":"x"}')) == {
        "jsonrpc": "2.0",
        "id": "a",
        "result": {"lease": "x"},
    }
    error = RpcError(ErrorCode.WRONG_STATE, "the\nplate", where="state", remedy="arm first")
    line = error_line(None, error)
    assert line.count(b"\n") == 1
    assert json.loads(line) == {
        "jsonrpc": "2.0",
        "id": None,
        "error": {
            "code": 1001,
            "message": "the\nplate; arm first",
            "data": {"what": "the\nplate", "where": "state", "remedy": "arm first"},
        },
    }


@given(st.binary(max_size=200))
def test_line_of_any_bytes_is_a_request_or_refused(line: bytes) -> None:
    """Any input gives a request or an RpcError whose response is one line."""
    response = b"{}\n"
    try:
        read_request(line)
    except RpcError as error:
        response = error_line(None, error)
    assert json.loads(response) is not None
    assert response.index(b"\n") == len(response) - 1


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner, max_size=2)
    ),
    max_leaves=4,
)


@given(st.sampled_from(sorted(METHODS)), st.dictionaries(st.text(max_size=8), JSON, max_size=4))
def test_params_of_any_shape_are_valid_or_refused(method: str, params: dict[str, object]) -> None:
    """Any parameters give a message or an RpcError without control characters."""
    line = json.dumps({"jsonrpc": "2.0", "id": 1, "method": method, "params": params})
    text = ""
    try:
        read_params(METHODS[method].params, read_request(line.encode()))
    except RpcError as error:
        text = str(error)
    assert text == "" or text.isprintable()


READY, ENABLED = "READY_TO_SWITCH_ON", "OPERATION_ENABLED"
# keyed by name, not messages: so many levels deep
MAPPINGS = {"drive": 1, "layers": 2, "parameters": 1, "layout": 1}
MAPPINGS |= {"strengths": 1, "rejected_touches": 1, "rejected_examples": 1, "lost_events": 1}


def with_extra_keys(content: Any, mapping_depth: int = 0) -> Any:
    """A message of a later minor version: every object has a further key."""
    if isinstance(content, list):
        return [with_extra_keys(each) for each in content]
    if not isinstance(content, dict):
        return content
    if mapping_depth:
        return {key: with_extra_keys(each, mapping_depth - 1) for key, each in content.items()}
    later = {key: with_extra_keys(each, MAPPINGS.get(key, 0)) for key, each in content.items()}
    return later | {"extra": [{"of": "later"}]}


async def test_extra_keys_of_a_later_minor_version_are_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In results and notifications at every depth: by both clients and by the gateway."""
    made = Connection.connection_made

    def speak_later(connection: Connection, transport: Any) -> None:
        write = transport.write
        transport.write = lambda line: write(
            json.dumps(with_extra_keys(json.loads(line))).encode() + b"\n"
        )
        made(connection, transport)

    def use(path: Path) -> list[str]:
        with Client.connect(path) as era:
            era.subscribe("state")
            seen = [era.status().state, *(event.topic for event in era.events(timeout=0.2))]
            era.effects()
            return seen

    monkeypatch.setattr(Connection, "connection_made", speak_later)
    async with running_daemon(tmp_path) as bench:
        async with await AsyncClient.connect(bench.socket) as era:
            await until_state(era, READY)
            assert await asyncio.to_thread(use, bench.socket) == [READY, "state"]
            field = DrawnField(bench.socket)
            drawing = asyncio.create_task(field.run())
            frames = field.frames()
            empty = await anext(frames)
            await era.subscribe("pattern")
            async with era.armed("me"), holding(era, PLACE), asyncio.timeout(60):
                async for event in era.events():
                    assert "extra" in event.data["contacts"][0]
                    drives = [event.data["drive"], *event.data["layers"].values()]
                    assert all("extra" in tone for drive in drives for tone in drive.values())
                    if event.data["layers"]:
                        break
                drawn = empty
                while len(drawn) == len(empty):
                    drawn = await anext(frames)
        drawing.cancel()
        await asyncio.wait({drawing})


@in_virtual_time
async def test_daemon_sends_exactly_the_documented_keys(tmp_path: Path) -> None:
    """Results and notifications read strictly by the models of the reference page."""
    down = [{"id": 1, "x_m": PLACE[0], "y_m": PLACE[1]}]
    topics = sorted(TOPICS.keys() - {"link", "log"})
    received: set[str] = set()

    async with contextlib.AsyncExitStack() as stack:
        bench = await stack.enter_async_context(running_daemon(tmp_path))
        async with await bench.client() as era:
            await until_state(era, READY)
        reader, writer = await asyncio.open_unix_connection(bench.socket, limit=1 << 20)
        stack.callback(writer.close)

        async def next_response() -> dict[str, Any]:
            """The next response; notifications before it are read strictly."""
            while True:
                content: dict[str, Any] = json.loads(await reader.readline())
                if "method" not in content:
                    return content
                event = EventParams.model_validate(content["params"])
                TOPICS[event.topic].data.model_validate_json(json.dumps(event.data))
                received.add(event.topic)

        async def call(method: str, **params: object) -> None:
            request = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
            writer.write(json.dumps(request).encode() + b"\n")
            response = await next_response()
            assert response.keys() == {"jsonrpc", "id", "result"}, response
            METHODS[method].result.model_validate_json(json.dumps(response["result"]))

        async with asyncio.timeout(60):
            await call("hello", client="me")
            await call("subscribe", topics=topics, rate_hz=60.0)
            assert received == set()  # the reply comes before the first event
            await call("effects")
            await call("arm", owner="me", lease_s=5.0)
            for touches, awaited in ((down, "pattern"), ([], "silence")):
                while awaited not in received:
                    await call("touch", source="me", touches=touches)
                    await call("status")
                    await asyncio.sleep(0.01)
            await call("stop")
            await call("clear")
            while received != set(topics):
                await call("status")
                await asyncio.sleep(0.01)


REQUEST = request("renew", '{"lease":"a"}')


def serve() -> ServedApi:
    """A server that counts time from now on."""
    loop = asyncio.get_running_loop()
    began_at = loop.time()
    return ServedApi(clock=lambda: loop.time() - began_at)


@pytest.fixture(autouse=True)
def one_line_a_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """End turns by the number of lines, as virtual time stands still meanwhile."""
    monkeypatch.setattr(server, "MAX_TURN", 0.0)


async def iterate(count: int) -> None:
    """Run the event loop for some iterations."""
    for _ in range(count):
        await asyncio.sleep(0)


@in_virtual_time
async def test_turn_ends_with_the_line_after_a_tenth_of_a_millisecond(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whose lines take 30 us each: four of ten."""
    lines = 0

    def count(name: str) -> None:
        nonlocal lines
        lines += 1

    monkeypatch.undo()
    monkeypatch.setattr(server.time, "perf_counter", lambda: 30e-6 * lines)
    served = serve()
    served.called = count
    feed(served.client()[0], REQUEST * 10)
    await iterate(3)
    assert lines == 4


def connect(now: Callable[[], float]) -> tuple[Connection, Wire]:
    """A connection to a server with a clock, and its transport."""
    return ServedApi(clock=now).client()


def test_connection_closes_when_unread_responses_exceed_256_kib() -> None:
    """At 256 KiB and a byte; a single response may be longer."""
    connection, wire = connect(lambda: 0.0)
    connection.respond(b"x" * (MAX_UNREAD_BYTES - 1))
    connection.respond(b"\n")
    assert (len(wire.waiting), wire.is_aborted) == (1 << 18, False)
    connection.respond(b"\n")
    assert (len(wire.waiting), wire.is_aborted) == (1 << 18, True)
    connection, wire = connect(lambda: 0.0)
    connection.respond(b"x" * (4 * MAX_UNREAD_BYTES))
    assert (len(wire.waiting), wire.is_aborted) == (1 << 20, False)


async def test_input_of_a_client_is_bounded() -> None:
    """Nothing is read while 64 KiB wait to be served; no line is, beside 64 stops on their way."""
    served, client, wire = serving()
    client.pending = {asyncio.ensure_future(asyncio.sleep(3600)) for _ in range(64)}
    await served.takes(client, request("stop") * 2000)
    assert (served.names, wire.is_read) == ([], False)
    client.pending.pop().cancel()
    await served.takes(client, b"\n")
    assert (served.names, wire.is_read) == (["stop"] * 2000, True)
    for each in client.pending:
        each.cancel()


def test_client_that_does_not_read_loses_notifications_then_the_connection() -> None:
    """Unread output stays bounded, the next event counts the lost ones, then it is closed."""
    now = 0.0
    connection, wire = connect(lambda: now)
    counts: list[int] = []

    def make(lost: int) -> bytes:
        counts.append(lost)
        return b"x" * 1023 + b"\n"

    for _ in range(500):
        connection.notify(make)
    assert (counts, len(wire.waiting)) == ([0] * 128, MAX_UNREAD_BYTES // 2)
    wire.waiting = b""
    connection.notify(make)
    assert counts[-1] == 372
    for now in (0.0, 4.9, 5.1):  # noqa: B007  s, from the first loss on; read by the clock
        assert not wire.is_aborted
        for _ in range(500):
            connection.notify(make)
    assert wire.is_aborted


async def test_hub_survives_an_exception_of_a_producer(caplog: pytest.LogCaptureFixture) -> None:
    """The failure is logged once, outside the topic of the log; later events are sent."""
    hub = Hub({}, clock=lambda: 0.0)
    connection, wire = connect(lambda: 0.0)
    hub.subscribe(connection, ["log", "contacts"])

    def fail() -> ApiMessage:
        raise ZeroDivisionError

    for topic in ("log", "contacts", "log"):
        hub.publish(topic, fail)  # type: ignore[arg-type]
    await asyncio.sleep(0.03)
    assert [hasattr(record, "topic") for record in caplog.records] == [True, True]
    hub.publish("contacts", lambda: ContactsEvent(contacts=[]))
    await asyncio.sleep(0.03)
    assert b'"topic":"contacts"' in wire.waiting
    hub.close()


@in_virtual_time
async def test_hub_sends_the_newest_of_changes_at_most_sixty_times_per_second() -> None:
    """A thousand changes make one event, a sixtieth of a second after the previous one.

    Records of the log are sent one by one, immediately.
    """
    loop = asyncio.get_running_loop()
    hub = Hub({}, clock=loop.time)
    connection, wire = connect(loop.time)
    hub.subscribe(connection, ["contacts", "log"])
    wire.lines()
    made = 0

    def make() -> ApiMessage:
        nonlocal made
        made += 1
        return ContactsEvent(contacts=[])

    async def seconds_until_sent() -> float:
        began_at = loop.time()
        for _ in range(1000):
            hub.publish("contacts", make)
        while not wire.waiting:  # noqa: ASYNC110 - virtual time
            await asyncio.sleep(0.0001)
        topics = [line["params"]["topic"] for line in wire.lines()]
        assert topics == ["contacts"]
        return loop.time() - began_at

    assert await seconds_until_sent() < 0.001
    assert await seconds_until_sent() == pytest.approx(1 / MAX_RATE, abs=0.001)
    await asyncio.sleep(1.0)
    assert await seconds_until_sent() < 0.001
    assert made == 3
    for _ in range(3):
        hub.publish("log", lambda: LogEvent(level="info", message="", cause=None, remedy=None))
    assert [line["params"]["topic"] for line in wire.lines()] == ["log"] * 3
    hub.close()


async def test_hub_sends_each_periodic_topic_at_its_own_rate() -> None:
    """A later subscription to another topic leaves that of the first; both end with the client."""
    hub = Hub({"amplifiers": lambda: None, "latency": lambda: None}, clock=lambda: 0.0)
    connection, _ = connect(lambda: 0.0)
    loop = asyncio.get_running_loop()
    hub.subscribe(connection, ["amplifiers"], rate=2.0)
    hub.subscribe(connection, ["latency"], rate=50.0)
    topics = hub.subscriptions[connection]
    timers = {topic: cast(asyncio.TimerHandle, timer) for topic, timer in topics.items()}
    due = {topic: timer.when() - loop.time() for topic, timer in timers.items()}
    assert due == pytest.approx({"amplifiers": 0.5, "latency": 0.02}, abs=0.015)
    hub.forget(connection)
    assert all(timer.cancelled() for timer in timers.values())
    assert not hub.subscriptions
